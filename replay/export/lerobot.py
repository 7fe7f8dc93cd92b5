"""A recording as a LeRobot dataset, layout v3.0: its views as videos, an episode without gaps.

The layout is written as it is published (github.com/huggingface/lerobot), with PyArrow and
PyAV: the `lerobot` package itself pins a Rerun older than the viewer's and cannot be
installed beside it. `LeRobotDataset("name", root=FOLDER)` and Rerun open the folder.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from cdmisfa.core.errors import UsageError
from cdmisfa.core.names import stream_names
from replay.export.frames import pieces, pixel_format, shared_spans, write_film
from replay.inputs import Logged
from replay.stored import Span

VERSION = "v3.0"
FILE = "chunk-000/file-000"
"""An export is one file of each kind, whatever its episodes."""

KEY_EVERY = 2
"""Frames from a key frame to the next, as in LeRobot: training reads single frames."""

QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}

STATE = "observation.environment_state"
"""What the world knows: LeRobot's name for ground truth."""

ABOUT = """# {name}

A recording of cdmisfa as a LeRobot dataset ({version}): {episodes}, {frames} frames at {fps}
frames per second. `meta/info.json` names its features. `{state}` is the ground truth; there
are no actions, because nothing in the recording was moved by what was seen.

```python
from lerobot.datasets.lerobot_dataset import LeRobotDataset

dataset = LeRobotDataset("cdmisfa/{name}", root="{name}")
```
"""

Feature = dict[str, Any]
Stats = dict[str, list[Any]]


def write_lerobot(source: Logged, folder: Path, *, name: str, lossless: bool) -> int:
    """Write a recording as a LeRobot dataset, and return how many frames it has.

    Each stretch of frames that every view has is an episode: one, or several between gaps.
    Images become videos `observation.images.VIEW`, values `observation.VIEW`; numbers become
    float32, as LeRobot's own. The dataset's card calls it by `name`.

    Raises:
        UsageError: the frame rate is not a whole number, which LeRobot's format asks for, or
            PyAV is not installed.
        CdmisfaError: a file cannot be written.
    """
    fps = round(source.spec.fps)
    if fps != source.spec.fps or fps < 1:
        raise UsageError(
            f"LeRobot knows whole frame rates only, not {source.spec.fps:g} per second: "
            "change it with cdmisfa convert --rate"
        )
    spans = shared_spans(source)
    lengths = [high - low for low, high in spans]
    columns, features = _columns(source, spans, fps)
    stats = {key: _number_stats(column) for key, column in columns.items()}
    ends = np.cumsum(lengths)
    own = [
        {key: _number_stats(column[end - length : end]) for key, column in columns.items()}
        for end, length in zip(ends, lengths, strict=True)
    ]
    videos = []
    for stream, view in enumerate(stream_names(source.spec.streams) if source.spec.images else ()):
        videos.append(key := f"observation.images.{view}")
        file = _place(folder / "videos" / key, "mp4")
        write_film(source, stream, file, lossless=lossless, key_every=KEY_EVERY, spans=spans)
        features[key] = _video_feature(source.spec.frame_shape, fps)
        values = [_values_shown(source, stream, span) for span in spans]
        stats[key] = _image_stats(np.sum(values, axis=0), sum(lengths))
        for episode, counts, length in zip(own, values, lengths, strict=True):
            episode[key] = _image_stats(counts, length)
    task = f"what {source.scene().get('scene', 'a recording')} shows"
    pq.write_table(_table(columns, features), _place(folder / "data", "parquet"))
    episodes = _episodes(lengths, fps, task, videos, own)
    pq.write_table(episodes, _place(folder / "meta" / "episodes", "parquet"))
    pq.write_table(_tasks(task), folder / "meta" / "tasks.parquet")
    _write_json(folder / "meta" / "info.json", _info(lengths, fps, features))
    _write_json(folder / "meta" / "stats.json", stats)
    many = "one episode" if len(spans) == 1 else f"{len(spans)} episodes, split at its gaps"
    about = {"name": name, "version": VERSION, "episodes": many, "state": STATE}
    card = ABOUT.format(**about, frames=sum(lengths), fps=fps)
    (folder / "README.md").write_text(card, "utf-8")
    return sum(lengths)


def _columns(
    source: Logged, spans: Sequence[Span], fps: int
) -> tuple[dict[str, NDArray[Any]], dict[str, Feature]]:
    """All numbers, (n,) or (n, k), and what they are."""
    spec, lengths = source.spec, [high - low for low, high in spans]
    columns: dict[str, NDArray[Any]] = {}
    features: dict[str, Feature] = {}

    def add(key: str, values: NDArray[Any], names: list[str] | None) -> None:
        values = values[:, 0] if values.ndim == 2 and values.shape[1] == 1 else values
        shape = list(values.shape[1:]) or [1]
        columns[key] = values
        features[key] = {"dtype": str(values.dtype), "shape": shape, "names": names}

    if spec.truth:
        truth = np.concatenate([block.truth for block in pieces(source, 0, spans)])
        add(STATE, truth.astype(np.float32), list(spec.truth))
    if not spec.images:
        for stream, view in enumerate(stream_names(spec.streams)):
            frames = np.concatenate([block.frames for block in pieces(source, stream, spans)])
            names = [f"x{i + 1}" for i in range(frames.shape[1])]
            add(f"observation.{view}", frames.astype(np.float32), names)
    within = np.concatenate([np.arange(length, dtype=np.int64) for length in lengths])
    add("timestamp", (within / fps).astype(np.float32), None)
    add("frame_index", within, None)
    add("episode_index", np.repeat(np.arange(len(lengths), dtype=np.int64), lengths), None)
    add("index", np.arange(len(within), dtype=np.int64), None)
    add("task_index", np.zeros(len(within), dtype=np.int64), None)
    return columns, features


