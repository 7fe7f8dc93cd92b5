"""Messages by the times in their headers, where the log's own say when they came."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from camera_files import HEIGHT, WIDTH, pictures
from folders import external
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from message_files import START, STEP, every, write_mcap
from test_foreign import raw_json
from test_numbers import joint_state

from cdmisfa.core.clock import NANOSECONDS
from cdmisfa.core.errors import LogDamagedError
from recorder.images.messages import MessageKind, stamp_of

COUNT = 40
MADE = 5 * NANOSECONDS + 7


def made(i: int) -> int:
    """When the i-th message was made: 40 ms after the one before, the second and third swapped."""
    return MADE + {1: 2, 2: 1}.get(i, i) * 2 * STEP


def foxglove() -> Iterator[bytes]:
    for i, image in enumerate(pictures(COUNT)):
        message = RawImage(width=WIDTH, height=HEIGHT, step=WIDTH, encoding="mono8")
        message.timestamp.seconds, message.timestamp.nanos = divmod(made(i), NANOSECONDS)
        message.data = image.tobytes()
        yield message.SerializeToString()


def in_json() -> Iterator[bytes]:
    for i, image in enumerate(pictures(COUNT)):
        seconds, rest = divmod(made(i), NANOSECONDS)
        size = {"height": HEIGHT, "width": WIDTH, "encoding": "mono8", "step": WIDTH, "big": 0}
        message = json.loads(raw_json(data=image.tobytes(), **size))
        message["timestamp"] = {"sec": seconds, "nsec": rest}
        yield json.dumps(message).encode()


LOGS = {
    "protobuf": (MessageKind("foxglove.RawImage", "protobuf"), foxglove),
    "json": (MessageKind("foxglove.RawImage", "json"), in_json),
}


@pytest.mark.parametrize("kind", LOGS)
def test_images_are_shown_at_the_times_of_their_headers(kind: str, tmp_path: Path) -> None:
    what, messages = LOGS[kind]
    path = write_mcap(tmp_path / "a.mcap", what, {"/cam": every(STEP, messages())})
    images = list(pictures(COUNT))
    with external(path) as logged:
        assert (logged.spec.fps, logged.spec.start_ns) == (50, START)
        assert (logged.take(0, 3).frames == images[:3]).all()
    with external(path, stamp="header") as source:
        assert (source.spec.fps, source.spec.start_ns) == (25, MADE)
        shown = source.take(0, COUNT).frames
        assert (shown == [images[i] for i in (0, 2, 1, *range(3, COUNT))]).all()
        assert source.describe()["stamp"] == "header"


def test_a_time_in_a_header_beyond_any_clock_is_refused(tmp_path: Path) -> None:
    kind = MessageKind("Joints", "json")
    messages = [json.dumps({"x": i, "stamp": {"sec": 2**70, "nsec": i}}).encode() for i in range(9)]
    path = write_mcap(tmp_path / "a.mcap", kind, {"/joints": every(STEP, messages)})
    with pytest.raises(LogDamagedError, match=r"/joints .*: the time in its header is too large"):
        external(path, fields=["x"], stamp="header")


@pytest.mark.parametrize("ros1", [True, False])
def test_ros_says_it_in_the_header_that_a_message_begins_with(ros1: bool) -> None:
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    name, version = "sensor_msgs/msg/JointState", 1 if ros1 else 2
    text, _ = store.generate_msgdef(name, ros_version=version)
    pack = store.serialize_ros1 if ros1 else store.serialize_cdr
    kind = MessageKind(name, "ros1" if ros1 else "cdr", text.encode(), f"ros{version}msg")
    stamp = stamp_of(kind)
    assert stamp is not None
    message = joint_state(store, np.arange(2.0), ros1=ros1)
    assert stamp(bytes(pack(message, name))) == 7 * NANOSECONDS + 8
    with pytest.raises(LogDamagedError, match="cut short"):
        stamp(bytes(pack(message, name))[:9])
    assert stamp_of(kind._replace(definition=b"# of\nfloat64 a\nHeader header")) is None
