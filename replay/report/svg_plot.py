"""Plots as SVG that is stretched to the width of a page, while its letters keep their size."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from markupsafe import Markup

from cdmisfa.core.arrays import FloatArray, IntArray

# Units across a plot: about one a pixel on a screen, so 0.1 is exact enough.
WIDE = 1000

# Places across a plot at which a curve keeps its least and its greatest value.
#
# A curve of a million values so takes at most 1,000 points, about 12 kB.
PLACES = 500


def number(value: float) -> str:
    """Return a coordinate with at most one decimal place."""
    return f"{value:.1f}".removesuffix(".0")


@dataclass(frozen=True, slots=True)
class Axis:
    """Places of values on an axis of some length, by their logarithms if `log`; see `Plot`."""

    start: float
    stop: float
    size: float
    log: bool = False
    upward: bool = False

    def __call__(self, values: Any) -> FloatArray:
        """Return the places of values, from 0 to `size` within the axis; from `size` if upward."""
        with np.errstate(divide="ignore", invalid="ignore"):
            low, high, at = (
                np.log10(v) if self.log else np.asarray(v, dtype=np.float64)
                for v in (self.start, self.stop, values)
            )
        part = (at - low) / max(high - low, 1e-12)
        return np.asarray(self.size * (1 - part if self.upward else part), dtype=np.float64)

    def ticks(self, most: int) -> list[float]:
        """Return at most `most` round values: 1, 2 or 5 times a power of ten."""
        if self.log:
            powers = range(math.floor(math.log10(self.start)), math.ceil(math.log10(self.stop)) + 1)
            for factors in ((1, 2, 5), (1, 3), (1,)):
                values = [factor * 10.0**power for power in powers for factor in factors]
                values = [value for value in values if self.start <= value <= self.stop]
                if len(values) <= most:
                    return values
            return values[:: -(-len(values) // most)]
        if not (span := self.stop - self.start) > 0:
            return [self.start]
        step = 10.0 ** math.floor(math.log10(span / most))
        step *= next(factor for factor in (1, 2, 5, 10) if span / (step * factor) <= most)
        first, last = math.ceil(self.start / step - 1e-9), math.floor(self.stop / step + 1e-9)
        return [round(k * step, 12) for k in range(first, last + 1)]


class Text(NamedTuple):
    """Words at a place: percent across, pixels down."""

    x: float
    y: float
    text: str
    anchor: str = "start"
    kind: str = ""


@dataclass(slots=True)
class Plot:
    """Shapes, in `WIDE` units across and pixels down, with words and names beside them.

    Attributes:
        about: description for readers who do not see the plot.
        rows: names at its left, each with its CSS class; a plot without them has `ticks` there.
        frames: key of the frames that are shown where the reader points; "" without any.
        most: ticks across.
        x_label: name and unit of the horizontal axis.
    """

    about: str
    x: Axis
    y: Axis
    rows: list[tuple[str, str]] = field(default_factory=list)
    frames: str = ""
    most: int = 8
    x_label: str = "frame"
    shapes: list[Markup] = field(default_factory=list)
    labels: list[Text] = field(default_factory=list)
    ticks: list[Text] = field(default_factory=list)

    @property
    def across(self) -> list[Text]:
        """Ticks below the plot."""
        places = [(value, float(self.x(value)) / WIDE * 100) for value in self.x.ticks(self.most)]
        anchors = ("start" if x < 3 else "end" if x > 97 else "middle" for _, x in places)
        return [
            Text(x, 11, f"{value:,.10g}", anchor)
            for (value, x), anchor in zip(places, anchors, strict=True)
        ]

    def path(self, kind: str, pieces: Iterable[str]) -> None:
        """Add a path of a CSS class, unless it is empty."""
        if d := "".join(pieces):
            self.shapes.append(Markup('<path class="{}" d="{}"/>').format(kind, d))

    def boxes(self, kind: str, left: Any, right: Any, top: Any = 0, bottom: Any = None) -> None:
        """Add rectangles between values of x, and between pixels from the top."""
        bottom = self.y.size if bottom is None else bottom
        edges = np.broadcast_arrays(self.x(left), self.x(right), top, bottom)
        corners = zip(*([number(v) for v in edge.ravel().tolist()] for edge in edges), strict=True)
        self.path(kind, (f"M{a} {c}H{b}V{d}H{a}z" for a, b, c, d in corners))

    def marks(self, kind: str, at: Any) -> None:
        """Add lines from top to bottom at values of x."""
        places = self.x(at).ravel().tolist()
        self.path(kind, (f"M{number(x)} 0v{number(self.y.size)}" for x in places))

    def grid(self, most: int, form: str = "g") -> None:
        """Add lines across at round values of y, with the values at the left."""
        for value in self.y.ticks(most):
            y = float(self.y(value))
            self.path("grid", [f"M0 {number(y)}h{WIDE}"])
            text = f"{value:{form}}" if value else "0"
            self.ticks.append(Text(100, min(max(y + 4, 9), self.y.size), text, "end"))

    def limit(self, value: float) -> None:
        """Add a dashed line across at a value of y."""
        y = float(self.y(value))
        self.path("limit", [f"M0 {number(y)}h{WIDE}"])
        self.labels.append(Text(100, y - 4 if y > 16 else y + 12, f"{value:g}", "end", "back"))

    def word(self, at: float, y: float, text: str) -> None:
        """Add words right of a value of x, or left of it near the end of the plot."""
        x = float(self.x(at)) / WIDE * 100
        place, anchor = (x + 0.5, "start") if x < 88 else (x - 0.5, "end")
        self.labels.append(Text(place, y, text, anchor, "back strong"))

    def curve(self, kind: str, at: Any, values: Any, parts: IntArray | None = None) -> None:
        """Add a curve of (n,) values, broken at NaN and between parts of different numbers."""
        with np.errstate(invalid="ignore"):
            valid = np.isfinite(values) & ((values > 0) | (not self.y.log))
        part = np.cumsum(~valid) + (0 if parts is None else parts * (len(valid) + 1))
        x, y, part = self.x(at)[valid], self.y(values)[valid], part[valid]
        # Of many values at one place only the least and the greatest can be seen.
        place = np.minimum((x * (PLACES / WIDE)).astype(np.int64), PLACES - 1)
        order = np.lexsort((y, place, part))
        first = np.diff(place[order], prepend=-1) | np.diff(part[order], prepend=-1) != 0
        rows = np.unique(np.concatenate([order[first], order[np.roll(first, -1)]]))
        x, y, part = x[rows], np.clip(y[rows], 0, self.y.size), part[rows]
        points = [f"{number(a)} {number(b)}" for a, b in zip(x.tolist(), y.tolist(), strict=True)]
        begins = np.diff(part, prepend=-1) != 0
        alone = begins & np.roll(begins, -1)  # a point between two gaps is a dot
        for i, point in enumerate(points):
            points[i] = ("M" if begins[i] else "L") + point + ("h0" if alone[i] else "")
        self.path(f"line {kind}", points)

    def dots(self, kind: str, at: Any, values: Any) -> None:
        """Add a dot for each of (n,) values that is finite."""
        valid = np.isfinite(values)
        places = zip(self.x(at)[valid].tolist(), self.y(values)[valid].tolist(), strict=True)
        self.path(f"dots {kind}", (f"M{number(x)} {number(y)}h0" for x, y in places))
