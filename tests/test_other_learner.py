"""A learner that no file of the packages knows: registered, configured, run, resumed, swept."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import Cdmisfa
from numpy.typing import NDArray
from run_data import signals_of

from cdmisfa.agents.learners import LEARNERS, LearnerEntry
from cdmisfa.core.blocks import Block, SourceSpec
from cdmisfa.core.errors import UsageError
from cdmisfa.core.learning import Learner, LearnerState
from cdmisfa.core.modules import Module
from cdmisfa.core.signals import BlockSignals
from cdmisfa.experiments.sources import configure
from cdmisfa.experiments.store import read_rows
from cdmisfa.experiments.sweep import sweep


@dataclass(frozen=True)
class WatcherConfig:
    """Keys `learner.*` of the watcher."""

    algorithm: str = "watcher"
    tau: int = 30
    patience: int = 50


class Watcher:
    """Watches one stream after the other and keeps the mean of what it saw."""

    def __init__(self, config: WatcherConfig, spec: SourceSpec, seed: int) -> None:
        self.config, self.spec = config, spec
        self.modules: list[Module] = []
        self._mean = np.zeros((1, int(np.prod(spec.frame_shape))))
        self._rng = np.random.default_rng(seed)
        self._count = np.zeros(1, np.int64)

    @property
    def stream(self) -> int:
        return self.iteration % len(self.spec.streams)

    @property
    def tau(self) -> int:
        return self.config.tau

    @property
    def iteration(self) -> int:
        return int(self._count[0])

    @property
    def events(self) -> tuple[str, ...]:
        return ()

    @property
    def phi(self) -> NDArray[np.float64]:
        return self._mean.copy()

    @property
    def over(self) -> str:
        return "nothing_left" if self.iteration >= self.config.patience else ""

    @property
    def max_modules(self) -> None:
        return None

    def step(self, block: Block) -> BlockSignals:
        k = self.iteration
        signals = signals_of(self.spec, k, self._rng, tau=self.tau, modules=0)
        self._mean[0] += block.frames.reshape(len(block), -1).mean(axis=0)
        self._count += 1
        time = self.spec.time_ns(block.t)
        return dataclasses.replace(
            signals, t=block.t, log_time=time, stream=block.stream, reward=float(self._mean.sum())
        )

    @property
    def state(self) -> LearnerState:
        arrays = {"mean": self._mean.copy(), "count": self._count.copy()}
        return LearnerState(arrays, (), self._rng.bit_generator.state)

    def restore(self, state: LearnerState) -> None:
        self._mean[...], self._count[...] = state.arrays["mean"], state.arrays["count"]
        self._rng.bit_generator.state = dict(state.policy_rng)

    def summary(self) -> Mapping[str, Any]:
        return {"mean": self._mean.tolist()}


@pytest.fixture(autouse=True)
def registered(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    preset = tmp_path_factory.mktemp("presets") / "watcher.toml"
    preset.write_text("[learner]\npatience = 12\n")
    LEARNERS.add("watcher", LearnerEntry(WatcherConfig, Watcher, str(preset)))
    yield
    LEARNERS.remove("watcher")


def test_it_is_a_learner() -> None:
    assert isinstance(Watcher(WatcherConfig(), SourceSpec(("a",), (2,), "float64"), 0), Learner)


def test_its_keys_are_those_of_its_class_and_its_preset_is_its_own() -> None:
    config = configure("oscillatory", settings=("learner.algorithm=watcher",)).learner
    assert config == WatcherConfig("watcher", 30, 12)
    with pytest.raises(UsageError, match=r"learner\.tua: did you mean learner\.tau\?"):
        configure("oscillatory", settings=("learner.algorithm=watcher", "learner.tua=3"))


def test_an_unknown_learner_names_the_nearest(cdmisfa: Cdmisfa) -> None:
    done = cdmisfa("learn", "oscillatory", "--algorithm", "wacher")
    assert (done.code, done.err.count("\n")) == (2, 1)
    assert "no learner.algorithm 'wacher': did you mean watcher?" in done.err


def test_it_runs_and_is_resumed_bit_for_bit(cdmisfa: Cdmisfa, tmp_path: Path) -> None:
    words = ("learn", "oscillatory", "--algorithm", "watcher", "--json")
    whole = cdmisfa(*words, "-o", tmp_path / "whole")
    assert whole.json["ended"] == "nothing_left"
    assert (whole.json["iterations"], whole.json["frames"]) == (12, 360)
    assert len(whole.json["mean"][0]) == 2
    assert (tmp_path / "whole" / "run.rrd").is_file()
    assert cdmisfa(*words, "-o", tmp_path / "run", "--max-iterations", 5).json["iterations"] == 5
    more = ("--max-iterations", 100)  # what was asked for before holds where nothing else is said
    resumed = cdmisfa("learn", "--resume", "-o", tmp_path / "run", *more, "--json").json
    assert resumed["signals_sha256"] == whole.json["signals_sha256"]
    assert resumed["mean"] == whole.json["mean"]


def test_it_is_swept(tmp_path: Path) -> None:
    settings = ("learner.algorithm=watcher", "learner.patience=4")
    sweep("oscillatory", tmp_path, seeds=[0], settings=settings, grid={"learner.tau": [10, 20]})
    assert [row["result"]["frames"] for row in read_rows(tmp_path)] == [40, 80]
