"""The paper's experiments as real, quick runs; what is written, kept and refused."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import Cdmisfa

from cdmisfa.core.blocks import Block, SourceSpec
from cdmisfa.core.config import LearnerConfig
from cdmisfa.experiments.documents import versions
from cdmisfa.experiments.trial import run_oscillatory_trial
from cdmisfa.studies.paper import icub, nonstationary, oscillatory
from cdmisfa.studies.paper.experiment import Experiment, Findings, Trial
from cdmisfa.studies.paper.oscillatory import Oscillatory
from cdmisfa.studies.paper.reproduce import reproduce
from recorder.world.oscillatory import OscillatorySource

ROOT = Path(__file__).parent.parent
SAMPLE = ROOT / "sample_logs" / "icub"


def stability(folder: Path, trials: int = 1, jobs: int = 1) -> tuple[dict[str, Any], list[int]]:
    """The results of an experiment, and how many trials were finished at each report."""
    done: list[int] = []
    document = reproduce(
        "stability", folder, trials=trials, jobs=jobs, progress=lambda n, _: done.append(n)
    )
    return document, done


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """No figures, which take a second each, where they are not looked at."""
    for experiment in (Oscillatory, oscillatory.Stability):
        monkeypatch.setattr(experiment, "draw", lambda self, trials, folder: [])


def judged(experiment: Experiment, trials: list[Trial]) -> Findings:
    result = Findings()
    experiment.evaluate(trials, result)
    return result


@pytest.mark.parametrize("name", ["oscillatory", "five", "stability"])
def test_quick_runs_reproduce_the_claim_and_write_everything(
    name: str, tmp_path: Path, cdmisfa: Cdmisfa
) -> None:
    done = cdmisfa("reproduce", name, "--quick", "-o", tmp_path, "--json")
    assert done.code == 0, done.err
    (document,) = done.json["experiments"]
    folder = tmp_path / name
    assert document["reproduced"] is True
    assert json.loads((folder / "results.json").read_text()) == document
    assert document["versions"] == versions()
    assert document["figures"] == ([] if name == "five" else [f"{name}.png"])
    assert all((folder / figure).stat().st_size > 1000 for figure in document["figures"])
    assert document["trials"] == len((folder / "rows.jsonl").read_text().splitlines())


def test_a_change_is_followed_early_and_not_late(tmp_path: Path) -> None:
    document = reproduce("nonstationary", tmp_path, trials=2, quick=True)
    assert document["claims"][1]["holds"]
    by_sigma = [row[2] for row in document["tables"][0]["rows"]]
    assert by_sigma[0] == "above 0.86"


def test_finished_trials_are_kept_and_figures_are_drawn_alike(tmp_path: Path) -> None:
    first, done = stability(tmp_path)
    assert done == [0, 1, 2]
    picture = (tmp_path / "stability.png").read_bytes()
    assert stability(tmp_path) == (first, [2])
    assert (tmp_path / "stability.png").read_bytes() == picture
    assert stability(tmp_path / "two", jobs=2)[0] == first
    assert stability(tmp_path, trials=2)[1] == [2, 3, 4]


@pytest.mark.usefixtures("undrawn")
def test_a_claim_that_fails_exits_4(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cdmisfa: Cdmisfa
) -> None:
    def unstable(self: Experiment, settings: Any) -> tuple[dict[str, Any], dict[str, Any]]:
        row = {"exploration_ends": 1, "changes": 1, "after": "101"}
        return row, {"R": np.zeros((9, 3)), "policy": np.eye(9, 3, dtype=np.int8)}

    monkeypatch.setattr(oscillatory.Stability, "run", unstable)
    done = cdmisfa("reproduce", "stability", "--trials", 1, "-o", tmp_path)
    assert done.code == 4
    said = "stability is not reproduced: 2.0 keeps its policy after epsilon = 0 (0 of 1 trials)"
    assert done.err.endswith(f"{said}\n")


def trials_with(midpoints: dict[float, float], spread: float = 0.0) -> list[Trial]:
    """A trial a sigma, epsilon^c and each of ten seeds, which turn one after the other."""
    return [
        Trial(
            {"key": "sigma", "value": sigma, "epsilon_c": e, "seed": seed},
            {
                "policy": nonstationary.NEW
                if e > midpoint + spread * (seed - 4.5)
                else nonstationary.OLD,
                "rewarded": 100 if e <= 0.86 else 0,
            },
            {},
        )
        for sigma, midpoint in midpoints.items()
        for e in nonstationary.CHANGES
        for seed in range(10)
    ]


@pytest.mark.parametrize(
    ("midpoints", "holds"),
    [
        ({0.008: 2.0, 0.0009: 0.82, 0.0: 0.7}, [True, True, True, True]),
        ({0.008: 0.7, 0.0009: 0.82, 0.0: 0.9}, [False, True, True, False]),
        ({0.008: 0.95, 0.0: 0.88}, [False, True, True, False]),
    ],
)
def test_the_order_of_table_1_is_judged_where_enough_was_rewarded(
    midpoints: dict[float, float], holds: list[bool]
) -> None:
    result = judged(nonstationary.NonStationary(), trials_with(midpoints))
    assert [claim["holds"] for claim in result.claims] == holds
    assert "Above 0.86 they are fewer than 30" in result.notes[0]
    (table,) = result.tables
    above = [row[2] == "above 0.86" for row in table["rows"]]
    assert above == [midpoint > 0.86 for midpoint in midpoints.values()]


def test_a_module_is_judged_by_frames_after_those_it_learned_from() -> None:
    class Moving(OscillatorySource):
        @property
        def spec(self) -> SourceSpec:
            return dataclasses.replace(super().spec, truth=icub.OBJECTS)

        def take(self, stream: int, n: int) -> Block:
            block = super().take(stream, n)
            return dataclasses.replace(block, truth=block.frames[:, ::-1])

    source = Moving()
    module = run_oscillatory_trial(LearnerConfig(), seed=0, max_modules=1).modules[0]
    first = dataclasses.replace(module, phi=np.eye(5)[:1])
    assert icub.follows(first, source, 5000) == [pytest.approx(0, abs=0.2), pytest.approx(1)]


GOOD = {
    "streams": [0, 2],
    "policies": ["011", "110"],
    "saved_at": [600, 1100],
    "follows": [[0.99, 0.01], [0.02, 0.97]],
    **{key: [0.003, 0.0, 0.001] for key in ("curiosity", "reward")},
    "iterations": 1400,
}
"""A trial on the iCub as it should be."""


def test_icub_figures_and_claims_from_rows(tmp_path: Path) -> None:
    truth = np.linspace(0.4, 0.6, 200)
    arrays = {
        "Q": np.zeros((50, 3, 2), np.float32),
        "policy": np.zeros((50, 3), np.float32),
        "eta_dot": np.full((50, 1), 0.001, np.float32),
        "views": np.zeros((3, 48, 128), np.uint8),
        **{f"{kind}{i}": truth for kind in ("y", "truth") for i in (1, 2)},
    }
    wrong = GOOD | {"streams": [0, 2, 1], "policies": ["011", "110", "101"]}
    vain = GOOD | {"follows": [[0.2, 0.01], [0.02, 0.97]]}
    new, old, loose = ({"algorithm": a, "roc_error": error} for a, error in icub.LEARNERS)
    trials = [Trial(new, GOOD, arrays), Trial(new, GOOD, arrays)]
    trials += [Trial(old, vain, arrays), Trial(loose, vain, arrays)]

    def holds(*more: Trial) -> list[bool]:
        return [c["holds"] for c in judged(icub.Icub(), [*trials, *more]).claims]

    assert holds() == [True] * 6
    assert holds(Trial(new, wrong, arrays)) == [True, True, False, True, True, True]
    assert holds(Trial(new, vain, arrays)) == [True, False, True, True, True, True]
    assert not holds(Trial(old, GOOD, arrays), Trial(old, GOOD, arrays))[5]
    rows = judged(icub.Icub(), trials).tables[0]["rows"]
    assert [row[1:3] for row in rows[1:]] == [["1 of 1", "**0 of 1**"]] * 2
    assert len(icub.Icub().draw(trials, tmp_path)) == 3
