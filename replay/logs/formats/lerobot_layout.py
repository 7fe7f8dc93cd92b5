"""Rules of LeRobot's layout that readers and writers share: whole episodes, tasks, statistics.

`lerobot` 0.4 writes the footers of its tables when a recording ends, so that a killed one leaves
tables that cannot be read; v2.1 writes the table and the videos of an episode before it lists it.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from cdmisfa.core.clock import NANOSECONDS
from cdmisfa.core.errors import LogDamagedError
from cdmisfa.core.untrusted import check_regular
from replay.logs.formats.video import VideoFile
from replay.logs.stream import UnreadableError, limited

# Reasons that a message names; a killed recording has one or two.
_MOST_REASONS = 3

# Error of a Parquet file that a killed process left.
NO_FOOTER = "is missing or has no footer, so its rows are lost"

Stats = dict[str, NDArray[Any]]

# Table of episodes of layout v2.1.
V21 = "meta/episodes.jsonl"

# Pixels of the longer side of an image that its statistics count, as in LeRobot.
SAMPLED = 150

QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}


def file_columns(camera: str, chunk: int = 0, number: int = 0) -> dict[str, int]:
    """Return the columns that state the table of an episode, or its video of a camera."""
    kind = f"videos/{camera}" if camera else "data"
    return {f"{kind}/chunk_index": chunk, f"{kind}/file_index": number}


def video_cameras(info: Mapping[str, Any]) -> list[str]:
    """Return the names of the cameras whose images are in videos."""
    return [name for name, kind in info["features"].items() if kind.get("dtype") == "video"]


def episode_file(info: Mapping[str, Any], row: Mapping[str, Any], camera: str = "") -> str:
    """Return the file in a dataset with the frames of an episode, or with its video of a camera."""
    chunk, number = (int(row[column]) for column in file_columns(camera))
    template = info["video_path" if camera else "data_path"]
    v21 = {"episode_chunk": chunk, "episode_index": number}
    return str(template.format(video_key=camera, chunk_index=chunk, file_index=number, **v21))


def table_frames(info: Mapping[str, Any], rows: Sequence[Mapping[str, Any]]) -> Counter[str]:
    """Return the number of frames of episodes in each table."""
    frames = Counter[str]()
    for row in rows:
        frames[episode_file(info, row)] += int(row["length"])
    return frames


def table_rows(file: Path) -> int | None:
    """Return the number of rows of a Parquet file; None if it is missing or has no footer."""
    import pyarrow.parquet as pq

    if not file.exists():
        return None
    check_regular(file)
    with suppress(UnreadableError), limited(file, "PyArrow"):
        return int(pq.read_metadata(file).num_rows)
    return None


def whole_episodes(
    path: Path, info: Mapping[str, Any], rows: Sequence[dict[str, Any]], damage: Sequence[str]
) -> tuple[list[dict[str, Any]], str]:
    """Return the rows of episodes up to the last whole one, and a message about the others, or "".

    Only the last episodes are examined: a killed recording leaves the others whole.

    Args:
        path: the dataset.
        info: its description.
        rows: rows of its tables of episodes.
        damage: problems of these tables.

    Raises:
        LogDamagedError: no episode is whole.
    """
    whole, reasons = list(rows), dict.fromkeys(damage)
    listed = table_frames(info, rows)
    frames = listed.copy()
    while whole and (why := _damage_of(path, info, whole[-1], frames)):
        reasons[why] = None
        frames[episode_file(info, whole[-1])] -= int(whole.pop()["length"])
    reasons |= dict.fromkeys(_further_damage(path, info, whole, listed))
    stated = int(info.get("total_episodes", len(rows)))
    if stated != len(rows):
        reasons[f"meta/info.json states {stated} episodes, the tables list {len(rows)}"] = None
    more = len(reasons) - _MOST_REASONS
    text = "; ".join([*reasons][:_MOST_REASONS]) + (f"; and {more} more" if more > 0 else "")
    if reasons and not whole:
        raise LogDamagedError(f"{path}: no episode is whole: {text}")
    missing = (
        f"the first {len(whole)} of {max(stated, len(rows))} episodes are whole and are read: "
        f"{text}; write them as a whole dataset with cdmisfa recover"
    )
    return whole, missing if reasons else ""


def _damage_of(
    path: Path, info: Mapping[str, Any], row: Mapping[str, Any], frames: Mapping[str, int]
) -> str:
    """Return why the last episode is not whole, or "".

    Args:
        path: the dataset.
        info: its description.
        row: row of the episode.
        frames: frames of this and the earlier episodes in each table.
    """
    name = episode_file(info, row)
    if (count := table_rows(path / name)) is None:
        return f"{name} {NO_FOOTER}"
    if count < frames[name]:
        return f"{name} has {count} of {frames[name]} frames"
    for camera in video_cameras(info):
        start = row.get(f"videos/{camera}/from_timestamp")
        if start is None or None in (row.get(column) for column in file_columns(camera)):
            return f"no video of {camera} is listed for episode {row['episode_index']}"
        name = episode_file(info, row, camera)
        if not (path / name).is_file():
            return f"{name} is missing"
        try:
            end, cut = _video_end(path / name, (path / name).stat().st_mtime_ns)
        except LogDamagedError as error:
            return str(error).removeprefix(f"{path}/")
        # A recorder that drops frames leaves shorter videos, too, which end properly.
        absent = round(start * info["fps"]) + int(row["length"]) - 1 - end * info["fps"]
        if absent > (0.5 if cut else int(row["length"]) / 2):
            return f"{name} ends before its episode"
    return ""


@lru_cache
def _video_end(file: Path, changed: int) -> tuple[float, bool]:
    """Return when a video ends (s), and whether the file is cut; `changed` is the file's time."""
    video = VideoFile(file)
    video.close()
    return float(video.times[-1]) / NANOSECONDS, bool(video.missing)


