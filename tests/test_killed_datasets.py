"""A dataset whose recording was killed is read up to its last whole episode, and recovered."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from conftest import Cdmisfa
from folders import contents, external
from killed_recorder import KEY, LENGTHS, PICTURE, STATE, TASK, write_video

from replay.stored_source import PAUSE

INFO = "meta/info.json"
TABLE = "data/chunk-000/file-000.parquet"
VIDEO = f"videos/{KEY}/chunk-000/file-000.mp4"
EPISODES = "meta/episodes/chunk-000/file-000.parquet"


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Datasets of both layouts, whose recorder was killed in its fourth and sixth episode."""
    folders = {}
    for version in ("v3.0", "v2.1"):
        folders[version] = folder = tmp_path_factory.mktemp("killed") / "data"
        script = Path(__file__).with_name("killed_recorder.py")
        words = [sys.executable, str(script), str(folder), version]
        with subprocess.Popen(words, stdout=subprocess.PIPE) as process:
            assert process.stdout is not None
            assert process.stdout.readline() == b"recording\n"
            process.kill()
    return folders


@pytest.mark.parametrize("version", ["v3.0", "v2.1"])
def test_a_killed_recording_is_read_and_recovered_up_to_its_last_whole_episode(
    cdmisfa: Cdmisfa, recorded: dict[str, Path], tmp_path: Path, version: str
) -> None:
    data, out, before = recorded[version], tmp_path / "whole", contents(recorded[version])
    what, lost, stated = {
        "v3.0": ("file-001.parquet is missing or has no footer, so its rows are lost", 19, 5),
        "v2.1": ("has 8 frames of episodes that meta/episodes does not list", None, 3),
    }[version]
    missing = f"the first 3 of {stated} episodes are whole and are read: "
    count = sum(LENGTHS[:3])
    verified = cdmisfa("verify", data, "--json")
    assert (verified.code, verified.json["files"][0]["state"]) == (3, "cut short")
    (problem,) = verified.json["problems"]
    assert missing in problem["what"]
    assert what in problem["what"]
    assert "with cdmisfa recover" in problem["what"]
    assert {c["messages"] for c in cdmisfa("info", data, "--json").json["channels"]} == {count}
    for words in (["--topic", KEY], ["--topic", PICTURE], ["--field", STATE]):
        done = cdmisfa("convert", data, *words, "-o", tmp_path / words[1], "--json")
        assert done.code == 0
        assert [missing in warning for warning in done.json["warnings"]].count(True) == 1
    shown = cdmisfa("episodes", data, "-o", tmp_path / "check", "--json")
    assert len(shown.json["episodes"]) == 3
    assert missing in shown.json["notes"][0]

    done = cdmisfa("recover", data, "-o", out, "--json")
    assert (done.code, done.json["complete"]) == (3, False)
    assert {(c["kept"], c["lost"]) for c in done.json["channels"]} == {(count, lost)}
    assert contents(data) == before
    assert "exists" in cdmisfa("recover", data, "-o", out).err
    assert "choose another output" in cdmisfa("recover", data, "-o", data, "--force").err
    checked = cdmisfa("verify", out, "--json")
    assert (checked.code, checked.json["ok"], checked.json["problems"]) == (0, True, [])
    info = json.loads((out / INFO).read_text())
    assert (info["total_episodes"], info["total_frames"]) == (3, count)
    assert info["splits"] == {"train": "0:3"}
    with external(out, fields=[STATE]) as source, external(data, fields=[STATE]) as damaged:
        blocks = source.take_all(count + 2 * PAUSE)
        np.testing.assert_array_equal(
            np.concatenate([block.frames for block in blocks])[:, 0], np.arange(count)
        )
        assert [*damaged.coverage().values()] == [*source.coverage().values()]
    if version == "v2.1":
        lines = (out / "meta/episodes_stats.jsonl").read_text().splitlines()
        assert [json.loads(line)["episode_index"] for line in lines] == [0, 1, 2]
        return
    stats = json.loads((out / "meta/stats.json").read_text())[STATE]
    starts = np.array([0, *np.cumsum(LENGTHS[:2])])
    assert stats["count"] == [count]
    assert stats["max"] == [starts[-1], 1.0]
    assert stats["mean"] == pytest.approx([(starts * LENGTHS[:3]).sum() / count, 1.0])
    assert pq.read_table(out / EPISODES).num_rows == 3


def cut(name: str) -> Callable[[Path], None]:
    def change(data: Path) -> None:
        (data / name).write_bytes((data / name).read_bytes()[:-900])

    return change


def fewer_episodes(data: Path) -> None:
    pq.write_table(pq.read_table(data / EPISODES).slice(0, 2), data / EPISODES)


def fewer_frames(data: Path) -> None:
    pq.write_table(pq.read_table(data / TABLE).slice(0, sum(LENGTHS[:2]) + 5), data / TABLE)


def states(episodes: int) -> Callable[[Path], None]:
    def change(data: Path) -> None:
        info = json.loads((data / INFO).read_text())
        info |= {"total_episodes": episodes, "total_frames": sum(LENGTHS[:episodes])}
        (data / INFO).write_text(json.dumps(info))

    return change


def shorter_video(data: Path) -> None:
    write_video(data / VIDEO, range(sum(LENGTHS[:2]) + 6))


