"""Slow feature analysis in river's interface, which learns on from sample to sample."""

from __future__ import annotations

from collections.abc import Mapping
from math import nan
from typing import Any, Self

import numpy as np

from cdmisfa.agents.inputs import LARGEST_VALUE
from cdmisfa.core.arrays import FloatArray
from cdmisfa.core.errors import UsageError
from cdmisfa.features.outputs import project
from cdmisfa.features.recursive import RecursiveFeature
from cdmisfa.kernels import mean_output

try:
    from river.base import Transformer
except ImportError:

    class Transformer:  # type: ignore[no-redef]
        def __new__(cls, *_: Any, **__: Any) -> Self:
            raise UsageError(
                f"{cls.__name__} needs river, which is missing: pip install 'cdmisfa[river]'"
            )


class OnlineSFA(Transformer):  # type: ignore[misc]
    """The slowest features of all samples so far: `RecursiveSFA`, a sample at a time.

    The features of x are those of the first sample learned from. One that lacks some of them, or
    holds no finite number, is a gap: nothing is learned from it, nor from the difference across it.
    Its outputs are those of the means in place of what it lacks.

    Args:
        n_components: slow features to find; those beyond the features of x are 0.
        n_whitened: principal components that they are found among.
        window: samples of the exponential window; the first so many all count the same.

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
        """Learn from a sample that follows the one before.

        Raises:
            UsageError: no such features can be found.
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
        """Outputs of a sample, the slowest first; 0 where there is no such feature yet."""
        y = np.zeros(self.n_components)
        if self._feature is not None:
            sample, mean, phi = self._sample(x), self._feature.mean, self._feature.phi
            sample = np.where(np.isnan(sample), mean, sample)
            y[: len(phi)] = project(phi, mean_output(phi, mean), sample[None])[0]
        return {f"onlinesfa{i}": float(value) for i, value in enumerate(y)}

    @property
    def slowness(self) -> float:
        """Slowness of the slowest feature, in cycles a sample; NaN where there is none yet."""
        return nan if self._feature is None else self._feature.slowness

    def _sample(self, x: Mapping[Any, Any]) -> FloatArray:
        """Return the features in their order, NaN where there is no number to learn from."""
        values = (x.get(name, nan) for name in self._names)
        return np.array([float(v) if _is_number(v) else nan for v in values])


def _is_number(value: Any) -> bool:
    real = isinstance(value, int | float | np.number | np.bool_)
    return real and bool(abs(value) <= LARGEST_VALUE)  # a NaN is not
