"""Images of raw pixels, JPEG and PNG, decoded to gray or colours, and shrunk."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from cdmisfa.core.arrays import ByteArray
from cdmisfa.core.errors import LogDamagedError, TooSmallError, UsageError
from recorder.images.options import Depth

Shown = NDArray[Any]
"""What one message shows: a gray image, (height, width) uint8, or one in colours, (height, width,
3), or numbers, (I,) float64."""

MAX_PIXELS: Final = 36_000_000
"""Largest image that is decoded, more than one of 7680x4320."""

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
"""Pixel formats that are read as they are, and what each byte of a pixel is."""

_BAYER: Final[Mapping[str, str]] = {
    f"bayer_{order}{bits}": order for order in ("rggb", "bggr", "gbrg", "grbg") for bits in (8, 16)
}
"""Formats of one colour a pixel, and the colours of two by two of them, row by row."""

DISTANCES: Final[Mapping[str, tuple[str, float]]] = {"16UC1": ("u2", 0.001), "32FC1": ("f4", 1.0)}
"""Formats of distances: their numbers, and how many metres one is (REP 118)."""

_BAND: Final = 1 << 20
"""Pixels that are converted at a time: what is between takes several bytes each."""


class MalformedImage(LogDamagedError):  # noqa: N818 - says what is wrong with an image, not where
    """No image that can be read; the caller adds where it was."""


class UnknownPixels(MalformedImage):
    """Pixels in a format that is not read."""


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
    """The image that pixels of any supported format show, gray, (height, width) uint8.

    Of a Bayer pattern each two by two pixels become one, (height // 2, width // 2).

    Args:
        data: rows of `step` bytes, 0 for no more than the pixels take.
        height: rows of pixels.
        width: pixels of a row.
        encoding: the pixel format, as ROS names it.
        step: bytes from one row to the next.
        big_endian: the byte order of 16 and 32 bits.
        depth: show distances, 16UC1 in millimetres and 32FC1 in metres, from black to white;
            black, too, where none was measured. None takes 16UC1 as gray.
        color: give what has colours as they are, (height, width, 3) red, green and blue.

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
    if not 0 < height * width <= MAX_PIXELS:
        raise MalformedImage(f"an image of {height}x{width} pixels is not read")
    if step < width * size or step * (height - 1) + width * size > len(data):
        raise MalformedImage(
            f"an image of {height}x{width} {encoding} with a step of {step} bytes does not "
            f"fit its {len(data)} bytes"
        )
    raw = np.frombuffer(data, np.uint8)
    if number and depth is not None:
        kind = (">" if big_endian else "<") + number
        values = np.ndarray((height, width), kind, raw, 0, (step, size))
        return _shown_depth(values, metres, depth)
    rows = np.ndarray((height, width, size), np.uint8, raw, 0, (step, size, 1))
    if size < 3:
        high = rows[:, :, 0 if big_endian else size - 1]
        order = _BAYER.get(encoding)
        return np.ascontiguousarray(high) if order is None else _bayer(high, order, color=color)
    bytes_are = ENCODINGS[encoding]
    if color:
        return np.ascontiguousarray(rows[:, :, [bytes_are.index(c) for c in "rgb"]])

    def gray(part: ByteArray) -> Any:
        pixels = part.tobytes()  # without what is between the rows
        shape, mode = (width, len(part)), bytes_are.upper()
        colors = Image.frombuffer("RGB", shape, pixels, "raw", mode, 0, 1)
        return np.asarray(colors.convert("L"))  # as in `RECIPE`

    return by_bands(rows, gray)


def by_bands(pixels: NDArray[Any], convert: Callable[[NDArray[Any]], Any]) -> ByteArray:
    """Convert rows of pixels (height, width, ...) to gray, some rows at a time."""
    height, width = pixels.shape[:2]
    found = np.empty((height, width), np.uint8)
    step = max(_BAND // width, 1)
    for start in range(0, height, step):
        found[start : start + step] = convert(pixels[start : start + step])
    return found


def _bayer(pixels: ByteArray, order: str, *, color: bool) -> ByteArray:
    """The gray or the colours of each two by two pixels; green is the mean of its two."""
    height, width = pixels.shape[0] // 2, pixels.shape[1] // 2
    if not height * width:
        raise MalformedImage("a Bayer pattern has two rows and columns at least")
    squares = pixels[: 2 * height, : 2 * width].reshape(height, 2, width, 2).swapaxes(1, 2)
    cells = squares.reshape(height, width, 4)
    greens = [place for place, colour in enumerate(order) if colour == "g"]
    if color:
        total = cells[:, :, greens[0]].astype(np.uint16) + cells[:, :, greens[1]]
        green = ((total + 1) >> 1).astype(np.uint8)
        return np.stack([cells[:, :, order.index("r")], green, cells[:, :, order.index("b")]], 2)
    weights = np.array([{"r": 19595, "g": 19235, "b": 7471}[c] for c in order], np.uint32)
    return by_bands(cells, lambda part: (part @ weights + 32768) >> 16)


def _shown_depth(values: NDArray[Any], metres: float, depth: Depth) -> ByteArray:
    """Distances as gray; 0, infinity and NaN, which are none, as black."""
    near, far = depth
    if near < 0:
        raise UsageError("input.range: no distance is below 0, write NEAR,FAR in metres, as 0.3,5")

    def gray(part: NDArray[Any]) -> Any:
        distance = part.astype(np.float64) * metres
        distance[~np.isfinite(distance) | (distance <= 0)] = near
        return np.floor((np.clip(distance, near, far) - near) * (255 / (far - near)) + 0.5)

    return by_bands(values, gray)


def shrink(
    image: ByteArray,
    height: int,
    width: int,
    *,
    enlarge: bool = False,
    whole: tuple[int, ...] | None = None,
) -> ByteArray:
    """Average the areas of a gray image into fewer pixels.

    Args:
        image: (rows, columns) uint8.
        height: rows of the result.
        width: columns of the result.
        enlarge: repeat the pixels of a smaller image instead of refusing it.
        whole: shape of the picture that it was cropped from, for the error.

    Raises:
        TooSmallError: the image is smaller.
    """
    if image.shape == (height, width):
        return image
    if not enlarge and (image.shape[0] < height or image.shape[1] < width):
        said = f"{image.shape[1]}x{image.shape[0]}"
        if whole is not None and whole != image.shape:
            said = f"{whole[1]}x{whole[0]}, cropped to {said},"
        raise TooSmallError(
            f"an image of {said} is smaller than {width}x{height}: choose larger images"
        )
    small = Image.fromarray(image).resize((width, height), Image.Resampling.BOX)
    return np.asarray(small, np.uint8)
