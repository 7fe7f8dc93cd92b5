"""Reading MCAP logs that others wrote, against mcap's own reader with the same decoder."""

from __future__ import annotations

import base64
import contextlib
import io
import itertools
import json
import struct
import tempfile
import time
from collections.abc import Callable, Mapping
from functools import partial
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
from recorder.images.framing import default_size, fitted, size_of
from recorder.images.messages import MessageKind, decoder_of
from recorder.images.options import IMAGES
from recorder.mcap.reader import LogReader
from replay.open_sources import open_external

TAU = 40
STEP_NS = 33_333_333
TOPIC = "/camera"
VGA = (480, 640)

Picture = NDArray[np.uint8]


def pictures(n: int, height: int, width: int) -> list[Picture]:
    """Slow waves with some noise, (height, width) each."""
    rng = np.random.default_rng(3)
    y, x = np.mgrid[0:height, 0:width]
    images = []
    for t in range(n):
        wave = 128 + 90 * np.sin(x / 17 + t / 40) * np.cos(y / 11 - t / 70)
        noise = rng.random((height, width)) < 0.08
        images.append((wave // 8 * 8 + noise * 4).astype(np.uint8))
    return images


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
    """Messages of a log: their type, encoding, how they are made, size, and the compression.

    Attributes:
        beside: messages of another topic between two of its own, of `numbers` each.
        number: of messages, relative to others.
    """

    schema: str
    encoding: str
    encode: Callable[[Picture], bytes]
    size: tuple[int, int]
    compression: str
    beside: int = 0
    number: int = 1


def numbers(image: Picture) -> bytes:
    """A JSON of 200 bytes, as of a sensor."""
    values = [int(v) * 0.37 for v in image.flat[:8]]
    return json.dumps({"position": values}).encode().ljust(200)


RAW, JPEG = "foxglove.RawImage", "foxglove.CompressedImage"
SMALL = (48, 128)
CASES = {
    "mono8 640x480, zstd": Case(RAW, "protobuf", foxglove_raw, VGA, "zstd"),
    "mono8 640x480, lz4": Case(RAW, "protobuf", foxglove_raw, VGA, "lz4"),
    "mono8 640x480, none": Case(RAW, "protobuf", foxglove_raw, VGA, "none"),
    "mono8 128x48, zstd": Case(RAW, "protobuf", foxglove_raw, SMALL, "zstd", number=20),
    "rgb8 640x480, zstd": Case(RAW, "protobuf", foxglove_rgb, VGA, "zstd"),
    "JSON mono8 640x480, zstd": Case(RAW, "json", json_raw, VGA, "zstd"),
    "ROS 2 mono8 640x480, lz4": Case("sensor_msgs/msg/Image", "cdr", ros2_raw, VGA, "lz4"),
    "JPEG 640x480, none": Case(JPEG, "protobuf", foxglove_jpeg, VGA, "none", number=2),
    "JPEG 640x480, zstd": Case(JPEG, "protobuf", foxglove_jpeg, VGA, "zstd", number=2),
}
READ_ONLY = {
    "200 bytes, zstd": Case("Numbers", "json", numbers, SMALL, "zstd", number=100),
    "JPEG among 20 x 200 bytes, zstd": Case(JPEG, "protobuf", foxglove_jpeg, VGA, "zstd", 20, 2),
}
"""Cases in which only messages are read, no frames."""
PICTURES = 60
"""Pictures that follow one another, again and again."""


def write(path: Path, case: Case, n: int) -> Path:
    """Write n messages, or as many times more as the case says, with mcap's own writer."""
    payloads = [case.encode(image) for image in pictures(min(n, PICTURES), *case.size)]
    other = numbers(np.arange(8, dtype=np.uint8))
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType[case.compression.upper()])
        writer.start()
        schema = writer.register_schema(case.schema, case.encoding, b"")
        channel = writer.register_channel(TOPIC, case.encoding, schema)
        beside = writer.register_channel("/beside", "json", 0)
        for i, data in zip(range(n * case.number), itertools.cycle(payloads), strict=False):
            at = i * STEP_NS
            writer.add_message(channel, at, data, at)
            for k in range(1, case.beside + 1):
                writer.add_message(beside, at + k, other, at + k)
        writer.finish()  # type: ignore[no-untyped-call]
    return path


def frames(path: Path) -> int:
    """Open a log and take all of it in blocks; how many frames."""
    with contextlib.closing(open_external(path)) as source:
        blocks = source.frames // TAU
        for _ in range(blocks):
            source.take(0, TAU)
    return blocks * TAU


def mcap_frames(path: Path) -> int:
    """The same frames with mcap's reader, CRCs checked, the same decoder, and Pillow's BOX."""
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
    """Go over every message by log time, each payload as bytes, every CRC checked; how many."""
    with LogReader(path) as reader:
        return sum(1 for message in reader.messages([TOPIC]) if message.data)


def views(path: Path) -> int:
    """As `messages`, each payload where it lies in its chunk."""
    count = 0
    with LogReader(path) as reader:
        (number,) = (n for n, channel in reader.channels.items() if channel.topic == TOPIC)
        for _, table in reader.tables(topics=[TOPIC]):
            rows = np.flatnonzero(table.channel == number).tolist()
            count += sum(1 for row in rows if table.view(row))
    return count


def mcap_messages(path: Path, *, crc: bool = True) -> int:
    """Do as `messages` with mcap's reader; how many."""
    with path.open("rb") as file:
        records = make_reader(file, validate_crcs=crc).iter_messages(topics=[TOPIC])
        return sum(1 for _, _, message in records if message.data)


CLOCKS = {"CPU": time.process_time_ns, "wall": time.perf_counter_ns}
READERS: dict[str, Callable[[Path], int]] = {
    "mcap": mcap_messages,
    "bytes": messages,
    "views": views,
    "mcap without CRCs": partial(mcap_messages, crc=False),
}
FRAMES: dict[str, Callable[[Path], int]] = {"mcap": mcap_frames, "ours": frames}


def measured(
    path: Path, work: Mapping[str, Callable[[Path], int]], rounds: int
) -> dict[str, list[object]]:
    """For each clock us of mcap's reader, and how often the others' are in it."""
    calls = {name: partial(call, path) for name, call in work.items()}
    rows: dict[str, list[object]] = {}
    for name, clock in CLOCKS.items():
        times = interleaved(calls, rounds, clock)
        ratios = [f"{ratio(times['mcap'], times[k]):.2f}x" for k in work if k != "mcap"]
        rows[name] = [middle(times["mcap"], 1), *ratios]
    return rows


def main(*, quick: bool = False) -> None:
    """Measure, and write results/foreign.json."""
    rounds, n = (2, 300) if quick else (7, 400)
    read: dict[str, list[list[object]]] = {clock: [] for clock in CLOCKS}
    decoded: dict[str, list[list[object]]] = {clock: [] for clock in CLOCKS}
    with tempfile.TemporaryDirectory() as folder:
        for name, case in (CASES | READ_ONLY).items():
            path = write(Path(folder) / "log.mcap", case, n)
            for clock, row in measured(path, READERS, rounds).items():
                read[clock].append([name, *row])
            if name in CASES:
                for clock, row in measured(path, FRAMES, rounds).items():
                    decoded[clock].append([name, *row])
    reading = ["mcap, µs a message", "cdmisfa", "cdmisfa, no copy", "mcap without CRCs"]
    save(
        "foreign",
        "Reading external MCAP logs",
        f"Logs of at least {n} images written by the mcap library, read to the end; the "
        "factor says how much faster cdmisfa is than mcap's reader with the same image "
        "decoder (below 1: slower). Both check the CRC of each chunk, except in the column "
        "without CRCs. Decompression and JPEG decoding take most of the time and are the "
        "same libraries in both.",
        [
            *((["reader alone, " + clock, *reading], rows) for clock, rows in read.items()),
            *(
                (["frames, " + clock, "mcap, µs a frame", "cdmisfa, times as fast"], rows)
                for clock, rows in decoded.items()
            ),
        ],
    )
