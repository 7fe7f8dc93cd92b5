"""Reports of runs: one HTML file each, which opens in a browser without any other file."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from replay.palette import CYCLE, STATE_COLOURS
from replay.report.figures import colour_class, curves, timeline
from replay.report.run_data import RunData
from replay.report.run_page import cli_command, run_content
from replay.report.svg_plot import number
from replay.runs.compare import side_by_side

# Size of a page that mail programs still send and phones still open.
MOST_BYTES = 2_000_000

# Watched frames to keep: fewer if the page would be too large.
FRAMES = (192, 96, 48, 24, 12)

# Signals that the page of several runs draws over each other.
CURVES = {
    "learning_error": "Learning error of the attended stream",
    "eta_dot": "Change of slowness |η̇| of output 1 [cycles/frame]",
    "tested": "Slowness of the attended stream on new frames [cycles/frame]",
    "share": "Share of recent blocks that are novel and of one stream",
    "epsilon": "Probability of a random action ε",
}


def report_of_run(path: Path, reproducible: str, again: str) -> tuple[str, list[str]]:
    """Return the page of a run, and a sentence for each damage of its files.

    Args:
        path: folder or log of the run.
        reproducible: whether learning it again is expected to give the same bits.
        again: the command that learns it again.

    Raises:
        UsageError: the run does not exist.
        LogDamagedError: not even its header can be read.
    """
    page = ""
    for frames in FRAMES:
        data = RunData(path, frames)
        page = rendered(run_content(data, reproducible, again))
        if len(page.encode()) < MOST_BYTES:
            break
    return page, data.damage


def report_of_runs(paths: Sequence[Path], title: str) -> str:
    """Return the page that compares runs with the first of them.

    Raises:
        UsageError: a path is not a run.
        LogDamagedError: the log of a run cannot be read.
    """
    rows = side_by_side(paths)
    outlines = [row.outline for row in rows]
    powers = ("learning_error", "eta_dot", "tested")  # these fall over several powers of ten
    plots = [curves(name, outlines, about, log=name in powers) for name, about in CURVES.items()]
    return rendered(
        {
            "kind": "runs",
            "title": title,
            "lead": f"{len(rows)} runs; {sum(row.difference is None for row in rows[1:])} of "
            f"{len(rows) - 1} have the same signals as the first, bit for bit",
            "rows": [(colour_class(place), *row.cells()) for place, row in enumerate(rows)],
            "explained": [line for row in rows for line in row.explanation().splitlines()],
            "curves": [plot for plot in plots if plot is not None],
            "timelines": [
                (row.name, timeline(row.outline), cli_command("report", path))
                # More timelines would make the page too large.
                for path, row in zip(paths[:24], rows, strict=False)
                if row.outline.iterations
            ],
            "compare": cli_command("compare", *paths, "--save", "both.rrd")
            if len(paths) < 5
            else "",
            "frames": {},
        }
    )


def rendered(content: Mapping[str, Any]) -> str:
    """Return a page: page.html around the template that `kind` names."""
    environment, style, script = _templates()
    policy = (
        "default-src 'none'; img-src data:; "
        f"style-src 'sha256-{_digest(style)}'; script-src 'sha256-{_digest(script)}'; "
        "base-uri 'none'; form-action 'none'"
    )
    return environment.get_template("page.html").render(
        policy=policy, style=Markup(style), script=Markup(script), **content
    )


@lru_cache
def _templates() -> tuple[Environment, str, str]:
    """Return the templates, the style and the script of every page."""
    loader = PackageLoader("replay.report", ".")
    environment = Environment(
        loader=loader,
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"number": number, "command": cli_command, "thousands": "{:,}".format}
    style, script = (loader.get_source(environment, name)[0] for name in ("page.css", "page.js"))
    for kind, variable, colours in (("c", "--c", CYCLE), ("state", "--s", STATE_COLOURS)):
        style += "".join(
            f".{kind}{i}{{{variable}:#{r:02x}{g:02x}{b:02x}}}"
            for i, (r, g, b) in enumerate(colours)
        )
    return environment, style, script


def _digest(text: str) -> str:
    return base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
