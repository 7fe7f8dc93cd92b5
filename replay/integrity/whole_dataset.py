"""Write the whole episodes of a LeRobot dataset as a dataset of its own."""

from __future__ import annotations

import json
import shutil
from collections import defaultdict
from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from recorder.log.files import atomic_write
from replay.logs.formats import lerobot
from replay.logs.formats import lerobot_layout as layout
from replay.logs.stream import limited

_TASKS = "meta/tasks.parquet"


def write_whole(src: Path, dst: Path) -> tuple[lerobot.Dataset, bool]:
    """Copy the whole episodes; return the dataset, and whether frames are lost.

    Raises:
        LogDamagedError: no episode is whole, or a table is damaged.
        LogWriteError: the folder cannot be written.
    """
    dataset = lerobot.Dataset(src)
    info, rows = dataset.info, dataset.rows
    numbers = {int(row["episode_index"]) for row in rows}
    frames = layout.table_frames(info, rows)
    cameras = layout.video_cameras(info)
    videos = {layout.episode_file(info, row, camera) for camera in cameras for row in rows}
    # Not images/ and folders of videos that are being encoded: their episodes were not saved.
    documents = [f for f in (*src.glob("meta/*"), *src.glob("*")) if f.is_file()]
    counts = {f.relative_to(src).as_posix(): layout.table_rows(f) for f in lerobot.tables(src)}
    with atomic_write(dst) as out:
        for name in {*videos, *frames, *(str(file.relative_to(src)) for file in documents)}:
            (out / name).parent.mkdir(parents=True, exist_ok=True)
            if name not in frames or counts[name] == frames[name]:
                shutil.copyfile(src / name, out / name)
            else:
                pq.write_table(_read(src / name).slice(0, frames[name]), out / name)
        for name in (lerobot.V21, lerobot.V21.replace("episodes", "episodes_stats")):
            if (src / name).is_file():
                lines = lerobot.json_lines(src / name, [])
                chosen = [json.dumps(line) for line in lines if line["episode_index"] in numbers]
                (out / name).write_text("\n".join([*chosen, ""]), "utf-8")
        if not (src / lerobot.V21).is_file():
            _write_episodes(src, out, numbers)
            if layout.table_rows(src / _TASKS) is None:
                pq.write_table(layout.table_of_tasks(_tasks(dataset)), out / _TASKS)
        whole = info | {"total_episodes": len(rows), "total_frames": len(dataset.times)}
        whole |= {"splits": {"train": f"0:{len(rows)}"}}
        whole |= {"total_videos": len(videos)} if "total_videos" in info else {}
        (out / lerobot.INFO).write_text(json.dumps(whole, indent=4), "utf-8")
    listed = max(int(info["total_frames"]), dataset.listed)
    return dataset, listed > len(dataset.times) or counts != frames


def _read(file: Path) -> Any:
    with limited(file, "PyArrow"):
        return pq.ParquetFile(file).read(use_threads=False)


def _write_episodes(src: Path, out: Path, numbers: Collection[int]) -> None:
    """Write the tables of some episodes, and the statistics of all of them."""
    stats: dict[str, list[layout.Stats]] = defaultdict(list)
    for file in lerobot.tables(src, "meta/episodes"):
        if layout.table_rows(file) is not None:
            table = _read(file)
            chosen = [number in numbers for number in table["episode_index"].to_pylist()]
            table = table.filter(pa.array(chosen, pa.bool_()))
            (out / file.relative_to(src)).parent.mkdir(parents=True, exist_ok=True)
            pq.write_table(table, out / file.relative_to(src))
            values = table.select([n for n in table.column_names if n.startswith("stats/")])
            for row in values.to_pylist():
                episode: dict[str, layout.Stats] = defaultdict(dict)
                for name, value in row.items():
                    key, _, kind = name.removeprefix("stats/").rpartition("/")
                    episode[key][kind] = np.array(value)
                for key, parts in episode.items():
                    stats[key].append(parts)
    layout.write_stats(out / "meta/stats.json", stats)


def _tasks(dataset: lerobot.Dataset) -> dict[str, int]:
    """Return the number of each task, as episodes with one task tell; others are unknown."""
    numbers = lerobot.frame_numbers(dataset, ["task_index"])[:, 0].astype(int)
    texts = {number: f"unknown task {number}" for number in range(numbers.max() + 1)}
    for row, start in zip(dataset.rows, dataset.starts, strict=False):
        if len(row["tasks"]) == 1:
            texts[int(numbers[start])] = row["tasks"][0]
    return {text: number for number, text in texts.items()}
