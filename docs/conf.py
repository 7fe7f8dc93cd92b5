"""How Sphinx makes the site of the pages in this folder: `make docs`."""

from __future__ import annotations

import dataclasses
import importlib
import inspect
import json
import re
import shutil
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path
from typing import Any

import cdmisfa
from cdmisfa.cli import interrupts
from cdmisfa.core import errors
from cdmisfa.core.signals import SIGNALS
from cdmisfa.experiments.documents import markdown
from replay.viewer import HOST, Program, free_port

SAMPLES = Path(__file__).parents[1] / "sample_logs"

project = "cdmisfa"
author = copyright = "the maintainers of cdmisfa"
version = release = metadata.version("cdmisfa")

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx_click",
    "sphinx_copybutton",
]
html_theme = "furo"
html_favicon = "images/icon.svg"
html_title = f"cdmisfa {release}"
html_show_sourcelink = False
smartquotes = False
highlight_language = "none"
myst_heading_anchors = 4
napoleon_use_ivar = True
templates_path = ["templates"]
copybutton_prompt_text = "$ "
copybutton_exclude = ".linenos"
exclude_patterns = ["decisions", "images/README.md"]

# Pages of the former outline: they leave with the page that takes their place.
exclude_patterns += ["tutorials"]
suppress_warnings = ["toc.not_included", "myst.xref_missing"]

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


def words_as_written(*event: Any) -> None:
    """Docstrings and help are text, not reStructuredText: stars and underscores are themselves."""
    lines, code = event[-1], False
    for at, line in enumerate(lines):
        code = code and (not line or line[0] == " ")
        if code:
            continue
        words = re.split(r"(`+[^`]+`+)", line)
        words[::2] = [re.sub(r"\*|_(?=\W|$)", r"\\\g<0>", word) for word in words[::2]]
        words[1::2] = [f"``{word.strip('`')}``" for word in words[1::2]]
        lines[at] = "".join(words)
        if line.endswith(":") and lines[at + 1 : at + 2] == [""] and lines[at + 2][:1] == " ":
            lines[at], code = lines[at] + ":", True


def from_code(app: Any, name: str, text: list[str]) -> None:
    """Replace lines such as {{ keys module.Class }} by tables."""
    text[0] = text[0].replace("../README.md)", "index.md)")
    tables = {"keys": keys, "exit_codes": exit_codes, "signals": signals}
    text[0] = re.sub(
        r"^\{\{ (\w+) ?(.*) \}\}$",
        lambda match: tables[match[1]](*match[2].split()),
        text[0],
        flags=re.MULTILINE,
    )


def keys(name: str) -> str:
    """A section's keys: the fields of its dataclass, with their defaults and docstrings."""
    module, _, of = name.rpartition(".")
    section = getattr(importlib.import_module(module), of)
    return markdown(["key", "default", "meaning"], list(_keys("", section())))


def _keys(prefix: str, section: Any) -> Iterator[list[str]]:
    told = "\n".join(inspect.getdoc(each) or "" for each in reversed(type(section).__mro__))
    for field in dataclasses.fields(section):
        value, key = getattr(section, field.name), prefix + field.name
        if dataclasses.is_dataclass(value):
            yield from _keys(f"{key}.", value)
            continue
        meaning = re.findall(rf"^    {field.name}: (.*(?:\n {{8}}.*)*)", told, re.MULTILINE)[-1]
        default = "auto" if value is None else json.dumps(value).strip('"')
        yield [f"`{key}`", f"`{default}`", " ".join(meaning.split())]


def exit_codes() -> str:
    """What a command ends with: the errors of the library, and signals."""
    kinds = [errors.CdmisfaError, *errors.CdmisfaError.__subclasses__()]
    kinds = [kind for kind in kinds if kind.__module__ == errors.__name__]
    rows = [("0", "It is done.")]
    rows += sorted((str(e.exit_code), (e.__doc__ or "").partition("\n")[0]) for e in kinds)
    rows += [(str(128 + s), f"A signal ended it: {s.name}.") for s in interrupts.SIGNALS]
    return markdown(["code", "what it says"], rows)


def signals() -> str:
    """Return the table of the signals that every run records."""
    columns = ("name", "symbol", "equation", "unit", "dims", "dtype", "about")
    rows = [[getattr(signal, column) for column in columns] for signal in SIGNALS.values()]
    return markdown(columns, [[f"`{name}`", *cells] for name, *cells in rows])


def link_within_the_site(app: Any, path: Path, page: str, text: list[str]) -> None:
    """Make links of the files beside docs/, such as README, links of the site."""
    pages = {
        "README.md": "/index.md",
        "CONTRIBUTING.md": "/project/contributing.md",
        "CHANGELOG.md": "/project/changelog.md",
        "SECURITY.md": "/evidence/security.md",
    }
    text[0] = text[0].replace("](docs/", "](/")
    for name, address in pages.items():
        text[0] = text[0].replace(f"]({name}", f"]({address}")


def add_the_viewer(app: Any, failure: Exception | None) -> None:
    """Put Rerun's page beside the runs, with a policy by which it asks nobody else."""
    folder = Path(app.outdir) / "_static" / "viewer"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    port = free_port()
    page = f"http://{HOST}:{port}/"
    with Program("--serve-web", "--web-viewer-port", str(port), page):
        for file in VIEWER:
            (folder / file).write_bytes(_fetched(page + file.replace("index.html", "")))
    page = (folder / "index.html").read_text("utf-8")
    opened = (
        'location.search || history.replaceState(null, "", "?url=" + '
        'encodeURIComponent(new URL("run.rrd", location)))'
    )
    policy = (
        f'<meta http-equiv="Content-Security-Policy" content="{POLICY}"><script>{opened}</script>'
    )
    (folder / "index.html").write_text(page.replace("<head>", f"<head>{policy}", 1), "utf-8")
    run = cdmisfa.learn(SAMPLES / "icub", algorithm="progress", loop=True)
    run.view(folder / "run.rrd")
    run.report(folder / "report.html")


def _fetched(address: str) -> bytes:
    for _ in range(200):
        try:
            with urllib.request.urlopen(address) as answer:
                return bytes(answer.read())
        except urllib.error.URLError:  # it is starting
            time.sleep(0.1)
    raise OSError(f"{address} does not answer")


def setup(app: Any) -> None:
    app.connect("autodoc-process-docstring", words_as_written, priority=100)
    for part in ("description", "arguments", "options", "epilog"):
        app.connect(f"sphinx-click-process-{part}", words_as_written)
    app.connect("source-read", from_code)
    app.connect("include-read", link_within_the_site)
    app.connect("build-finished", add_the_viewer)
