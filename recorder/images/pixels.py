"""Raw pixels of all supported formats to gray or colours; images to fewer pixels."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from cdmisfa.core.arrays import ByteArray, FloatArray
from cdmisfa.core.errors import LogDamagedError, UsageError
from recorder.images.options import Depth

# Content of one message: a gray image, (height, width) uint8, or one in colours, (height, width,
# 3), or numbers, (I,) float64.
Shown = NDArray[Any]

# Largest image that is decoded, more than one of 7680x4320.
MAX_PIXELS: Final = 36_000_000

# Pixel formats that are read as they are, and what each byte of a pixel is.
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

# Formats of one colour a pixel, and the colours of two by two of them, row by row.
_BAYER: Final[Mapping[str, str]] = {
    f"bayer_{order}{bits}": order for order in ("rggb", "bggr", "gbrg", "grbg") for bits in (8, 16)
}

# Formats of distances: their numbers, and how many metres one is (REP 118).
DISTANCES: Final[Mapping[str, tuple[str, float]]] = {"16UC1": ("u2", 0.001), "32FC1": ("f4", 1.0)}

# Pixels that are converted at a time: the steps between take several bytes for each.
_BAND: Final = 1 << 20


class MalformedImage(LogDamagedError):  # noqa: N818 - its text lacks the place
    """An image cannot be read; the caller adds where it is."""


class UnknownPixels(MalformedImage):
    """The pixels have a format that is not supported."""


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

    Each two by two pixels of a Bayer pattern become one, (height // 2, width // 2).

    Args:
        data: rows of `step` bytes, 0 for no more than the pixels take.
        height: rows of pixels.
        width: pixels of a row.
        encoding: the pixel format, as ROS names it.
        step: bytes from one row to the next.
        big_endian: the byte order of 16 and 32 bits.
        depth: show distances, 16UC1 in millimetres and 32FC1 in metres, from black to white;
            no measurement is black, too. None takes 16UC1 as gray.
        color: return colours as red, green and blue, (height, width, 3).

    Raises:
        UsageError: 32FC1, and no `depth`.
        UnknownPixels: an unsupported format.
        MalformedImage: sizes that contradict the data.
    """
    number, metres = DISTANCES.get(encoding, ("", 0.0))
    if encoding == "32FC1" and depth is None:
        raise UsageError(
            "its images are distances (32FC1): say which to show, as --set input.range=0.3,5"
        )
    if number and depth is not None:
        size = int(number[1])
    elif encoding in _BAYER:
        size = 2 if encoding.endswith("16") else 1
    elif encoding in ENCODINGS:
        size = len(ENCODINGS[encoding])
    else:
        known = ", ".join([*ENCODINGS, "32FC1", *_BAYER])
        raise UnknownPixels(f"its pixel format {encoding[:40]!r} is not read: use one of {known}")
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
    if size < 3:
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
    """Return the gray or the colours of each two by two pixels; green is the mean of its two."""
    height, width = pixels.shape[0] // 2, pixels.shape[1] // 2
    if not height * width:
        raise MalformedImage("a Bayer pattern has two rows and columns at least")
    squares = pixels[: 2 * height, : 2 * width].reshape(height, 2, width, 2).swapaxes(1, 2)
    cells = squares.reshape(height, width, 4)
    if color:
        first, second = (place for place, name in enumerate(order) if name == "g")
        total = cells[:, :, first].astype(np.uint16) + cells[:, :, second]
        green = ((total + 1) >> 1).astype(np.uint8)
        return np.stack([cells[:, :, order.index("r")], green, cells[:, :, order.index("b")]], 2)
    # The weights of `RECIPE`, with green's on two pixels.
    weights = np.array([{"r": 19595, "g": 19235, "b": 7471}[name] for name in order], np.uint32)
    return by_bands(cells, lambda part: (part @ weights + 32768) >> 16)


def _depth_gray(values: NDArray[Any], metres: float, depth: Depth) -> FloatArray:
    """Map distances to gray; 0, infinity and NaN mean no measurement and are black."""
    near, far = depth
    distances = values.astype(np.float64) * metres
    distances[~np.isfinite(distances) | (distances <= 0)] = near
    return np.floor((np.clip(distances, near, far) - near) * (255 / (far - near)) + 0.5)


def shrink(image: ByteArray, height: int, width: int, *, enlarge: bool = False) -> ByteArray:
    """Average the areas of a gray image into fewer pixels.

    Args:
        image: (rows, columns) uint8.
        height: rows of the result.
        width: columns of the result.
        enlarge: repeat the pixels of a smaller image instead of rejecting it.

    Raises:
        UsageError: the image is smaller.
    """
    if image.shape == (height, width):
        return image
    if not enlarge and (image.shape[0] < height or image.shape[1] < width):
        raise UsageError(
            f"an image of {image.shape[1]}x{image.shape[0]} is smaller than {width}x{height}: "
            "choose larger images"
        )
    small = Image.fromarray(image).resize((width, height), Image.Resampling.BOX)
    return np.asarray(small, np.uint8)
