"""The paper's experiments as real, quick runs; what is written, kept and refused."""

from __future__ import annotations

import contextlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import Cdmisfa

from cdmisfa.core.config import LearnerConfig
from cdmisfa.core.errors import UsageError
from cdmisfa.experiments.documents import versions
from cdmisfa.experiments.trial import run_trial
from cdmisfa.studies.paper import difficulty, icub, nonstationary, oscillatory
from cdmisfa.studies.paper.experiment import Experiment, Findings, Request, Trial
from cdmisfa.studies.paper.oscillatory import Oscillatory, paper_config
from cdmisfa.studies.paper.reproduce import markdown_table, reproduce
from recorder.world.oscillatory import OscillatorySource
from replay.recordings.source import RecordedSource

SAMPLE = Path(__file__).parent.parent / "sample_logs" / "icub"


def stability(folder: Path, trials: int = 1, jobs: int = 1) -> tuple[dict[str, Any], list[int]]:
    """The results of an experiment, and how many trials were finished at each report."""
    done: list[int] = []
    request = Request(trials, True, None, folder, jobs)
    return reproduce("stability", request, progress=lambda n, _: done.append(n)), done


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """No figures, which take a second each, where they are not looked at."""
    for experiment in (Oscillatory, oscillatory.Stability):
        monkeypatch.setattr(experiment, "draw", lambda self, trials, folder: [])


def judged(experiment: Experiment, trials: list[Trial]) -> Findings:
    found = Findings()
    experiment.evaluate(trials, found)
    return found


@pytest.mark.parametrize("name", ["oscillatory", "five", "stability", "costs", "difficulty"])
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
    assert (folder / "table.md").read_text().startswith("| quantity | paper | ours |")
    drawn = set() if name in ("five", "costs") else {".png", ".svg"}
    assert {Path(f).suffix for f in document["figures"]} == drawn
    assert all((folder / figure).stat().st_size > 1000 for figure in document["figures"])
    parquet = pytest.importorskip("pyarrow.parquet")
    assert parquet.read_table(folder / "rows.parquet").num_rows == document["trials"]


def test_a_change_is_followed_early_and_not_late(tmp_path: Path) -> None:
    document = reproduce("nonstationary", Request(1, True, None, tmp_path))
    assert [claim["holds"] for claim in document["claims"][:2]] == [True, True]


def test_finished_trials_are_kept_and_the_page_shows_table_and_figures(
    tmp_path: Path, cdmisfa: Cdmisfa
) -> None:
    folder = tmp_path / "r" / "stability"
    first, done = stability(folder)
    assert done == [0, 1, 2]
    pictures = {f: (folder / f).read_bytes() for f in first["figures"]}
    assert stability(folder) == (first, [2])
    assert {f: (folder / f).read_bytes() for f in first["figures"]} == pictures
    page = tmp_path / "docs" / "reproduction.md"
    assert cdmisfa("reproduce", "-o", tmp_path / "r", "--page", page).code == 0
    text = page.read_text()
    assert (folder / "table.md").read_text() in text
    assert "](reproduction/stability.png)" in text
    assert (page.parent / "reproduction" / "stability.png").exists()
    assert cdmisfa("reproduce", "-o", tmp_path / "none", "--page", page).code == 2


@pytest.mark.usefixtures("undrawn")
def test_more_trials_run_only_what_is_missing_in_as_many_processes(tmp_path: Path) -> None:
    one, _ = stability(tmp_path / "1")
    assert stability(tmp_path / "2", jobs=2)[0] == one
    assert stability(tmp_path / "1", trials=2)[1] == [2, 3, 4]


@pytest.mark.usefixtures("undrawn")
def test_results_of_more_or_other_trials_are_replaced_only_with_force(
    tmp_path: Path, cdmisfa: Cdmisfa
) -> None:
    command = ("reproduce", "stability", "-o", tmp_path)
    folder = tmp_path / "stability"
    assert cdmisfa(*command, "--trials", 2).code in (0, 4)
    before = {file.name: file.read_bytes() for file in folder.iterdir() if file.is_file()}
    refused = cdmisfa(*command, "--trials", 1)
    assert refused.code == 2
    assert f"{folder} holds results of 4 trials, 2 of them not among the 2" in refused.err
    assert "--force" in refused.err
    assert {file.name: file.read_bytes() for file in folder.iterdir() if file.is_file()} == before
    assert cdmisfa(*command, "--trials", 1, "--force").code in (0, 4)
    assert json.loads((folder / "results.json").read_text())["trials"] == 2


