"""Images in other people's messages: found, decoded, made gray and small."""

from __future__ import annotations

import io
import warnings
from collections.abc import Mapping
from typing import Final

import numpy as np
from PIL import Image

from cdmisfa.core.errors import UsageError
from replay.mcap.records import Bytes, MalformedRecord

MAX_PIXELS: Final = 64 * 1024 * 1024
"""Largest image that is decoded."""

RECIPE: Final = (
    "gray: 16 bit by its high byte, colour as (19595 R + 38470 G + 7471 B + 32768) >> 16; "
    "size: area average (Pillow BOX)"
)
"""How any image becomes a frame, for the record."""

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
ENCODINGS: Final = tuple(_LAYOUTS)
"""Pixel formats that are read."""


def gray(
    data: bytes | memoryview,
    height: int,
    width: int,
    encoding: str,
    step: int = 0,
    *,
    big_endian: bool = False,
) -> Bytes:
    """Turn pixels of any supported format into gray, (height, width) uint8.

    Args:
        data: rows of `step` bytes, 0 for no more than the pixels take.
        height: rows of pixels.
        width: pixels of a row.
        encoding: the pixel format, as ROS names it.
        step: bytes from one row to the next.
        big_endian: the byte order of 16 bits.

    Raises:
        MalformedRecord: an unsupported format, or sizes that contradict the data.
    """
    layout = _LAYOUTS.get(encoding)
    if layout is None:
        hint = " (undo the Bayer pattern first)" if "bayer" in encoding.lower() else ""
        raise MalformedRecord(
            f"its pixel format {encoding[:40]!r} is not read{hint}: use one of "
            f"{', '.join(ENCODINGS)}"
        )
    size, kind = layout
    step = step or width * size
    if not 0 < height * width <= MAX_PIXELS:
        raise MalformedRecord(f"an image of {height}x{width} pixels is not read")
    if step < width * size or step * (height - 1) + width * size > len(data):
        raise MalformedRecord(
            f"an image of {height}x{width} {encoding} with a step of {step} bytes does not "
            f"fit its {len(data)} bytes"
        )
    raw = np.frombuffer(data, np.uint8)
    rows = np.ndarray((height, width, size), np.uint8, raw, 0, (step, size, 1))
    if kind == "gray":
        return np.ascontiguousarray(rows[:, :, 0])
    if kind == "gray16":
        return np.ascontiguousarray(rows[:, :, 0 if big_endian else 1])
    red, green, blue = (rows[:, :, kind.index(c)].astype(np.uint32) for c in "rgb")
    return ((19595 * red + 38470 * green + 7471 * blue + 32768) >> 16).astype(np.uint8)


def shrink(image: Bytes, height: int, width: int) -> Bytes:
    """Average the areas of a gray image into fewer pixels.

    Raises:
        UsageError: the image is smaller.
    """
    if image.shape == (height, width):
        return image
    if image.shape[0] < height or image.shape[1] < width:
        raise UsageError(
            f"an image of {image.shape[1]}x{image.shape[0]} is smaller than {width}x{height}: "
            "choose a smaller --size"
        )
    small = Image.fromarray(image).resize((width, height), Image.Resampling.BOX)
    return np.asarray(small, np.uint8)


def compressed_gray(data: bytes) -> Bytes:
    """Decode a JPEG or PNG into gray.

    Raises:
        MalformedRecord: it is neither, broken, or too large.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            image: Image.Image = Image.open(io.BytesIO(data), formats=["JPEG", "PNG"])
            if not 0 < image.width * image.height <= MAX_PIXELS:
                raise MalformedRecord(f"an image of {image.width}x{image.height} is not read")
            if image.mode in ("I;16", "I;16B", "I"):
                return (np.asarray(image, np.int64) >> 8).clip(0, 255).astype(np.uint8)
            if image.mode not in ("L", "RGB"):
                image = image.convert("RGB")
            return np.array(image.convert("L"), np.uint8)
    except MalformedRecord:
        raise
    except Exception as error:  # Pillow raises whatever its codecs raise
        raise MalformedRecord(f"its JPEG or PNG is broken ({type(error).__name__})") from None