def _further_damage(
    path: Path, info: Mapping[str, Any], whole: Sequence[dict[str, Any]], listed: Mapping[str, int]
) -> Iterator[str]:
    """Yield problems of the tables after the last whole episode, and of that of the tasks."""
    last = path / episode_file(info, whole[-1]) if whole else path / "data"
    for file in sorted((path / "data").rglob("*.parquet")):
        name = file.relative_to(path).as_posix()
        if file < last:
            continue
        if (count := table_rows(file)) is None:
            yield f"{name} {NO_FOOTER}"
        elif count > listed.get(name, 0):
            unlisted = count - listed.get(name, 0)
            yield f"{name} has {unlisted} frames of episodes that meta/episodes does not list"
    tasks = path / "meta/tasks.parquet"
    v3 = not (path / V21).is_file()
    if v3 and info.get("total_tasks") and table_rows(tasks) is None:
        yield f"meta/tasks.parquet {NO_FOOTER}"


def table_of_tasks(tasks: Mapping[str, int]) -> Any:
    """Return the table of tasks as pandas writes it: the text is the index of the row."""
    import pyarrow as pa

    index = "__index_level_0__"
    kind = {"pandas_type": "unicode", "numpy_type": "object", "metadata": None}
    columns = [{"name": None, "field_name": index, **kind}]
    pandas = {"index_columns": [index], "column_indexes": [], "columns": columns}
    table = pa.table({"task_index": pa.array(tasks.values(), pa.int64()), index: pa.array(tasks)})
    return table.replace_schema_metadata({"pandas": json.dumps(pandas)})


def aggregated(parts: Sequence[Stats]) -> Stats:
    """Return statistics over all parts from the statistics of each; quantiles are averaged.

    LeRobot averages quantiles in the same way.
    """
    counts = np.array([float(part["count"][0]) for part in parts])

    def mean(values: list[NDArray[Any]]) -> NDArray[Any]:
        return np.average(values, axis=0, weights=counts)

    centre = mean([part["mean"] for part in parts])
    return {
        "min": np.min([part["min"] for part in parts], axis=0),
        "max": np.max([part["max"] for part in parts], axis=0),
        "mean": centre,
        "std": np.sqrt(mean([part["std"] ** 2 + (part["mean"] - centre) ** 2 for part in parts])),
        "count": np.array([int(counts.sum())]),
        **{key: mean([part[key] for part in parts]) for key in parts[0] if key.startswith("q")},
    }


def write_stats(file: Path, episodes: Mapping[str, Sequence[Stats]]) -> None:
    """Write the statistics of features over all episodes."""
    whole = {key: aggregated(parts) for key, parts in episodes.items()}
    lists = {key: {n: v.tolist() for n, v in values.items()} for key, values in whole.items()}
    file.write_text(json.dumps(lists, indent=4), "utf-8")


def number_stats(values: NDArray[Any]) -> Stats:
    """Return LeRobot's statistics of (n,) or (n, k) numbers."""
    rows = values.astype(np.float64).reshape(len(values), -1)
    return {
        "min": rows.min(axis=0),
        "max": rows.max(axis=0),
        "mean": rows.mean(axis=0),
        "std": rows.std(axis=0),
        "count": np.array([len(rows)]),
        **{key: np.quantile(rows, q, axis=0) for key, q in QUANTILES.items()},
    }


class ImageStats:
    """LeRobot's statistics of pixels from 0 to 1, (3, 1, 1) each, from a histogram a channel."""

    def __init__(self) -> None:
        self._counts, self._images = np.zeros((3, 256), np.int64), 0

    def add(self, images: NDArray[Any]) -> None:
        """Count the pixels of images (n, height, width, 1 or 3)."""
        longest = max(images.shape[1:3])
        step = longest // SAMPLED if longest >= 2 * SAMPLED else 1
        for image in images[:, ::step, ::step]:  # Pillow counts faster than NumPy
            pixels = Image.fromarray(image if image.shape[2] == 3 else image[:, :, 0])
            self._counts += np.reshape(pixels.histogram(), (-1, 256))
        self._images += len(images)

    def result(self) -> Stats:
        """Return the statistics of all images."""
        levels, counts = np.arange(256) / 255, self._counts
        total, below = counts[0].sum(), np.cumsum(counts, axis=1)
        mean = counts @ levels / total
        values = {
            "min": [levels[row > 0][0] for row in counts],
            "max": [levels[row > 0][-1] for row in counts],
            "mean": mean,
            "std": np.sqrt(((levels - mean[:, None]) ** 2 * counts).sum(axis=1) / total),
            **{
                key: [levels[np.searchsorted(row, q * total)] for row in below]
                for key, q in QUANTILES.items()
            },
        }
        stats = {key: np.reshape(value, (3, 1, 1)) for key, value in values.items()}
        return {**stats, "count": np.array([self._images])}
