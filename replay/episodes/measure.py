"""Measure an episode in one pass over its images and numbers; nothing here knows other episodes."""

from __future__ import annotations

import json
import zipfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from cdmisfa.core.arrays import ByteArray, FloatArray
from recorder.images.pixels import MalformedImage
from recorder.log.files import atomic_write
from replay.logs.health import BLACK, WHITE

# Width of the view of an image, in pixels: larger ones are averaged over whole blocks of pixels.
# Wide enough to measure a shift of the camera by a pixel, small enough for 30 images/s of 640x480.
VIEW: Final = 128

# Width of the thumbnail that features are learned from, in pixels.
THUMBNAIL: Final = 16

# Images that the view without moving things is the median of.
STILLS: Final = 8

# Bins of each of the two color differences, and their width in gray levels.
BINS: Final = 7
BIN: Final = 30

# Columns of `Camera.frames`, one value for each image.
FRAME: Final = ("sharpness", "brightness", "black", "saturated", "change", "again")

# Arrays of `Camera`, as a file has them.
ARRAYS: Final = ("times", "frames", "thumbnails", "colors", "begin", "end")


@dataclass(slots=True)
class CameraMeasures:
    """Measures of the images of one camera in one episode.

    Attributes:
        times: (T,) time of each image (s).
        frames: (T, 6) measures of each image, see `FRAME`.
        thumbnails: (T, I) pixels of each image at `THUMBNAIL` width.
        colors: (49,) share of pixels in each bin of color.
        begin: (h, w) median image of the first third.
        end: (h, w) median image of the last third.
        scale: width of an image over the width of its view.
    """

    times: FloatArray
    frames: FloatArray
    thumbnails: ByteArray
    colors: FloatArray
    begin: FloatArray
    end: FloatArray
    scale: float

    def column(self, name: str) -> FloatArray:
        """Return a measure of each image, (T,)."""
        return self.frames[:, FRAME.index(name)]


@dataclass(slots=True)
class Measured:
    """Measures of one episode.

    Attributes:
        name: its name: the path of its file, or its number.
        cameras: measures of each camera.
        numbers: (times (N,), values (N, n)) of "state" and of "action", if there are any.
        problem: why it cannot be read, or "".
        remarks: lines about images that are left out.
    """

    name: str
    cameras: dict[str, CameraMeasures] = field(default_factory=dict)
    numbers: dict[str, tuple[FloatArray, FloatArray]] = field(default_factory=dict)
    problem: str = ""
    remarks: list[str] = field(default_factory=list)

    @property
    def seconds(self) -> float:
        """Duration from the first to the last image or number, and one period."""
        clocks = [c.times for c in self.cameras.values()] + [t for t, _ in self.numbers.values()]
        return max((float(t[-1] - t[0]) + period(t) for t in clocks if len(t)), default=0.0)