@pytest.mark.usefixtures("undrawn")
def test_a_claim_that_fails_exits_4(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cdmisfa: Cdmisfa
) -> None:
    def unstable(self: Experiment, settings: Any) -> tuple[dict[str, Any], dict[str, Any]]:
        row = {"exploration_ends": 1, "changes": 1, "before": "011", "after": "101"}
        return row, {"R": np.zeros((9, 3)), "policy": np.eye(9, 3, dtype=np.int8)}

    monkeypatch.setattr(oscillatory.Stability, "run", unstable)
    done = cdmisfa("reproduce", "stability", "--trials", 1, "-o", tmp_path)
    assert done.code == 4
    said = "stability did not come out: 2.0 keeps its policy after epsilon = 0 (0 of 1 trials)"
    assert done.err.endswith(f"{said}\n")


@pytest.mark.usefixtures("undrawn")
def test_a_trial_that_breaks_or_is_damaged_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cdmisfa: Cdmisfa
) -> None:
    stability(tmp_path)
    rows = tmp_path / "rows.jsonl"
    rows.write_text(rows.read_text().replace('"arrays":"UEsDB', '"arrays":"UEsDA'))
    with pytest.raises(UsageError, match=r"the row of trial \w+ is damaged"):
        stability(tmp_path)

    def broken(self: Experiment, settings: Any) -> Any:
        raise UsageError("it broke")

    monkeypatch.setattr(oscillatory.Stability, "run", broken)
    done = cdmisfa("reproduce", "stability", "--trials", 1, "-o", tmp_path / "other")
    assert done.code == 1
    assert "'seed': 0}: it broke; the others are kept" in done.err


@pytest.mark.parametrize("algorithm", ["1.0", "2.0"])
def test_a_key_that_is_not_counted_for_an_algorithm_changes_nothing(algorithm: str) -> None:
    def learned(*others: str) -> Any:
        keys = {key: other[key] for key in others}
        config = paper_config("oscillatory", algorithm=algorithm, warm_up=2, **keys)
        result = run_trial(config, seed=1, max_iterations=1200, max_modules=2)
        return [(m.iteration, m.phi.tolist()) for m in result.modules], result.iterations

    other = {"delta": 1e-5, "gate_window": 5, "alpha": 0.5, "roc_centres": 3, "roc_radius": 1.0}
    other |= {"roc_memory": 10, "roc_error": 0.01}
    unchanged = learned()
    assert unchanged[0]
    assert learned(*set(other) - set(oscillatory.used_keys(algorithm))) == unchanged
    assert learned(*set(other) & set(oscillatory.used_keys(algorithm))) != unchanged


def trials_with(midpoints: dict[float, float], rewarded: int = 100) -> list[Trial]:
    """Ten trials a sigma and epsilon^c, with blocks rewarded before a change at .86 and later."""
    return [
        Trial(
            {"key": "sigma", "value": sigma, "start": start, "epsilon_c": e, "seed": 0},
            {
                "policy": nonstationary.NEW if e > midpoint else nonstationary.OLD,
                "rewarded": rewarded if e <= 0.86 else 0,
            },
            {},
        )
        for start in nonstationary.STARTS
        for sigma, midpoint in midpoints.items()
        for e in nonstationary.CHANGES
        for _ in range(10)
    ]


@pytest.mark.parametrize(
    ("midpoints", "holds"),
    [
        ({0.008: 2.0, 0.0009: 0.85, 0.0: 0.7}, [True, True, True]),
        ({0.008: 0.7, 0.0009: 0.85, 0.0: 0.9}, [False, True, False]),
    ],
)
def test_the_order_of_table_1_is_judged(midpoints: dict[float, float], holds: list[bool]) -> None:
    found = judged(nonstationary.NonStationary(), trials_with(midpoints))
    assert [claim["holds"] for claim in found.claims] == holds


