"""Slow feature analysis as scikit-learn estimators with `partial_fit`.

The rows of X are samples that follow one another in time. `gap=True` marks a batch that does not
follow the previous one; no difference is then taken across the gap.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from numbers import Integral, Real
from typing import Any, Self

import numpy as np

from cdmisfa.agents.inputs import LARGEST_VALUE
from cdmisfa.core.arrays import FloatArray, refuse_masked
from cdmisfa.core.config import MAX_COMPONENTS, LearnerConfig
from cdmisfa.core.errors import missing_base
from cdmisfa.features.incsfa import IncrementalFeature
from cdmisfa.features.outputs import project
from cdmisfa.features.recursive import PIECE, RecursiveFeature
from cdmisfa.kernels import mean_output, multiply

try:
    from sklearn.base import BaseEstimator, ClassNamePrefixFeaturesOutMixin, TransformerMixin
    from sklearn.exceptions import ConvergenceWarning
    from sklearn.utils.validation import check_is_fitted, check_random_state, validate_data

    class _Estimator(
        ClassNamePrefixFeaturesOutMixin,  # type: ignore[misc]
        TransformerMixin,  # type: ignore[misc]
        BaseEstimator,  # type: ignore[misc]
    ):
        pass

except ImportError:
    _Estimator = missing_base("scikit-learn", "'cdmisfa[sklearn]'")  # type: ignore[misc]


# Samples that are converted to float64 at once. It is a multiple of the pieces in which
# `RecursiveFeature` learns, so that its value does not change the result.
CHUNK = 16 * PIECE

# IncSFA has converged if its first output has at least this correlation with the slowest feature of
# the last `REFERENCE` samples, and at most this share of the slowness of the whitened input. White
# noise of 5,000 samples and 12 features reaches a share of 0.97 by chance.
CONVERGED, BELOW_INPUT, REFERENCE = 0.9, 0.95, 8000


class _SlowFeatures(_Estimator):
    """Base of both estimators; derived classes define `_begin`."""

    n_components: int
    n_whitened: int
    window: int
    _feature: Any

    def fit(self, X: Any, y: Any = None) -> Self:
        """Learn from one sequence; forget everything learned before.

        Args:
            X: (n, I) samples that follow one another in time.
            y: ignored.

        Raises:
            ValueError: X or a parameter is not valid.
        """
        self.__dict__.pop("_feature", None)
        return self._learn(X, False, fewest=2)

    def partial_fit(self, X: Any, y: Any = None, *, gap: bool = False) -> Self:
        """Continue learning with samples that follow the previous ones, or come after a gap.

        Args:
            X: (n, I) samples that follow one another in time.
            y: ignored.
            gap: True if the first sample does not follow the last one of the previous call, because
                samples are missing or another sequence begins.

        Raises:
            ValueError: X or a parameter is not valid.
        """
        return self._learn(X, gap, fewest=1)

    def transform(self, X: Any) -> FloatArray:
        """Return the outputs (X - mean_) @ components_.T, the same bits on every machine.

        Args:
            X: (n, I) samples, in any order.

        Returns:
            (n, n_components), the slowest first.

        Raises:
            NotFittedError: the estimator has not learned yet.
            ValueError: X is not valid.
        """
        check_is_fitted(self)
        X = self._checked(X, reset=False)
        weights, mean = np.ascontiguousarray(self.components_), self.mean_
        offset = mean_output(weights, mean)
        return np.concatenate([project(weights, offset, x) for x in _chunks(X)])

    @property
    def components_(self) -> FloatArray:
        """(n_components, I) weights of the centred sample; 0 for features not learned yet."""
        return np.array(self._feature.phi)

    @property
    def mean_(self) -> FloatArray:
        """(I,) mean of the samples, over the window."""
        return np.array(self._feature.mean)

    def __sklearn_is_fitted__(self) -> bool:
        return "_feature" in vars(self)

    @property
    def _n_features_out(self) -> int:
        return len(self._feature.phi)

    def _begin(self, n_features: int) -> Any:
        raise NotImplementedError

    def _follow(self, x: FloatArray, gap: bool) -> None:
        """Handle samples that the estimator has learned from."""

    def _learn(self, X: Any, gap: bool, fewest: int) -> Self:
        first = not self.__sklearn_is_fitted__()
        X = self._checked(X, reset=first, ensure_min_samples=fewest)
        largest = max(abs(float(X.max())), abs(float(X.min())))
        if largest > LARGEST_VALUE:
            raise ValueError(f"X holds {largest:g}, above the limit of {LARGEST_VALUE:g}: scale it")
        if first:
            self._check(X.shape[1])
            self._feature = self._begin(X.shape[1])
            self.n_samples_seen_ = 0
        for x in _chunks(X):
            self._feature.update(x, gap)
            self._follow(x, gap)
            self.n_samples_seen_ += len(x)
            gap = False
        return self

    def _checked(self, X: Any, **options: Any) -> Any:
        refuse_masked(X, "X")
        if isinstance(X, list | tuple):  # scikit-learn passes None in lists, but not in arrays
            X = np.asarray(X)
        X = validate_data(self, X, dtype="numeric", **options)
        if X.dtype.kind in "mM":
            raise ValueError(f"X has type {X.dtype}: give times as numbers, or leave them out")
        return X

    def _check(self, n_features: int) -> None:
        sizes = {"n_components": self.n_components, "n_whitened": self.n_whitened}
        for name, value in {**sizes, "window": self.window}.items():
            if not isinstance(value, Integral) or isinstance(value, bool) or value < 1:
                raise ValueError(f"{name} is {value!r}: give a whole number from 1")
        limit = min(self.n_whitened, n_features, MAX_COMPONENTS)
        if self.n_components > limit:
            raise ValueError(
                f"n_components is {self.n_components}: with n_whitened={self.n_whitened} and "
                f"n_features={n_features} give at most {limit}"
            )


class RecursiveSFA(_SlowFeatures):
    """Slow feature analysis of all samples so far, without a learning rate.

    It stores the largest principal components and the covariance of the differences along them, and
    solves for the slowest directions after every batch. If X has at most `n_whitened` features and
    at most `window` samples, the result is that of batch SFA up to rounding, however the samples
    are cut into batches.

    Args:
        n_components: number of slow features.
        n_whitened: number of principal components among which they are found, at most the number
            of features of X.
        window: exponential window (samples); the first `window` samples have equal weights.
        n_principal: number of principal components with variance 1 that follow the slow features,
            as in a module; J = n_components + n_principal outputs.

    Attributes:
        components_: (J, n_features_in_) weights of the centred sample.
        mean_: (n_features_in_,) mean of the samples.
        slowness_: (J,) slowness of each output (cycles a sample).
        n_samples_seen_: number of samples learned from.
        n_features_in_: number of features of X.
        feature_names_in_: names of the features of X, if X has names.

    Example:
        >>> t = np.arange(2000.0)
        >>> X = np.stack([np.sin(t / 50) + np.sin(t), np.sin(t)], axis=1)
        >>> sfa = RecursiveSFA().fit(X[:1000]).partial_fit(X[1000:])
        >>> round(float(sfa.slowness_[0] * 2 * np.pi * 50), 2)
        0.99
    """

    def __init__(
        self,
        n_components: int = 1,
        *,
        n_whitened: int = 16,
        window: int = 8000,
        n_principal: int = 0,
    ) -> None:
        self.n_components = n_components
        self.n_whitened = n_whitened
        self.window = window
        self.n_principal = n_principal

    @property
    def slowness_(self) -> FloatArray:
        """(J,) slowness, sqrt(E(ydot^2) / Var(y)) / 2 pi; NaN before it is learned."""
        feature, slow = self._feature, self._n_features_out - self.n_principal
        return np.append(feature.state.spectrum[:slow], feature.output_slowness[slow:])

    def inverse_transform(self, Y: Any) -> FloatArray:
        """Return the samples that have these outputs with the least mean square error.

        Args:
            Y: (n, J) outputs.

        Returns:
            (n, I) samples.

        Raises:
            NotFittedError: the estimator has not learned yet.
            ValueError: Y has another shape.
        """
        check_is_fitted(self)
        Y, state = np.asarray(Y, np.float64), self._feature.state
        if Y.ndim != 2 or Y.shape[1] != self._n_features_out:
            raise ValueError(f"Y has the shape {Y.shape}: give (n, {self._n_features_out})")
        if self.n_principal:  # slow features are uncorrelated with one another, not with these
            Y = Y @ np.linalg.pinv(
                multiply(state.weights * state.variance, state.weights.T), hermitian=True
            )
        patterns = multiply(state.weights * state.variance, state.basis)
        return np.asarray(multiply(np.ascontiguousarray(Y), patterns) + self.mean_)

    def _check(self, n_features: int) -> None:
        super()._check(n_features)
        limit, value = min(self.n_whitened, n_features), self.n_principal
        if not isinstance(value, Integral) or isinstance(value, bool) or not 0 <= value <= limit:
            raise ValueError(f"n_principal is {value!r}: give a whole number from 0 to {limit}")

    def _begin(self, n_features: int) -> Any:
        sizes = n_features, min(self.n_whitened, n_features), self.n_components, self.window
        return RecursiveFeature(*sizes, principal=self.n_principal)


class IncSFA(_SlowFeatures):
    """Incremental slow feature analysis, sample by sample, with a learning rate.

    This is the algorithm of the paper's learner: candid covariance-free PCA, and minor component
    analysis of the whitened differences (Kompella, Luciw and Schmidhuber 2012). It follows streams
    that change, and needs thousands of samples to converge; `RecursiveSFA` needs fewer.

    Args:
        n_components: number of slow features.
        n_whitened: number of principal components among which they are found, at most the number
            of features of X.
        nu: learning rate, 0 to 1.
        window: window of the running mean and of the slowness (samples).
        random_state: seed or generator of the initial weights.

    Attributes:
        components_: (n_components, n_features_in_) weights of the centred sample.
        mean_: (n_features_in_,) running mean of the samples.
        slowness_: (n_components,) slowness of each feature over the window (cycles a sample).
        n_samples_seen_: number of samples learned from.
        n_features_in_: number of features of X.
        feature_names_in_: names of the features of X, if X has names.

    Example:
        >>> t = np.arange(20000.0)
        >>> X = np.stack([np.sin(t / 50) + np.sin(t), np.sin(t)], axis=1)
        >>> y = IncSFA(n_whitened=2).fit(X).transform(X)
        >>> round(abs(float(np.corrcoef(y[:, 0], np.sin(t / 50))[0, 1])), 1)
        1.0
    """

    def __init__(
        self,
        n_components: int = 1,
        *,
        n_whitened: int = 16,
        nu: float = 0.05,
        window: int = 1000,
        random_state: Any = 0,
    ) -> None:
        self.n_components = n_components
        self.n_whitened = n_whitened
        self.nu = nu
        self.window = window
        self.random_state = random_state

    _moments: FloatArray
    _measured: int
    _last: FloatArray

    def fit(self, X: Any, y: Any = None) -> Self:
        """Learn from one sequence; forget everything learned before.

        A `ConvergenceWarning` is raised if the first output is not the slowest feature of the last
        samples (correlation below 0.9 with that of `RecursiveSFA`), or is not slower than the
        whitened input, as in white noise.

        Args:
            X: (n, I) samples that follow one another in time.
            y: ignored.

        Raises:
            ValueError: X or a parameter is not valid.
        """
        super().fit(X)
        last = self._checked(X, reset=False)[-REFERENCE:]
        slowest = RecursiveFeature(last.shape[1], self.n_whitened)
        for x in _chunks(last):
            slowest.update(x)
        spectrum = slowest.state.spectrum[np.isfinite(slowest.state.spectrum)]
        if len(spectrum) < 2:  # one feature cannot be slower than the input
            return self
        fit, whitened = slowest.compare(self.components_[0]), np.sqrt(np.mean(spectrum**2))
        if fit.rho < CONVERGED or fit.slowness > BELOW_INPUT * whitened:
            warnings.warn(
                f"IncSFA has not converged: its first output has slowness {fit.slowness:.4f}, "
                f"the whitened input {whitened:.4f}, and the slowest feature {spectrum[0]:.4f} "
                f"(correlation {fit.rho:.2f}): use RecursiveSFA, or give more samples",
                ConvergenceWarning,
                stacklevel=2,
            )
        return self

    @property
    def slowness_(self) -> FloatArray:
        """(n_components,) slowness, sqrt(E(ydot^2) / Var(y)) / 2 pi; NaN before it is learned."""
        mean, square, moves = self._moments
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.asarray(np.sqrt(moves / (square - mean * mean)) / (2 * np.pi))

    def _begin(self, n_features: int) -> Any:
        if not isinstance(self.nu, Real) or not 0 <= self.nu <= 1:
            raise ValueError(f"nu is {self.nu!r}: give a learning rate of 0 to 1")
        config = LearnerConfig(
            outputs=self.n_components,
            components=min(self.n_whitened, n_features),
            nu=self.nu,
            mean_window=self.window,
        )
        seed = check_random_state(self.random_state).randint(2**31 - 1)
        self._moments, self._measured = np.zeros((3, self.n_components)), 0
        return IncrementalFeature(config, n_features, np.random.default_rng(seed))

    def _follow(self, x: FloatArray, gap: bool) -> None:
        """Update the moments of the outputs, from which `slowness_` follows."""
        weights = self._feature.phi
        before = x[:0] if gap or not self.n_samples_seen_ else self._last
        self._last = x[-1:].copy()
        y = project(weights, mean_output(weights, self._feature.mean), np.concatenate([before, x]))
        if len(y) < 2:
            return
        now, moves = y[1:], np.diff(y, axis=0)
        self._measured = min(self._measured + len(now), self.window)
        share = min(len(now) / self._measured, 1.0)
        new = np.stack([now, now**2, moves**2]).mean(axis=1)
        self._moments = (1 - share) * self._moments + share * new


def _chunks(X: Any) -> Iterator[FloatArray]:
    """Yield the rows as float64 arrays of at most `CHUNK` rows."""
    for start in range(0, len(X), CHUNK):
        yield np.ascontiguousarray(X[start : start + CHUNK], np.float64)
