"""Numbers in messages and tables become streams, and are learned from."""

from __future__ import annotations

import contextlib
import json
import random
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from conftest import Cdmisfa
from folders import external
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from message_files import START, STEP, every, write_mcap, write_table

from cdmisfa.core.errors import CdmisfaError, UsageError
from recorder.images.fields import Field, numbers_of
from recorder.images.messages import MessageKind, message_decoder
from recorder.log.messages import descriptor_set

COUNT = 90
JOINTS = 3

NESTED = {
    "position": [1.0, 2.0, 3.0],
    "on": True,
    "pose": {"position": {"x": 4, "y": 5.5}},
    "points": [{"x": 1, "y": 2}, {"x": 3, "y": 4}, {"x": 5, "y": 6}],
    "grid": [[1, 2], [3, 4]],
    "name": "arm",
}


@pytest.mark.parametrize(
    ("path", "found"),
    [
        ("position", [1, 2, 3]),
        ("position[1]", [2]),
        ("position[0:2]", [1, 2]),
        ("position[1:]", [2, 3]),
        ("pose.position.y", [5.5]),
        ("points[2].x", [5]),
        ("points[0:2].y", [2, 4]),
        ("points.x", [1, 3, 5]),
        ("grid", [1, 2, 3, 4]),
        ("grid[1][0]", [3]),
        ("on", [1]),
    ],
)
def test_a_field_names_numbers(path: str, found: list[float]) -> None:
    assert Field(path).numbers(NESTED) == found


@pytest.mark.parametrize(
    ("path", "why"),
    [
        ("velocity", "there is no velocity: it has position, on, pose"),
        ("pose.position.z", "there is no z: it has x, y"),
        ("pose", "is not a number but dict: name one of position"),
        ("name", "is not a number but a text"),
        ("position[3]", "the list has 3 members"),
        ("position[0:0]", "hold 0 numbers"),
        ("a[x]", "is not a field"),
    ],
)
def test_what_is_no_number_is_refused_in_words(path: str, why: str) -> None:
    with pytest.raises(UsageError, match=why.replace("[", r"\[")):
        numbers_of([Field(path)], NESTED, None)


def test_what_is_not_finite_is_refused_or_kept_in_a_range() -> None:
    ranges = {"ranges": [0.5, float("inf"), float("nan"), 50.0, -1.0]}
    with pytest.raises(UsageError, match=r"holds inf at index 1.* such as --set input.range"):
        numbers_of([Field("ranges")], ranges, None)
    remaining = numbers_of([Field("ranges")], ranges, (0.1, 10.0))
    assert remaining.tolist() == [0.5, 0.1, 0.1, 10.0, 0.1]


def angles(count: int = COUNT) -> np.ndarray:
    """(count, JOINTS), different from each other."""
    t = np.arange(count)[:, None]
    return np.sin(t / (5 + np.arange(JOINTS))) + np.arange(JOINTS)


def joint_state(store: Any, row: np.ndarray, *, ros1: bool) -> Any:
    time = store.types["builtin_interfaces/msg/Time"](sec=7, nanosec=8)
    header = store.types["std_msgs/msg/Header"](*([0] if ros1 else []), stamp=time, frame_id="")
    names = [f"joint {i}" for i in range(len(row))]
    none = np.empty(0)
    kind = store.types["sensor_msgs/msg/JointState"]
    return kind(header=header, name=names, position=row.copy(), velocity=-row, effort=none)


def ros_mcap(folder: Path, *, ros1: bool) -> Path:
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    name = "sensor_msgs/msg/JointState"
    text, _ = store.generate_msgdef(name, ros_version=1 if ros1 else 2)
    pack = store.serialize_ros1 if ros1 else store.serialize_cdr
    rows = (bytes(pack(joint_state(store, row, ros1=ros1), name)) for row in angles())
    kind = MessageKind(name, "cdr", text.encode(), "ros2msg")
    if ros1:
        kind = MessageKind("sensor_msgs/JointState", "ros1", text.encode(), "ros1msg")
    return write_mcap(folder / "joints.mcap", kind, {"/joint_states": every(STEP, rows)})


