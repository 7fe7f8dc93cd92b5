"""Reading MCAP logs that others wrote, against mcap's own reader with the same decoder."""

from __future__ import annotations

import base64
import contextlib
import io
import json
import struct
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from numpy.typing import NDArray
from PIL import Image

from benchmarks.report import interleaved, middle, ratio, save
from recorder.images.decoding import decoder_of
from recorder.images.framing import default_size, fitted, size_of
from recorder.images.reading import IMAGES, MessageKind
from replay.camera_logs.source import ForeignSource
from replay.mcap.reader import LogReader

TAU = 40
STEP_NS = 33_333_333
TOPIC = "/camera"
VGA = (480, 640)

Picture = NDArray[np.uint8]


def pictures(n: int, height: int, width: int) -> list[Picture]:
    """Slow waves with some noise, (height, width) each."""
    rng = np.random.default_rng(3)
    y, x = np.mgrid[0:height, 0:width]
    found = []
    for t in range(n):
        wave = 128 + 90 * np.sin(x / 17 + t / 40) * np.cos(y / 11 - t / 70)
        noise = rng.random((height, width)) < 0.08
        found.append((wave // 8 * 8 + noise * 4).astype(np.uint8))
    return found


def _fields(image: Picture, encoding: str) -> dict[str, Any]:
    height, width = image.shape[:2]
    step = image.nbytes // height
    return {"height": height, "width": width, "step": step, "encoding": encoding}


def foxglove_raw(image: Picture) -> bytes:
    """A foxglove.RawImage, mono8."""
    raw = RawImage(data=image.tobytes(), **_fields(image, "mono8"))
    return bytes(raw.SerializeToString())


def foxglove_rgb(image: Picture) -> bytes:
    """A foxglove.RawImage, rgb8."""
    colors = np.stack([image, 255 - image, image // 2], axis=2)
    raw = RawImage(data=colors.tobytes(), **_fields(colors, "rgb8"))
    return bytes(raw.SerializeToString())


def foxglove_jpeg(image: Picture) -> bytes:
    """A foxglove.CompressedImage, JPEG in colours."""
    out = io.BytesIO()
    Image.fromarray(image).convert("RGB").save(out, "JPEG", quality=80)
    return bytes(CompressedImage(data=out.getvalue(), format="jpeg").SerializeToString())


def json_raw(image: Picture) -> bytes:
    """A foxglove.RawImage as JSON, its pixels in base64."""
    pixels = {"data": base64.b64encode(image.tobytes()).decode()}
    return json.dumps(_fields(image, "mono8") | pixels).encode()


def ros2_raw(image: Picture) -> bytes:
    """A sensor_msgs/msg/Image in CDR, mono8."""
    height, width = image.shape
    fields = struct.pack("<III4s", 0, 0, 4, b"cam\0")
    fields += struct.pack("<III6sBxI", height, width, 6, b"mono8\0", 0, width)
    return b"\0\1\0\0" + fields + struct.pack("<I", image.nbytes) + image.tobytes()


class Case(NamedTuple):
    """Messages of a log: their type, encoding, how they are made, size, and the compression."""

    schema: str
    encoding: str
    encode: Callable[[Picture], bytes]
    size: tuple[int, int]
    compression: str


RAW, JPEG = "foxglove.RawImage", "foxglove.CompressedImage"
CASES = {
    "mono8 640x480, zstd": Case(RAW, "protobuf", foxglove_raw, VGA, "zstd"),
    "mono8 640x480, lz4": Case(RAW, "protobuf", foxglove_raw, VGA, "lz4"),
    "mono8 640x480, none": Case(RAW, "protobuf", foxglove_raw, VGA, "none"),
    "mono8 128x48, zstd": Case(RAW, "protobuf", foxglove_raw, (48, 128), "zstd"),
    "rgb8 640x480, zstd": Case(RAW, "protobuf", foxglove_rgb, VGA, "zstd"),
    "JSON mono8 640x480, zstd": Case(RAW, "json", json_raw, VGA, "zstd"),
    "ROS 2 mono8 640x480, lz4": Case("sensor_msgs/msg/Image", "cdr", ros2_raw, VGA, "lz4"),
    "JPEG 640x480, none": Case(JPEG, "protobuf", foxglove_jpeg, VGA, "none"),
    "JPEG 640x480, zstd": Case(JPEG, "protobuf", foxglove_jpeg, VGA, "zstd"),
}


def write(path: Path, case: Case, n: int) -> Path:
    """Write n images with mcap's own writer."""
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType[case.compression.upper()])
        writer.start()
        schema = writer.register_schema(case.schema, case.encoding, b"")
        channel = writer.register_channel(TOPIC, case.encoding, schema)
        for i, image in enumerate(pictures(n, *case.size)):
            writer.add_message(channel, i * STEP_NS, case.encode(image), i * STEP_NS)
        writer.finish()  # type: ignore[no-untyped-call]
    return path


def frames(path: Path) -> int:
    """Open a log and take all of it in blocks; how many frames."""
    with contextlib.closing(ForeignSource(path)) as source:
        blocks = source.frames // TAU
        for _ in range(blocks):
            source.take(0, TAU)
    return blocks * TAU


def mcap_frames(path: Path) -> int:
    """The same frames with mcap's reader, CRCs checked, and the same decoder."""
    out: list[Picture] = []
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        decode = None
        for schema, channel, message in reader.iter_messages(topics=[TOPIC]):
            if decode is None and schema is not None:
                kind = MessageKind(schema.name, channel.message_encoding, schema.data)
                decode = decoder_of(kind, IMAGES)
            assert decode is not None
            image = decode(message.data)
            out.append(fitted(image, default_size(size_of(image)), "crop").copy())
    return len(out)


def messages(path: Path) -> int:
    """Go over every message, every CRC checked; how many."""
    with LogReader(path) as reader:
        return sum(1 for _ in reader.messages([TOPIC]))


def mcap_messages(path: Path, *, crc: bool = True) -> int:
    """Go over every message with mcap's reader; how many."""
    with path.open("rb") as file:
        return sum(1 for _ in make_reader(file, validate_crcs=crc).iter_messages(topics=[TOPIC]))


def main(*, quick: bool = False, full: bool = False) -> None:
    """Measure, and write results/foreign.json."""
    del full
    rounds, n = (2, 80) if quick else (5, 200)
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for name, case in CASES.items():
            path = write(Path(folder) / "log.mcap", case, n)
            work: dict[str, Callable[[], int]] = {
                "frames": lambda path=path: frames(path),
                "mcap frames": lambda path=path: mcap_frames(path),
                "messages": lambda path=path: messages(path),
                "mcap messages": lambda path=path: mcap_messages(path),
                "no CRC": lambda path=path: mcap_messages(path, crc=False),
            }
            row: list[object] = [name]
            for clock in (time.process_time_ns, time.perf_counter_ns):
                times = interleaved(work, rounds, clock)
                row.append(middle(times["frames"], 1))
                row.append(f"{ratio(times['mcap frames'], times['frames']):.2f}x")
                row.append(middle(times["messages"], 1))
                for other in ("mcap messages", "no CRC"):
                    row.append(f"{ratio(times[other], times['messages']):.2f}x")
            rows.append(row)
    header = ["us a frame", "vs mcap", "us a message", "vs mcap", "vs mcap without CRCs"]
    save(
        "foreign",
        "Reading logs of others",
        f"Logs of {n} images written by mcap's own writer, opened and read to their end: as gray "
        "frames, against mcap's reader with the same decoder and scaling; and message by message. "
        "Every CRC is checked, but for the last column. CPU of all threads, and by the wall's "
        "clock, which counts whatever else runs: of two chunks the next are decompressed while "
        "one is decoded.",
        [
            (["CPU", *header], [[row[0], *row[1:6]] for row in rows]),
            (["wall", *header], [[row[0], *row[6:]] for row in rows]),
        ],
    )