def _video_feature(shape: tuple[int, ...], fps: int) -> Feature:
    height, width = shape
    return {
        "dtype": "video",
        "shape": [height, width, 3],
        "names": ["height", "width", "channels"],
        "info": {
            "video.height": height,
            "video.width": width,
            "video.codec": "h264",
            "video.pix_fmt": pixel_format(shape),
            "video.is_depth_map": False,
            "video.fps": fps,
            "video.channels": 3,
            "has_audio": False,
        },
    }


def _number_stats(values: NDArray[Any]) -> Stats:
    rows = values.astype(np.float64).reshape(len(values), -1)
    stats = {
        "min": rows.min(axis=0),
        "max": rows.max(axis=0),
        "mean": rows.mean(axis=0),
        "std": rows.std(axis=0),
        "count": np.array([len(rows)]),
        **{key: np.quantile(rows, q, axis=0) for key, q in QUANTILES.items()},
    }
    return {key: value.tolist() for key, value in stats.items()}


def _values_shown(source: Logged, stream: int, span: Span) -> NDArray[np.int64]:
    """How often each value is a pixel of a view in some frames, (256,)."""
    counts = np.zeros(256, dtype=np.int64)
    for block in pieces(source, stream, [span]):
        counts += np.bincount(block.frames.reshape(-1), minlength=256)
    return counts


def _image_stats(counts: NDArray[np.int64], frames: int) -> Stats:
    """Statistics of pixels from 0 to 1, (3, 1, 1) each, from how often each value is."""
    levels, total = np.arange(256) / 255, counts.sum()
    seen, below = levels[counts > 0], np.cumsum(counts)
    mean = (levels * counts).sum() / total
    found = {
        "min": seen[0],
        "max": seen[-1],
        "mean": mean,
        "std": np.sqrt(((levels - mean) ** 2 * counts).sum() / total),
        **{key: levels[np.searchsorted(below, q * total)] for key, q in QUANTILES.items()},
    }
    stats = {key: np.full((3, 1, 1), value).tolist() for key, value in found.items()}
    return {**stats, "count": [frames]}


def _table(columns: Mapping[str, NDArray[Any]], features: Mapping[str, Feature]) -> pa.Table:
    arrays = {}
    for key, values in columns.items():
        flat = pa.array(np.ascontiguousarray(values).reshape(-1))
        width = features[key]["shape"][0]
        arrays[key] = flat if width == 1 else pa.FixedSizeListArray.from_arrays(flat, width)
    return pa.table(arrays)


def _episodes(
    lengths: Sequence[int],
    fps: int,
    task: str,
    videos: list[str],
    stats: Sequence[Mapping[str, Stats]],
) -> pa.Table:
    """The table of episodes, a row each."""
    rows, start = [], 0
    for episode, (length, own) in enumerate(zip(lengths, stats, strict=True)):
        stop = start + length
        row: dict[str, Any] = {
            "episode_index": episode,
            "tasks": [task],
            "length": length,
            "data/chunk_index": 0,
            "data/file_index": 0,
            "dataset_from_index": start,
            "dataset_to_index": stop,
        }
        for key in videos:
            row |= {
                f"videos/{key}/chunk_index": 0,
                f"videos/{key}/file_index": 0,
                f"videos/{key}/from_timestamp": start / fps,
                f"videos/{key}/to_timestamp": stop / fps,
            }
        for key, values in own.items():
            row |= {f"stats/{key}/{name}": value for name, value in values.items()}
        row |= {"meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0}
        rows.append(row)
        start = stop
    return pa.Table.from_pylist(rows)


def _tasks(task: str) -> pa.Table:
    """The table of tasks as pandas writes it: the text is the index of the row."""
    index = "__index_level_0__"
    text = {"name": None, "field_name": index, "pandas_type": "unicode", "metadata": None}
    number = {"name": "task_index", "field_name": "task_index", "pandas_type": "int64"}
    pandas = {
        "index_columns": [index],
        "column_indexes": [],
        "columns": [
            {**number, "numpy_type": "int64", "metadata": None},
            {**text, "numpy_type": "object"},
        ],
        "creator": {"library": "pyarrow", "version": pa.__version__},
        "pandas_version": "2.0.0",
    }
    table = pa.table({"task_index": pa.array([0], pa.int64()), index: pa.array([task])})
    return table.replace_schema_metadata({"pandas": json.dumps(pandas)})


def _info(lengths: Sequence[int], fps: int, features: Mapping[str, Feature]) -> dict[str, Any]:
    place = "chunk-{chunk_index:03d}/file-{file_index:03d}"
    videos = any(feature["dtype"] == "video" for feature in features.values())
    return {
        "codebase_version": VERSION,
        "robot_type": None,
        "total_episodes": len(lengths),
        "total_frames": sum(lengths),
        "total_tasks": 1,
        "chunks_size": 1000,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "fps": fps,
        "splits": {"train": f"0:{len(lengths)}"},
        "data_path": f"data/{place}.parquet",
        "video_path": f"videos/{{video_key}}/{place}.mp4" if videos else None,
        "features": features,
    }


def _place(folder: Path, ending: str) -> Path:
    file = folder / f"{FILE}.{ending}"
    file.parent.mkdir(parents=True, exist_ok=True)
    return file


def _write_json(file: Path, document: Mapping[str, Any]) -> None:
    file.write_text(json.dumps(document, indent=4), "utf-8")
