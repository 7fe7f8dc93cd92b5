"""Runs of the gallery: made from the blocks of its page, shown as reports and in Rerun's viewer."""

from __future__ import annotations

import contextlib
import io
import re
import runpy
import shutil
import time
import urllib.error
import urllib.request
from pathlib import Path

import pyarrow.parquet as pq

from cdmisfa.cli import run
from cdmisfa.experiments.documents import markdown
from replay.viewer import HOST, Program, free_port

PAGE = Path(__file__).with_name("gallery.md")
SAMPLES = Path(__file__).parents[1] / "sample_logs"

# The run that the site shows in Rerun's viewer: its view has less than 5 MB.
VIEWED = "photographs"

# Rerun's page asks other hosts for fonts, examples and newer versions, and reports to its makers.
POLICY = "; ".join(
    (
        "default-src 'self'",
        "script-src 'self' 'unsafe-inline' 'wasm-unsafe-eval' blob:",
        "style-src 'self' 'unsafe-inline'",
        "img-src 'self' data: blob:",
        "worker-src 'self' blob:",
        "connect-src 'self' data: blob:",
        "base-uri 'none'",
        "form-action 'none'",
    )
)
VIEWER = ("index.html", "re_viewer.js", "re_viewer_bg.wasm", "favicon.ico")


def make_runs(folder: Path) -> None:
    """Run the blocks of the page in a folder: `$ cdmisfa` lines and Python.

    Paths are relative to the folder, so that commands in the reports can be copied.
    """
    (folder / "sample_logs").symlink_to(SAMPLES)
    blocks = re.findall(r"^```(console|python)\n(.*?)^```$", PAGE.read_text("utf-8"), re.M | re.S)
    with contextlib.chdir(folder), contextlib.redirect_stdout(io.StringIO()):
        for language, block in blocks:
            if language == "python":
                Path("block.py").write_text(block, encoding="utf-8")
                runpy.run_path("block.py")
                continue
            for line in re.findall(r"^\$ cdmisfa (.*)$", block, re.M):
                if code := run(["-q", *line.split()]):
                    raise SystemExit(f"cdmisfa {line} ended with {code}")


def index_table(folder: Path) -> str:
    """Return the index of the page's folder as a table, with a row for each stream of images."""
    columns = ["path", "topic", "schema", "shape", "messages", "rate", "seconds", "state"]
    rows = pq.read_table(folder / "logs.parquet", columns=columns).to_pylist()
    return markdown(columns, [["" if c is None else c for c in row.values()] for row in rows])


def add_reports(folder: Path, site: Path) -> None:
    """Put the report of each run into the site."""
    for report in sorted(folder.glob("runs/*/report.html")):
        target = site / "reports" / f"{report.parent.name}.html"
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(report, target)


def add_viewer(folder: Path, site: Path) -> None:
    """Put Rerun's page with one run into the site; its policy lets it ask no other host."""
    target = site / "viewer"
    target.mkdir(parents=True, exist_ok=True)
    port = free_port()
    address = f"http://{HOST}:{port}/"
    with Program("--serve-web", "--web-viewer-port", str(port), address):
        for file in VIEWER:
            (target / file).write_bytes(_fetched(address + file.replace("index.html", "")))
    opened = (
        'location.search || history.replaceState(null, "", "?url=" + '
        'encodeURIComponent(new URL("run.rrd", location)))'
    )
    policy = (
        f'<meta http-equiv="Content-Security-Policy" content="{POLICY}"><script>{opened}</script>'
    )
    page = (target / "index.html").read_text("utf-8")
    (target / "index.html").write_text(page.replace("<head>", f"<head>{policy}", 1), "utf-8")
    shutil.copyfile(folder / "runs" / VIEWED / "run.rrd", target / "run.rrd")


def _fetched(address: str) -> bytes:
    for _ in range(200):
        try:
            with urllib.request.urlopen(address) as answer:
                return bytes(answer.read())
        except urllib.error.URLError:  # it is starting
            time.sleep(0.1)
    raise OSError(f"{address} does not answer")
