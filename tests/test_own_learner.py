"""A learner of the user, named as package.module:Class: learned with, checked, resumed, refused."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from conftest import Cdmisfa
from contracts.learners import LearnerContract

from cdmisfa.agents.learners import learner_class
from cdmisfa.core.blocks import SourceSpec
from cdmisfa.core.learning import Learner
from cdmisfa.experiments.store import read_trial_rows
from cdmisfa.experiments.sweep import plan, sweep

ROOT = Path(__file__).parents[1]
OWN = "watcher:Watcher"


@pytest.fixture(autouse=True)
def _found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(ROOT / "examples")


class TestWatcher(LearnerContract):
    def open(self, spec: SourceSpec, seed: int) -> Learner:
        watcher = learner_class(OWN)
        return watcher(watcher.configuration(), spec, seed)


def test_it_learns_is_checked_and_resumed(cdmisfa: Cdmisfa, tmp_path: Path) -> None:
    words = ("learn", "oscillatory", "--algorithm", OWN, "--set", "learner.patience=9")
    words = (*words, "--no-rerun", "--json")
    whole = cdmisfa(*words, "-o", tmp_path / "whole").json
    assert (whole["iterations"], whole["frames"], whole["ended"]) == (9, 270, "nothing_left")
    assert cdmisfa("check", tmp_path / "whole", "--json").json["identical"]
    cdmisfa(*words, "-o", tmp_path / "parts", "--max-iterations", 4)
    resumed = cdmisfa("learn", "--resume", "-o", tmp_path / "parts", "--max-iterations", 9).code
    assert resumed == 0
    result = json.loads((tmp_path / "parts" / "run.json").read_text())["result"]
    assert result["signals_sha256"] == whole["signals_sha256"]
    assert result["mean"] == whole["mean"]


def test_a_sweep_uses_it_and_knows_its_code(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = (f"learner.algorithm={OWN}", "learner.patience=4")
    grid = {"learner.tau": [10, 20]}
    sweep("oscillatory", tmp_path / "swept", seeds=[0], settings=settings, grid=grid, jobs=2)
    rows = read_trial_rows(tmp_path / "swept")
    assert sorted(row["result"]["frames"] for row in rows) == [40, 80]
    planned = [plan(["oscillatory"], grid={}, seeds=[0], settings=settings)[0].id for _ in range(2)]
    monkeypatch.setattr("inspect.getfile", lambda found: __file__)
    other = plan(["oscillatory"], grid={}, seeds=[0], settings=settings)[0].id
    assert planned[0] == planned[1] != other


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("nowhere:Watcher", "No module named 'nowhere'): install its package, or name its folder"),
        ("watcher:Wacher", "module 'watcher' has no attribute 'Wacher')"),
        ("progess", "did you mean progress?"),
    ],
)
def test_what_is_no_learner_is_one_line(cdmisfa: Cdmisfa, name: str, words: str) -> None:
    refused = cdmisfa("learn", "oscillatory", "--algorithm", name)
    assert (refused.code, refused.err.count("\n")) == (2, 1)
    assert words in refused.err
