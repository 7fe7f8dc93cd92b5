"""A scene of somebody else: added without editing a file, recorded, and learned from."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import Cdmisfa
from folders import contents

from cdmisfa.core.blocks import (
    Block,
    ClockedSource,
    SeekableSource,
    SourceSpec,
    check_request,
    freeze,
)
from cdmisfa.core.errors import UsageError
from cdmisfa.testing.sources import SourceContract
from recorder import RecordConfig, Scene, SceneConfig, open_scene, record, record_scene
from recorder.world.scenes import SCENES

LEARNER = """
[learner]
tau = 20
components = 2
expansion = "none"
warm_up = 3
"""


@dataclass(frozen=True)
class PendulumConfig(SceneConfig):
    """Two pendulums (keys `scene.*`)."""

    kind: str = "pendulum"
    period: float = 90.0


class Pendulums(ClockedSource):
    """Two pendulums and noise that the seed decides."""

    def __init__(self, config: PendulumConfig, clock: RecordConfig) -> None:
        self.config, names = config, ("swing", "slow_swing")
        self._spec = SourceSpec(names, (3,), "float64", ("angle",), clock.fps, clock.start_ns)

    def take(self, stream: int, n: int) -> Block:
        check_request(self.spec, stream, n)
        t = np.arange(self._t, self._t + n)
        angle = 2 * np.pi * t / self.config.period / (1 + stream)
        noise = [np.random.default_rng((self.config.seed or 0, stream, at)).random() for at in t]
        frames = np.stack([np.sin(angle), np.cos(9 * angle), noise], axis=1)
        block = Block(stream, self._t, freeze(frames), freeze(t[:, None] / self.config.period))
        self._t += n
        return block

    def describe(self) -> Mapping[str, Any]:
        return {"kind": "pendulum", "seed": self.config.seed, "period": self.config.period}


@pytest.fixture(autouse=True)
def pendulum(tmp_path: Path) -> Iterator[None]:
    preset = tmp_path / "pendulum.toml"
    preset.write_text(LEARNER)
    SCENES.add("pendulum", Scene(PendulumConfig, Pendulums, str(preset), packages=("pillow",)))
    yield
    SCENES.remove("pendulum")


class TestPendulums(SourceContract):
    def open(self) -> SeekableSource:
        return open_scene("pendulum", PendulumConfig(seed=4))


def test_it_is_recorded_and_learned_from_with_the_same_signals(
    cdmisfa: Cdmisfa, tmp_path: Path
) -> None:
    words = ("--seed", 5, "--set", "scene.period=120")
    folder = tmp_path / "rec"
    done = cdmisfa("record", "pendulum", "-o", folder, "--frames", 900, *words, "--json")
    assert done.code == 0, done.err
    assert [view["name"] for view in done.json["views"]] == ["swing", "slow_swing"]
    assert b"version_pillow" in (folder / "swing.mcap").read_bytes()
    learn = ("--max-iterations", 20, "--no-rerun", "--json")
    live = cdmisfa("learn", "pendulum", *words, *learn, "-o", tmp_path / "live")
    recorded = cdmisfa("learn", folder, "--seed", 5, *learn, "-o", tmp_path / "recorded")
    assert (live.code, recorded.code) == (0, 0), live.err + recorded.err
    assert live.json["iterations"] == 20
    assert live.json["signals_sha256"] == recorded.json["signals_sha256"]
    manifest = json.loads((tmp_path / "live" / "run.json").read_text())
    assert manifest["config"]["scene"] == {"kind": "pendulum", "seed": 5, "period": 120.0}
    assert manifest["config"]["learner"]["tau"] == 20
    assert cdmisfa("compare", tmp_path / "live", tmp_path / "recorded").code == 0


def test_processes_change_no_byte(tmp_path: Path) -> None:
    for jobs in (1, 2):
        record_scene(
            "pendulum", tmp_path / f"{jobs}", PendulumConfig(seed=1), frames=300, jobs=jobs
        )
    assert contents(tmp_path / "1") == contents(tmp_path / "2")


def test_its_keys_are_its_own(cdmisfa: Cdmisfa) -> None:
    for words, said in (
        (("learn", "pendulum", "--set", "scene.perod=3"), "did you mean scene.period?"),
        (("learn", "pendulum", "--set", "scene.streams=x1"), "means nothing to the scene pendulum"),
        (("learn", "icub", "--set", "scene.period=3"), "means nothing to the scene icub"),
        (("learn", "pendulum", "--set", "scene.seed=-1"), "scene.seed is -1"),
        (("record", "pendulm", "-o", "x"), "no scene 'pendulm': did you mean pendulum?"),
        (("record", "pendulum", "--scene-picture", "x.png"), "--scene-picture is for icub"),
    ):
        refused = cdmisfa(*words)
        assert (refused.code, said in refused.err) == (2, True), refused.err


@pytest.mark.parametrize("name", ["oscillatory", "icub", "pendulum"])
def test_a_source_that_was_opened_by_name_is_recorded_as_by_name(name: str, tmp_path: Path) -> None:
    if name == "icub":
        pytest.importorskip("pybullet")
    clock = RecordConfig(fps=25.0, compression="lz4")
    config = SCENES[name].config(seed=3)
    record_scene(name, tmp_path / "name", config, clock, frames=20)
    source = open_scene(name, config, clock)
    record(source, tmp_path / "source", frames=20)
    source.close()
    assert contents(tmp_path / "name") == contents(tmp_path / "source")


def test_a_scene_is_told_by_its_own_configuration(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="oscillatory takes OscillatoryConfig, not Pend"):
        record_scene("oscillatory", tmp_path / "rec", PendulumConfig())
    with pytest.raises(ValueError, match="there is a scene 'icub' already"):
        SCENES.add("icub", SCENES["oscillatory"])
