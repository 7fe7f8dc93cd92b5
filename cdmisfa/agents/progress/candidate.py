"""`Candidate`: the slow features of one stream as they are learned, tested before they learn."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa import kernels
from cdmisfa.core.arrays import FloatArray
from cdmisfa.core.learning import overwrite
from cdmisfa.features.outputs import slowness_by_moments, window_rate
from cdmisfa.features.recursive import RecursiveFeature, RecursiveState

# Slowness of white noise.
WHITE_NOISE = math.sqrt(2.0) / (2.0 * math.pi)

# With fewer slow features than this there is no typical one; white noise stands for it.
FEWEST = 4

# Blocks whose learning error is kept.
ERRORS = 90

# Most candidates held at once, and the bytes that they may take together: where frames are large
# fewer are held. Those of other streams begin again when they are watched.
HELD = 32
MEMORY = 2 * 1024**3

# Learning error of a block before anything was tested: larger than any that is.
UNTESTED = 3.0

_TINY = 1e-12


def log_ratio(a: float, b: float) -> float:
    """Return ln(a / b) of two slownesses, finite where one of them is 0."""
    return kernels.log(max(a, _TINY) / max(b, _TINY))


def learning_error(change: float, tested: float, fitted: float) -> float:
    """Return the learning error, e = c + |ln(test / fit)|.

    Equation: P2

    Args:
        change: mean change c of the outputs with a block.
        tested: slowness on frames not yet learned from.
        fitted: slowness on those learned from.
    """
    return change + abs(log_ratio(tested, fitted))


class Candidate:
    """The slow features that are being learned of a stream.

    Args:
        n_inputs: I.
        components: K.
        outputs: J.
        window: frames of the exponential window of its SFA.
        test_window: blocks of that of its tests.

    Attributes:
        sfa: the recursive SFA.
        y: (n, J) outputs on the last block, before any of it was learned from; NaN without.
        blocks: blocks learned from.
        tests: blocks tested before they were learned from.
        change: mean change of the outputs with a block, see `RecursiveFeature.update`.
        regret: log of the slowness that the outputs of some time ago have now, over that of
            today's: 0 where nothing was gained since.
        errors: (ERRORS,) learning error of the last blocks, the newest last; NaN before.
    """

    def __init__(
        self, n_inputs: int, components: int, outputs: int, window: int, test_window: int
    ) -> None:
        self.sfa = RecursiveFeature(n_inputs, components, outputs, window)
        n_outputs = len(self.sfa.state.weights)
        self.test_window = test_window
        self.blocks = self.tests = self._reference_age = 0
        self.change = self.regret = math.nan
        self.errors = np.full(ERRORS, np.nan)
        self.y = np.zeros((0, n_outputs))
        self._moments = np.zeros((3, n_outputs))
        self._phi = np.zeros((n_outputs, n_inputs))
        self._last = np.zeros(n_outputs)
        self._reference = np.zeros(n_inputs)

    def learn(self, frames: NDArray[Any], gap: bool) -> None:
        """Test on a block, then learn from it.

        Args:
            frames: (n, I) consecutive frames.
            gap: they do not follow those before.
        """
        self.y = np.full((len(frames), len(self._last)), np.nan)
        if self.alive:
            self._test(frames, gap)
        changes = self.sfa.update(frames, gap)
        self.blocks += 1
        changes = changes[np.isfinite(changes)]
        if len(changes):
            change = min(float(changes.sum()), math.sqrt(2.0))
            if math.isnan(self.change):
                self.change = change
            else:
                self.change += window_rate(self.test_window, max(self.tests, 1)) * (
                    change - self.change
                )
        self.errors[:-1] = self.errors[1:]
        self.errors[-1] = self.error
        self._reference_age += 1
        if self._reference_age >= self.test_window:
            if self._reference.any():
                self.regret = log_ratio(self.sfa.compare(self._reference).slowness, self.fitted)
            self._reference[:] = self.sfa.phi[0]
            self._reference_age = 0

    def _test(self, frames: NDArray[Any], gap: bool) -> None:
        """Take in the outputs on a block and their steps from frame to frame.

        The step from the block before is that of the weights that block was tested with: they
        have learned from neither of its frames.
        """
        self.tests += 1
        rate = window_rate(self.test_window, self.tests)
        phi = self.sfa.phi
        offset = kernels.mean_output(phi, self.sfa.mean)
        y = self.y = kernels.outputs(phi, offset, frames)
        steps = np.diff(y, axis=0)
        if self._phi.any() and not gap:
            first = kernels.outputs(self._phi, np.zeros(len(phi)), frames[:1])
            steps = np.concatenate([first - self._last, steps])
        self._phi[:], self._last[:] = phi, y[-1] + offset
        now = np.stack([y.mean(axis=0), (y * y).mean(axis=0), (steps * steps).mean(axis=0)])
        self._moments += rate * (now - self._moments)

    @property
    def alive(self) -> bool:
        """Whether the stream has shown anything that varies."""
        return bool(self.sfa.state.weights.any())

    @property
    def fitted(self) -> float:
        """Slowness of the slowest output on the frames it learned from; NaN where there is none."""
        return self.sfa.slowness

    @property
    def tested(self) -> FloatArray:
        """(J,) slowness of each output on frames not yet learned from; NaN before any."""
        return np.array(
            [
                slowness_by_moments(derivative, square - mean * mean) if self.tests else math.nan
                for mean, square, derivative in self._moments.T
            ]
        )

    @property
    def variance(self) -> FloatArray:
        """(J,) variance of each output on frames not yet learned from."""
        mean, square, _ = self._moments
        return np.asarray(square - mean * mean)

    @property
    def error(self) -> float:
        """Its `learning_error`; `UNTESTED` before anything was tested."""
        if not self.tests or math.isnan(self.change):
            return UNTESTED
        return learning_error(self.change, float(self.tested[0]), self.fitted)

    def recent_errors(self, most: int) -> FloatArray:
        """Return the last learning errors, (n,) with n at most `most`, the newest last."""
        recent = self.errors[-most:]
        return np.asarray(recent[np.isfinite(recent)])

    @property
    def typical(self) -> float:
        """Slowness of the stream's typical direction: the median of all slow features'."""
        spectrum = self.sfa.state.spectrum
        known = spectrum[np.isfinite(spectrum)]
        if len(known) < FEWEST:
            return WHITE_NOISE
        return float(known[len(known) // 2])

    @property
    def arrays(self) -> dict[str, NDArray[Any]]:
        """Everything that changes in it, by name; no copies."""
        arrays = {
            "counters": np.array([self.blocks, self.tests, self._reference_age], dtype=np.int64),
            "measures": np.array([self.change, self.regret]),
            "errors": self.errors,
            "moments": self._moments,
            "phi": self._phi,
            "last": self._last,
            "reference": self._reference,
        }
        sfa = zip(RecursiveState._fields, self.sfa.state, strict=True)
        return arrays | {f"sfa.{name}": array for name, array in sfa}

    def restore(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Go to where another of the same sizes was.

        Raises:
            ValueError: an array is missing or of another shape or type.
        """
        current = self.arrays
        overwrite(current, arrays)
        self.blocks, self.tests, self._reference_age = current["counters"].tolist()
        self.change, self.regret = current["measures"].tolist()


