"""Other people's camera logs become the frames they should, or are refused by name."""

from __future__ import annotations

import base64
import io
import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from camera_files import encoded, raw
from folders import external
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from hypothesis import given
from hypothesis import strategies as st
from message_files import write_mcap
from PIL import Image, ImageOps
from video_packets import cdr as ros2

from cdmisfa.core.errors import LogDamagedError, UsageError
from recorder.images.compressed import compressed_image
from recorder.images.framing import fitted
from recorder.images.messages import MessageKind, decoder_of, stated_format
from recorder.images.options import InputOptions
from recorder.images.pixels import DISTANCES, ENCODINGS, MalformedImage, raw_image, shrink

RAW_IMAGES = MessageKind("foxglove.RawImage", "protobuf")
RANDOM = np.random.default_rng(5)
GRAY = RANDOM.integers(0, 256, (6, 8), np.uint8)
COLOUR = RANDOM.integers(0, 256, (6, 8, 3), np.uint8)


def sized(data: bytes) -> bytes:
    return struct.pack("<I", len(data)) + data


def cdr(*, height: int, width: int, encoding: str, big: int, step: int, data: bytes) -> bytes:
    head = ros2(height, width, encoding.encode() + b"\0") + bytes([big])
    return head + bytes(-len(head) % 4) + struct.pack("<I", step) + sized(data)


def ros1(*, height: int, width: int, encoding: str, big: int, step: int, data: bytes) -> bytes:
    head = struct.pack("<III", 1, 5, 6) + sized(b"cam") + struct.pack("<II", height, width)
    return head + sized(encoding.encode()) + bytes([big]) + struct.pack("<I", step) + sized(data)


def shown(kind: tuple[str, str], message: bytes, **options: Any) -> np.ndarray:
    """What a decoder makes of a message of a kind."""
    decoder = decoder_of(MessageKind(*kind), InputOptions(**options))
    assert decoder is not None
    return decoder(message)


def raw_protobuf(**fields: object) -> bytes:
    fields.pop("big")
    return RawImage(frame_id="cam", **fields).SerializeToString()  # type: ignore[arg-type]


def raw_json(**fields: object) -> bytes:
    data = base64.b64encode(fields.pop("data")).decode()  # type: ignore[arg-type]
    return json.dumps(fields | {"data": data, "frame_id": "cam"}).encode()


RAW: dict[tuple[str, str], Callable[..., bytes]] = {
    ("sensor_msgs/msg/Image", "cdr"): cdr,
    ("sensor_msgs/Image", "ros1"): ros1,
    ("foxglove.RawImage", "protobuf"): raw_protobuf,
    ("foxglove.RawImage", "json"): raw_json,
}


def pixels(encoding: str, *, big: bool = False, pad: int = 0) -> tuple[bytes, int, int]:
    """The test image in a format: its bytes, its step, and its height."""
    if encoding in ("mono8", "8UC1"):
        rows = GRAY.reshape(6, 8)
    elif encoding in ("mono16", "16UC1"):
        rows = (GRAY.astype(np.uint16) << 8 | 77).astype(">u2" if big else "<u2").view(np.uint8)
    else:
        planes = COLOUR if encoding.startswith("rgb") else COLOUR[:, :, ::-1]
        if "a" in encoding or encoding == "8UC4":
            planes = np.concatenate([planes, np.full((6, 8, 1), 9, np.uint8)], axis=2)
        rows = planes.reshape(6, -1)
    rows = np.concatenate([rows.reshape(6, -1), np.full((6, pad), 123, np.uint8)], axis=1)
    return rows.tobytes(), rows.shape[1], 6


@pytest.mark.parametrize("kind", RAW)
@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("pad", [0, 5])
def test_pixels_of_every_format_become_gray(kind: tuple[str, str], encoding: str, pad: int) -> None:
    gray = encoding in ("mono8", "mono16", "8UC1", "16UC1")
    expected = GRAY if gray else np.asarray(Image.fromarray(COLOUR).convert("L"))
    for big in (0, 1) if encoding == "mono16" and kind[0].startswith("sensor") else (0,):
        data, step, height = pixels(encoding, big=bool(big), pad=pad)
        made = RAW[kind](height=height, width=8, encoding=encoding, big=big, step=step, data=data)
        np.testing.assert_array_equal(shown(kind, made), expected)


