"""What every `Feature` promises, as tests: say what to open.

class TestMine(FeatureContract):
    def open(self, config, n_inputs, rng) -> Feature:
        return Mine(config, n_inputs, rng)
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.config import LearnerConfig
from cdmisfa.features.incsfa import Feature

INPUTS = 3


def seen(n: int, seed: int = 0) -> NDArray[np.float64]:
    """Values that change slowly, with noise, (n, 3)."""
    t = np.arange(n)[:, None] / np.array([40.0, 7.0, 3.0])
    noise = np.random.default_rng(seed).standard_normal((n, INPUTS))
    return np.asarray(np.sin(t) + 0.1 * noise)


class FeatureContract:
    """The tests; a subclass opens a fresh feature in `open`.

    Attributes:
        config: of the learner that it is for.
    """

    config = LearnerConfig(expansion="none")

    def open(self, config: LearnerConfig, n_inputs: int, rng: np.random.Generator) -> Feature:
        """Open a fresh feature of the kind under test."""
        raise NotImplementedError

    def _open(self) -> Feature:
        return self.open(self.config, INPUTS, np.random.default_rng(5))

    def test_it_is_a_feature(self) -> None:
        feature = self._open()
        assert isinstance(feature, Feature)
        assert feature.phi.shape == (self.config.outputs, INPUTS)
        assert feature.mean.shape == (INPUTS,)

    def test_it_says_how_much_each_frame_changed_it(self) -> None:
        feature = self._open()
        assert feature.update(seen(50)).shape == (50,)
        xi = feature.update(seen(20, 1), gap=True)
        assert xi.shape == (20,)
        assert np.isnan(xi).all() or (xi[~np.isnan(xi)] >= 0).all()

    def test_the_same_frames_give_the_same_bits(self) -> None:
        one, two = self._open(), self._open()
        for feature in (one, two):
            feature.update(seen(60))
        assert one.phi.tobytes() == two.phi.tobytes()
        assert one.mean.tobytes() == two.mean.tobytes()

    def test_what_is_written_into_its_state_restores_it(self) -> None:
        one, two = self._open(), self._open()
        one.update(seen(60))
        stored: dict[str, NDArray[Any]] = {k: v.copy() for k, v in one.state._asdict().items()}
        for name, array in two.state._asdict().items():
            array[...] = stored[name]
        more = seen(60, 1)
        np.testing.assert_array_equal(one.update(more), two.update(more))
        assert one.phi.tobytes() == two.phi.tobytes()
