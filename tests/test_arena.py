"""The arena in benchmarks/: its sets, its rules, known answers of its measures, and a small run."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.arena.comparison import LEARNERS, main
from benchmarks.arena.judging import Course, Saved, judge, probe
from benchmarks.arena.rules import RULES
from benchmarks.arena.streams import ArenaSource
from cdmisfa.agents.progress.attention import ERROR_BLOCKS, Situation

WORDS = ("x1", "x2", "vector-noise")
TERMS = (5, "quadratic")


def test_modules_are_judged_against_batch_sfa() -> None:
    source = ArenaSource(WORDS, 0)
    good, _ = source.reference("x1", *TERMS)
    fast = dataclasses.replace(good, phi=np.eye(1, good.phi.shape[1], 1))  # the fast cosine

    def judged(*saved: Saved) -> dict[str, Any]:
        watched = [(40 * k, k % 3) for k in range(99)]
        return judge(Course([*saved], watched, {2: 13}, ended=True), source, *TERMS)

    row = judged(Saved(good, 0, "x1", True, 10), Saved(good, 2, "vector-noise", False, 20))
    assert row["targets"] == {"x1 0": 10, "x2 0": None}
    assert (row["learned"], row["all learned"], row["blocks"]) == (0.5, None, 99)
    assert (row["noise"], row["noise learned"], row["noise told"]) == (["vector-noise"], 1, 13)
    assert row["in vain"] == pytest.approx(1 / 3)
    assert row["R2"] == pytest.approx(1.0, abs=1e-3)
    row = judged(Saved(fast, 0, "x1", True, 10), Saved(good, 0, "x1", True, 30))
    assert (row["targets"]["x1 0"], row["twice"]) == (30, 1)


def test_a_probe_tells_what_is_in_the_features_and_no_more() -> None:
    rng = np.random.default_rng(0)
    features = rng.standard_normal((40000, 3))
    linear = features @ [[1.0], [2.0], [-0.5]]
    hidden, still = rng.standard_normal((40000, 1)), np.ones((40000, 1))
    assert probe(features, linear) == pytest.approx(1.0, abs=1e-5)
    assert probe(features, linear + 2.2913 * hidden) == pytest.approx(0.5, abs=0.03)
    assert probe(features, hidden) == pytest.approx(0.0, abs=0.01)
    assert probe(features, np.hstack([linear, still])) == pytest.approx(1.0, abs=1e-5)
    assert probe(np.zeros((40000, 1)), linear) == 0.0


def test_a_small_arena(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main(["oscillatory-noise", "--learners", "progress,alp", "--seeds", "0:1", "-o", str(tmp_path)])
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[:4] for line in lines[1:]] == [
        ["oscillatory-noise", name, "1", "1.00"] for name in ("progress", "alp")
    ]
    rows = json.loads((tmp_path / "results.json").read_text())["rows"]
    assert [row["noise learned"] for row in rows] == [0, 0]
    assert {*RULES} <= {*LEARNERS}


FALLS = np.r_[np.full(8, 2.0), np.full(8, 1.0)]
EVEN = np.full(ERROR_BLOCKS, 1.5)
NOT_YET = np.full(ERROR_BLOCKS, np.nan)


@pytest.mark.parametrize(
    ("name", "told", "draw", "chosen"),
    [
        ("robin", {"stream": 1, "learning": [1, 1, 0, 1]}, 0.5, 3),
        ("robin", {"stream": 3, "learning": [0, 0, 1, 0]}, 0.5, 2),
        ("robin", {"stream": 3, "learning": [0, 0, 0, 0]}, 0.5, 0),
        ("alp", {"errors": [EVEN, FALLS, EVEN, FALLS[::-1]]}, 0.3, 1),
        ("alp", {"errors": [EVEN, FALLS, EVEN, FALLS[::-1]]}, 0.7, 3),
        ("alp", {"errors": [EVEN, FALLS, EVEN[:3], EVEN]}, 0.3, 2),
        ("lpm", {"surprise": [EVEN, FALLS[::-1], FALLS, EVEN]}, 0.5, 2),
        ("lpm", {"surprise": [EVEN, FALLS, NOT_YET, EVEN]}, 0.5, 2),
        ("prediction", {"surprise": [EVEN, FALLS, 2 * EVEN, EVEN]}, 0.5, 2),
        ("rnd", {"surprise": [2 * EVEN, FALLS, EVEN, EVEN], "learning": [0, 1, 1, 1]}, 0.5, 2),
    ],
)
def test_rules_choose_what_they_are_for(
    name: str, told: dict[str, Any], draw: float, chosen: int
) -> None:
    situation = Situation(
        stream=told.get("stream", 0),
        learning=np.array(told.get("learning", [1] * 4), bool),
        changed=np.zeros(4, bool),
        errors=dict(enumerate(told.get("errors", ()))),
        visits=np.full(4, 9),
        draws=np.array([draw, draw]),
        explore=0.1,
    )
    assert RULES[name](situation, np.array(told.get("surprise", np.empty((4, 0)))))[0] == chosen