@pytest.mark.parametrize("order", ["rggb", "bggr", "gbrg", "grbg"])
@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("big", [False, True])
def test_a_bayer_pattern_becomes_gray(order: str, bits: int, big: bool) -> None:
    mosaic = np.zeros((7, 9), np.uint8)
    for place, letter in enumerate(order):
        cell = COLOUR[:3, :4, "rgb".index(letter)]
        mosaic[place // 2 : 6 : 2, place % 2 : 8 : 2] = cell
    data = mosaic.tobytes()
    if bits == 16:
        data = (mosaic.astype(np.uint16) << 8 | 55).astype(">u2" if big else "<u2").tobytes()
    result = raw_image(data, 7, 9, f"bayer_{order}{bits}", big_endian=big)
    np.testing.assert_array_equal(result, np.asarray(Image.fromarray(COLOUR).convert("L"))[:3, :4])


@pytest.mark.parametrize("kind", RAW)
@pytest.mark.parametrize("encoding", ["16UC1", "32FC1"])
def test_distances_are_shown_in_a_range(kind: tuple[str, str], encoding: str) -> None:
    metres = np.array([[0.0, 0.5, 1.0, 1.5, 3.0], [np.nan, np.inf, 2.0, 0.9, 1.02]])
    expected = np.array([[0, 0, 0, 128, 255], [0, 0, 255, 0, 5]], np.uint8)
    values = metres.astype("<f4")
    if encoding == "16UC1":
        values = np.round(np.nan_to_num(metres, posinf=0) * 1000).astype("<u2")
    step, data = 5 * values.itemsize, values.tobytes()
    made = RAW[kind](height=2, width=5, encoding=encoding, big=0, step=step, data=data)
    np.testing.assert_array_equal(shown(kind, made, range=(1.0, 2.0)), expected)
    if encoding == "32FC1":
        with pytest.raises(UsageError, match=r"input\.range"):
            shown(kind, made)


@pytest.mark.parametrize("kind", ["PNG", "JPEG"])
@pytest.mark.parametrize("image", [GRAY, COLOUR], ids=["gray", "colour"])
def test_compressed_images_become_gray(kind: str, image: np.ndarray) -> None:
    smooth = np.asarray(Image.fromarray(image).resize((64, 48), Image.Resampling.BICUBIC))
    data = encoded(smooth, kind)
    messages = {
        ("foxglove.CompressedImage", "protobuf"): CompressedImage(data=data).SerializeToString(),
        ("foxglove.CompressedImage", "json"): raw_json(data=data, format="jpeg"),
        **ros_compressed("jpeg", data),
    }
    expected = np.asarray(Image.fromarray(smooth).convert("L"), np.int64)
    for which, message in messages.items():
        assert abs(shown(which, message) - expected).max() <= (0 if kind == "PNG" else 6)


def ros_compressed(form: str, data: bytes) -> dict[tuple[str, str], bytes]:
    """A message of ROS 2 and one of ROS 1."""
    text = form.encode()
    one = struct.pack("<III", 1, 5, 6) + sized(b"cam") + sized(text) + sized(data)
    return {
        ("sensor_msgs/msg/CompressedImage", "cdr"): ros2(text + b"\0", data),
        ("sensor_msgs/CompressedImage", "ros1"): one,
    }


def test_compressed_distances_are_shown_in_a_range() -> None:
    metres = np.array([[0.0, 0.5, 1.0], [1.5, 3.0, 1.02]])
    expected = np.array([[0, 0, 0], [128, 255, 5]], np.uint8)
    plain = encoded((metres * 1000).astype(np.uint16), "PNG")
    scale, offset = 20000.0, -3.0  # a metre is a step of 1 in 20000
    with np.errstate(divide="ignore"):
        inverse = np.where(metres > 0, scale / metres + offset, 0)
    packed = encoded(np.round(inverse).astype(np.uint16), "PNG")
    head = struct.pack("<iff", 0, scale, offset)
    for form, data in (
        ("16UC1; png compressed ", plain),
        ("16UC1; compressedDepth", head + plain),
        ("16UC1; compressedDepth png", head + plain),
        ("32FC1; compressedDepth png", head + packed),
    ):
        for kind, message in ros_compressed(form, data).items():
            assert stated_format(*kind, message) in DISTANCES
            np.testing.assert_array_equal(shown(kind, message, range=(1.0, 2.0)), expected)
            if form.startswith("16"):
                high = (metres * 1000).astype(np.uint16) >> 8
                np.testing.assert_array_equal(shown(kind, message), high)
            else:
                with pytest.raises(UsageError, match=r"input\.range"):
                    shown(kind, message)


@pytest.mark.parametrize("kind", ["PNG", "JPEG"])
@pytest.mark.parametrize("orientation", range(10))
def test_an_image_stands_upright_as_its_exif_says(kind: str, orientation: int) -> None:
    exif = Image.Exif()
    exif[0x0112] = orientation
    file = io.BytesIO()
    Image.fromarray(GRAY).save(file, kind, exif=exif)
    turned = ImageOps.exif_transpose(Image.open(file))
    np.testing.assert_array_equal(compressed_image(file.getvalue()), np.asarray(turned))


@pytest.mark.parametrize("encoding", ["bayer_rggb12", "64FC1", "yuv422", ""])
def test_other_formats_are_refused_by_name(encoding: str) -> None:
    with pytest.raises(MalformedImage, match=repr(encoding)):
        raw_image(bytes(48), 6, 8, encoding, 8)


@given(data=st.binary(max_size=300), which=st.sampled_from(sorted(RAW)))
def test_bytes_that_are_no_image_are_refused(data: bytes, which: tuple[str, str]) -> None:
    try:
        image = shown(which, data)
    except MalformedImage:
        return
    assert image.dtype == np.uint8


def test_an_image_is_averaged_over_areas() -> None:
    image = RANDOM.integers(0, 256, (96, 256), np.uint8)
    expected = image.reshape(48, 2, 128, 2).mean(axis=(1, 3))
    assert abs(shrink(image, 48, 128) - expected).max() <= 1
    with pytest.raises(UsageError, match="256x96 is smaller than 128x100: use larger images"):
        fitted(image, (100, 128), "crop")


def write(path: Path, streams: dict[str, tuple[int, int]], *, broken_from: int = 999) -> None:
    """A log with `count` images on each topic, `step` milliseconds apart; all are of one value."""

    def image(i: int) -> bytes:
        return raw(np.full((6, 8), i, np.uint8)) if i < broken_from else b"no image"

    topics = {
        topic: [((1000 + i * step) * 1_000_000, image(i)) for i in range(count)]
        for topic, (count, step) in streams.items()
    }
    write_mcap(path, RAW_IMAGES, topics)


def test_streams_that_differ_are_refused_with_what_would_work(tmp_path: Path) -> None:
    write(tmp_path / "a.mcap", {"/left": (30, 20), "/right": (15, 40)})
    topics = ["/left", "/right"]
    with pytest.raises(UsageError, match=r"--align time --rate 50$"):
        external(tmp_path / "a.mcap", topics, size=(3, 4))
    source = external(tmp_path / "a.mcap", topics, size=(3, 4), align="time", rate=50)
    right = source.take(1, 29).frames[:, 0, 0].tolist()
    assert right == [i // 2 for i in range(29)]
    assert source.alignment["right"] == {"messages": 15, "repeated": 14, "dropped": 0}
    assert source.alignment["left"] == {"messages": 30, "repeated": 0, "dropped": 1}
    slow = external(tmp_path / "a.mcap", topics, size=(3, 4), align="time", rate=25)
    assert slow.take(0, 15).frames[:, 0, 0].tolist() == list(range(0, 30, 2))
    index = external(tmp_path / "a.mcap", topics, size=(3, 4), align="index")
    assert index.spec.length == 15
    assert index.alignment["left"]["dropped"] == 15


def test_one_log_a_stream(tmp_path: Path) -> None:
    for name in ("one", "two"):
        write(tmp_path / f"{name}.mcap", {"/image": (10, 20)})
    files = [tmp_path / "one.mcap", tmp_path / "two.mcap"]
    source = external(files, size=(3, 4), loop=True)
    assert source.spec.streams == ("one_image", "two_image")
    source.seek(8)
    assert source.take(1, 4).frames[:, 0, 0].tolist() == [8, 9, 0, 1]


def test_topics_are_named_where_they_are_wrong(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    write(path, {"/left": (3, 20), "/right": (3, 20)})
    with pytest.raises(UsageError, match="/left, /right"):
        external(path, size=(3, 4))
    with pytest.raises(UsageError, match="no topic /lefd"):
        external(path, ["/lefd"], size=(3, 4))
    write_mcap(path, MessageKind("foxglove.Imu", "protobuf"), {"/imu": [(1, b"")]})
    with pytest.raises(UsageError, match=r"foxglove\.Imu in protobuf"):
        external(path, ["/imu"], size=(3, 4))


def test_a_message_that_is_no_image_is_named(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    write(path, {"/left": (3, 20)})
    with pytest.raises(UsageError, match=r"a\.mcap: .* 8x6 is smaller than 80x60: .* --size$"):
        external(path, size=(60, 80))
    write(path, {"/left": (3, 20)}, broken_from=0)
    with pytest.raises(LogDamagedError, match=r"a\.mcap: /left at 1000000000 ns"):
        external(path, size=(3, 4))
    write(path, {"/left": (3, 20)}, broken_from=1)
    source = external(path, size=(3, 4))
    with pytest.raises(LogDamagedError, match=r"a\.mcap: /left at 1020000000 ns"):
        source.take(0, 2)
    assert source.t == 0
