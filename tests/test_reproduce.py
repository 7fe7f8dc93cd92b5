"""The paper's experiments as real, quick runs; what is written, kept and refused."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from waiting import wait_for

from cdmisfa.cli.app import run as cdmisfa
from cdmisfa.core.errors import NotReproducedError, UsageError
from cdmisfa.experiments.documents import versions
from cdmisfa.experiments.trial import run_trial
from cdmisfa.paper import (
    costs,
    difficulty,
    icub,
    nonstationary,
    oscillatory,
    reproduce,
    stability,
)
from cdmisfa.paper.reproduce import Request, Trial
from recorder.world.oscillatory import OscillatorySource

SAMPLE = Path(__file__).parent.parent / "sample_logs" / "icub"


def request(folder: Path, trials: int | None = None, **keys: Any) -> Request:
    return Request(trials, True, None, folder, **keys)


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """No figures, which take a second each, where they are not looked at."""
    for module in (oscillatory, stability):
        monkeypatch.setattr(module, "draw", lambda trials, folder: [])


@pytest.mark.parametrize("name", ["oscillatory", "five", "stability", "costs", "difficulty"])
def test_quick_runs_reproduce_the_claim_and_write_everything(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cdmisfa(["reproduce", name, "--quick", "-o", str(tmp_path), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)["experiments"][0]
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
    document = reproduce.reproduce("nonstationary", request(tmp_path, trials=1))
    early, late = document["claims"][:2]
    assert early["holds"], early
    assert late["holds"], late


def test_finished_trials_are_kept_and_the_figures_are_the_same_bytes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = reproduce.reproduce("stability", request(tmp_path, trials=1))
    pictures = {f: (tmp_path / f).read_bytes() for f in first["figures"]}
    monkeypatch.setattr(reproduce, "run_one", pytest.fail)
    counts: list[tuple[int, int]] = []
    again = reproduce.reproduce(
        "stability", request(tmp_path, trials=1), progress=lambda d, n: counts.append((d, n))
    )
    assert again == first
    assert counts == [(2, 2)]
    assert {f: (tmp_path / f).read_bytes() for f in again["figures"]} == pictures


@pytest.mark.usefixtures("undrawn")
def test_more_trials_run_only_what_is_missing(tmp_path: Path) -> None:
    reproduce.reproduce("stability", request(tmp_path, trials=1))
    counts: list[int] = []
    reproduce.reproduce(
        "stability", request(tmp_path, trials=2), progress=lambda done, _: counts.append(done)
    )
    assert counts == [2, 3, 4]


@pytest.mark.usefixtures("undrawn")
def test_results_of_more_or_other_trials_are_replaced_only_with_force(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["reproduce", "stability", "-o", str(tmp_path)]
    folder = tmp_path / "stability"
    assert cdmisfa([*command, "--trials", "2"]) in (0, 4)
    before = {file.name: file.read_bytes() for file in folder.iterdir() if file.is_file()}
    capsys.readouterr()
    assert cdmisfa([*command, "--trials", "1"]) == 2
    message = capsys.readouterr().err.splitlines()[-1]
    assert f"{folder} holds results of 4 trials, 2 of them not among the 2" in message
    assert "--force" in message
    assert {file.name: file.read_bytes() for file in folder.iterdir() if file.is_file()} == before
    assert cdmisfa([*command, "--trials", "1", "--force"]) in (0, 4)
    assert json.loads((folder / "results.json").read_text())["trials"] == 2


@pytest.mark.usefixtures("undrawn")
def test_a_killed_reproduction_goes_on_where_it_stopped(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "cdmisfa", "reproduce", "oscillatory"]
    command += ["-o", str(tmp_path), "--trials", "400"]
    trials = tmp_path / "oscillatory" / "trials"
    process = subprocess.Popen(command, stderr=subprocess.DEVNULL)
    try:
        wait_for(lambda: len(list(trials.glob("*.npz"))) >= 3, 120, process)
    finally:
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
    kept = {p.name: p.stat().st_mtime_ns for p in trials.glob("*.npz")}
    assert len(kept) >= 3
    folder = tmp_path / "oscillatory"
    document = reproduce.reproduce("oscillatory", request(folder, trials=len(kept) + 1))
    assert document["trials"] == len(kept) + 1
    assert {n: (trials / n).stat().st_mtime_ns for n in kept} == kept


@pytest.mark.usefixtures("undrawn")
def test_two_processes_give_the_rows_of_one(tmp_path: Path) -> None:
    one = reproduce.reproduce("stability", request(tmp_path / "1", trials=1))
    two = reproduce.reproduce("stability", request(tmp_path / "2", trials=1, jobs=2))
    assert two == one


@pytest.mark.usefixtures("undrawn")
def test_a_claim_that_fails_exits_4(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(stability, "run", _unstable)
    assert cdmisfa(["reproduce", "stability", "--trials", "1", "-o", str(tmp_path)]) == 4
    assert "stability did not come out: 2.0 keeps its policy" in capsys.readouterr().err


def _unstable(settings: Any) -> tuple[dict[str, Any], dict[str, Any]]:
    row = {"exploration_ends": 1, "changes": 1, "before": "011", "after": "101"}
    return row, {"R": np.zeros((9, 3)), "policy": np.eye(9, 3, dtype=np.int8)}


@pytest.mark.parametrize("algorithm", ["1.0", "2.0"])
def test_a_key_that_is_not_counted_for_an_algorithm_changes_nothing(algorithm: str) -> None:
    def learned(**keys: Any) -> Any:
        config = oscillatory.learner_config(algorithm=algorithm, warm_up=2, **keys)
        result = run_trial(config, seed=1, max_iterations=1200, max_modules=2)
        return [(m.iteration, m.phi.tolist()) for m in result.modules], result.iterations

    uncounted = {*costs.OWN["1.0"], *costs.OWN["2.0"]} - set(costs.parameters(algorithm))
    other = {"delta": 1e-5, "gate_window": 5, "alpha": 0.5, "roc_centres": 3, "roc_radius": 1.0}
    other |= {"roc_memory": 10, "roc_error": 0.01}
    unchanged = learned()
    assert unchanged[0]
    assert learned(**{key: other[key] for key in uncounted}) == unchanged
    assert learned(**{key: other[key] for key in costs.OWN[algorithm]}) != unchanged


def test_check_names_every_failed_claim() -> None:
    claims = [
        {"claim": "a", "holds": False, "detail": "1"},
        {"claim": "b", "holds": True, "detail": ""},
    ]
    with pytest.raises(NotReproducedError, match=r"x did not come out: a \(1\)$"):
        reproduce.check({"experiment": "x", "claims": claims})


@pytest.mark.usefixtures("undrawn")
def test_a_damaged_trial_is_named(tmp_path: Path) -> None:
    reproduce.reproduce("stability", request(tmp_path, trials=1))
    damaged = next((tmp_path / "trials").glob("*.npz"))
    damaged.write_bytes(damaged.read_bytes()[:100])
    with pytest.raises(UsageError, match=damaged.name):
        reproduce.reproduce("stability", request(tmp_path, trials=1))


def test_an_unknown_experiment_is_a_usage_error(tmp_path: Path) -> None:
    assert cdmisfa(["reproduce", "stabillity", "-o", str(tmp_path)]) == 2
    assert cdmisfa(["reproduce", "-o", str(tmp_path)]) == 2


def test_the_page_holds_every_table_and_figure_and_nothing_is_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    reproduce.reproduce("stability", request(tmp_path / "r" / "stability", trials=1))
    monkeypatch.setattr(reproduce, "run_one", pytest.fail)
    page = tmp_path / "docs" / "reproduction.md"
    page.parent.mkdir()
    assert cdmisfa(["reproduce", "-o", str(tmp_path / "r"), "--page", str(page)]) == 0
    text = page.read_text()
    assert (tmp_path / "r" / "stability" / "table.md").read_text() in text
    assert "](reproduction/stability.png)" in text
    assert (page.parent / "reproduction" / "stability.png").exists()
    assert cdmisfa(["reproduce", "-o", str(tmp_path / "none"), "--page", str(page)]) == 2


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


def test_the_order_of_table_1_is_judged() -> None:
    falling = nonstationary.evaluate(trials_with({0.008: 2.0, 0.0009: 0.85, 0.0: 0.7}))
    assert all(claim.holds for claim in falling.claims)
    rising = nonstationary.evaluate(trials_with({0.008: 0.7, 0.0009: 0.85, 0.0: 0.9}))
    assert [claim.holds for claim in rising.claims] == [False, True, False]


def test_a_change_is_judged_only_after_enough_rewarded_blocks() -> None:
    followed = nonstationary.evaluate(trials_with({0.008: 0.9, 0.0: 0.7})).claims[0]
    assert followed.holds
    assert followed.detail == "10 of 10 trials with epsilon^c = 0.86"  # not 1, where 0 came before
    unfollowed = nonstationary.evaluate(trials_with({0.008: 0.95, 0.0: 0.88})).claims[0]
    assert not unfollowed.holds
    notes = nonstationary.evaluate(trials_with({0.008: 0.95, 0.0: 0.7})).notes
    assert "Above 0.86 they are fewer than 30" in notes[1]
    assert notes[1].endswith("Epsilon^d lies there at sigma = 0.008.")


def test_the_other_start_of_epsilon_has_a_column_of_its_own() -> None:
    trials = trials_with({0.008: 0.9, 0.0: 0.7})
    early = [t for t in trials if t.settings["start"] == nonstationary.STARTS[0]]
    late = trials_with({0.008: 0.8, 0.0: 0.5})
    late = [t for t in late if t.settings["start"] == nonstationary.STARTS[1]]
    lines = [line.as_json() for line in nonstationary.evaluate([*early, *late]).lines]
    head, _, first, share, *_ = reproduce.markdown_table(lines).splitlines()
    assert head.endswith("| n | epsilon from 1.0 |")
    ours, other = (float(first.split(" | ")[k].split()[0]) for k in (2, 6))
    assert ours == pytest.approx(0.915, abs=0.02)
    assert other == pytest.approx(0.815, abs=0.02)
    assert share.endswith("| - |")


def test_the_icub_trial_watches_learns_and_keeps_what_its_figures_show() -> None:
    source = OscillatorySource()
    from cdmisfa.core.config import LearnerConfig

    row, arrays = icub.watch(source, LearnerConfig(), seed=0, iterations=1600)
    assert row["streams"] == [0, 1, 2]
    assert row["policies"] == ["011", "101", "110"]
    assert arrays["eta_dot"].shape == (1600, 1)
    assert arrays["y1"].shape == (icub.SHOWN,)


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
    assert all(claim.holds for claim in icub.evaluate(trials).claims)
    claims = icub.evaluate([*trials, Trial(new, wrong, arrays)]).claims
    assert [claim.holds for claim in claims] == [True, False, True]
    claims = icub.evaluate([*trials, Trial(old, good, arrays)]).claims
    assert [claim.holds for claim in claims] == [True, True, False]
    of_the_old = [line for line in icub.evaluate(trials).lines if line.quantity.startswith("1.0")]
    learned = [line.ours.mean for line in of_the_old if "correlation" not in line.quantity]
    assert learned == [1.0, 0.0, 2.0, 1.0]  # modules and both in order, of each threshold
    assert len(icub.draw(trials, tmp_path)) == 4


@pytest.mark.skipif(not SAMPLE.exists(), reason="the sample recording is not there")
def test_the_sample_recording_s_noise_is_not_learnable() -> None:
    eta = []
    for view in range(3):
        frames = difficulty._view(str(SAMPLE), view, 2000)
        weights = difficulty.slowest(frames[:1000], 7)
        eta.append(difficulty.slowness((frames[1000:] / 255.0 @ weights)[:, None])[0])
    limit = difficulty.LEARNABLE * difficulty.WHITE_NOISE
    assert eta[0] < limit
    assert eta[2] < limit
    assert eta[1] > limit


def test_difficulty_says_how_many_frames_of_a_view_it_takes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["reproduce", "difficulty", "--quick", "--recording", str(SAMPLE)]
    assert cdmisfa([*words, "-o", str(tmp_path)]) == 2
    assert "takes more than 4000: record them" in capsys.readouterr().err