class Candidates(dict[int, Candidate]):
    """The candidates in memory, by their streams.

    Args:
        new: makes one.
        size: bytes of one.

    Attributes:
        most: held at once.
    """

    def __init__(self, new: Callable[[], Candidate], size: int) -> None:
        super().__init__()
        self._new = new
        self.most = max(2, min(HELD, MEMORY // size))

    def opened(self, stream: int, learning: NDArray[np.bool_], last: NDArray[Any]) -> Candidate:
        """Return the candidate of a stream, for which another may have to go.

        Args:
            stream: which.
            learning: (S,) which streams are being learned.
            last: (S,) iterations of their last blocks.
        """
        if stream not in self:
            while len(self) >= self.most:
                idle = [s for s in self if not learning[s]]
                del self[min(idle or self, key=lambda s: last[s])]
            self[stream] = self._new()
        return self[stream]

    @property
    def arrays(self) -> dict[str, NDArray[Any]]:
        """Everything that changes in them, by name, a copy."""
        streams = sorted(self)
        arrays = {
            f"candidate.{stream}.{name}": array.copy()
            for stream in streams
            for name, array in self[stream].arrays.items()
        }
        return arrays | {"held": np.array(streams, dtype=np.int64)}

    def restore(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Hold the candidates that are stored in these arrays, among others.

        Raises:
            ValueError: an array is missing or of another shape or type.
        """
        self.clear()
        for stream in arrays["held"].tolist():
            prefix = f"candidate.{stream}."
            parts = {k.removeprefix(prefix): v for k, v in arrays.items() if k.startswith(prefix)}
            self[stream] = self._new()
            self[stream].restore(parts)
