"""ROS bags, written by rosbags, become the frames that are in them."""

from __future__ import annotations

import contextlib
import re
import sqlite3
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from camera_files import HEIGHT, WIDTH, pictures
from conftest import Cdmisfa
from folders import external
from rosbags import rosbag1, rosbag2
from rosbags.typesys import Stores, get_typestore

from cdmisfa.core.errors import LogDamagedError
from replay.logs.open_logs import open_stream

COUNT = 60
TOPICS = ("/cam_left", "/cam_right")


def fill(writer: Any, store: Any, serialize: Callable[..., Any], ros1: bool) -> None:
    """Two cameras and one topic of text, 20 ms apart; the second image has the first's time."""
    image_type, header_type = "sensor_msgs/msg/Image", store.types["std_msgs/msg/Header"]
    stamp = store.types["builtin_interfaces/msg/Time"](sec=1, nanosec=2)
    header = header_type(*([0] if ros1 else []), stamp=stamp, frame_id="cam")
    channels = [writer.add_connection(topic, image_type, typestore=store) for topic in TOPICS]
    text = writer.add_connection("/chatter", "std_msgs/msg/String", typestore=store)
    for i, images in enumerate(zip(pictures(COUNT, 0), pictures(COUNT, 1), strict=True)):
        time = 10**18 + (0 if i == 1 else i) * 20_000_000
        word = store.types["std_msgs/msg/String"](data=f"word {i}")
        writer.write(text, time, bytes(serialize(word, "std_msgs/msg/String")))
        for channel, image in zip(channels, images, strict=True):
            message = store.types[image_type](
                header=header,
                height=HEIGHT,
                width=WIDTH,
                encoding="mono8",
                is_bigendian=0,
                step=WIDTH,
                data=image.reshape(-1),
            )
            writer.write(channel, time, bytes(serialize(message, image_type)))


def ros1_bag(folder: Path) -> Path:
    path = folder / "cameras.bag"
    store = get_typestore(Stores.ROS1_NOETIC)
    with rosbag1.Writer(path) as writer:
        fill(writer, store, store.serialize_ros1, True)
    return path


def ros2_bag(folder: Path, plugin: str = "SQLITE3", *, packed: bool = False) -> Path:
    path = folder / "cameras"
    store = get_typestore(Stores.ROS2_HUMBLE)
    storage = rosbag2.StoragePlugin[plugin]
    writer = rosbag2.Writer(path, version=9, storage_plugin=storage)
    if packed:
        writer.set_compression(rosbag2.CompressionMode.FILE, rosbag2.CompressionFormat.ZSTD)
    with writer:
        fill(writer, store, store.serialize_cdr, False)
    return path


def ros2_database(folder: Path) -> Path:
    return next(ros2_bag(folder).glob("*.db3"))


def ros2_mcap(folder: Path) -> Path:
    return ros2_bag(folder, "MCAP")


def ros2_packed(folder: Path) -> Path:
    return ros2_bag(folder, packed=True)


def ros2_packed_mcap(folder: Path) -> Path:
    return ros2_bag(folder, "MCAP", packed=True)


BAGS = [ros1_bag, ros2_bag, ros2_database, ros2_mcap, ros2_packed, ros2_packed_mcap]


@pytest.mark.parametrize("make", BAGS)
def test_every_image_is_there_in_its_place(make: Callable[[Path], Path], tmp_path: Path) -> None:
    source = external(make(tmp_path), TOPICS, size=(HEIGHT, WIDTH))
    assert source.spec.streams == ("cam_left", "cam_right")
    assert (source.spec.fps, source.spec.start_ns) == (50.0, 10**18)
    expected = np.stack(list(pictures(COUNT, 1)))
    np.testing.assert_array_equal(source.take(1, COUNT).frames, expected)
    for at in (30, 1, 0, 59):
        source.seek(at)
        np.testing.assert_array_equal(source.take(1, 1).frames[0], expected[at])
    source.close()


@pytest.mark.parametrize("value", [5, "text"])
def test_a_message_that_is_no_bytes_is_damage(tmp_path: Path, value: object) -> None:
    path = ros2_database(tmp_path)
    with contextlib.closing(sqlite3.connect(path)) as database, database:
        database.execute("UPDATE messages SET data = ?", (value,))
    with (
        open_stream(path, "/cam_left") as images,
        pytest.raises(LogDamagedError, match=re.escape(f"{path}: /cam_left at ") + ".*as bytes"),
    ):
        images.image(0)


@pytest.mark.parametrize("make", [ros1_bag, ros2_database, ros2_bag])
def test_a_bag_is_described_without_its_messages(
    make: Callable[[Path], Path], cdmisfa: Cdmisfa, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, last = make(tmp_path), 10**18 + (COUNT - 1) * 20_000_000
    assert cdmisfa("verify", path, "--json").json["ok"]
    reader = rosbag1.Reader if make is ros1_bag else rosbag2.Reader
    with monkeypatch.context() as unread:
        unread.setattr(reader, "messages", lambda *_: pytest.fail("it was read"))
        channels = {c["topic"]: c for c in cdmisfa("info", path, "--json").json["channels"]}
        if make is not ros1_bag:
            with open_stream(path, "/cam_right") as opened:
                assert opened.times is not None
                assert (opened.count, opened.times[-1]) == (COUNT, last)
    assert {c["messages"] for c in channels.values()} == {COUNT}
    assert {(c["start_ns"], c["end_ns"]) for c in channels.values()} == {(10**18, last)}


@pytest.mark.parametrize("kind", ["FILE", "MESSAGE", "BZ2", "LZ4"])
def test_a_packed_bag_is_the_same(tmp_path: Path, kind: str) -> None:
    ros1 = kind in ("BZ2", "LZ4")
    whole, packed = (ros1_bag if ros1 else ros2_bag)(tmp_path), tmp_path / "packed.bag"
    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    writer: Any = rosbag1.Writer(packed) if ros1 else rosbag2.Writer(packed, version=9)
    if ros1:
        writer.set_compression(rosbag1.Writer.CompressionFormat[kind])
    else:
        writer.set_compression(rosbag2.CompressionMode[kind], rosbag2.CompressionFormat.ZSTD)
    with writer:
        fill(writer, store, store.serialize_ros1 if ros1 else store.serialize_cdr, ros1)
    with open_stream(packed, TOPICS[0]) as images, open_stream(whole, TOPICS[0]) as expected:
        np.testing.assert_array_equal(images.times, expected.times)  # type: ignore[arg-type]
        for row in (*range(COUNT), 1, 3):
            np.testing.assert_array_equal(images.image(row), expected.image(row))
