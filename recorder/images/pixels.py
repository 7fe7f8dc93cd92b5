"""Images in other people's messages: found, decoded, made gray and small."""

from __future__ import annotations

import io
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any, BinaryIO, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from cdmisfa.core.errors import LogDamagedError, UsageError
from cdmisfa.core.untrusted.memory import BUDGET, budget
from recorder.images.areas import averaged
from recorder.images.reading import Depth

Bytes = NDArray[np.uint8]

Shown = NDArray[Any]
"""What one message shows: a gray image, (height, width) uint8, or one in colours, (height, width,
3), or numbers, (I,) float64."""

MAX_PIXELS: Final = 36_000_000
"""Largest image that is decoded, more than one of 7680x4320."""

_BAND: Final = 1 << 20
"""Pixels that are made gray at a time, for what is between takes several bytes each."""

RECIPE: Final = (
    "gray: 16 bit by its high byte, colour as (19595 R + 38470 G + 7471 B + 32768) >> 16; "
    "size: area average (Pillow BOX); turned as the EXIF of a JPEG or PNG says"
)
"""How any image becomes a frame, for the record."""

_ORIENTATION: Final = 0x0112
"""The tag of EXIF that says how a camera was held."""

_TURNS: Final = {
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_270,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}
"""What puts an image upright, by its orientation; 1 is."""

_WORDS: Final = ("I;16", "I;16B", "I")
"""Pillow's modes of 16 bit."""

_LAYOUTS: Final[Mapping[str, tuple[int, str]]] = {
    "mono8": (1, "gray"),
    "8UC1": (1, "gray"),
    "mono16": (2, "gray16"),
    "16UC1": (2, "gray16"),
    "rgb8": (3, "rgb"),
    "8UC3": (3, "bgr"),
    "bgr8": (3, "bgr"),
    "rgba8": (4, "rgb"),
    "bgra8": (4, "bgr"),
    "8UC4": (4, "bgr"),
}
_BAYER: Final[Mapping[str, str]] = {
    f"bayer_{order}{bits}": order for order in ("rggb", "bggr", "gbrg", "grbg") for bits in (8, 16)
}
"""Formats of one colour a pixel, and the colours of two by two of them, row by row."""

_DEPTHS: Final[Mapping[str, tuple[str, float]]] = {"16UC1": ("u2", 0.001), "32FC1": ("f4", 1.0)}
"""Formats of distances: their numbers, and how many metres one is (REP 118)."""

DISTANCES: Final = frozenset(_DEPTHS)
"""Formats that hold distances."""

ENCODINGS: Final = tuple(_LAYOUTS)
"""Pixel formats that are read as they are."""


class MalformedImage(LogDamagedError):  # noqa: N818 - says what is wrong with an image, not where
    """What is no image that is read; who knows where it came from adds that."""


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
) -> Bytes:
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
    if encoding == "32FC1" and depth is None:
        raise UsageError("its images are distances (32FC1): say which to show, as --range 0.3:5")
    if encoding in _BAYER:
        layout: tuple[int, str] | None = (1, "bayer") if encoding.endswith("8") else (2, "bayer")
    elif encoding in _DEPTHS and depth is not None:
        layout = (int(_DEPTHS[encoding][0][1]), "depth")
    else:
        layout = _LAYOUTS.get(encoding)
    if layout is None:
        raise UnknownPixels(
            f"its pixel format {encoding[:40]!r} is not read: use one of "
            f"{', '.join([*ENCODINGS, '32FC1', *_BAYER])}"
        )
    size, kind = layout
    step = step or width * size
    if not 0 < height * width <= MAX_PIXELS:
        raise MalformedImage(f"an image of {height}x{width} pixels is not read")
    if step < width * size or step * (height - 1) + width * size > len(data):
        raise MalformedImage(
            f"an image of {height}x{width} {encoding} with a step of {step} bytes does not "
            f"fit its {len(data)} bytes"
        )
    raw = np.frombuffer(data, np.uint8)
    rows = np.ndarray((height, width, size), np.uint8, raw, 0, (step, size, 1))
    if kind == "depth" and depth is not None:
        number, metres = _DEPTHS[encoding]
        order = ">" if big_endian else "<"
        values = np.ndarray((height, width), order + number, raw, 0, (step, size))
        return _shown_depth(values, metres, depth)
    if kind == "bayer":
        pattern, order = rows[:, :, 0 if big_endian else size - 1], _BAYER[encoding]
        return _bayer_colors(pattern, order) if color else _bayer_gray(pattern, order)
    if kind == "gray":
        return np.ascontiguousarray(rows[:, :, 0])
    if kind == "gray16":
        return np.ascontiguousarray(rows[:, :, 0 if big_endian else 1])
    if color:
        return np.ascontiguousarray(rows[:, :, [kind.index(c) for c in "rgb"]])
    found = np.empty((height, width), np.uint8)
    for band in _bands(height, width):
        part, order = rows[band], kind.upper() + "X" * (size - 3)
        pixels = part.tobytes()  # without what is between the rows
        colors = Image.frombuffer("RGB", (width, len(part)), pixels, "raw", order, 0, 1)
        found[band] = np.asarray(colors.convert("L"))  # as in `RECIPE`
    return found


