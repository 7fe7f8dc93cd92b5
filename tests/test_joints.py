"""Values of JointState messages go to the joints that the messages name."""

from __future__ import annotations

import json
from collections.abc import Collection, Iterable, Sequence
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from camera_files import RAW, raw
from conftest import Cdmisfa
from mcap.writer import Writer
from message_files import START, STEP
from test_bad_episodes import COUNT, dataset

from recorder.images.messages import MessageKind
from replay.episodes.reading import list_episodes, measure_episode, read_numbers

JOINTS = MessageKind("JointState", "json")
VALUES = {"elbow": 1.0, "hand": 2.0, "neck": 3.0}


def joint_log(
    path: Path, orders: Iterable[Sequence[str]], start: int = START, lost: Collection[int] = ()
) -> Path:
    """Write images and joint states, which name joints in the given orders, or `lost` the first."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema(RAW.schema, RAW.encoding, RAW.definition)
        camera = writer.register_channel("/cam", RAW.encoding, schema)
        schema = writer.register_schema(JOINTS.schema, "", b"")
        joints = writer.register_channel("/joints", JOINTS.encoding, schema)
        for i, names in enumerate(orders):
            time = start + i * STEP
            image = np.random.default_rng(i).integers(0, 255, (48, 64), np.uint8)
            writer.add_message(camera, time, raw(image), time)
            values: list[float | None] = [VALUES.get(name, 0) for name in names]
            values[:1] = [None] if i in lost else values[:1]
            message = {"name": names, "position": values, "velocity": values, "effort": []}
            writer.add_message(joints, time, json.dumps(message).encode(), time)
        writer.finish()
    return path


ONE, OTHER = ["hand", "elbow", "neck"], ["neck", "hand", "elbow"]


def test_messages_in_other_orders_are_put_into_the_first_one(
    cdmisfa: Cdmisfa, tmp_path: Path
) -> None:
    log = joint_log(tmp_path / "a.mcap", [ONE, OTHER, ["elbow", "hand", "neck"], ONE])
    words = "--topic", "/joints", "--field", "position", "--field", "velocity[1]"
    assert cdmisfa("export", log, *words, "-o", tmp_path / "a.parquet").code == 0
    table = pq.read_table(tmp_path / "a.parquet")
    assert [list(row.values())[1:] for row in table.to_pylist()] == [[2, 1, 3, 1]] * 4


def test_datasets_have_the_joints_of_the_first_log_by_their_names(
    cdmisfa: Cdmisfa, tmp_path: Path
) -> None:
    logs = [joint_log(tmp_path / "a.mcap", [ONE] * 6), joint_log(tmp_path / "b.mcap", [OTHER] * 6)]
    done = cdmisfa("export", *logs, "--to", "lerobot", "-o", tmp_path / "d")
    assert done.code == 0, done.err
    features = json.loads((tmp_path / "d/meta/info.json").read_text())["features"]
    assert features["observation.state"]["names"] == ONE
    assert features["observation.joints"]["names"] == [f"{name}.velocity" for name in ONE]
    table = pq.read_table(tmp_path / "d/data")
    for feature in ("observation.state", "observation.joints"):
        assert table[feature].to_pylist() == [[2, 1, 3]] * 12


def test_episodes_and_logs_that_follow_one_another_have_one_order(
    cdmisfa: Cdmisfa, tmp_path: Path
) -> None:
    logs = [
        joint_log(tmp_path / "a.mcap", [ONE] * 6),
        joint_log(tmp_path / "b.mcap", [OTHER] * 6, START + 6 * STEP),
    ]
    with ExitStack() as opened:
        for episode in list_episodes(logs, tmp_path / "out", {}):
            assert read_numbers(episode, opened)["state"][1].tolist() == [[1, 2, 3]] * 6
    words = "--topic", "/joints", "--field", "position", "-o", tmp_path / "a.parquet"
    done = cdmisfa("export", *logs, *words)
    assert done.code == 0, done.err
    table = pq.read_table(tmp_path / "a.parquet")
    assert [list(row.values())[1:] for row in table.to_pylist()] == [[2, 1, 3]] * 12


@pytest.mark.parametrize("form", ["lerobot", "parquet"])
def test_two_publishers_on_a_topic_are_refused_by_their_joints(
    cdmisfa: Cdmisfa, tmp_path: Path, form: str
) -> None:
    log = joint_log(tmp_path / "a.mcap", [ONE, ["left", "middle", "right"]] * 4)
    words = (
        ["--to", "lerobot"] if form == "lerobot" else ["--topic", "/joints", "--field", "position"]
    )
    refused = cdmisfa("export", log, *words, "-o", tmp_path / f"out.{form}")
    assert refused.code == 2
    assert (
        "/joints has the joints left, middle, right after messages with hand, elbow, neck: write "
        "the joints of each publisher to a topic or log of its own"
    ) in refused.err


def test_episodes_leave_out_joint_states_that_are_not_finite(
    cdmisfa: Cdmisfa, tmp_path: Path
) -> None:
    log = joint_log(tmp_path / "a.mcap", [ONE] * 30, lost=range(5, 9))
    episode = measure_episode(list_episodes([log], tmp_path / "out", {})[0])
    assert episode.problem == ""
    assert "4 of 30 rows of the states are not finite: they are left out" in episode.remarks
    assert episode.numbers["state"][1].tolist() == [[1, 2, 3]] * 26


def test_episodes_refuse_an_output_that_holds_the_input(cdmisfa: Cdmisfa, tmp_path: Path) -> None:
    logs = tmp_path / "logs"
    logs.mkdir()
    joint_log(logs / "a.mcap", [ONE] * 6)
    for word in (logs, logs / "a.mcap", logs / "*.mcap"):
        refused = cdmisfa("episodes", word, "-o", logs)
        assert refused.code == 2
        assert f"{logs}: it is, or holds, the input {logs}" in refused.err
    assert [file.name for file in logs.iterdir()] == ["a.mcap"]


@pytest.mark.parametrize("names", [["x", "y"], {"motors": ["x", "y"]}])
def test_a_dataset_keeps_its_tasks_and_the_names_of_its_elements(
    cdmisfa: Cdmisfa, tmp_path: Path, names: object
) -> None:
    data = dataset(tmp_path / "data", [""] * 3, tasks=["push", "pull", "push"])
    info = json.loads((data / "meta/info.json").read_text())
    info["features"]["observation.state"]["names"] = names
    (data / "meta/info.json").write_text(json.dumps(info))
    done = cdmisfa("export", data, "--to", "lerobot", "-o", tmp_path / "out")
    assert done.code == 0, done.err
    info = json.loads((tmp_path / "out/meta/info.json").read_text())
    assert info["features"]["observation.state"]["names"] == ["x", "y"]
    episodes = pq.read_table(tmp_path / "out/meta/episodes")
    assert episodes["tasks"].to_pylist() == [["push"], ["pull"], ["push"]]
    tasks = pq.read_table(tmp_path / "out/meta/tasks.parquet").to_pydict()
    assert tasks == {"task_index": [0, 1], "__index_level_0__": ["push", "pull"]}
    numbers = pq.read_table(tmp_path / "out/data")["task_index"].to_pylist()
    assert numbers == [0] * COUNT + [1] * COUNT + [0] * COUNT
