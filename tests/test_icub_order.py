"""The iCub's modules come in order over the whole range of components that the preset lies in."""

from __future__ import annotations

import contextlib
import dataclasses
from pathlib import Path

import pytest

from cdmisfa.agents.learners import open_learner
from cdmisfa.core.blocks import FrameSource
from cdmisfa.core.config import LearnerConfig
from cdmisfa.core.learning import Learner
from cdmisfa.experiments.loop import Digest, learn_blocks
from cdmisfa.studies.paper import icub
from cdmisfa.studies.paper.experiment import paper_config
from replay.open_sources import open_recording

SAMPLE = Path(__file__).parent.parent / "sample_logs" / "icub"

COMPONENTS = (8, 10, 12)


def config(components: int) -> LearnerConfig:
    return dataclasses.replace(paper_config("icub"), components=components)


@pytest.mark.parametrize("components", COMPONENTS)
def test_object_1_then_object_3(components: int) -> None:
    with open_recording(SAMPLE, loop=True) as source:
        learner = open_learner(config(components), source.spec, 2)
        learn_blocks(source, learner, max_iterations=icub.ITERATIONS, max_modules=2)
    result = [(m.stream_index, "".join(map(str, m.policy))) for m in learner.modules]
    assert result == list(icub.OPTIMAL)
    fastest = [float(m.eta.max()) for m in learner.modules]
    assert fastest[0] < 0.11  # the toggle of object 1, and nothing of the noise beside it
    assert fastest[1] < 0.03


def test_live_and_recorded_are_the_same(tmp_path: Path) -> None:
    pytest.importorskip("pybullet")
    from recorder.recording import record_scene
    from recorder.world.icub.config import IcubConfig
    from recorder.world.scenes import open_scene

    scene = IcubConfig(seed=4)
    record_scene("icub", tmp_path, scene, frames=400)
    live, recorded = open_scene("icub", scene), open_recording(tmp_path)
    assert after_ten(live) == after_ten(recorded)


def after_ten(source: FrameSource) -> str:
    digest = Digest()
    with contextlib.closing(source):
        learner: Learner = open_learner(config(10), source.spec, 4)
        learn_blocks(source, learner, (digest,), max_iterations=10)
    return digest.hexdigest()