def json_mcap(folder: Path) -> Path:
    rows = (json.dumps({"position": row.tolist()}).encode() for row in angles())
    kind = MessageKind("joints", "json", b"{}", "jsonschema")
    return write_mcap(folder / "joints.mcap", kind, {"/joint_states": every(STEP, rows)})


def bag(folder: Path, *, ros1: bool) -> Path:
    from rosbags import rosbag1, rosbag2
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    path, name = folder / ("joints.bag" if ros1 else "joints"), "sensor_msgs/msg/JointState"
    with rosbag1.Writer(path) if ros1 else rosbag2.Writer(path, version=9) as writer:
        channel = writer.add_connection("/joint_states", name, typestore=store)
        text = writer.add_connection("/chatter", "std_msgs/msg/String", typestore=store)
        pack = store.serialize_ros1 if ros1 else store.serialize_cdr
        for i, row in enumerate(angles()):
            word = store.types["std_msgs/msg/String"](data="x")
            writer.write(text, START + i * STEP, bytes(pack(word, "std_msgs/msg/String")))
            state = joint_state(store, row, ros1=ros1)
            writer.write(channel, START + i * STEP, bytes(pack(state, name)))
    return path


LOGS: dict[str, Callable[[Path], Path]] = {
    "json": json_mcap,
    "ros1 mcap": lambda folder: ros_mcap(folder, ros1=True),
    "ros2 mcap": lambda folder: ros_mcap(folder, ros1=False),
    "bag": lambda folder: bag(folder, ros1=True),
    "db3 folder": lambda folder: bag(folder, ros1=False),
}


@pytest.mark.parametrize("kind", LOGS)
def test_every_kind_of_message_gives_the_same_numbers(kind: str, tmp_path: Path) -> None:
    path = LOGS[kind](tmp_path)
    source = external(path, ["/joint_states"], fields=["position[1:]", "position[0]"])
    with contextlib.closing(source):
        assert (source.spec.frame_shape, source.spec.dtype) == ((JOINTS,), "float64")
        assert source.spec.fps == 50
        assert (source.take(0, COUNT).frames == angles()[:, [1, 2, 0]]).all()
        assert source.describe()["fields"] == [["position[1:]", "position[0]"]]


def test_fields_of_protobuf_are_found_by_their_definition(tmp_path: Path) -> None:
    def poses() -> Iterator[bytes]:
        for i in range(COUNT):
            message = PoseInFrame()
            message.pose.position.x, message.pose.orientation.w = i, -i
            yield message.SerializeToString()

    definition = descriptor_set(PoseInFrame.DESCRIPTOR)
    kind = MessageKind("foxglove.PoseInFrame", "protobuf", definition, "protobuf")
    path = write_mcap(tmp_path / "p.mcap", kind, {"/pose": every(STEP, poses())})
    fields = ["pose.position.x", "pose.orientation.w"]
    with external(path, fields=fields) as source:
        assert source.take(0, 5).frames.tolist() == [[i, -i] for i in range(5)]
    with pytest.raises(UsageError, match="there is no pos: it has timestamp, frame_id, pose"):
        external(path, fields=["pos"])


@pytest.mark.parametrize("encoding", ["json", "protobuf", "cdr", "ros1"])
def test_broken_messages_are_said_to_be(encoding: str) -> None:
    definition = descriptor_set(PoseInFrame.DESCRIPTOR)
    name = "foxglove.PoseInFrame"
    if encoding in ("cdr", "ros1"):
        name, definition = "a_msgs/msg/A", b"float64[] a\nstring b\n"
    decode = message_decoder(MessageKind(name, encoding, definition, ""))
    assert decode is not None
    chosen = random.Random(0)
    broken = 0
    for _ in range(200):
        try:
            numbers_of([Field("a")], decode(chosen.randbytes(chosen.randrange(60))), None)
        except CdmisfaError:
            broken += 1
    assert broken > 150


