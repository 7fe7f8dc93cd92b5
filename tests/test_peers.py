"""Other people's readers see our recordings as they are, and we see what their writers write."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from camera_files import HEIGHT, WIDTH, encoded, pictures, write_cameras
from folders import external
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from mcap.reader import make_reader
from mcap.writer import Writer

from recorder.mcap.reader import LogReader
from recorder.recording import record

COUNT = 200
SIZE = (HEIGHT, WIDTH)
EXPECTED = np.stack(list(pictures(COUNT)))
IMAGE_TEXT = """std_msgs/Header header
uint32 height
uint32 width
string encoding
uint8 is_bigendian
uint32 step
uint8[] data
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
"""
COMPRESSED_TEXT = """std_msgs/Header header
string format
uint8[] data
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
"""


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One view of images, as the recorder writes it."""
    folder = tmp_path_factory.mktemp("peers")
    write_cameras(folder / "a.mcap", {"/cam": (COUNT, 20)})
    source = external(folder / "a.mcap", size=SIZE)
    (written,) = record(source, folder / "rec")
    source.close()
    return written.file


def pixels(data: bytes) -> np.ndarray:
    return np.frombuffer(RawImage.FromString(data).data, np.uint8).reshape(SIZE)


def stamp(i: int) -> int:
    return 10**18 + 20_000_000 * i


@pytest.mark.parametrize("reader", ["mcap", "small_mcap"])
def test_others_readers_see_every_message(recording: Path, reader: str) -> None:
    library = pytest.importorskip(reader)
    with recording.open("rb") as file:
        if reader == "mcap":
            result = make_reader(file, validate_crcs=True).iter_messages()
        else:
            result = library.read_message(file, validate_crc=True)
        theirs = [(channel.topic, m.log_time, bytes(m.data)) for _, channel, m in result]
    with LogReader(recording) as ours:
        assert theirs == [(m.channel.topic, m.log_time, m.data) for m in ours.messages()]
    np.testing.assert_array_equal([pixels(data) for _, _, data in theirs], EXPECTED)


@pytest.mark.parametrize("topics", [None, ["/b"]])
@pytest.mark.parametrize("size", [0, 40, 9000])
def test_payloads_of_any_size_are_those_that_mcap_reads(
    tmp_path: Path, size: int, topics: list[str] | None
) -> None:
    with (tmp_path / "a.mcap").open("wb") as file:
        writer = Writer(file, chunk_size=50_000)
        writer.start()
        channels = [writer.register_channel(topic, "raw", 0) for topic in ("/a", "/b")]
        for i in range(60):
            data = bytes([i]) * (size + i)
            writer.add_message(channels[i % 3 == 1], i, data, i + 1, sequence=i + 2)
        writer.finish()
    with (tmp_path / "a.mcap").open("rb") as file, LogReader(tmp_path / "a.mcap") as reader:
        theirs = make_reader(file).iter_messages(topics)
        assert [
            (m.channel.id, m.sequence, m.log_time, m.publish_time, m.data)
            for m in reader.messages(topics)
        ] == [(m.channel_id, m.sequence, m.log_time, m.publish_time, m.data) for _, _, m in theirs]


def test_rerun_shows_images_as_images(recording: Path) -> None:
    chunk = pytest.importorskip("rerun.chunk")
    buffers: list[Any] = []
    for piece in chunk.McapReader(str(recording)).stream():
        batch = piece.to_record_batch()
        if "Image:buffer" in batch.schema.names:
            buffers += batch.column("Image:buffer").to_pylist()
    frames = [np.array(buffer[0], np.uint8).reshape(SIZE) for buffer in buffers]
    np.testing.assert_array_equal(frames, EXPECTED)


@pytest.mark.parametrize("compression", ["zstd", "lz4", None])
@pytest.mark.parametrize("kind", ["RawImage", "CompressedImage"])
def test_logs_of_the_foxglove_sdk_are_streams(
    tmp_path: Path, kind: str, compression: str | None
) -> None:
    foxglove = pytest.importorskip("foxglove")
    from foxglove import channels, messages
    from foxglove.mcap import MCAPCompression, MCAPWriteOptions

    chosen = {"zstd": MCAPCompression.Zstd, "lz4": MCAPCompression.Lz4, None: None}[compression]
    options = MCAPWriteOptions(compression=chosen, chunk_size=8192)
    context = foxglove.Context()
    channel = getattr(channels, f"{kind}Channel")("/cam", context=context)
    with foxglove.open_mcap(tmp_path / "a.mcap", context=context, writer_options=options):
        for i, image in enumerate(EXPECTED):
            if kind == "RawImage":
                message = messages.RawImage(
                    width=WIDTH, height=HEIGHT, step=WIDTH, encoding="mono8", data=image.tobytes()
                )
            else:
                message = messages.CompressedImage(data=encoded(image), format="png")
            channel.log(message, log_time=stamp(i))
    _check(tmp_path / "a.mcap")


@pytest.mark.parametrize("kind", ["Image", "CompressedImage"])
def test_logs_of_mcap_ros2_are_streams(tmp_path: Path, kind: str) -> None:
    mcap_ros2 = pytest.importorskip("mcap_ros2.writer")
    text = IMAGE_TEXT if kind == "Image" else COMPRESSED_TEXT
    with (tmp_path / "a.mcap").open("wb") as file:
        writer = mcap_ros2.Writer(file, chunk_size=8192)
        schema = writer.register_msgdef(f"sensor_msgs/msg/{kind}", text)
        for i, image in enumerate(EXPECTED):
            message: dict[str, Any] = {
                "header": {"stamp": {"sec": 1, "nanosec": i}, "frame_id": "cam"}
            }
            if kind == "Image":
                message |= {"height": HEIGHT, "width": WIDTH, "encoding": "mono8"}
                message |= {"is_bigendian": 0, "step": WIDTH, "data": image.tobytes()}
            else:
                message |= {"format": "mono8; png compressed mono8", "data": encoded(image)}
            writer.write_message("/cam", schema, message, stamp(i), stamp(i), i)
        writer.finish()
    _check(tmp_path / "a.mcap")


def _check(path: Path) -> None:
    source = external(path, ["/cam"], size=SIZE)
    assert (source.spec.fps, source.spec.length, source.spec.start_ns) == (50.0, COUNT, stamp(0))
    np.testing.assert_array_equal(source.take(0, COUNT).frames, EXPECTED)
    source.close()