def _bayer_gray(pixels: Bytes, order: str) -> Bytes:
    """The grey of each two by two pixels of a Bayer pattern, without interpolation."""
    height, width = pixels.shape[0] // 2, pixels.shape[1] // 2
    if not height * width:
        raise MalformedImage("a Bayer pattern has two rows and columns at least")
    weights = {"r": 19595, "g": 19235, "b": 7471}
    found = np.empty((height, width), np.uint8)
    for band in _bands(height, width):
        rows = pixels[2 * band.start : 2 * min(band.stop, height)]
        total = np.full((len(rows) // 2, width), 32768, np.uint32)
        for place, colour in enumerate(order):
            cell = rows[place // 2 :: 2, place % 2 : 2 * width : 2]
            total += weights[colour] * cell.astype(np.uint32)
        found[band] = total >> 16
    return found


def _bayer_colors(pixels: Bytes, order: str) -> Bytes:
    """The colours of each two by two pixels of a Bayer pattern; green is the mean of its two."""
    height, width = pixels.shape[0] // 2, pixels.shape[1] // 2
    if not height * width:
        raise MalformedImage("a Bayer pattern has two rows and columns at least")
    cells = [pixels[i // 2 : 2 * height : 2, i % 2 : 2 * width : 2] for i in range(4)]
    one, two = (cells[i].astype(np.uint16) for i, colour in enumerate(order) if colour == "g")
    green = ((one + two + 1) >> 1).astype(np.uint8)
    return np.stack([cells[order.index("r")], green, cells[order.index("b")]], axis=2)


def _shown_depth(values: NDArray[Any], metres: float, depth: Depth) -> Bytes:
    """Distances as gray; 0, infinity and NaN, which are none, as black."""
    near, far = depth
    if near < 0:
        raise UsageError("--range: no distance is below 0, write NEAR:FAR in metres, as 0.3:5")
    found = np.empty(values.shape, np.uint8)
    for band in _bands(*values.shape):
        distance = values[band].astype(np.float64) * metres
        distance[~np.isfinite(distance) | (distance <= 0)] = near
        shown = (np.clip(distance, near, far) - near) * (255 / (far - near))
        found[band] = np.floor(shown + 0.5)
    return found


def _bands(height: int, width: int) -> Iterator[slice]:
    step = max(_BAND // width, 1)
    return (slice(start, start + step) for start in range(0, height, step))


def _high_bytes(pixels: NDArray[Any]) -> Bytes:
    found = np.empty(pixels.shape, np.uint8)
    for band in _bands(*pixels.shape):
        found[band] = (pixels[band].astype(np.int64) >> 8).clip(0, 255)
    return found


def shrink(image: Bytes, height: int, width: int, *, enlarge: bool = False) -> Bytes:
    """Average the areas of a gray image into fewer pixels.

    Args:
        image: (rows, columns) uint8.
        height: rows of the result.
        width: columns of the result.
        enlarge: repeat the pixels of a smaller image instead of refusing it.

    Raises:
        UsageError: the image is smaller.
    """
    if image.shape == (height, width):
        return image
    if not enlarge and (image.shape[0] < height or image.shape[1] < width):
        raise UsageError(
            f"an image of {image.shape[1]}x{image.shape[0]} is smaller than {width}x{height}: "
            "choose a smaller --size"
        )
    if (found := averaged(image, height, width)) is not None:
        return found
    small = Image.fromarray(image).resize((width, height), Image.Resampling.BOX)
    return np.asarray(small, np.uint8)


def compressed_image(data: bytes, *, color: bool = False) -> Bytes:
    """The image in a JPEG or PNG, gray, (height, width) uint8.

    Args:
        data: the file.
        color: give what has colours as they are, (height, width, 3) red, green and blue.

    Raises:
        MalformedImage: it is neither, broken, or too large.
    """
    with _opened(data) as image:
        if image.mode in _WORDS:
            return _high_bytes(np.asarray(image))
        if image.mode not in ("L", "RGB"):
            image = image.convert("RGB")
        return np.array(image if color else image.convert("L"), np.uint8)


def compressed_words(data: bytes) -> NDArray[np.uint16]:
    """Decode a PNG of 16 bit, as distances are packed in, into (height, width).

    Raises:
        MalformedImage: it is none, broken, or too large.
    """
    with _opened(data) as image:
        if image.mode not in _WORDS:
            raise MalformedImage(f"its distances are packed as {image.mode}, not in 16 bit")
        return np.asarray(image).astype(np.uint16)


@contextmanager
def _opened(data: bytes) -> Iterator[Image.Image]:
    """A JPEG or PNG, upright; Pillow decodes it when it is asked for."""
    try:
        with budget(), warnings.catch_warnings():
            warnings.simplefilter("error")
            image: Image.Image = Image.open(io.BytesIO(data), formats=["JPEG", "PNG"])
            if not 0 < image.width * image.height <= MAX_PIXELS:
                raise MalformedImage(f"an image of {image.width}x{image.height} is not read")
            if image.info.get("progressive") and _progressive_bytes(image) > BUDGET:
                raise MalformedImage(
                    f"a progressive JPEG of {image.width}x{image.height} in {image.mode} takes "
                    f"more than {BUDGET >> 20} MiB of memory, the limit"
                )
            if (orientation := _orientation(image)) in _TURNS:
                image = image.transpose(_TURNS[orientation])
            yield image
    except MalformedImage:
        raise
    except MemoryError:
        raise MalformedImage(
            f"its JPEG or PNG takes more than {BUDGET >> 20} MiB of memory, the limit"
        ) from None
    except Exception as error:  # Pillow raises whatever its codecs raise
        raise MalformedImage(f"its JPEG or PNG is broken ({type(error).__name__})") from None


def picture_size(file: BinaryIO) -> tuple[int, int] | None:
    """The (height, width), upright, that the head of a JPEG or PNG states; None if it is broken."""
    try:
        with budget(), Image.open(file, formats=["JPEG", "PNG"]) as image:
            turned = 5 <= _orientation(image) <= 8
            return (image.width, image.height) if turned else (image.height, image.width)
    except Exception:  # Pillow raises whatever its codecs raise
        return None


def _orientation(image: Image.Image) -> int:
    """EXIF's number for how the camera was held; 1, upright, where nothing whole says it."""
    if "exif" not in image.info:
        return 1
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            return int(image.getexif().get(_ORIENTATION, 1))
    except Exception:  # Pillow raises whatever its parser raises; the picture may be whole
        return 1


def _progressive_bytes(image: Image.Image) -> int:
    """Memory of decoding a progressive JPEG, whose coefficients are all held until its end."""
    return image.width * image.height * (2 * len(image.getbands()) + 4)
