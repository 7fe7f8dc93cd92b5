"""Slow feature analysis as a river transformer, which learns sample by sample."""

from __future__ import annotations

from collections.abc import Mapping
from math import nan
from typing import Any

import numpy as np

from cdmisfa.agents.inputs import LARGEST_VALUE
from cdmisfa.core.arrays import FloatArray, refuse_masked
from cdmisfa.core.errors import UsageError, missing_base
from cdmisfa.features.outputs import project
from cdmisfa.features.recursive import RecursiveFeature
from cdmisfa.kernels import mean_output

try:
    from river.base import Transformer
except ImportError:
    Transformer = missing_base("river", "'cdmisfa[river]'")


class OnlineSFA(Transformer):  # type: ignore[misc]
    """Slow feature analysis of all samples so far, in river's interface; see `RecursiveSFA`.

    The first sample names the features of x. A later sample that lacks one of them, or holds None,
    NaN, or a number above 1e100, counts as a gap: nothing is learned from it. In `transform_one`
    the mean replaces a missing value.

    Args:
        n_components: number of slow features; those beyond the features of x are 0.
        n_whitened: number of principal components among which they are found.
        window: exponential window (samples); the first `window` samples have equal weights.

    Example:
        >>> from math import sin
        >>> sfa = OnlineSFA()
        >>> for t in range(2000):
        ...     sfa.learn_one({"a": sin(t / 50) + sin(t), "b": sin(t)})
        >>> round(sfa.slowness * 2 * 3.14159 * 50, 2)
        0.99
        >>> list(sfa.transform_one({"a": 1.0, "b": 0.0}))
        ['onlinesfa0']
    """

    def __init__(self, n_components: int = 1, n_whitened: int = 16, window: int = 8000) -> None:
        self.n_components = n_components
        self.n_whitened = n_whitened
        self.window = window
        self._names: tuple[Any, ...] = ()
        self._feature: RecursiveFeature | None = None
        self._gap = False

    def learn_one(self, x: Mapping[Any, float]) -> None:
        """Learn from a sample that follows the previous one.

        Raises:
            UsageError: a parameter is not valid, or a value is neither a number nor None.
        """
        if self._feature is None and x:
            self._names = tuple(sorted(x, key=str))
            sizes = self.n_whitened, self.n_components, self.window
            self._feature = RecursiveFeature(len(x), *sizes)
        sample = self._sample(x)
        if self._feature is None or np.isnan(sample).any():
            self._gap = True
            return
        self._feature.update(sample[None], self._gap)
        self._gap = False

    def transform_one(self, x: Mapping[Any, float]) -> dict[str, float]:
        """Return the outputs of a sample, the slowest first; 0 for features not learned yet."""
        y = np.zeros(self.n_components)
        if self._feature is not None:
            sample, mean, phi = self._sample(x), self._feature.mean, self._feature.phi
            sample = np.where(np.isnan(sample), mean, sample)
            y[: len(phi)] = project(phi, mean_output(phi, mean), sample[None])[0]
        return {f"onlinesfa{i}": float(value) for i, value in enumerate(y)}

    @property
    def slowness(self) -> float:
        """Slowness of the slowest feature (cycles a sample); NaN before it is learned."""
        return nan if self._feature is None else self._feature.slowness

    def _sample(self, x: Mapping[Any, Any]) -> FloatArray:
        """Return the features in their order, NaN for a value that is missing or not finite."""
        return np.array([_number(name, x.get(name)) for name in self._names])


def _number(name: Any, value: Any) -> float:
    refuse_masked(value, str(name))
    try:
        number = nan if value is None else float(value)
    except (TypeError, ValueError, OverflowError):
        raise UsageError(f"{name} is {value!r}: give a number, or None if it is missing") from None
    return number if abs(number) <= LARGEST_VALUE else nan  # a NaN is not
