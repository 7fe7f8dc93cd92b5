"""The quantity of the world that a module's output follows, for reports and views."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from cdmisfa.core.arrays import FloatArray

# Last frames of an output that are fitted.
FITTED = 20_000

# Correlation by which a function must be followed better than a simpler one.
BETTER = 0.03

# Sines of an angle that are tried.
FREQUENCIES = 12


@dataclass(frozen=True, slots=True)
class TruthFit:
    """A function of a true quantity that an output follows.

    Attributes:
        column: column of the ground truth.
        function: formula with the name of the quantity.
        r: correlation of the output with the function, 0 to 1.
        weights: (K,) of the terms.
        terms: (n,) truth -> (n, K).
    """

    column: int
    function: str
    r: float
    weights: FloatArray
    terms: Callable[[FloatArray], FloatArray]

    def __call__(self, truth: FloatArray) -> FloatArray:
        """Return the function's values."""
        return np.asarray(self.terms(truth) @ self.weights)


def truth_fits(names: Sequence[str], truth: FloatArray, y: FloatArray) -> list[TruthFit]:
    """Return how an output follows each true quantity, the one that it follows most first.

    Args:
        names: names of the columns of truth.
        truth: (n, D) ground truth; the last `FITTED` frames count.
        y: (n,) the output.
    """
    truth, y = truth[-FITTED:], y[-FITTED:]
    turn = 2 * np.pi
    tried = []
    for column, name in enumerate(names if len(truth) else ()):
        x = truth[:, column]
        # An angle goes all around a circle, in radians.
        angle = x.min() >= 0 and x.max() <= turn and np.ptp(x) > 0.9 * turn
        tried.append(simplest_fit(x, y, column, name, angle=bool(angle)))
    return sorted((fit for fit in tried if fit), key=lambda fit: -fit.r)


def simplest_fit(
    truth: FloatArray, y: FloatArray, column: int, name: str, *, angle: bool
) -> TruthFit | None:
    """Return the simplest function of a true quantity that an output follows.

    Of an angle these are its sines, of all others a straight line or, where
    that is better by `BETTER`, a parabola: a slow feature need not be the quantity itself.

    Args:
        truth: (n,) its values.
        y: (n,) the output.
        column: number of the quantity.
        name: its name.
        angle: whether the quantity is an angle that covers a whole turn.
    """
    if len(truth) < 3 or np.std(truth) == 0 or np.std(y) == 0:
        return None
    powers = range(1, min(len(np.unique(truth)), 3))
    tried = [
        (name if k == 1 else f"a parabola of {name}", partial(_powers, degree=k)) for k in powers
    ]
    if angle:
        tried += [
            (f"sin({name if k == 1 else f'{k} {name}'} + c)", partial(_sines, frequency=k))
            for k in range(1, FREQUENCIES + 1)
        ]
    best: TruthFit | None = None
    for function, terms in tried:
        table = terms(truth)
        weights: FloatArray = np.linalg.lstsq(table, y, rcond=None)[0].astype(np.float64)
        fit = table @ weights
        r = float(np.corrcoef(fit, y)[0, 1]) if np.std(fit) > 0 else 0.0
        if best is None or r > best.r + BETTER:
            best = TruthFit(column, function, r, weights, terms)
    return best


def _powers(x: FloatArray, degree: int) -> FloatArray:
    return np.stack([x**k for k in range(degree + 1)], axis=1)


def _sines(x: FloatArray, frequency: int) -> FloatArray:
    return np.stack([np.ones_like(x), np.sin(frequency * x), np.cos(frequency * x)], axis=1)