def no_place(data: Path) -> None:
    table = pq.read_table(data / EPISODES).to_pylist()
    table[-1][f"videos/{KEY}/file_index"] = None
    pq.write_table(pa.Table.from_pylist(table), data / EPISODES)


@pytest.mark.parametrize(
    ("change", "whole", "lost", "what"),
    [
        (fewer_episodes, 2, True, "has 14 frames of episodes that meta/episodes does not list"),
        (fewer_frames, 2, True, "data/chunk-000/file-000.parquet has 26 of 35 frames"),
        (shorter_video, 2, True, "file-000.mp4 ends before its episode"),
        (no_place, 2, True, f"no video of {KEY} is listed for episode 2"),
        (states(2), 3, False, "meta/info.json states 2 episodes, the tables list 3"),
        (states(4), 3, True, "meta/info.json states 4 episodes, the tables list 3"),
        (
            lambda data: (data / "meta/tasks.parquet").unlink(),
            3,
            False,
            "tasks.parquet is missing or has no footer",
        ),
        (lambda data: (data / VIDEO).unlink(), 0, True, "file-000.mp4 is missing"),
        (cut(TABLE), 0, True, "file-000.parquet is missing or has no footer"),
        (cut(VIDEO), 0, True, "file-000.mp4"),
    ],
)
def test_what_is_not_whole_is_named_and_recovered(
    cdmisfa: Cdmisfa,
    recorded: dict[str, Path],
    tmp_path: Path,
    change: Callable[[Path], None],
    whole: int,
    lost: bool,
    what: str,
) -> None:
    data, out = tmp_path / "data", tmp_path / "whole"
    killed = tmp_path / "killed"
    shutil.copytree(recorded["v3.0"], killed)
    assert cdmisfa("recover", killed, "-o", data).code == 3
    assert cdmisfa("verify", data).code == 0
    change(data)
    done = cdmisfa("verify", data, "--json")
    assert done.code == 3
    assert what in done.json["problems"][0]["what"]
    done = cdmisfa("recover", data, "-o", out, "--json")
    assert done.code == (3 if lost else 0)
    if not whole:
        assert "no episode is whole: " in done.err
        assert not out.exists()
        return
    assert {c["kept"] for c in done.json["channels"]} == {sum(LENGTHS[:whole])}
    assert cdmisfa("verify", out).code == 0
    assert pq.read_table(out / "meta/tasks.parquet").to_pylist() == [
        {"task_index": 0, "__index_level_0__": TASK}
    ]


def test_lost_frames_are_counted_from_the_tables_if_info_json_lags_behind(
    cdmisfa: Cdmisfa, recorded: dict[str, Path], tmp_path: Path
) -> None:
    data = tmp_path / "data"
    assert cdmisfa("recover", recorded["v3.0"], "-o", data).code == 3
    shorter_video(data)
    states(1)(data)
    done = cdmisfa("recover", data, "-o", tmp_path / "out", "--json")
    assert done.code == 3
    lost = {(c["kept"], c["lost"]) for c in done.json["channels"]}
    assert lost == {(sum(LENGTHS[:2]), LENGTHS[2])}


@pytest.mark.parametrize("version", ["v3.0", "v2.1"])
def test_episodes_around_a_missing_file_are_recovered_with_new_numbers(
    cdmisfa: Cdmisfa, recorded: dict[str, Path], tmp_path: Path, version: str
) -> None:
    data, out = tmp_path / "data", tmp_path / "out"
    assert cdmisfa("recover", recorded[version], "-o", data).code == 3
    file = data / f"videos/{KEY}/chunk-000/file-001.mp4"
    if version == "v2.1":
        file = next((data / "videos").rglob("episode_000001.mp4"))
        file.unlink()
    else:  # the video of the second episode is a file of its own
        table = pq.read_table(data / EPISODES).to_pylist()
        table[1][f"videos/{KEY}/file_index"] = 1
        pq.write_table(pa.Table.from_pylist(table), data / EPISODES)
    done = cdmisfa("recover", data, "-o", out, "--json")
    assert done.code == 3
    missing = {"where": str(file), "what": "this file of the dataset is missing"}
    assert done.json["lost"] == [missing]
    frames = [*range(LENGTHS[0]), *range(sum(LENGTHS[:2]), sum(LENGTHS[:3]))]
    counts = {(c["kept"], c["lost"]) for c in done.json["channels"]}
    assert counts == {(len(frames), LENGTHS[1])}
    checked = cdmisfa("verify", out, "--json")
    assert (checked.code, checked.json["problems"]) == (0, [])
    tables = [pq.read_table(path) for path in sorted((out / "data").rglob("*.parquet"))]
    rows = [row for table in tables for row in table.to_pylist()]
    assert [row[STATE][0] for row in rows] == frames
    assert [row["index"] for row in rows] == [*range(len(frames))]
    episodes = [0] * LENGTHS[0] + [1] * LENGTHS[2]
    assert [row["episode_index"] for row in rows] == episodes
    with external(out, fields=[STATE]) as source:
        blocks = source.take_all(len(frames) + PAUSE)
        read = np.concatenate([block.frames for block in blocks])[:, 0]
        np.testing.assert_array_equal(read, frames)
    info = json.loads((out / INFO).read_text())
    assert (info["total_episodes"], info["total_frames"]) == (2, len(frames))
