"""The last frames of a camera log, which nothing learns from and what was learned is judged on."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import Cdmisfa
from folders import external
from message_files import write_table
from numpy.typing import NDArray
from PIL import Image

from cdmisfa.core.arrays import FloatArray
from cdmisfa.core.errors import LogDamagedError, LogExhaustedError
from cdmisfa.experiments.holdout import evaluate
from cdmisfa.features.following import batch_outputs, following_slowness
from cdmisfa.features.sfa import batch_sfa, slowness
from cdmisfa.modules import Module
from replay.runs.modules import load_modules

FRAMES = 6000
SETTINGS = ("input.time=t", "learner.expansion=none", "learner.outputs=2")
LEARN = (*(word for setting in SETTINGS for word in ("--set", setting)), "--json")


def values(frames: int = FRAMES) -> NDArray[Any]:
    """(frames, 6): two slow courses under jumps of which each column has its own mixture."""
    rng, t = np.random.default_rng(5), np.arange(frames)
    slow = np.stack([np.sin(t / 40), np.sin(t / 13), *rng.normal(0, 1, (4, frames))])
    return np.asarray(slow.T @ rng.normal(0, 1, (6, 6)))


def table(path: Path, rows: NDArray[Any]) -> Path:
    columns = {f"c{i}": rows[:, i] for i in range(rows.shape[1])}
    return write_table(path, {"t": np.arange(len(rows)) / 100, **columns})


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return table(tmp_path_factory.mktemp("holdout") / "log.csv", values())


def in_pieces(frames: NDArray[Any], size: int) -> Iterator[tuple[NDArray[Any], bool]]:
    return ((frames[at : at + size], False) for at in range(0, len(frames), size))


def test_frames_held_out_are_not_learned_from_and_judged_as_batch_sfa_is(
    cdmisfa: Cdmisfa, log: Path, tmp_path: Path
) -> None:
    run = tmp_path / "run"
    result = cdmisfa("learn", log, *LEARN, "-o", run, "--no-rerun").json
    changed = values()
    changed[5400:] = changed[5400:][::-1, ::-1]
    other = cdmisfa("learn", table(tmp_path / "other.csv", changed), *LEARN).json
    assert result["signals_sha256"] == other["signals_sha256"]
    assert result["held_out"]["modules"] != other["held_out"]["modules"]
    assert result["held_out"]["frames"] == [5400, 6000]
    assert result["held_out"]["fitted"] == [0, result["frames"]]
    (module,), (reported,) = load_modules(run), result["held_out"]["modules"]
    x = values()
    weights = batch_sfa(x[: result["frames"]], 2)
    batch = slowness((x[5400:] - x[: result["frames"]].mean(axis=0)) @ weights.T)
    np.testing.assert_allclose(
        reported["slowness"], slowness(module.transform(x[5400:], outputs=slice(2))), rtol=1e-9
    )
    np.testing.assert_allclose(reported["of_batch"], batch, rtol=1e-6)
    assert cdmisfa("info", run, "--json").json["held_out"] == result["held_out"]
    ((applied,),) = (
        log["modules"]
        for log in cdmisfa("apply", run, log, *LEARN[:2], "--start", "54", "--json").json["logs"]
    )
    assert applied["slowness"] == pytest.approx(reported["slowness"][0], rel=1e-12)
    lines = cdmisfa("info", run).out.splitlines()
    own, theirs = (", ".join(f"{v:.4f}" for v in reported[k]) for k in ("slowness", "of_batch"))
    at = lines.index("slowness on the held-out frames 5400 to 5999:")
    assert lines[at + 1] == f"module 1 of log: {own}; batch SFA: {theirs}"


def test_a_module_explains_its_training_log_and_no_log_of_other_speed(
    cdmisfa: Cdmisfa, log: Path, tmp_path: Path
) -> None:
    run = tmp_path / "run"
    assert cdmisfa("learn", log, *LEARN, "-o", run, "--no-rerun").code == 0
    shuffled = np.random.default_rng(0).permutation(values())
    for path, low, high in (
        (log, 0.95, 1.0),
        (table(tmp_path / "fast.csv", shuffled), 0.0, 0.0),
        (table(tmp_path / "large.csv", 5 * values()), 0.0, 0.0),
    ):
        (applied,) = cdmisfa("apply", run, path, *LEARN[:2], "--json").json["logs"]
        assert low <= applied["modules"][0]["explained"] <= high


@pytest.mark.parametrize(
    ("options", "held"),
    [
        ((), 600),
        (("--set", "input.holdout=0.25"), 1500),
        (("--start", "10", "--end", "50"), 400),
        (("--set", "input.holdout=0"), 0),
        (("--end", "15"), 0),  # too few
        (("--loop",), 0),
        (("--algorithm", "2.0"), 0),
    ],
)
def test_a_share_of_what_is_learned_from_once_is_held_out(
    cdmisfa: Cdmisfa, log: Path, options: tuple[str, ...], held: int
) -> None:
    said = LEARN[:2] if "2.0" in options else LEARN[:-1]
    done = cdmisfa("learn", log, *said, "--json", "--max-iterations", "3", *options)
    assert done.json["source"].get("held_out", 0) == held
    assert ("held_out" in done.json) == (held > 0)
    few = "150 of 1500 frames are too few to test on: none are held out (input.holdout)"
    assert (few in done.err) == ("15" in options)


def test_going_on_keeps_to_what_the_run_learns_from(
    cdmisfa: Cdmisfa, log: Path, tmp_path: Path
) -> None:
    once, resumed, fork = (tmp_path / name for name in ("once", "resumed", "fork"))
    how = (*LEARN[:-1], "--no-rerun", "--passes", "1")
    whole = cdmisfa("learn", log, *how, "-o", once, "--json").json
    cdmisfa("learn", log, *how, "-o", resumed, "--max-iterations", "20")
    assert (
        cdmisfa("learn", log, *how, "-o", resumed, "--resume", "--set", "input.holdout=0.2").code
        == 2
    )
    more = ("--max-iterations", "1000", "--no-rerun", "--json")
    assert cdmisfa("learn", "--resume", "-o", resumed, *more).json["held_out"] == whole["held_out"]
    assert cdmisfa("check", once).code == 0
    endless = ("--set", "learner.watch=1000", "--json", "--no-rerun")
    forked = cdmisfa("fork", once, "--iteration", "20", "-o", fork, *endless).json
    assert forked["frames"] == forked["held_out"]["frames"][0] == 5400


@pytest.mark.parametrize("size", [7, 100, 5000])
def test_slowness_in_pieces_is_that_of_all_frames(size: int) -> None:
    x = values(3000)
    phi, mean, _ = batch_outputs(in_pieces(x, size), len(x), components=6, outputs=2)
    exact = slowness((x - x.mean(axis=0)) @ batch_sfa(x, 2).T)
    np.testing.assert_allclose(mean, x.mean(axis=0), rtol=1e-9, atol=1e-12)
    (result,) = following_slowness(in_pieces(x, size), [(phi, mean)])
    np.testing.assert_allclose(result, exact, rtol=1e-6)


def test_no_step_leads_across_what_is_missing() -> None:
    y: FloatArray = np.array([0.0, 1.0, 2.0, 10.0, 11.0])[:, None]
    one = (np.ones((1, 1)), np.zeros(1))
    (slow,) = following_slowness([(y[:3], False), (y[3:], True)], [one])
    assert slow[0] == pytest.approx(math.sqrt(1 / y.var()) / (2 * math.pi))
    (still,), (none,) = (
        following_slowness(pieces, [one])[0] for pieces in ([(np.ones((4, 1)), False)], [])
    )
    assert still == math.inf
    assert math.isnan(none)


def test_damage_among_what_is_held_out_is_named_or_passed_over(tmp_path: Path) -> None:
    x = np.rint(128 + 12 * values(120)).clip(0, 255).astype(np.uint8)
    for i, frame in enumerate(x):
        Image.fromarray(frame.reshape(2, 3)).save(tmp_path / f"{i:03}.png")
    (tmp_path / "110.png").write_bytes((tmp_path / "110.png").read_bytes()[:50])
    none, policy = np.zeros(1), np.zeros(0, np.int64)
    learned = Module(1, "log", 0, 0, np.eye(6)[:1], np.zeros(6), none, none, none, policy)
    for skip_damaged in (False, True):
        with external(tmp_path, rate=5, skip_damaged=skip_damaged) as source:
            source.hold_out(20)
            source.take(0, 100)
            with pytest.raises(LogExhaustedError, match="before 20 held-out"):
                source.take(0, 1)
            if skip_damaged:
                result = evaluate(source, [replace(learned, expansion="none")], components=2)
                assert result is not None
                assert result["frames"] == [100, 120]
            else:
                with pytest.raises(LogDamagedError, match=r"110\.png.*--skip-damaged"):
                    evaluate(source, [replace(learned, expansion="none")], components=2)
