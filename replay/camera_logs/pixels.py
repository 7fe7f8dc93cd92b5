"""Images in other people's messages: found, decoded, made gray and small."""

from __future__ import annotations

import base64
import binascii
import io
import json
import struct
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.message import DecodeError
from numpy.typing import NDArray
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


@dataclass(frozen=True, slots=True)
class RawPixels:
    """An image as it stands in a message: rows of `step` bytes."""

    height: int
    width: int
    encoding: str
    big_endian: bool
    step: int
    data: bytes | memoryview


Decoder = Callable[[bytes], Bytes]
"""Turns a message into a gray image, (height, width) uint8; raises MalformedRecord."""


def image_decoder(schema: str, encoding: str) -> Decoder | None:
    """Find the decoder for messages of a schema in an encoding, or None."""
    return _DECODERS.get((schema, encoding))


def gray(image: RawPixels) -> Bytes:
    """Turn pixels of any supported format into gray, (height, width) uint8.

    Raises:
        MalformedRecord: an unsupported format, or sizes that contradict the data.
    """
    layout = _LAYOUTS.get(image.encoding)
    if layout is None:
        hint = " (undo the Bayer pattern first)" if "bayer" in image.encoding.lower() else ""
        raise MalformedRecord(
            f"its pixel format {image.encoding[:40]!r} is not read{hint}: use one of "
            f"{', '.join(ENCODINGS)}"
        )
    size, kind = layout
    height, width, step = image.height, image.width, image.step or image.width * size
    if not 0 < height * width <= MAX_PIXELS:
        raise MalformedRecord(f"an image of {height}x{width} pixels is not read")
    if step < width * size or step * (height - 1) + width * size > len(image.data):
        raise MalformedRecord(
            f"an image of {height}x{width} {image.encoding} with a step of {step} bytes does not "
            f"fit its {len(image.data)} bytes"
        )
    raw = np.frombuffer(image.data, np.uint8)
    rows = np.ndarray((height, width, size), np.uint8, raw, 0, (step, size, 1))
    if kind == "gray":
        return np.ascontiguousarray(rows[:, :, 0])
    if kind == "gray16":
        return np.ascontiguousarray(rows[:, :, 0 if image.big_endian else 1])
    red, green, blue = (rows[:, :, c].astype(np.uint32) for c in _ORDER[kind])
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


def _foxglove_raw(data: bytes) -> Bytes:
    message = _parse(RawImage, data)
    return gray(
        RawPixels(
            message.height, message.width, message.encoding, False, message.step, message.data
        )
    )


def _foxglove_compressed(data: bytes) -> Bytes:
    return compressed_gray(_parse(CompressedImage, data).data)


def _parse(kind: Any, data: bytes) -> Any:
    try:
        return kind.FromString(data)
    except DecodeError:
        raise MalformedRecord(f"a message is no foxglove.{kind.DESCRIPTOR.name}") from None


def _json_raw(data: bytes) -> Bytes:
    fields = _json(data)
    numbers = [fields.get(k) for k in ("height", "width", "step")]
    if not all(isinstance(n, int) and 0 <= n < 2**32 for n in numbers):
        raise MalformedRecord("a JSON image needs whole height, width and step")
    height, width, step = (int(n) for n in numbers if n is not None)
    return gray(RawPixels(height, width, str(fields.get("encoding")), False, step, _base64(fields)))


def _json_compressed(data: bytes) -> Bytes:
    return compressed_gray(_base64(_json(data)))


def _json(data: bytes) -> Mapping[str, Any]:
    try:
        fields = json.loads(data)
    except (ValueError, RecursionError):
        raise MalformedRecord("a message is no JSON") from None
    if not isinstance(fields, dict):
        raise MalformedRecord("a message is no JSON object")
    return fields


def _base64(fields: Mapping[str, Any]) -> bytes:
    try:
        return base64.b64decode(fields.get("data", ""), validate=True)
    except (binascii.Error, ValueError, TypeError):
        raise MalformedRecord("a JSON image's data is no base64") from None


class _RosFields:
    """Fields of a ROS message, aligned (ROS 2) or packed (ROS 1)."""

    def __init__(self, data: bytes, *, ros1: bool) -> None:
        self._data = memoryview(data)
        self._at = self._base = 0
        self._aligned = not ros1
        self._order = "<"
        self.terminated = not ros1
        if not ros1:
            head = bytes(self._take(4))
            if head[0] != 0 or head[1] not in (0, 1, 6, 7, 8, 9, 10, 11):
                raise MalformedRecord("a message is no CDR")
            self._order = "<" if head[1] & 1 else ">"
            self._base = 4

    def _take(self, count: int) -> memoryview:
        if count > len(self._data) - self._at:
            raise MalformedRecord("a ROS message is cut short or lies about a length")
        self._at += count
        return self._data[self._at - count : self._at]

    def u32(self) -> int:
        if self._aligned:
            self._take(-(self._at - self._base) % 4)
        return int(struct.unpack(self._order + "I", self._take(4))[0])

    def u8(self) -> int:
        return self._take(1)[0]

    def text(self) -> str:
        raw = bytes(self._take(self.u32()))
        return str(raw.removesuffix(b"\0") if self.terminated else raw, "utf-8", "replace")

    def data(self) -> memoryview:
        return self._take(self.u32())


def _ros_header(data: bytes, ros1: bool) -> _RosFields:
    fields = _RosFields(data, ros1=ros1)
    for _ in range(3 if ros1 else 2):
        fields.u32()
    fields.text()
    return fields


def _ros_raw(data: bytes, *, ros1: bool) -> Bytes:
    fields = _ros_header(data, ros1)
    height, width, encoding = fields.u32(), fields.u32(), fields.text()
    big_endian, step = bool(fields.u8()), fields.u32()
    return gray(RawPixels(height, width, encoding, big_endian, step, fields.data()))


def _ros_compressed(data: bytes, *, ros1: bool) -> Bytes:
    fields = _ros_header(data, ros1)
    fields.text()
    return compressed_gray(bytes(fields.data()))


_ORDER: Final = {"rgb": (0, 1, 2), "bgr": (2, 1, 0)}

_DECODERS: Final[Mapping[tuple[str, str], Decoder]] = {
    ("foxglove.RawImage", "protobuf"): _foxglove_raw,
    ("foxglove.CompressedImage", "protobuf"): _foxglove_compressed,
    ("foxglove.RawImage", "json"): _json_raw,
    ("foxglove.CompressedImage", "json"): _json_compressed,
    ("sensor_msgs/msg/Image", "cdr"): lambda data: _ros_raw(data, ros1=False),
    ("sensor_msgs/msg/CompressedImage", "cdr"): lambda data: _ros_compressed(data, ros1=False),
    ("sensor_msgs/Image", "ros1"): lambda data: _ros_raw(data, ros1=True),
    ("sensor_msgs/CompressedImage", "ros1"): lambda data: _ros_compressed(data, ros1=True),
}

SCHEMAS: Final = tuple(sorted({schema for schema, _ in _DECODERS}))
"""Message types that are read."""


def step_of(time_ns: NDArray[np.uint64]) -> float:
    """Median time between messages, in seconds; NaN of fewer than two."""
    return float(np.median(np.diff(time_ns)) / 1e9) if len(time_ns) > 1 else float("nan")
