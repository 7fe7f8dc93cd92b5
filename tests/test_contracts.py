"""The contracts of learners and cameras hold for those of this package.

Those of sources and sinks are derived from where these are tested.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import pytest
from contracts.learners import LearnerContract
from contracts.sources import CameraContract

from cdmisfa.agents.inputs import signals_of_block
from cdmisfa.agents.learners import open_learner
from cdmisfa.agents.progress.config import ProgressConfig
from cdmisfa.core.blocks import Block, SourceSpec
from cdmisfa.core.config import LearnerConfig
from cdmisfa.core.learning import Learner
from cdmisfa.core.signals import SIGNALS
from cdmisfa.features.incsfa import IncrementalFeature
from cdmisfa.features.recursive import RecursiveFeature
from recorder.cameras.readers import Camera
from recorder.cameras.video import VideoCamera
from recorder.images.pixels import Content
from recorder.world.oscillatory import OscillatorySource


class TestCurious(LearnerContract):
    def open(self, spec: SourceSpec, seed: int) -> Learner:
        return open_learner(LearnerConfig(warm_up=3, eta_dot_window=4, delta=1.0), spec, seed)


class TestCuriousOfTheFirstVersion(LearnerContract):
    def open(self, spec: SourceSpec, seed: int) -> Learner:
        return open_learner(LearnerConfig(algorithm="1.0", warm_up=3), spec, seed)


class TestProgress(LearnerContract):
    def open(self, spec: SourceSpec, seed: int) -> Learner:
        return open_learner(ProgressConfig(), spec, seed)


@pytest.mark.parametrize("kind", [IncrementalFeature, RecursiveFeature])
def test_what_is_written_into_the_state_of_a_feature_restores_it(kind: type[Any]) -> None:
    def opened() -> Any:
        if kind is RecursiveFeature:
            return RecursiveFeature(3, components=3)
        config = LearnerConfig(expansion="none")
        return IncrementalFeature(config, 3, np.random.default_rng(5))

    t = np.arange(130)[:, None] / np.array([40.0, 7.0, 3.0])
    frames = np.sin(t) + 0.1 * np.random.default_rng(0).standard_normal(t.shape)
    one, two = opened(), opened()
    assert one.update(frames[:50]).shape == (50,)
    one.update(frames[50:70], gap=True)
    for array, stored in zip(two.state, one.state, strict=True):
        array[...] = stored.copy()
    np.testing.assert_array_equal(one.update(frames[70:]), two.update(frames[70:]))
    assert one.phi.tobytes() == two.phi.tobytes()
    assert one.mean.tobytes() == two.mean.tobytes()


class TestVideo(CameraContract):
    def open(self) -> Camera:
        return VideoCamera("av:lavfi:testsrc=rate=100:size=64x48", "bars")


class TestColours(TestVideo):
    def open(self) -> Camera:
        return VideoCamera("av:lavfi:testsrc=rate=100:size=64x48", "bars", color=True)


class Readings:
    """A camera of whatever it is given."""

    name, finite, rate = "readings", True, 50.0

    def __init__(self, *shown: Content) -> None:
        self._shown = shown

    def images(self) -> Iterator[tuple[int, Content]]:
        return ((0, shown) for shown in self._shown)

    def describe(self) -> Mapping[str, Any]:
        return {"kind": "readings"}


class TestNumbers(CameraContract):
    def open(self) -> Camera:
        return Readings(*np.ones((3, 7)))


@pytest.mark.parametrize(
    "shown",
    [
        [np.ones((4, 4))] * 3,
        [np.ones(7, np.float32)] * 3,
        [np.full(7, np.nan)] * 3,
        [np.ones(7), np.ones(7), np.ones(6)],
        [np.ones((4, 4), np.uint8), np.ones((4, 4, 3), np.uint8), np.ones((4, 4), np.uint8)],
        [np.ones((4, 4, 2), np.uint8)] * 3,
        [np.ones((0, 4), np.uint8)] * 3,
    ],
)
def test_a_camera_that_shows_something_else_breaks_its_contract(shown: list[Content]) -> None:
    class Wrong(CameraContract):
        def open(self) -> Camera:
            return Readings(*shown)

    with pytest.raises(AssertionError):
        Wrong().test_its_images_are_of_one_kind_and_no_older_than_now()


def test_signals_that_are_not_said_do_not_exist() -> None:
    source = OscillatorySource()
    block: Block = source.take(1, 5)
    record = signals_of_block(block, source.spec, 7, outputs=2, modules=3, reward=0.5)
    assert (record.iteration, record.t, record.stream, record.reward) == (7, 0, 1, 0.5)
    assert record.y_frozen.shape == (3, 5, 2)
    floats = [np.asarray(getattr(record, s.name)) for s in SIGNALS.values() if s.dtype == "float64"]
    assert sum(np.isfinite(array).all() for array in floats if array.size) == 1
    assert {field.name for field in dataclasses.fields(record)} == set(SIGNALS)
