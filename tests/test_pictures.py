"""The code that draws the pictures of the pages draws every tab there is."""

from __future__ import annotations

import runpy
from pathlib import Path
from typing import Any

import pytest
from run_data import IMAGE, VECTOR, write_run
from test_overlay import three

from replay.runs.compare import side_by_side
from replay.runs.run import read_outline
from replay.view import overlay
from replay.view.build import recording_layout
from replay.view.panels import run_layout

IMAGES = Path(__file__).parents[1] / "docs" / "images"

__all__ = ["three"]


@pytest.fixture(scope="module")
def code() -> dict[str, Any]:
    return runpy.run_path(str(IMAGES / "draw.py"))


def tabs(layout: Any) -> set[str]:
    return {tab.name for tab in layout.root_container.contents}


def drawn(code: dict[str, Any], *sources: str) -> set[str]:
    return {tab for source, tab, *_ in code["VIEWS"].values() if source in sources}


def test_every_tab_of_a_run_is_drawn(code: dict[str, Any], tmp_path: Path) -> None:
    for algorithm, sources in {
        "2.0": ("icub", "seed0", "progress"),
        "progress": ("progress", "cameras", "icub", "seed0"),
    }.items():
        folder = tmp_path / algorithm
        folder.mkdir()
        learner = {"algorithm": algorithm, "settled": 0.05, "agreement": 0.25}
        write_run(folder / "run.mcap", IMAGE, 3, learner=learner)
        shown = run_layout(read_outline(folder))
        assert tabs(shown) <= drawn(code, *sources)


def test_every_tab_of_a_recording_and_of_a_comparison_is_drawn(
    code: dict[str, Any], three: Any
) -> None:
    assert tabs(recording_layout(VECTOR, 10, has_scene=True)) == drawn(code, code["SAMPLE"])
    runs, _ = three
    layout = overlay._layout(side_by_side(runs), ["a"], ["a/learning_error/1_x1"], None)
    assert tabs(layout) == drawn(code, *code["COMPARED"])


def test_what_is_drawn_is_there(code: dict[str, Any]) -> None:
    names = {path.stem for path in IMAGES.glob("*.png")}
    assert names == {*code["VIEWS"], *code["REPORTS"], "scene"}
