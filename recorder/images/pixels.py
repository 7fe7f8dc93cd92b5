"""Conversion of raw pixels in all supported formats to gray or color, and shrinking of images."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from cdmisfa.core.arrays import ByteArray, FloatArray
from cdmisfa.core.errors import LogDamagedError, UsageError
from recorder.images.options import Depth

# Content of a message: a gray image (height, width) uint8, a color image (height, width, 3) uint8,
# or numbers (I,) float64.
Content = NDArray[Any]

# Largest number of pixels of an image that is decoded, more than 7680x4320.
MAX_PIXELS: Final = 36_000_000

# Supported pixel formats, and the meaning of each byte of a pixel.
ENCODINGS: Final[Mapping[str, str]] = {
    "mono8": "g",
    "8UC1": "g",
    "mono16": "gg",
    "16UC1": "gg",
    "rgb8": "rgb",
    "8UC3": "bgr",
    "bgr8": "bgr",
    "rgba8": "rgbX",
    "bgra8": "bgrX",
    "8UC4": "bgrX",
}

# Formats with one color for each pixel, and the colors of two by two pixels, row by row.
_BAYER: Final[Mapping[str, str]] = {
    f"bayer_{order}{bits}": order for order in ("rggb", "bggr", "gbrg", "grbg") for bits in (8, 16)
}

# Formats of distances: their numpy type, and the metres of one unit (REP 118).
DISTANCES: Final[Mapping[str, tuple[str, float]]] = {"16UC1": ("u2", 0.001), "32FC1": ("f4", 1.0)}

# Pixels that are converted at a time, because intermediate arrays take several bytes for each.
_BAND: Final = 1 << 20


# Losses that several decoders have.
GRAY: Final = "colors become gray: keep them with --color on"
TO_8_BITS: Final = "to keep lower bits, scale its 16-bit pixels to 8 bits before"
HIGH_BYTE: Final = f"16-bit pixels are reduced to their high byte: {TO_8_BITS}"
ALPHA: Final = "transparency is ignored"

_losses: ContextVar[list[str] | None] = ContextVar("_losses", default=None)


@contextmanager
def losses() -> Iterator[list[str]]:
    """Collect what decoders drop, reduce or turn in this thread, as `lost` states it."""
    lines: list[str] = []
    token = _losses.set(lines)
    try:
        yield lines
    finally:
        _losses.reset(token)


def lost(line: str, when: object = True) -> None:
    """State a loss of the image that is decoded, on a condition, to `losses`."""
    lines = _losses.get()
    if lines is not None and (when() if callable(when) else when):
        lines.append(line)


class MalformedImage(LogDamagedError):  # noqa: N818 - its text lacks the place
    """Image that cannot be read; the caller adds its place to the error."""


class UnknownPixels(MalformedImage):
    """Pixels in a format that is not supported."""


def raw_image(
    data: bytes | memoryview,
    height: int,
    width: int,
    encoding: str,
    step: int = 0,
    *,
    big_endian: bool = False,
    depth: Depth | None = None,
    color: bool = False,
) -> ByteArray:
    """Convert pixels of any supported format to gray, (height, width) uint8.

    Two by two pixels of a Bayer pattern become one, so that the result is (height // 2, width //
    2).

    Args:
        data: rows of `step` bytes.
        height: height of the image (pixels).
        width: width of the image (pixels).
        encoding: name of the pixel format in ROS.
        step: bytes from one row to the next; 0: as many as the pixels take.
        big_endian: byte order of values of 16 and 32 bits.
        depth: distances (m) that become black and white, for 16UC1 in millimetres and 32FC1 in
            metres; pixels without a measurement become black. None: 16UC1 is gray.
        color: True to return red, green and blue, (height, width, 3).

    Raises:
        UsageError: 32FC1 without `depth`.
        UnknownPixels: the format is not supported.
        MalformedImage: the sizes contradict the data.
    """
    number, metres = DISTANCES.get(encoding, ("", 0.0))
    if encoding == "32FC1" and depth is None:
        raise UsageError("its images are distances (32FC1): add --set input.range=0.3,5")
    if number and depth is not None:
        size = int(number[1])
    elif encoding in _BAYER:
        size = 2 if encoding.endswith("16") else 1
    elif encoding in ENCODINGS:
        size = len(ENCODINGS[encoding])
    else:
        known = ", ".join([*ENCODINGS, "32FC1", *_BAYER])
        raise UnknownPixels(
            f"its pixel format {encoding[:40]!r} is not supported: use one of {known}"
        )
    step = step or width * size
    fits = width * size <= step and step * (height - 1) + width * size <= len(data)
    if not 0 < height * width <= MAX_PIXELS or not fits:
        raise MalformedImage(
            f"an image of {height}x{width} {encoding} with a step of {step} bytes does not "
            f"fit its {len(data)} bytes, or has more than {MAX_PIXELS} pixels"
        )
    raw = np.frombuffer(data, np.uint8)
    if number and depth is not None:
        kind = (">" if big_endian else "<") + number
        distances = np.ndarray((height, width), kind, raw, 0, (step, size))
        return by_bands(distances, lambda part: _depth_gray(part, metres, depth))
    rows = np.ndarray((height, width, size), np.uint8, raw, 0, (step, size, 1))
    lost(GRAY, not color and (size > 2 or encoding in _BAYER))
    lost(ALPHA, "X" in ENCODINGS.get(encoding, ""))
    lost(f"distances ({encoding}) are read as gray: set --set input.range=NEAR,FAR", number)
    if size < 3:
        lost(HIGH_BYTE, size == 2)
        lost("two by two pixels of a Bayer pattern become one", encoding in _BAYER)
        high = rows[:, :, 0 if big_endian else size - 1]
        order = _BAYER.get(encoding)
        return np.ascontiguousarray(high) if order is None else _bayer(high, order, color=color)
    order = ENCODINGS[encoding]
    if color:
        return np.ascontiguousarray(rows[:, :, [order.index(c) for c in "rgb"]])

    def gray(part: ByteArray) -> Any:
        pixels = part.tobytes()  # without the bytes between the rows
        colors = Image.frombuffer("RGB", (width, len(part)), pixels, "raw", order.upper(), 0, 1)
        return np.asarray(colors.convert("L"))  # as in `RECIPE`

    return by_bands(rows, gray)


def by_bands(pixels: NDArray[Any], convert: Callable[[NDArray[Any]], Any]) -> ByteArray:
    """Convert rows of pixels, (height, width, ...), to gray, some rows at a time."""
    height, width = pixels.shape[:2]
    gray = np.empty((height, width), np.uint8)
    step = max(_BAND // width, 1)
    for start in range(0, height, step):
        gray[start : start + step] = convert(pixels[start : start + step])
    return gray


def _bayer(pixels: ByteArray, order: str, *, color: bool) -> ByteArray:
    """Return gray or color of each two by two pixels; green is the mean of its two pixels."""
    height, width = pixels.shape[0] // 2, pixels.shape[1] // 2
    if not height * width:
        raise MalformedImage("its Bayer pattern has less than two rows or columns")
    squares = pixels[: 2 * height, : 2 * width].reshape(height, 2, width, 2).swapaxes(1, 2)
    cells = squares.reshape(height, width, 4)
    if color:
        first, second = (place for place, name in enumerate(order) if name == "g")
        total = cells[:, :, first].astype(np.uint16) + cells[:, :, second]
        green = ((total + 1) >> 1).astype(np.uint8)
        return np.stack([cells[:, :, order.index("r")], green, cells[:, :, order.index("b")]], 2)
    # The weights of `RECIPE`, with that of green divided among two pixels.
    weights = np.array([{"r": 19595, "g": 19235, "b": 7471}[name] for name in order], np.uint32)
    return by_bands(cells, lambda part: (part @ weights + 32768) >> 16)


def _depth_gray(values: NDArray[Any], metres: float, depth: Depth) -> FloatArray:
    """Map distances to gray; 0, infinity and NaN mean no measurement and become black."""
    near, far = depth
    distances = values.astype(np.float64) * metres
    absent = ~np.isfinite(distances) | (distances <= 0)
    lost("pixels without a distance become black", absent.any())
    distances[absent] = near
    return np.floor((np.clip(distances, near, far) - near) * (255 / (far - near)) + 0.5)


def shrink(image: ByteArray, height: int, width: int) -> ByteArray:
    """Shrink a gray image by averaging areas; repeat the pixels of a smaller one.

    Args:
        image: (rows, columns) uint8.
        height: height of the result.
        width: width of the result.
    """
    if image.shape == (height, width):
        return image
    small = Image.fromarray(image).resize((width, height), Image.Resampling.BOX)
    return np.asarray(small, np.uint8)