@pytest.mark.parametrize("name", ["t.csv", "t.parquet"])
@pytest.mark.parametrize(
    ("unit", "times"),
    [
        ("", np.arange(COUNT) / 50),
        (":ms", np.arange(COUNT) * 20),
        (":ns", START + np.arange(COUNT) * STEP),
        ("", pa.array(START + np.arange(COUNT) * STEP, pa.timestamp("ns"))),
    ],
)
def test_the_rows_of_a_table_are_frames_at_their_times(
    name: str, unit: str, times: Any, tmp_path: Path
) -> None:
    columns = {"stamp": times, "a.b": angles()[:, 0], "word": ["x"] * COUNT, "c": range(COUNT)}
    path = write_table(tmp_path / name, columns)
    with external(path, time="stamp" + unit) as source:
        assert source.spec.streams == ("t",)
        assert source.spec.fps == 50
        frames = source.take(0, COUNT).frames
        assert (frames == np.c_[angles()[:, 0], np.arange(COUNT)]).all()
        assert source.describe()["fields"] == [["a.b", "c"]]
    with external(path, fields=["c"], rate=10) as source:
        assert (source.spec.fps, source.take(0, 3).frames.tolist()) == (10, [[0], [1], [2]])


def test_lists_in_a_table_are_taken_apart(tmp_path: Path) -> None:
    path = write_table(tmp_path / "t.parquet", {"state": angles().tolist(), "n": range(COUNT)})
    with external(path, fields=["state[1:3]", "n"], rate=5) as source:
        assert (source.take(0, 2).frames == np.c_[angles()[:2, 1:3], [0, 1]]).all()
    with pytest.raises(UsageError, match="state has 2 or 3 numbers in a row: choose"):
        external(
            write_table(tmp_path / "u.parquet", {"state": [[1, 2, 3], [1, 2]]}),
            fields=["state"],
            rate=5,
        )


@pytest.mark.parametrize(
    ("options", "why"),
    [
        ({}, "set --rate in frames per second, or name the column of times.* --set input.time"),
        ({"fields": ["z"], "rate": 5}, "no column z; it has s, a, word"),
        ({"fields": ["word"], "rate": 5}, "t.csv: --field word: it is not a number but a text"),
        ({"time": "word"}, r"word \(string\) has no times from 1970 to 2116"),
        ({"time": "s:h"}, r"no column s:h; .* a unit \(s, ms, us, ns\)"),
        ({"time": "big"}, r"big \(int64\) has no times .* or in s: state the unit"),
        ({"time": "us"}, r"state the unit \(s, ms, us, ns\), as in --set input.time=us:ns"),
        ({"rate": 5, "size": (4, 4)}, "are numbers: --size is for images"),
    ],
)
def test_what_a_table_lacks_is_said(options: Any, why: str, tmp_path: Path) -> None:
    columns = {"s": [0.0, 1.0], "a": [1, 2], "word": ["x", "y"], "big": [10**18, 10**18 + 1]}
    columns |= {"ms": [1_700_000_000_000] * 2, "us": [1_700_000_000_000_000] * 2}
    with pytest.raises(UsageError, match=why):
        external(write_table(tmp_path / "t.csv", columns), **options)


def test_a_slow_sine_hidden_in_fields_of_noise_is_learned(cdmisfa: Cdmisfa, tmp_path: Path) -> None:
    rng = np.random.default_rng(20)
    t = np.arange(4000)
    sine = np.sin(2 * np.pi * t / 200)
    fields = np.c_[sine, rng.normal(size=(len(t), 6))] @ rng.normal(size=(7, 7))
    noise = rng.normal(size=(len(t), 7))
    for name, values in {"arm": fields, "noise": noise}.items():
        columns = {"stamp": t / 50, **{f"joint {i}": values[:, i] for i in range(7)}}
        write_table(tmp_path / f"{name}.csv", columns)
    logs = [tmp_path / "arm.csv", tmp_path / "noise.csv"]
    run = tmp_path / "run"
    done = cdmisfa(
        "learn", *logs, "--set", "input.time=stamp", "-o", run, "--no-rerun", "--json"
    ).json
    assert done["ended"] == "all_decided"
    arm, noisy = done["streams"]
    assert (arm["state"], noisy["state"]) == ("learned", "given_up")
    assert arm["slowness"] == pytest.approx(1 / 200, rel=0.1)
    from replay.runs.modules import load_modules

    (module,) = load_modules(run / "modules.npz")
    heard = np.asarray(module.transform(fields))[:, 0]
    assert abs(np.corrcoef(heard, sine)[0, 1]) > 0.99
