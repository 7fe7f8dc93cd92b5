"""LeRobot datasets of many episodes are streams of all their images."""

from __future__ import annotations

import json
from pathlib import Path

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from camera_files import encoded, pictures, write_cameras
from conftest import Cdmisfa
from folders import external

from cdmisfa.core.errors import LogDamagedError, UsageError
from replay.corpus.index import read_index
from replay.open_sources import open_recording
from replay.stored_source import PAUSE

COUNT, FIRST = 60, 25
KEY = "observation.images.cam"
EPISODES = "meta/episodes/chunk-000/file-000.parquet"


@pytest.fixture
def dataset(cdmisfa: Cdmisfa, tmp_path: Path) -> Path:
    """An export without loss, its one episode told as two."""
    write_cameras(tmp_path / "log.mcap", {"/cam": (COUNT, 20)})
    words = ["--to", "lerobot", "--lossless", "-o", tmp_path / "data"]
    assert cdmisfa("convert", tmp_path / "log.mcap", "-o", tmp_path / "rec").code == 0
    assert cdmisfa("export", tmp_path / "rec", *words).code == 0
    row = pq.read_table(tmp_path / "data" / EPISODES).to_pylist()[0]
    rows = [
        {**row, "episode_index": i, "length": stop - start, "dataset_from_index": start,
         f"videos/{KEY}/from_timestamp": start / 50, f"videos/{KEY}/to_timestamp": stop / 50}
        for i, (start, stop) in enumerate([(0, FIRST), (FIRST, COUNT)])
    ]  # fmt: skip
    pq.write_table(pa.Table.from_pylist(rows[::-1]), tmp_path / "data" / EPISODES)
    info = tmp_path / "data/meta/info.json"
    info.write_text(info.read_text().replace('"total_episodes": 1', '"total_episodes": 2'))
    return tmp_path / "data"


def as_pictures(dataset: Path) -> None:
    """Keep the images in the table instead of a video."""
    table = dataset / "data/chunk-000/file-000.parquet"
    images = [
        {"bytes": encoded(image), "path": f"{i}.png"} for i, image in enumerate(pictures(COUNT))
    ]
    pq.write_table(pq.read_table(table).append_column(KEY, pa.array(images)), table)
    info = json.loads((dataset / "meta/info.json").read_text())
    info["features"][KEY]["dtype"] = "image"
    (dataset / "meta/info.json").write_text(json.dumps(info))


@pytest.mark.parametrize("kept", ["video", "pictures"])
def test_episodes_follow_one_another_after_a_pause(dataset: Path, kept: str) -> None:
    if kept == "pictures":
        as_pictures(dataset)
    source = external(dataset)
    assert source.pauses["cam"] == [(FIRST, FIRST + PAUSE)]
    expected = np.stack(list(pictures(COUNT)))
    blocks = source.take_all(COUNT + PAUSE)
    assert [(block.t, len(block)) for block in blocks] == [
        (0, FIRST),
        (FIRST + PAUSE, COUNT - FIRST),
    ]
    np.testing.assert_array_equal(np.concatenate([b.frames for b in blocks]), expected)
    source.close()


def test_no_frame_is_missing_between_episodes(cdmisfa: Cdmisfa, dataset: Path) -> None:
    index = ["index", dataset, "--deep", "-o", dataset.parent / "all.parquet", "--json"]
    assert cdmisfa(*index).code == 0
    gaps = {row["topic"]: row["gaps"] for row in read_index(index[-2]).to_pylist()}
    assert gaps[KEY] == 0
    assert cdmisfa("verify", dataset, "--json").json["ok"]
    video = next(dataset.rglob("*.mp4"))
    with av.open(str(video)) as old, av.open(str(dataset.parent / "new.mp4"), "w") as new:
        stream = new.add_stream_from_template(old.streams.video[0])
        for i, packet in enumerate(p for p in old.demux(video=0) if p.dts is not None):
            packet.stream = stream
            if i != FIRST + 3:
                new.mux(packet)
    (dataset.parent / "new.mp4").replace(video)
    assert cdmisfa(*index).code == 0
    gaps = {row["topic"]: row["gaps"] for row in read_index(index[-2]).to_pylist()}
    assert gaps[KEY] == 1
    done = cdmisfa("verify", dataset, "--json")
    assert done.code == 3
    assert "has no frame at 0.56 s" in done.json["problems"][0]["what"]


def test_numbers_come_back_as_they_were_exported(cdmisfa: Cdmisfa, tmp_path: Path) -> None:
    frames = {"a": 60, "b": 41}
    for seed, (name, count) in enumerate(frames.items()):
        words = ["--frames", count, "--seed", seed, "-o", tmp_path / name]
        assert cdmisfa("record", "oscillatory", *words).code == 0
    out = tmp_path / "data"
    words = ["--to", "lerobot", "--task", "oscillate", "-o", out, "--json"]
    assert cdmisfa("export", tmp_path / "a", tmp_path / "b", *words).json["rows"] == 101
    tasks = pq.read_table(out / "meta/tasks.parquet").to_pylist()
    assert tasks == [{"task_index": 0, "__index_level_0__": "oscillate"}]
    expected = []
    for name, count in frames.items():
        with open_recording(tmp_path / name) as one:
            views = one.spec.streams
            expected.append(np.hstack([block.frames for block in one.take_all(count)]))
    fields = [f"observation.{view}" for view in views]
    with external(out, fields=fields) as source:
        assert source.pauses == {"data": [(60, 60 + PAUSE)]}
        result = [block.frames for block in source.take_all(101 + PAUSE)]
    for block, numbers in zip(result, expected, strict=True):
        np.testing.assert_array_equal(block, numbers.astype(np.float32))
    with external(out) as source:  # without cameras: all numbers but those that count frames
        assert [*source.streams[0].fields] == ["observation.environment_state", *fields]
        every = source.take(0, len(result[0])).frames
        np.testing.assert_array_equal(every[:, -result[0].shape[1] :], result[0])
    with pytest.raises(UsageError, match="no field state; choose from observation"):
        external(out, fields=["state"])
    table = out / "data/chunk-000/file-000.parquet"
    pq.write_table(pq.read_table(table).slice(0, 50), table)
    with pytest.raises(LogDamagedError, match=r"no episode is whole: .* has 50 of 60 frames"):
        external(out, fields=fields)
