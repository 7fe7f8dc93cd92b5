"""Health of the images of a stream: frozen, repeated, black and saturated ones."""

from __future__ import annotations

from array import array
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.arrays import FloatArray
from cdmisfa.core.errors import LogDamagedError
from recorder.images.pixels import HIGH_BYTE, Content, losses
from replay.logs.stream import LogStream

# Brightness below which a pixel is black, and above which it is saturated.
BLACK: Final = 16
WHITE: Final = 250

# Largest width of the grid of pixels that is compared. Pixels are not averaged: the sensor noise,
# which tells a frozen image from a scene at rest, would vanish.
_GRID: Final = 64

# Share of the median change below which an image is the same.
_SAME: Final = 0.1

# Gray levels by which motion changes pixels, and neither noise nor a key frame of a codec.
_FAR: Final = 24

# Images before and after a run of equal images that its end is compared with, and least number.
_AROUND: Final = 10
_LEAST: Final = 5

# Shortest frozen stretch (s).
_FROZEN: Final = 0.5

# Share of black or saturated pixels from which on an image is; the second in streams of
# which most images are so, as those with a black background.
_LIMITS: Final = 0.8, 0.995

# Columns of the health of a stream.
COLUMNS: Final = ("frozen_seconds", "frozen_at", "repeated", "black", "saturated",
                  "black_pixels", "saturated_pixels")  # fmt: skip


class Health:
    """Measures the images of a stream as they come; holds the last two, and 36 bytes of each."""

    def __init__(self) -> None:
        self._rows, self._last = array("f"), list[NDArray[Any]]()
        self._times = array("d")

    def add(self, time: float, read: Callable[[], Content]) -> None:
        """Decode and measure the next image of a stream; numbers are only decoded.

        Of images of 16 bits, which are read as their high bytes, 0 is black and 255 saturated.

        Args:
            time: its time (s).
            read: returns the image, gray uint8 (height, width), or numbers.
        """
        with losses() as lines:
            image = read()
        if image.ndim != 2 or image.dtype != np.uint8:
            return
        step = max(image.shape[1] // _GRID, 1)
        grid = image[::step, ::step].copy()
        last = self._last if self._last and self._last[0].shape == grid.shape else []
        changes = [np.maximum(grid, one) - np.minimum(grid, one) for one in last] or [grid * 0]
        low, high = (1, 254) if HIGH_BYTE in lines else (BLACK, WHITE)
        counts = (changes[-1] > _FAR, grid < low, grid > high)
        half = grid.size // 2
        for change in (changes[-1], changes[0]):
            self._rows.extend((change.mean(), np.partition(change, half, None)[half]))
        self._rows.extend(np.count_nonzero(part) / grid.size for part in counts)
        self._times.append(time)
        self._last = [*last[-1:], grid]

    def columns(self) -> dict[str, float | None]:
        """Return the columns; {} without images."""
        if not self._times:
            return {}
        times = np.array(self._times)
        rows = np.array(self._rows, np.float64).reshape(len(times), -1)
        change, typical, wide, wider, far, black, white = rows.T
        again = np.minimum(change, wide)
        steps = np.diff(times)
        period = float(np.median(steps)) if len(steps) else 0.0
        pause = np.concatenate([[True], (steps > _LEAST * period) | (steps < 0)])
        changed = (again > 0) & ~pause
        limits = [_LIMITS[int(np.median(part) > 0.5)] for part in (black, white)]
        empty = np.stack([black >= limits[0], white >= limits[1]])
        far = np.where(pause, 0, far)  # the scene may have moved while nothing was recorded
        frozen, start, repeated = 0.0, None, 0
        if changed.any():
            same = (again < _SAME * np.median(again[changed])) & ~pause & ~empty.any(0)
            noisy = _shows_noise(change[1:], typical[1:], wider[1:], same[1:])
            edges = np.flatnonzero(np.diff(np.concatenate([[False], same, [False]])))
            for first, stop in edges.reshape(-1, 2).tolist():
                seconds = float(times[stop - 1] - times[first]) + period
                is_long = seconds >= _FROZEN and stop - first >= _LEAST
                if noisy or (is_long and _jumps(far, same, first, stop)):
                    repeated += stop - first
                    if is_long and seconds > frozen:
                        frozen, start = seconds, float(times[first] - times[0])
        shares = [repeated / len(times), *empty.mean(1), black.mean(), white.mean()]
        values = [frozen, start, *map(float, shares)]
        rounded = (None if value is None else round(value, 4) for value in values)
        return dict(zip(COLUMNS, rounded, strict=True))

    def remark(self) -> str:
        """Return a line about frozen, repeated, black and saturated images, or ""."""
        columns, parts = self.columns(), list[str]()
        if (at := columns.get("frozen_at")) is not None:
            parts.append(f"frozen for {columns['frozen_seconds']:.1f} s at {at:.1f} s")
        for name in ("repeated", "black", "saturated"):
            share = columns.get(name) or 0.0
            if share >= 0.01 or share * len(self._times) >= _LEAST:
                parts.append(f"{100 * share:.1f} % of the images are {name}")
        return "; ".join(parts)


def broken_rows(stream: LogStream, health: Health) -> Iterator[tuple[int, LogDamagedError]]:
    """Measure all images of a stream, and yield each row that is broken, with its error."""
    for row, time in enumerate(stream.seconds().tolist()):
        try:
            health.add(time, partial(stream.image, row))
        except LogDamagedError as error:
            yield row, error


def _shows_noise(
    change: FloatArray, typical: FloatArray, wider: FloatArray, same: NDArray[np.bool_]
) -> bool:
    """Return whether all images have noise, so that equal ones were not taken by a sensor.

    Noise changes most pixels (`typical` is the median), and no more within two images (`wider`)
    than within one. Codecs with a key frame every two images change every second one more.
    """
    fresh = (change > 0) & ~same
    if fresh.sum() < _LEAST or fresh.mean() < 0.6 or np.median(typical[fresh]) < 1:
        return False
    alternates = np.cov(change[:-1], change[1:])[0, 1] < -0.3 * change.var()
    return bool(abs(wider[fresh].mean() / typical[fresh].mean() - 1) < 0.15 and not alternates)


def _jumps(far: FloatArray, same: NDArray[np.bool_], first: int, stop: int) -> bool:
    """Return whether the image behind a run shows that the scene moved meanwhile."""
    near = [slice(max(first - _AROUND, 0), first), slice(stop + 3, stop + 3 + _AROUND)]
    moves = np.concatenate([far[part][~same[part]] for part in near])
    after = far[stop : stop + 3].max(initial=0)  # a codec may show the motion two images later
    return bool(len(moves) >= _LEAST and after > 2.5 * np.quantile(moves, 0.75) + 0.01)
