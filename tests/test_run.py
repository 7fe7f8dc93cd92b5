"""A run: how it ends, what its folder holds, what it never overwrites."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from run_data import parts_of, read_signals

from cdmisfa.core.blocks import Block
from cdmisfa.core.config import LearnerConfig, build, load_preset
from cdmisfa.core.errors import UsageError
from cdmisfa.core.outcomes import END_REASONS
from cdmisfa.core.signals import SignalsHash
from cdmisfa.experiments.run_folder import RunResult
from cdmisfa.experiments.session import run_session
from recorder.world.oscillatory import OscillatorySource
from replay.runs.modules import load_modules

CONFIG = build(LearnerConfig, "learner", load_preset("oscillatory")["learner"])
IMPATIENT = dataclasses.replace(CONFIG, epsilon_start=1e-4, patience=3)


def run(out: Path | None = None, source: OscillatorySource | None = None, **how: Any) -> RunResult:
    how = {"max_iterations": 12, "rerun": False, **how}
    config = how.pop("config", CONFIG)
    return run_session(source or OscillatorySource(), config, out, **how)


def logged(out: Path) -> SignalsHash:
    digest = SignalsHash()
    for signals in read_signals(out):
        digest.add(signals)
    return digest


def test_it_ends_when_every_stream_is_learned(tmp_path: Path) -> None:
    result = run(tmp_path / "run", max_iterations=None)
    assert result.ended == "max_modules"
    assert [m.stream_index for m in result.modules] == [0, 1, 2]
    assert result.iterations == result.modules[-1].iteration + 1
    assert result.summary["epsilon"] == 1.2
    assert logged(tmp_path / "run").hexdigest() == result.signals_sha256
    texts = [event.text for event in parts_of(tmp_path / "run", "events")]
    assert texts == [
        "module 1 saved on stream x1, policy [0, 1, 1]",
        "module 2 saved on stream x2, policy [1, 0, 1]",
        "module 3 saved on stream x3, policy [1, 1, 0]",
        f"ended: {END_REASONS['max_modules']}",
    ]
    for one, other in zip(load_modules(tmp_path / "run"), result.modules, strict=True):
        for field in dataclasses.fields(one):
            np.testing.assert_array_equal(getattr(one, field.name), getattr(other, field.name))


@pytest.mark.parametrize(
    ("how", "ended", "iterations"),
    [
        ({"source": OscillatorySource(length=350), "max_iterations": None}, "log_exhausted", 3),
        ({"max_iterations": 0}, "max_iterations", 0),
        ({"max_iterations": 5}, "max_iterations", 5),
        ({"max_iterations": None, "max_modules": 1}, "max_modules", None),
        ({"max_iterations": None, "config": IMPATIENT}, "nothing_left", 4),
        ({"max_iterations": None, "stop": 7}, "interrupted", 7),
    ],
)
def test_it_ends_as_it_is_told_and_leaves_a_whole_run(
    tmp_path: Path, how: dict[str, Any], ended: str, iterations: int | None
) -> None:
    out = tmp_path / "run"
    if "stop" in how:
        asked = iter(range(10**9))
        how = how | {"stop": lambda: next(asked) >= iterations}
    result = run(out, **how)
    assert result.ended == ended
    assert iterations in (None, result.iterations)
    assert result.frames == 100 * result.iterations
    assert len(result.modules) == (ended == "max_modules")
    assert (out / "run.mcap").is_file()
    assert (logged(out).count, logged(out).hexdigest()) == (
        result.iterations,
        result.signals_sha256,
    )
    assert json.loads((out / "run.json").read_text())["result"] == result.as_json()


def test_the_seed_decides_and_logging_does_not(tmp_path: Path) -> None:
    one, two, other = run(seed=1), run(tmp_path / "run", seed=1), run(seed=2)
    assert one.signals_sha256 == two.signals_sha256 != other.signals_sha256


@pytest.mark.parametrize("leftover", ["run.mcap", "run.mcap.partial", "notes.txt"])
def test_a_folder_that_holds_something_is_refused(tmp_path: Path, leftover: str) -> None:
    (tmp_path / leftover).write_text("mine")
    with pytest.raises(UsageError, match=f"{tmp_path} exists: .*--force"):
        run(tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == [leftover]
    assert (tmp_path / leftover).read_text() == "mine"


class Failing(OscillatorySource):
    """A source that breaks at its sixth block."""

    def take(self, stream: int, n: int) -> Block:
        if self.t >= 500:
            raise RuntimeError("the simulator died")
        return super().take(stream, n)


@pytest.mark.parametrize("before", [False, True])
def test_a_run_that_breaks_leaves_what_it_has_and_nothing_older(
    tmp_path: Path, before: bool
) -> None:
    if before:
        run(tmp_path, seed=1, max_iterations=8)
    with pytest.raises(RuntimeError, match="the simulator died"):
        run(tmp_path, Failing(), force=before)
    assert not (tmp_path / "run.mcap").exists()
    assert not (tmp_path / "run.json").exists()
    assert logged(tmp_path).count == 5
    assert logged(tmp_path).hexdigest() == run(max_iterations=5).signals_sha256
