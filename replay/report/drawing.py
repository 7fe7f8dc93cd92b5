"""Plots as SVG that keeps its letters' size at every width, and pictures as data URIs."""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from cdmisfa.core.arrays import FloatArray, IntArray
from replay.palette import CYCLE

WIDE = 1000
"""Units of a plot across: it is stretched to the width of the page."""

BINS = 500
"""Places across a plot at which a curve has a least and a greatest value."""


def number(value: float) -> str:
    """A coordinate, as short as can be."""
    return f"{value:.1f}".removesuffix(".0")


def colour_class(stream: int) -> str:
    """CSS class of a stream's colour."""
    return f"c{stream % len(CYCLE)}"


@dataclass(slots=True)
class Axis:
    """Values at places of a plot, [start, stop] on [0, size]; from the bottom up if turned.

    Attributes:
        log: by their logarithms; `start` is above 0.
    """

    start: float
    stop: float
    size: float
    log: bool = False
    turned: bool = False

    def __call__(self, values: Any) -> FloatArray:
        """Places of values, (n,)."""
        low, high = self._scaled(self.start), self._scaled(self.stop)
        part = (self._scaled(values) - low) / max(high - low, 1e-12)
        return np.asarray(self.size * (1 - part if self.turned else part), dtype=np.float64)

    def _scaled(self, values: Any) -> Any:
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.log10(values) if self.log else np.asarray(values, dtype=np.float64)

    def ticks(self, most: int) -> list[float]:
        """Round values, some up to `most`."""
        if self.log:
            return _powers(self.start, self.stop, most)
        span = self.stop - self.start
        if not span > 0:
            return [self.start]
        step = 10.0 ** math.floor(math.log10(span / most))
        step *= next(m for m in (1, 2, 5, 10) if span / (step * m) <= most)
        first = math.ceil(self.start / step - 1e-9)
        return [round(k * step, 12) for k in range(first, math.floor(self.stop / step + 1e-9) + 1)]


