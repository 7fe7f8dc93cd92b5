"""The reasons for which an episode is flagged: their limits, and how they are stated."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from cdmisfa.core.arrays import FloatArray, IntArray
from replay.episodes.numbers import Column

# Share of the episodes above which a reason is no fault of an episode but a property of many.
SHARED: Final = 0.1

# Fewest episodes for which that holds.
FEWEST: Final = 3


class Reason(NamedTuple):
    """A reason and its limit; the values were set on simulated data with planted faults.

    Attributes:
        limit: distance from the median, in robust standard deviations, from which on it is given.
        least: the smallest robust standard deviation that is believed, in the column's unit.
        words: how it is stated; {x} is the value, {median} the one of the others.
        form: how the value is written.
        relative: whether a value that many episodes share is normal for them, as another view.
    """

    limit: float
    least: float
    words: str
    form: str = "{}"
    relative: bool = True

    def text(self, value: float, median: float) -> str:
        """Return the reason in words, for a value and the median of the others, NaN if unknown."""
        words = self.words.partition(", the others")[0] if np.isnan(median) else self.words
        return words.format(x=self.form.format(value), median=self.form.format(median))


REASONS: Final = {
    "short": Reason(5, 0.06, "{x} long, the others {median}", "{:.1f} s"),
    "idle": Reason(5, 0.08, "the joints move {x} times as far as in the others", "{:.2f}"),
    "frozen": Reason(5, 0.06, "{x} of motion behind a frozen image", "{:.1f} s", False),
    "repeated": Reason(5, 0.01, "{x} of the images in motion are repeated", "{:.0%}", False),
    "dropped": Reason(5, 0.06, "{x} of images are missing", "{:.1f} s", False),
    "black": Reason(5, 0.02, "an image is {x} black", "{:.0%}", False),
    "light": Reason(4, 0.02, "brightness off by {x}", "{:+.0%}"),
    "flicker": Reason(5, 0.02, "brightness changes by {x} at once", "{:+.0%}", False),
    "blur": Reason(4, 0.04, "{x} times as sharp as the others", "{:.2f}"),
    "camera": Reason(5, 0.3, "the view is shifted by {x} pixels", "{:.0f}"),
    "colors": Reason(4, 0.5, "colors that the others lack, or the reverse"),
    "tint": Reason(4, 0.01, "red or blue off by {x}", "{:+.0%}"),
    "unlike": Reason(4.5, 0.03, "images unlike all other episodes"),
    "covered": Reason(5, 0.04, "something is in view that no other episode has"),
    "lag": Reason(5, 0.01, "camera {x} behind the joints, the others {median}", "{:+.2f} s"),
    "state": Reason(3, 0.1, "the states do not follow the actions"),
    "stuck": Reason(5, 0.3, "a state does not change while its action does", "{}", False),
    "jump": Reason(5, 0.1, "the states jump"),
    "noise": Reason(4, 0.1, "the states tremble"),
}


def scores(
    column: Column, groups: Sequence[IntArray]
) -> tuple[FloatArray, list[tuple[int, IntArray]]]:
    """Return how far each episode is from the median of its group, over the limit of the reason.

    score = (x - median) / max(1.4826 median |x - median|, least) / limit

    The deviation is the larger one of the group and of all groups. If a relative reason holds for
    more than `SHARED` of a group, with values alike, these are also compared with their median.

    Equation: E19

    Returns:
        (n,) scores, NaN where nothing is measured, and the episodes that share a value that is
        none of the others, with the place of their group.
    """
    reason, x = REASONS[column.reason], column.compared
    score, shared = np.full(len(x), np.nan), list[tuple[int, IntArray]]()
    for group in groups:
        if np.isfinite(x[group]).any():
            score[group] = x[group] - np.nanmedian(x[group])
    pooled = _deviation(score)
    for place, group in enumerate(groups):
        # A median of few values is uncertain, so that limits are larger in small groups.
        size = 1 + 4 / max(np.isfinite(score[group]).sum(), 1)
        unit = max(_deviation(score[group]), pooled, reason.least) * reason.limit * size
        score[group] /= unit
        many = group[score[group] >= 1]
        if not (reason.relative and len(many)):
            continue
        apart = np.abs(x[many] - np.median(x[many])) / unit
        if (apart < 1).sum() >= max(SHARED * len(group), FEWEST):
            score[many] = np.minimum(score[many], apart)
            shared.append((place, many[apart < 1]))
    return score, shared


def _deviation(rest: FloatArray) -> float:
    finite = np.abs(rest[np.isfinite(rest)])
    return 1.4826 * float(np.median(finite)) if len(finite) else 0.0
