"""`Candidate`: the slow features that are being learned of one stream, with their tests.

Each block is tested before the candidate learns from it, so that every test uses frames that the
features have not seen.
"""

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

# Slowness of white noise in cycles a frame, 0.2251: its differences have twice its variance, and
# slowness is sqrt(E(dy^2) / Var(y)) / (2 pi).
WHITE_NOISE_SLOWNESS = math.sqrt(2.0) / (2.0 * math.pi)

# Slow features that a stream must have for their median to be its typical slowness; with fewer,
# the slowness of white noise is used. Set by hand: the median of three or fewer features is itself
# one of the slowest. It matters only for
# frames of one value or `learner.components` below 4.
MIN_SPECTRUM = 4

# Learning errors that a candidate stores, in blocks: the last 30 are compared with the 60 before
# (`STALLED_BLOCKS` in `decisions.py`). Set by hand; each error takes 8 bytes in every stored state.
ERROR_HISTORY = 90

# Largest number of candidates in memory, and largest total size in bytes (decision 0029 of
# docs/project/decisions.md). Beyond it the candidate of another stream is dropped and starts again
# at that stream's next block. At 64x48 a candidate takes 1.3 MB, or 1.7 MB after `widen`, so that a
# stored state stays below 54 MB whatever the number of streams.
MAX_CANDIDATES = 32
MAX_CANDIDATE_BYTES = 2 * 1024**3

# Learning error before the first test. It exceeds the error of any tested candidate in practice
# (a change of at most sqrt(2), and a disagreement that is seldom above 1).
UNTESTED_ERROR = 3.0

# Largest change of an output with a block that enters the mean: sqrt(2), the change of an output
# that is uncorrelated with itself before.
MAX_CHANGE = math.sqrt(2.0)

# Smallest slowness in a ratio, so that its logarithm is finite for an output that does not move.
_MIN_SLOWNESS = 1e-12


def log_ratio(a: float, b: float) -> float:
    """Return ln(a / b) of two slownesses, finite also if one of them is 0."""
    return kernels.log(max(a, _MIN_SLOWNESS) / max(b, _MIN_SLOWNESS))


def learning_error(change: float, tested: float, fitted: float) -> float:
    """Return the learning error e = change + |ln(tested / fitted)|.

    Equation: P2

    Args:
        change: mean change of the outputs per block.
        tested: slowness on frames that the candidate had not learned from (cycles a frame).
        fitted: slowness on the frames that it learned from (cycles a frame).
    """
    return change + abs(log_ratio(tested, fitted))