class CameraMeter:
    """Measures the images of one camera as they come, and holds no more than a few of them.

    Args:
        times: (T,) time of each image (s).

    Attributes:
        broken: a line for each image that cannot be decoded.
    """

    def __init__(self, times: FloatArray) -> None:
        self._times, self.broken, self._scale = times, list[str](), 1.0
        self._rows, self._frames = list[int](), list[tuple[float, ...]]()
        self._thumbnails, self._colors = list[ByteArray](), np.zeros(BINS * BINS)
        first = set(np.linspace(0, max(len(times) // 3, 1) - 1, STILLS).astype(int).tolist())
        self._stills = first, {len(times) - 1 - row for row in first}
        self._views: tuple[list[FloatArray], list[FloatArray]] = [], []
        self._last: list[FloatArray] = []

    def add(self, row: int, image: NDArray[Any]) -> None:
        """Measure the image of a row, (height, width) or (height, width, 3) uint8."""
        factor = max(image.shape[1] // VIEW, 1)
        view = np.asarray(Image.fromarray(image).reduce(factor))
        gray = view if view.ndim == 2 else view.sum(2, dtype=np.int16) / np.float32(3)
        gray = gray.astype(np.float32)
        if self._last and self._last[0].shape != gray.shape:
            raise MalformedImage("it has another size than the images before it")
        # Codecs with a key frame every two frames show a frozen image as A B A B.
        changes = [float(np.abs(gray - one).mean()) for one in self._last] or [0.0]
        exposure = float(gray.mean()), float((gray < BLACK).mean()), float((gray > WHITE).mean())
        self._frames.append((sharpness(image), *exposure, changes[-1], min(changes)))
        self._rows.append(row)
        small = Image.fromarray(view)
        size = (THUMBNAIL, max(round(view.shape[0] * THUMBNAIL / view.shape[1]), 1))
        self._thumbnails.append(np.asarray(small.resize(size, Image.Resampling.BOX)).reshape(-1))
        if view.ndim == 3:
            self._colors += color_bins(view)
        for stills, views in zip(self._stills, self._views, strict=True):
            if row in stills:
                views.append(gray)
        self._last, self._scale = [*self._last[-1:], gray], float(factor)

    def result(self) -> CameraMeasures | None:
        """Return the measures; None without a readable image."""
        if not self._rows:
            return None
        frames = np.array(self._frames, np.float64)
        frames[0, -2:] = frames[min(1, len(frames) - 1), -2]
        stills = [np.median(views or self._last, axis=0) for views in self._views]
        colors = self._colors / max(self._colors.sum(), 1)
        times, thumbnails = self._times[self._rows], np.stack(self._thumbnails)
        return CameraMeasures(times, frames, thumbnails, colors, stills[0], stills[1], self._scale)


def sharpness(image: NDArray[Any]) -> float:
    """Return the variance of the Laplacian of an image, of its green; of a large one in 60 rows.

    s = var(4 g[y, x] - g[y, x-1] - g[y, x+1] - g[y-1, x] - g[y+1, x])
    """
    green = image if image.ndim == 2 else image[:, :, 1]
    if min(green.shape) < 3:
        return 0.0
    step = green.shape[0] // 60 if green.shape[0] >= 200 else 1
    rows = green[1:-1:step].astype(np.int16)
    above, below = green[:-2:step], green[2::step]
    laplacian = 4 * rows[:, 1:-1] - rows[:, :-2] - rows[:, 2:] - above[:, 1:-1] - below[:, 1:-1]
    return float(laplacian.var())


def color_bins(view: NDArray[Any]) -> FloatArray:
    """Return the number of pixels in each bin of (red - green, blue - green)."""
    red, green, blue = (view[..., i].astype(np.int16) for i in range(3))
    a, b = (np.clip((c - green + BINS * BIN // 2) // BIN, 0, BINS - 1) for c in (red, blue))
    return np.bincount((a * BINS + b).ravel(), minlength=BINS * BINS).astype(np.float64)


def period(times: FloatArray) -> float:
    """Return the median time between two rows (s); 0 for a single row."""
    return float(np.median(np.diff(times))) if len(times) > 1 else 0.0


def save_measures(measured: Measured, file: Path) -> None:
    """Write the measures of an episode to an .npz file."""
    facts = [measured.name, measured.problem, measured.remarks]
    cameras = {name: camera.scale for name, camera in measured.cameras.items()}
    arrays: dict[str, Any] = {"facts": np.array(json.dumps([*facts, cameras, [*measured.numbers]]))}
    for name, camera in measured.cameras.items():
        arrays |= {f"{array} {name}": getattr(camera, array) for array in ARRAYS}
    for kind, rows in measured.numbers.items():
        arrays |= {f"{i} {kind}": array for i, array in enumerate(rows)}
    with atomic_write(file) as partial, open(partial, "wb") as out:
        np.savez(out, **arrays)


def load_measures(file: Path) -> Measured | None:
    """Return the measures in a file; None if there is none, or it is damaged."""
    try:
        with open(file, "rb") as stored, np.load(stored) as arrays:
            name, problem, remarks, scales, kinds = json.loads(str(arrays["facts"]))
            cameras = dict[str, CameraMeasures]()
            for camera, scale in scales.items():
                parts: Any = {array: arrays[f"{array} {camera}"] for array in ARRAYS}
                cameras[camera] = CameraMeasures(**parts, scale=scale)
            numbers = {kind: (arrays[f"0 {kind}"], arrays[f"1 {kind}"]) for kind in kinds}
            return Measured(name, cameras, numbers, problem, remarks)
    except (OSError, ValueError, KeyError, TypeError, zipfile.BadZipFile):
        return None
