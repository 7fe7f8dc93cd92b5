"""Write the whole episodes of a LeRobot dataset as a dataset of its own."""

from __future__ import annotations

import json
import shutil
from collections import defaultdict
from collections.abc import Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from cdmisfa.core.arrays import IntArray
from cdmisfa.core.errors import LogDamagedError
from recorder.log.files import atomic_write
from replay.logs.formats import lerobot
from replay.logs.formats import lerobot_layout as layout
from replay.logs.stream import limited

_TASKS = "meta/tasks.parquet"


def write_whole(src: Path, dst: Path) -> tuple[lerobot.Dataset, int, list[str], bool]:
    """Copy the whole episodes, numbered without gaps.

    Returns:
        The dataset, the number of frames that are copied, missing files, and whether frames are
        lost.

    Raises:
        LogDamagedError: no episode is whole, or a table is damaged.
        LogWriteError: the folder cannot be written.
    """
    dataset = lerobot.Dataset(src)
    info, cameras = dataset.info, layout.video_cameras(dataset.info)
    files = [[layout.episode_file(info, r, c) for c in ("", *cameras)] for r in dataset.rows]
    absent = sorted(name for name in {*chain(*files)} if not (src / name).is_file())
    rows = [r for r, names in zip(dataset.rows, files, strict=True) if {*names}.isdisjoint(absent)]
    if not rows:
        raise LogDamagedError(f"{src}: no episode is whole: {absent[0]} is missing")
    numbers = {int(row["episode_index"]): number for number, row in enumerate(rows)}
    starts = np.cumsum([0, *(int(row["length"]) for row in rows)])
    moved = _moved(info, rows, ("", *cameras)) if (src / layout.V21).is_file() else {}
    frames = layout.table_frames(info, rows)
    videos = {layout.episode_file(info, row, camera) for camera in cameras for row in rows}
    # Not images/ and folders of videos that are being encoded: their episodes were not saved.
    documents = [f for f in (*src.glob("meta/*"), *src.glob("*")) if f.is_file()]
    counts = {f.relative_to(src).as_posix(): layout.table_rows(f) for f in lerobot.tables(src)}
    with atomic_write(dst) as out:
        for name in {*videos, *frames, *(str(file.relative_to(src)) for file in documents)}:
            target = out / moved.get(name, name)
            target.parent.mkdir(parents=True, exist_ok=True)
            if name in frames and absent:
                pq.write_table(_numbered(_read(src / name), numbers, starts), target)
            elif name not in frames or counts[name] == frames[name]:
                shutil.copyfile(src / name, target)
            else:
                pq.write_table(_read(src / name).slice(0, frames[name]), target)
        for name in (layout.V21, layout.V21.replace("episodes", "episodes_stats")):
            if (src / name).is_file():
                lines = lerobot.json_lines(src / name, [])
                chosen = [line for line in lines if line["episode_index"] in numbers]
                for line in chosen:
                    line["episode_index"] = numbers[line["episode_index"]]
                (out / name).write_text("\n".join([*map(json.dumps, chosen), ""]), "utf-8")
        if not (src / layout.V21).is_file():
            _write_episodes(src, out, numbers, starts)
            if layout.table_rows(src / _TASKS) is None:
                pq.write_table(layout.table_of_tasks(_tasks(dataset)), out / _TASKS)
        whole = info | {"total_episodes": len(rows), "total_frames": int(starts[-1])}
        whole |= {"splits": {"train": f"0:{len(rows)}"}}
        whole |= {"total_videos": len(videos)} if "total_videos" in info else {}
        (out / lerobot.INFO).write_text(json.dumps(whole, indent=4), "utf-8")
    listed = max(int(info["total_frames"]), dataset.listed)
    return dataset, int(starts[-1]), absent, listed > starts[-1] or counts != frames


def _moved(
    info: Mapping[str, Any], rows: Sequence[Mapping[str, Any]], cameras: Sequence[str]
) -> dict[str, str]:
    """Return the new name of each file of layout v2.1, which has the number of its episode."""
    names = {}
    for number, row in enumerate(rows):
        for camera in cameras:
            chunk = number // int(info["chunks_size"])
            new = {**row, **layout.file_columns(camera, chunk, number)}
            names[layout.episode_file(info, row, camera)] = layout.episode_file(info, new, camera)
    return names


def _numbered(table: Any, numbers: Mapping[int, int], starts: IntArray) -> Any:
    """Return the rows of some episodes, frames or episodes themselves, with new numbers."""
    old = table["episode_index"].to_pylist()
    table = table.filter(pa.array([number in numbers for number in old], pa.bool_()))
    new = np.array([numbers[number] for number in old if number in numbers], int)
    first = starts[new[0]] if len(new) else 0
    columns = {
        "episode_index": new,
        "index": first + np.arange(len(new)),
        "dataset_from_index": starts[new],
        "dataset_to_index": starts[new + 1],
    }
    for name in columns.keys() & {*table.column_names}:
        place = table.column_names.index(name)
        field = table.schema.field(name)
        table = table.set_column(place, field, pa.array(columns[name], field.type))
    return table


def _read(file: Path) -> Any:
    with limited(file, "PyArrow"):
        return pq.ParquetFile(file).read(use_threads=False)


def _write_episodes(src: Path, out: Path, numbers: Mapping[int, int], starts: IntArray) -> None:
    """Write the tables of some episodes, and the statistics of all of them."""
    stats: dict[str, list[layout.Stats]] = defaultdict(list)
    for file in lerobot.tables(src, "meta/episodes"):
        if layout.table_rows(file) is not None:
            table = _numbered(_read(file), numbers, starts)
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