def test_a_change_is_judged_only_after_enough_rewarded_blocks() -> None:
    experiment = nonstationary.NonStationary()
    followed = judged(experiment, trials_with({0.008: 0.9, 0.0: 0.7})).claims[0]
    assert followed["holds"]  # not 1, where 0 came before
    assert followed["detail"] == "10 of 10 trials with epsilon^c = 0.86"
    assert not judged(experiment, trials_with({0.008: 0.95, 0.0: 0.88})).claims[0]["holds"]
    notes = judged(experiment, trials_with({0.008: 0.95, 0.0: 0.7})).notes
    assert "Above 0.86 they are fewer than 30" in notes[1]
    assert notes[1].endswith("Epsilon^d lies there at sigma = 0.008.")


def test_the_other_start_of_epsilon_has_a_column_of_its_own() -> None:
    starts = zip(
        nonstationary.STARTS, ({0.008: 0.9, 0.0: 0.7}, {0.008: 0.8, 0.0: 0.5}), strict=True
    )
    trials = [t for s, midpoints in starts for t in trials_with(midpoints) if _start(t) == s]
    lines = judged(nonstationary.NonStationary(), trials).lines
    head, _, first, share, *_ = markdown_table(lines).splitlines()
    assert head.endswith("| n | epsilon from 1.0 |")
    ours, other = (float(first.split(" | ")[k].split()[0]) for k in (2, 6))
    assert ours == pytest.approx(0.915, abs=0.02)
    assert other == pytest.approx(0.815, abs=0.02)
    assert share.endswith("| - |")


def _start(trial: Trial) -> float:
    return float(trial.settings["start"])


def test_the_icub_trial_keeps_what_its_figures_show() -> None:
    source = OscillatorySource()
    row, arrays = icub.learn_curves(source, LearnerConfig(), seed=0, iterations=1600)
    assert row["streams"] == [0, 1, 2]
    assert row["policies"] == ["011", "101", "110"]
    assert arrays["eta_dot"].shape == (1600, 1)
    assert arrays["y1"].shape == (icub.DRAWN,)


def test_icub_figures_and_claims_from_rows(tmp_path: Path) -> None:
    truth = np.linspace(0.4, 0.6, 200)
    arrays = {
        "Q": np.zeros((50, 3, 2), np.float32),
        "policy": np.zeros((50, 3), np.float32),
        "eta_dot": np.full((50, 1), 0.001, np.float32),
        **{f"{kind}{i}": truth for kind in ("y", "truth") for i in (1, 2)},
    }
    good = {
        "streams": [0, 2],
        "policies": ["011", "110"],
        "saved_at": [600, 1100],
        "correlation": [0.99, 0.97],
        "iterations": 1400,
    }
    wrong = good | {"streams": [0, 2, 1], "policies": ["011", "110", "101"]}
    new, old, loose = ({"algorithm": a, "roc_error": error} for a, error in icub.LEARNERS)
    one = good | {"streams": [0], "policies": ["011"]}
    trials = [Trial(new, good, arrays), Trial(new, good, arrays)]
    trials += [Trial(old, one, arrays), Trial(loose, good, arrays)]

    def holds(*more: Trial) -> list[bool]:
        return [c["holds"] for c in judged(icub.Icub(), [*trials, *more]).claims]

    assert holds() == [True, True, True]
    assert holds(Trial(new, wrong, arrays)) == [True, False, True]
    assert holds(Trial(old, good, arrays)) == [True, True, False]
    lines = [x for x in judged(icub.Icub(), trials).lines if x["quantity"].startswith("1.0")]
    learned = [line["mean"] for line in lines if "correlation" not in line["quantity"]]
    assert learned == [1.0, 0.0, 2.0, 1.0]  # modules and both in order, of each threshold
    assert len(icub.Icub().draw(trials, tmp_path)) == 4


@pytest.mark.skipif(not SAMPLE.exists(), reason="the sample recording is not there")
def test_the_sample_recording_s_noise_is_not_learnable() -> None:
    eta = []
    with contextlib.closing(RecordedSource(SAMPLE)) as source:
        for view in range(3):
            source.seek(0)
            frames = source.take(view, 2000).frames.reshape(2000, -1)
            weights = difficulty.slowest_weights(frames[:1000], 7)
            eta.append(difficulty.slowness((frames[1000:] / 255.0 @ weights)[:, None])[0])
    assert [e < difficulty.LEARNABLE for e in eta] == [True, False, True]
