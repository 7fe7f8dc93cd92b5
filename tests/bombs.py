"""Small files that would take far more memory than they have bytes, one for each decoder."""

from __future__ import annotations

import io
import json
import sqlite3
import struct
import zlib
from collections.abc import Callable, Iterable
from pathlib import Path

import lz4.frame
import mcap_files as files
import numpy as np
import zstandard
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from message_files import every, write_mcap
from PIL import Image

from recorder.images.messages import MessageKind

Writing = Callable[[Path], Path]
"""Writes into a folder, and says what."""

PART = 1 << 20

EPISODES = "meta/episodes/a.parquet"

METADATA = """rosbag2_bagfile_information:
  version: 5
  storage_identifier: sqlite3
  duration: {{nanoseconds: 1}}
  starting_time: {{nanoseconds_since_epoch: 1}}
  message_count: 1
  topics_with_message_count:
    - topic_metadata: {{name: /cam, type: sensor_msgs/msg/Image, serialization_format: cdr,
                        offered_qos_profiles: ""}}
      message_count: 1
  compression_format: zstd
  compression_mode: {mode}
  relative_file_paths: [{name}]
"""

TABLES = """
CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT,
                    offered_qos_profiles TEXT);
CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB);
INSERT INTO topics VALUES(1, '/cam', 'sensor_msgs/msg/Image', 'cdr', '');
"""


IMAGE = struct.pack("<H", 1) + files.text("foxglove.RawImage") + files.text("protobuf") + bytes(4)
CHANNEL = struct.pack("<HH", 1, 1) + files.text("/cam") + files.text("protobuf") + files.texts({})
CAM = files.record(files.SCHEMA, IMAGE) + files.record(files.CHANNEL, CHANNEL)
"""A topic of raw images, and its schema."""


def zeros(mebibytes: int) -> bytes:
    """Nothing but zeros, packed by zstd."""
    packing = zstandard.ZstdCompressor().compressobj()
    return b"".join(packing.compress(bytes(PART)) for _ in range(mebibytes)) + packing.flush()


def database(path: Path, message: bytes) -> None:
    """A rosbag2's file with one message."""
    connection = sqlite3.connect(path)
    connection.executescript(TABLES)
    connection.execute("INSERT INTO messages VALUES(1, 1, 5, ?)", (message,))
    connection.commit()
    connection.close()


def packed_message(folder: Path) -> Path:
    (folder / "bag").mkdir()
    database(folder / "bag" / "a.db3", zeros(400))
    (folder / "bag" / "metadata.yaml").write_text(METADATA.format(mode="MESSAGE", name="a.db3"))
    return folder / "bag"


def packed_file(folder: Path) -> Path:
    (folder / "bag").mkdir()
    (folder / "bag" / "a.db3.zstd").write_bytes(zeros(300))
    (folder / "bag" / "metadata.yaml").write_text(METADATA.format(mode="FILE", name="a.db3.zstd"))
    return folder / "bag"


def ros1_chunk(folder: Path) -> Path:
    """A bag of ROS 1 with a chunk of one message."""
    from rosbags import rosbag1
    from rosbags.typesys import Stores, get_typestore

    writer = rosbag1.Writer(folder / "a.bag")
    writer.set_compression(rosbag1.Writer.CompressionFormat.LZ4)
    with writer:
        store = get_typestore(Stores.ROS1_NOETIC)
        topic = writer.add_connection("/cam", "sensor_msgs/msg/Image", typestore=store)
        writer.write(topic, 1, bytes(360_000_000))
    return folder / "a.bag"


def png(side: int) -> bytes:
    """The beginning of a square PNG."""
    head = png_chunk(b"IHDR", struct.pack(">IIBBBBB", side, side, 8, 2, 0, 0, 0))
    data = png_chunk(b"IDAT", zlib.compress(bytes(10**8), 1))
    return b"\x89PNG\r\n\x1a\n" + head + data + png_chunk(b"IEND", b"")


def png_chunk(kind: bytes, data: bytes) -> bytes:
    crc = zlib.crc32(kind + data)
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", crc)


def a_picture(name: str, data: Callable[[], bytes]) -> Writing:
    """A folder of one picture."""

    def write(folder: Path) -> Path:
        (folder / "pictures").mkdir()
        (folder / "pictures" / name).write_bytes(data())
        return folder / "pictures"

    return write


def progressive() -> bytes:
    """A JPEG whose coefficients are all held until its end."""
    return packed(Image.new("CMYK", (9000, 4000), 3), "JPEG", progressive=True)


def says_large() -> bytes:
    """A JPEG that says that it is 65,500x65,500."""
    raw = bytearray(packed(Image.new("L", (16, 16)), "JPEG"))
    struct.pack_into(">HH", raw, raw.index(b"\xff\xc0") + 5, 65_500, 65_500)
    return bytes(raw)


def packed(image: Image.Image, kind: str, **how: bool) -> bytes:
    file = io.BytesIO()
    image.save(file, kind, **how)
    return file.getvalue()


