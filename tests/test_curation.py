"""The measure of curation: known answers, and a page that its results make."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks.curation import page
from benchmarks.curation.choosing import farthest, judged
from benchmarks.curation.planting import Event, Planted
from benchmarks.curation.worlds import WORLDS


def test_what_was_chosen_is_judged_by_what_was_planted() -> None:
    frames = {name: np.zeros((100, 2, 2), np.uint8) for name in ("a", "b", "a-again", "noise")}
    events = [Event("a", "fast", 10, 50), Event("b", "light", 0, 40)]
    planted = Planted(frames, events, ["noise"], {"a-again": "a"}, frames["a"])
    chosen = {name: np.zeros(100, bool) for name in frames}
    chosen["a"][20:40] = chosen["a-again"][20:50] = chosen["noise"][:10] = True
    chosen["b"][30:50] = True
    assert judged(planted, chosen) == {
        "found": [["fast", True], ["light", False]],
        "precision": (30 + 10) / 80,
        "noise": 10 / 80,
        "twice": 20 / 80,
        "seconds": 4.0,
    }


def test_the_farthest_is_next() -> None:
    features = np.array([[0.0], [1.0], [10.0], [4.0]])
    assert farthest(features, np.zeros((0, 1))) == [3, 2, 0, 1]
    assert farthest(features, np.array([[9.0]])) == [0, 3, 1, 2]


def test_the_page_is_what_its_results_make(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    written = page.PAGE.read_text("utf-8")
    monkeypatch.setattr(page, "PAGE", tmp_path / page.PAGE.name)
    page.write_page()
    assert (tmp_path / page.PAGE.name).read_text("utf-8") == written
    assert (tmp_path / "curation" / "curation.png").stat().st_size > 10_000


def test_results_are_of_every_world_and_event() -> None:
    trials = json.loads((page.RESULTS / "curation.json").read_text("utf-8"))["trials"]
    for group, worlds in WORLDS.items():
        for name, world in worlds.items():
            own = [trial for trial in trials if (trial["group"], trial["world"]) == (group, name)]
            kinds = {kind for trial in own for kind, _ in trial["means"]["curate"]["found"]}
            assert kinds == {*world.events}
