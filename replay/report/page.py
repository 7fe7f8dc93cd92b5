"""Reports as HTML: one file that asks no other for anything."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from replay.palette import CYCLE
from replay.palette import STATES as STATE_COLOURS
from replay.report.content import run_content
from replay.report.several import runs_content
from replay.report.told import read_told
from replay.report.trust import Proof

MOST_BYTES = 2_000_000
"""Of a page."""

DETAIL = (192, 96, 48, 24, 12)
"""Frames that are kept of what was watched: fewer where the page would be too large."""


def report_of_run(path: Path, proof: Proof | None = None) -> str:
    """The page of a run.

    Args:
        path: its folder, or its log.
        proof: whether it can be learned again, where that was asked.

    Raises:
        UsageError: there is no such run.
        LogDamagedError: not even its head can be read.
    """
    page = ""
    for frames in DETAIL:
        page = rendered(run_content(read_told(path, frames=frames), proof))
        if len(page.encode()) < MOST_BYTES:
            break
    return page


def report_of_runs(
    paths: Sequence[Path],
    title: str,
) -> str:
    """Return the page that compares runs.

    Args:
        paths: of the runs, the first of which the others are compared with.
        title: of the page.

    Raises:
        UsageError: one is no run.
        LogDamagedError: one cannot be read.
    """
    return rendered(runs_content(paths, title))


def rendered(content: Mapping[str, Any]) -> str:
    """A page of the template that `kind` names."""
    environment, style, script = _page()
    template = environment.get_template("page.html")
    policy = (
        "default-src 'none'; img-src data:; "
        f"style-src 'sha256-{_digest(style)}'; script-src 'sha256-{_digest(script)}'; "
        "base-uri 'none'; form-action 'none'"
    )
    return template.render(policy=policy, style=Markup(style), script=Markup(script), **content)


@lru_cache
def _page() -> tuple[Environment, str, str]:
    """The templates, the style and the script of every page."""
    loader = PackageLoader("replay.report", ".")
    environment = Environment(
        loader=loader,
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    style, script = (loader.get_source(environment, name)[0] for name in ("page.css", "page.js"))
    colours = "".join(f".c{i}{{--c:#{r:02x}{g:02x}{b:02x}}}" for i, (r, g, b) in enumerate(CYCLE))
    states = "".join(
        f".state{i}{{--s:#{r:02x}{g:02x}{b:02x}}}" for i, (r, g, b) in enumerate(STATE_COLOURS)
    )
    return environment, f"{style}{colours}{states}", script


def _digest(text: str) -> str:
    return base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