class Candidate:
    """Slow features that are being learned of one stream.

    Args:
        n_inputs: number of inputs I.
        components: number of whitened components K.
        outputs: number of slow features.
        window: exponential window of the SFA statistics (frames).
        test_window: exponential window of the tests (blocks).
        more: `principal` and `wide` of the recursive SFA.

    Attributes:
        sfa: the recursive SFA.
        y: (n, J) outputs on the last block, computed before the candidate learned from it; NaN
            before the first test.
        blocks: number of blocks that the candidate learned from.
        tests: number of blocks that were tested.
        change: mean change of the outputs per block, see `RecursiveFeature.update`.
        improvement: ln of the slowness that the weights of one test window ago have now, divided
            by the slowness of the present weights: 0 if learning gained nothing since. The signal
            is called `regret`.
        errors: (ERROR_HISTORY,) learning errors of the last blocks, the newest last; NaN before.
    """

    def __init__(
        self,
        n_inputs: int,
        components: int,
        outputs: int,
        window: int,
        test_window: int,
        **more: int,
    ) -> None:
        self.sfa = RecursiveFeature(n_inputs, components, outputs, window, **more)
        n_outputs = len(self.sfa.state.weights)
        self.test_window = test_window
        self.blocks = self.tests = self._reference_age = 0
        self.change = self.improvement = math.nan
        self.errors = np.full(ERROR_HISTORY, np.nan)
        self.y = np.zeros((0, n_outputs))
        self._moments = np.zeros((3, n_outputs))
        self._phi = np.zeros((n_outputs, n_inputs))
        self._last = np.zeros(n_outputs)
        self._reference = np.zeros(n_inputs)

    def learn(self, frames: NDArray[Any], gap: bool) -> None:
        """Test on a block, then learn from it.

        Args:
            frames: (n, I) consecutive frames.
            gap: True if the frames do not follow the previous block.
        """
        self.y = np.full((len(frames), len(self._last)), np.nan)
        if self.varies:
            self._test(frames, gap)
        changes = self.sfa.update(frames, gap)
        self.blocks += 1
        changes = changes[np.isfinite(changes)]
        if len(changes):
            change = min(float(changes.sum()), MAX_CHANGE)
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
                before = self.sfa.compare(self._reference).slowness
                self.improvement = log_ratio(before, self.fitted)
            self._reference[:] = self.sfa.phi[0]
            self._reference_age = 0

    def _test(self, frames: NDArray[Any], gap: bool) -> None:
        """Update the running moments of the outputs and of their differences.

        The first difference, from the last frame of the previous block, is computed with the
        weights that the previous block was tested with, since these have learned from neither of
        the two frames. With the present weights it would lead from a learned frame to a new one,
        and the measured slowness of noise would be 0.318 instead of 0.226 (decision 0025).
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
    def varies(self) -> bool:
        """Whether any frame of the stream differed from another."""
        return bool(self.sfa.state.weights.any())

    @property
    def fitted(self) -> float:
        """Slowness of the slowest output on the frames learned from; NaN before any output."""
        return self.sfa.slowness

    @property
    def tested(self) -> FloatArray:
        """(J,) slowness of each output on frames before they were learned; NaN before any test."""
        if not self.tests:
            return np.full(len(self._last), np.nan)
        return slowness_by_moments(self._moments[2], self.variance)

    @property
    def variance(self) -> FloatArray:
        """(J,) variance of each output on frames before they were learned."""
        mean, square, _ = self._moments
        return np.asarray(square - mean * mean)

    @property
    def error(self) -> float:
        """The `learning_error` of the candidate; `UNTESTED_ERROR` before the first test."""
        if not self.tests or math.isnan(self.change):
            return UNTESTED_ERROR
        return learning_error(self.change, float(self.tested[0]), self.fitted)

    def recent_errors(self, most: int) -> FloatArray:
        """Return at most `most` learning errors, the newest last."""
        recent = self.errors[-most:]
        return np.asarray(recent[np.isfinite(recent)])

    @property
    def typical(self) -> float:
        """The stream's typical slowness: the median slowness of its K slow features."""
        spectrum = self.sfa.state.spectrum
        computed = spectrum[np.isfinite(spectrum)]
        if len(computed) < MIN_SPECTRUM:
            return WHITE_NOISE_SLOWNESS
        return float(computed[len(computed) // 2])

    @property
    def arrays(self) -> dict[str, NDArray[Any]]:
        """The arrays of the candidate's state by name; most are views, not copies."""
        counters = self.blocks, self.tests, self._reference_age, self.sfa.is_wide
        arrays = {
            "counters": np.array(counters, dtype=np.int64),
            "measures": np.array([self.change, self.improvement]),
            "errors": self.errors,
            "moments": self._moments,
            "phi": self._phi,
            "last": self._last,
            "reference": self._reference,
        }
        sfa = zip(RecursiveState._fields, self.sfa.state, strict=True)
        return arrays | {f"sfa.{name}": array for name, array in sfa}

    def restore(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Restore the state of a candidate with the same sizes.

        Raises:
            ValueError: an array is missing or has a different shape or type.
        """
        if np.any(np.asarray(arrays.get("counters", ()))[3:]):
            self.sfa.widen()
        current = self.arrays
        overwrite(current, arrays)
        self.blocks, self.tests, self._reference_age, _ = current["counters"].tolist()
        self.change, self.improvement = current["measures"].tolist()


class Candidates(dict[int, Candidate]):
    """The candidates in memory, by the index of their stream.

    Args:
        new: creates a candidate of a stream.
        size: size of the largest candidate (bytes).

    Attributes:
        capacity: largest number of candidates in memory.
    """

    def __init__(self, new: Callable[[int], Candidate], size: int) -> None:
        super().__init__()
        self._new = new
        self.capacity = max(2, min(MAX_CANDIDATES, MAX_CANDIDATE_BYTES // size))

    def get_or_create(
        self, stream: int, learning: NDArray[np.bool_], last: NDArray[Any]
    ) -> Candidate:
        """Return the candidate of a stream; drop another one if a new one does not fit.

        Args:
            stream: index of the stream.
            learning: (S,) True where a stream is being learned; its candidate is dropped last.
            last: (S,) iteration of the last block of each stream; the oldest is dropped first.
        """
        if stream not in self:
            while len(self) >= self.capacity:
                idle = [s for s in self if not learning[s]]
                del self[min(idle or self, key=lambda s: last[s])]
            self[stream] = self._new(stream)
        return self[stream]

    @property
    def arrays(self) -> dict[str, NDArray[Any]]:
        """Copies of the arrays of all candidates, by name."""
        streams = sorted(self)
        arrays = {
            f"candidate.{stream}.{name}": array.copy()
            for stream in streams
            for name, array in self[stream].arrays.items()
        }
        return arrays | {"held": np.array(streams, dtype=np.int64)}

    def restore(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Replace all candidates by those stored in `arrays`, which may hold other arrays too.

        Raises:
            ValueError: an array is missing or has a different shape or type.
        """
        self.clear()
        for stream in arrays["held"].tolist():
            prefix = f"candidate.{stream}."
            parts = {k.removeprefix(prefix): v for k, v in arrays.items() if k.startswith(prefix)}
            self[stream] = self._new(stream)
            self[stream].restore(parts)