def chunk(compression: str, size: int, stored: bytes) -> Writing:
    """An MCAP log of a chunk that says how long it is, and may hold more."""

    def write(folder: Path) -> Path:
        body = files.chunk(b"", 5, 5, compression=compression, size=size, stored=stored, crc=False)
        (folder / "a.mcap").write_bytes(files.finish(files.MAGIC + files.header() + CAM + body))
        return folder / "a.mcap"

    return write


def table_of_zeros(folder: Path) -> Path:
    """A Parquet file of forty million rows of four columns."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    part = pa.table({name: pa.array(np.zeros(10**7)) for name in "abcd"})
    with pq.ParquetWriter(folder / "a.parquet", part.schema, compression="zstd") as file:
        for _ in range(4):
            file.write_table(part)
    return folder / "a.parquet"


def text_of_a_table(folder: Path) -> Path:
    """A CSV file with a cell of a hundred million digits."""
    (folder / "a.csv").write_bytes(b"a,b\n1," + b"9" * 100_000_000 + b"\n")
    return folder / "a.csv"


def messages_of_a_chunk(folder: Path) -> Path:
    """An MCAP log of 1,100,000 empty messages in one chunk."""
    body = CAM + files.record(files.MESSAGE, files.message(1, 0, 5, 5, b"")) * 1_100_000
    log = files.MAGIC + files.header() + files.chunk(body, 5, 5, compression="zstd")
    (folder / "a.mcap").write_bytes(files.finish(log))
    return folder / "a.mcap"


def log(schema: str, encoding: str, payloads: Iterable[bytes]) -> Writing:
    """An MCAP log of messages, a chunk each or more."""
    kind = MessageKind(schema, encoding, b"", "protobuf")
    return lambda folder: write_mcap(folder / "a.mcap", kind, {"/cam": every(1, payloads)})


def picture_message(side: int) -> bytes:
    """A message with a square PNG."""
    return bytes(CompressedImage(data=png(side), format="png").SerializeToString())


def huge_frames(folder: Path) -> Path:
    """A video of 64x48 whose frames are pictures of 16,384x16,384."""
    import av

    with av.open(str(folder / "a.mp4"), "w") as container:
        stream = container.add_stream("png", rate=25)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "rgb24"
        stream.codec_context.open()
        for number in range(3):
            packet = av.Packet(png(16_384))
            packet.stream, packet.is_keyframe = stream, True
            packet.pts = packet.dts = number
            packet.time_base = stream.codec_context.time_base
            container.mux(packet)
    return folder / "a.mp4"


def table_of_pictures(folder: Path) -> Path:
    """A LeRobot dataset whose picture is 300 MiB of zeros."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    names = {"codebase_version": "v3.0", "fps": 25, "total_frames": 1, "data_path": "data.parquet"}
    features = {"cam": {"dtype": "image", "shape": [1, 1, 1]}}
    (folder / "meta/episodes").mkdir(parents=True)
    (folder / "meta/info.json").write_text(json.dumps({**names, "features": features}))
    episode = {"episode_index": 0, "length": 1, "dataset_from_index": 0}
    places = {"data/chunk_index": 0, "data/file_index": 0}
    pq.write_table(pa.Table.from_pylist([{**episode, **places}]), folder / EPISODES)
    pictures = [{"index": 0, "cam": {"bytes": bytes(300 << 20), "path": ""}}]
    plain = {"compression": "zstd", "use_dictionary": False, "write_statistics": False}
    pq.write_table(pa.Table.from_pylist(pictures), folder / "data.parquet", **plain)
    return folder


CAMERAS: dict[str, Writing] = {
    "packed message of .db3": packed_message,
    "packed .db3": packed_file,
    "chunk of .bag": ros1_chunk,
    "PNG": a_picture("0.png", lambda: png(60_000)),
    "PNG in a message": log("foxglove.CompressedImage", "protobuf", [picture_message(60_000)]),
    "JPEG's size": a_picture("0.jpg", says_large),
    "progressive JPEG": a_picture("0.jpg", progressive),
    "video's frames": huge_frames,
    "dataset's pictures": table_of_pictures,
    "JSON image": log("foxglove.RawImage", "json", [b"[" + b"[]," * 8_000_000 + b"[]]"]),
    "protobuf image": log("foxglove.RawImage", "protobuf", [bytes(140_000_000)]),
    "messages of a chunk": messages_of_a_chunk,
    "size of a chunk": chunk("zstd", 1 << 40, zeros(1)),
    "chunk of zstd": chunk("zstd", PART, zeros(300)),
    "chunk of LZ4": chunk("lz4", PART, lz4.frame.compress(bytes(300 * PART))),
    "Parquet": table_of_zeros,
    "CSV": text_of_a_table,
}
"""By what they are bombs of; each is written to a folder."""


def write_all(folder: Path) -> None:
    """Write each of `CAMERAS` to a folder of its own, with where it is in `path`."""
    for number, write in enumerate(CAMERAS.values()):
        place = folder / str(number)
        place.mkdir()
        (folder / f"{number}.path").write_text(str(write(place)))