def _powers(low: float, high: float, most: int) -> list[float]:
    low, high = max(low, 1e-300), max(high, 1e-300)
    first, last = math.floor(math.log10(low)), math.ceil(math.log10(high))
    for parts in ((1, 2, 5), (1, 3), (1,)):
        found = [m * 10.0**p for p in range(first, last + 1) for m in parts]
        found = [value for value in found if low <= value <= high]
        if len(found) <= most:
            return found
    return found[:: -(-len(found) // most)]


@dataclass(slots=True)
class Label:
    """Words at a place of a plot, across in percent and down in pixels."""

    x: str
    y: str
    text: str
    anchor: str = "start"
    kind: str = ""


@dataclass(slots=True)
class Plot:
    """A plot: what it draws, in `WIDE` units across and pixels down, and words at places.

    Attributes:
        about: what it shows, for who cannot see it.
        names: left of it, in place of the ticks of an axis, each with the class of its colour.
        frames: which pictures belong to places of it, if any.
        most: ticks across.
    """

    x: Axis
    y: Axis
    about: str
    parts: list[str] = field(default_factory=list)
    labels: list[Label] = field(default_factory=list)
    ticks: list[Label] = field(default_factory=list)
    names: list[tuple[str, str]] = field(default_factory=list)
    frames: str = ""
    most: int = 8

    @property
    def height(self) -> int:
        """Pixels."""
        return int(self.y.size)

    @property
    def drawn(self) -> Markup:
        """The inside of its SVG: made of numbers and classes alone."""
        return Markup("".join(self.parts))

    @property
    def across(self) -> list[Label]:
        """Ticks below it."""
        found = []
        for value in self.x.ticks(self.most):
            place = float(self.x(value)) / WIDE * 100
            anchor = "start" if place < 3 else "end" if place > 97 else "middle"
            found.append(Label(f"{number(place)}%", "11", f"{value:,.10g}", anchor))
        return found

    def add(self, tag: str, kind: str, **attributes: Any) -> None:
        """An element of SVG, of a CSS class."""
        words = (f' {name}="{value}"' for name, value in attributes.items())
        self.parts.append(f'<{tag} class="{kind}"{"".join(words)}/>')

    def path(self, kind: str, d: str) -> None:
        """A path; none where it is empty."""
        if d:
            self.add("path", kind, d=d)

    def grid(self, most: int = 5, form: str = "g") -> None:
        """Lines across at round values, with these left of them."""
        for value in self.y.ticks(most):
            y = float(self.y(value))
            self.path("grid", f"M0 {number(y)}h{WIDE}")
            place = number(min(max(y + 4, 9), self.height))
            text = f"{value:{form}}" if value else "0"
            self.ticks.append(Label("100%", place, text, "end"))

    def limit(self, value: float, text: str) -> None:
        """A line across where something is decided."""
        y = float(self.y(value))
        self.path("limit", f"M0 {number(y)}h{WIDE}")
        if text:
            above = y > 16
            self.labels.append(
                Label("100%", number(y - 4 if above else y + 12), text, "end", "back")
            )

    def marks(self, at: Iterable[float], kind: str = "saved") -> None:
        """Lines down at places of x."""
        self.path(kind, "".join(f"M{number(float(self.x(t)))} 0v{self.height}" for t in at))

    def word(self, t: float, y: float, text: str, kind: str = "back", avoid: float = 84) -> None:
        """Words right of a place, or left of it where the plot ends."""
        place = float(self.x(t)) / WIDE * 100
        right = place < avoid
        self.labels.append(
            Label(f"{number(place + (0.5 if right else -0.5))}%", number(y), text,
                  "start" if right else "end", kind)
        )  # fmt: skip

    def line(
        self, kind: str, t: FloatArray, values: FloatArray, parts: IntArray | None = None
    ) -> None:
        """A curve, from the least to the greatest of each place where many values are at one.

        Args:
            kind: its CSS class.
            t: (n,) where.
            values: (n,); it is broken where they are no numbers.
            parts: (n,) numbers of its unbroken parts.
        """
        with np.errstate(invalid="ignore"):
            known = np.isfinite(values) & ((values > 0) if self.y.log else True)
        part = np.cumsum(~known, dtype=np.int64)
        if parts is not None:
            part += parts * (len(t) + 1)
        x, y, part = self.x(t[known]), self.y(values[known]), part[known]
        y = np.clip(y, 0, self.height)
        kept = _extremes(x, y, part)
        x, y, part = x[kept], y[kept], part[kept]
        found = []
        for piece in np.split(np.arange(len(x)), np.flatnonzero(np.diff(part)) + 1):
            if len(piece) == 1:
                found.append(_dot(x[piece[0]], y[piece[0]]))
            elif len(piece):
                pairs = zip(x[piece].tolist(), y[piece].tolist(), strict=True)
                found.append("M" + "L".join(f"{number(a)} {number(b)}" for a, b in pairs))
        self.path(f"line {kind}", "".join(found))

    def dots(self, kind: str, t: FloatArray, values: FloatArray) -> None:
        """Points."""
        known = np.isfinite(values)
        places = zip(self.x(t[known]).tolist(), self.y(values[known]).tolist(), strict=True)
        self.path(f"dots {kind}", "".join(_dot(x, y) for x, y in places))


def _dot(x: float, y: float) -> str:
    return f"M{number(x)} {number(y)}h0"


def _extremes(x: FloatArray, y: FloatArray, part: IntArray) -> IntArray:
    """Indices of the least and the greatest y at each place and in each part, in order."""
    place = np.minimum((x * (BINS / WIDE)).astype(np.int64), BINS - 1)
    starts = np.flatnonzero(np.diff(place, prepend=-1) | np.diff(part, prepend=part[:1] - 1))
    stops = np.append(starts, len(x))[1:]
    kept = [
        a + k
        for a, b in zip(starts.tolist(), stops.tolist(), strict=True)
        for k in {int(np.argmin(y[a:b])), int(np.argmax(y[a:b]))}
    ]
    return np.array(sorted(kept), dtype=np.int64)


def padded(
    values: FloatArray, *, log: bool, also: Sequence[float | None] = ()
) -> tuple[float, float]:
    """A range that shows values and some limits, with a little room."""
    known = values[np.isfinite(values) & ((values > 0) | (not log))]
    every = [*([] if not len(known) else [float(known.min()), float(known.max())])]
    every += [value for value in also if value is not None and (value > 0 or not log)]
    low, high = (min(every), max(every)) if every else (0.1, 1.0)
    if log:
        return low / 1.25, high * 1.25
    room = 0.06 * (high - low) or max(abs(high), 1.0) * 0.1
    return low - room, high + room


def data_uri(picture: NDArray[np.uint8], *, photo: bool) -> str:
    """A picture, (height, width) or (height, width, 3), as a JPEG where it is a photo, or a PNG."""
    from PIL import Image

    data, kind = io.BytesIO(), "jpeg" if photo else "png"
    image = Image.fromarray(np.ascontiguousarray(picture))
    if photo:
        image.save(data, "JPEG", quality=78)
    else:
        image.save(data, "PNG", optimize=True)
    return f"data:image/{kind};base64,{base64.b64encode(data.getvalue()).decode()}"


def reduced(picture: NDArray[Any], most: int) -> NDArray[Any]:
    """A picture of at most so many pixels across or down, by the mean of areas."""
    step = -(-max(picture.shape[:2]) // most)
    if step <= 1:
        return picture
    height, width = (size // step * step for size in picture.shape[:2])
    cut = picture[:height, :width].astype(np.float64)
    shape = (height // step, step, width // step, step, *picture.shape[2:])
    found: NDArray[Any] = cut.reshape(shape).mean(axis=(1, 3))
    return found.astype(picture.dtype) if picture.dtype == np.uint8 else found


def sheet(pictures: Sequence[NDArray[np.uint8]], columns: int, gap: int = 0) -> NDArray[np.uint8]:
    """Pictures (height, width) in rows of so many, white between them."""
    height, width = pictures[0].shape
    rows = -(-len(pictures) // columns)
    columns = min(columns, len(pictures))
    shape = rows * (height + gap) - gap, columns * (width + gap) - gap
    found = np.full(shape, 255, np.uint8)
    for k, picture in enumerate(pictures):
        y, x = (height + gap) * (k // columns), (width + gap) * (k % columns)
        found[y : y + height, x : x + width] = picture
    return found
