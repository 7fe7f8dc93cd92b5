"""Recordings as a LeRobot dataset, layout v3.0: streams of images as videos, episodes without gaps.

The layout is as published (github.com/huggingface/lerobot), written with PyArrow and PyAV: the
package `lerobot` pins a Rerun older than the viewer's and cannot be installed beside it.
`LeRobotDataset("name", root=FOLDER)` and Rerun open the folder.
"""

from __future__ import annotations

import contextlib
import itertools
import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from cdmisfa.core.blocks import SourceSpec
from cdmisfa.core.errors import UsageError
from cdmisfa.core.names import ACTION, BEGINS, JOINT, stream_names
from replay.export.frames import pieces, pixel_format, shared_spans, write_video
from replay.logs.formats.lerobot_layout import Stats, table_of_tasks, write_stats
from replay.logs.source import LoggedSource
from replay.stored_source import Span

FILE = "chunk-{chunk_index:03d}/file-{file_index:03d}"

# LeRobot's limit for files in a folder. Each log is one video a stream; numbers are one table.
FILES = 1000

# LeRobot's names of actions, of the state of a robot or an agent, and of other ground truth.
ACTIONS, STATE, WORLD = "action", "observation.state", "observation.environment_state"

QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}

# Values (n,) or (n, k) of each feature, and the names of its k numbers.
Columns = dict[str, tuple[NDArray[Any], list[str] | None]]


def write_dataset(
    logs: Iterable[LoggedSource], folder: Path, *, lossless: bool, task: str | None = None
) -> int:
    """Write recordings as a LeRobot dataset, and return its number of frames.

    An episode is a stretch of frames that every stream has; it ends where an episode of a recorded
    task ends. Images become videos `observation.images.STREAM`, numbers `observation.STREAM`, and
    ground truth `action`, `observation.state` and `observation.environment_state`, all float32.

    Args:
        logs: logs with equal streams, shapes and rates, each open until the next one.
        folder: the new folder.
        lossless: keep every pixel.
        task: description of the task; by default that of each log.

    Raises:
        UsageError: no frame is in every stream, the frame rate is not a whole number, or PyAV is
            not installed.
        CdmisfaError: a file cannot be written.
    """
    features: dict[str, dict[str, Any]] = {}
    tasks: dict[str, int] = {}
    episodes: list[dict[str, Any]] = []
    fps = start = 0
    with contextlib.ExitStack() as stack:
        table: pq.ParquetWriter | None = None
        for log, source in enumerate(logs):
            fps, spans = _whole_rate(source.spec), _episodes(source)
            name = task or _task(source)
            number = tasks.setdefault(name, len(tasks))
            columns = _numbers(source, spans) | _clock(spans, fps, start, len(episodes), number)
            features |= {key: _feature(*column) for key, column in columns.items()}
            ends = list(itertools.accumulate((high - low for low, high in spans), initial=0))
            rows: list[dict[str, Any]] = [
                {
                    "episode_index": len(episodes) + i,
                    "tasks": [name],
                    "length": end - begin,
                    **_file_number("data", 0),
                    "dataset_from_index": start + begin,
                    "dataset_to_index": start + end,
                    "stats": {k: number_stats(v[begin:end]) for k, (v, _) in columns.items()},
                }
                for i, (begin, end) in enumerate(itertools.pairwise(ends))
            ]
            for stream, view in enumerate(stream_names(source.spec.streams)):
                if not source.spec.of(stream).images:
                    continue
                key = f"observation.images.{view}"
                features[key] = _video_feature(source.spec.kind(stream)[0], fps)
                file = _path(folder / "videos" / key, log, "mp4")
                write_video(source, stream, file, lossless=lossless, spans=spans)
                for row, span in zip(rows, spans, strict=True):
                    row |= _file_number(f"videos/{key}", log)
                    for edge in ("from", "to"):
                        frame = row[f"dataset_{edge}_index"] - start
                        row[f"videos/{key}/{edge}_timestamp"] = frame / fps
                    row["stats"][key] = image_stats(source, stream, span)
            arrow = _table(columns)
            if table is None:
                file = _path(folder / "data", 0, "parquet")
                table = stack.enter_context(pq.ParquetWriter(file, arrow.schema))
            table.write_table(arrow)
            episodes += rows
            start += ends[-1]
    _write_meta(folder / "meta", episodes, tasks, features, fps)
    return start


def _whole_rate(spec: SourceSpec) -> int:
    if spec.fps != round(spec.fps) or spec.fps < 1:
        raise UsageError(
            f"LeRobot needs a whole number of frames per second, not {spec.fps:g}: "
            "resample with cdmisfa convert --rate first"
        )
    return round(spec.fps)


def _task(source: LoggedSource) -> str:
    """Return the descriptions of the recorded tasks, or else of the scene."""
    tasks = source.origin().get("tasks")
    if isinstance(tasks, list) and tasks:
        return " and ".join(map(str, tasks))
    return f"what {source.scene().get('scene', 'a recording')} shows"


def _episodes(source: LoggedSource) -> list[Span]:
    """Return the spans of frames that every stream has, cut where a recorded task begins again."""
    begins = [i for i, name in enumerate(source.spec.truth) if name.startswith(BEGINS)]
    spans: list[Span] = []
    for low, high in shared_spans(source):
        edges = {low, high}
        for block in pieces(source, 0, [(low, high)]) if begins else ():
            edges |= {block.t + int(i) for i in np.flatnonzero(block.truth[:, begins].any(axis=1))}
        spans += itertools.pairwise(sorted(edges))
    return spans


def _numbers(source: LoggedSource, spans: Sequence[Span]) -> Columns:
    """Return ground truth and frames that are no images, as float32."""
    spec, columns = source.spec, Columns()
    if spec.truth:
        truth = np.concatenate([block.truth for block in pieces(source, 0, spans)])
        of_task = any(name.startswith(BEGINS) for name in spec.truth)
        groups: dict[str, list[int]] = {}
        for i, name in enumerate(spec.truth):
            if name.startswith(ACTION):
                groups.setdefault(ACTIONS, []).append(i)
            elif not name.startswith(BEGINS):
                state = of_task or name.startswith(JOINT)
                groups.setdefault(STATE if state else WORLD, []).append(i)
        for key, group in groups.items():
            columns[key] = truth[:, group], [spec.truth[i] for i in group]
    for stream, name in enumerate(stream_names(spec.streams)):
        if spec.of(stream).images:
            continue
        frames = np.concatenate([block.frames for block in pieces(source, stream, spans)])
        columns[f"observation.{name}"] = frames, [f"x{i + 1}" for i in range(frames.shape[1])]
    return {
        key: ((values[:, 0] if values.shape[1] == 1 else values).astype(np.float32), names)
        for key, (values, names) in columns.items()
    }


def _clock(spans: Sequence[Span], fps: int, start: int, episode: int, task: int) -> Columns:
    """Return the columns that number frames, episodes and tasks."""
    lengths = [high - low for low, high in spans]
    within = np.concatenate([np.arange(length) for length in lengths])
    columns = {
        "timestamp": (within / fps).astype(np.float32),
        "frame_index": within,
        "episode_index": episode + np.repeat(np.arange(len(spans)), lengths),
        "index": start + np.arange(len(within)),
        "task_index": np.full(len(within), task),
    }
    return {key: (values, None) for key, values in columns.items()}


def _feature(values: NDArray[Any], names: list[str] | None) -> dict[str, Any]:
    return {"dtype": str(values.dtype), "shape": list(values.shape[1:]) or [1], "names": names}


def _video_feature(shape: tuple[int, ...], fps: int) -> dict[str, Any]:
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


def _table(columns: Columns) -> pa.Table:
    arrays = {}
    for key, (values, _) in columns.items():
        flat = pa.array(np.ascontiguousarray(values).reshape(-1))
        wide = values.ndim > 1
        arrays[key] = pa.FixedSizeListArray.from_arrays(flat, values.shape[1]) if wide else flat
    return pa.table(arrays)


def _file_number(kind: str, number: int) -> dict[str, int]:
    return {f"{kind}/chunk_index": number // FILES, f"{kind}/file_index": number % FILES}


def _path(folder: Path, number: int, ending: str) -> Path:
    name = FILE.format(chunk_index=number // FILES, file_index=number % FILES)
    path = folder / f"{name}.{ending}"
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


def _write_meta(
    meta: Path,
    episodes: list[dict[str, Any]],
    tasks: Mapping[str, int],
    features: Mapping[str, Mapping[str, Any]],
    fps: int,
) -> None:
    """Write the files that describe a dataset: episodes, tasks, info and statistics."""
    stats: list[dict[str, Stats]] = [row.pop("stats") for row in episodes]
    for row, of_episode in zip(episodes, stats, strict=True):
        for key, values in of_episode.items():
            row |= {f"stats/{key}/{name}": value.tolist() for name, value in values.items()}
        row |= _file_number("meta/episodes", 0)
    pq.write_table(pa.Table.from_pylist(episodes), _path(meta / "episodes", 0, "parquet"))
    pq.write_table(table_of_tasks(tasks), meta / "tasks.parquet")
    videos = any(feature["dtype"] == "video" for feature in features.values())
    info = {
        "codebase_version": "v3.0",
        "robot_type": None,
        "total_episodes": len(episodes),
        "total_frames": episodes[-1]["dataset_to_index"],
        "total_tasks": len(tasks),
        "chunks_size": FILES,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "fps": fps,
        "splits": {"train": f"0:{len(episodes)}"},
        "data_path": f"data/{FILE}.parquet",
        "video_path": f"videos/{{video_key}}/{FILE}.mp4" if videos else None,
        "features": features,
    }
    (meta / "info.json").write_text(json.dumps(info, indent=4), "utf-8")
    write_stats(meta / "stats.json", {key: [part[key] for part in stats] for key in features})


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


def image_stats(source: LoggedSource, stream: int, span: Span) -> Stats:
    """Return LeRobot's statistics of pixels from 0 to 1, (3, 1, 1) each, from a histogram."""
    counts = np.zeros(256, dtype=np.int64)
    for block in pieces(source, stream, [span]):
        counts += np.bincount(block.frames.reshape(-1), minlength=256)
    levels, total, below = np.arange(256) / 255, counts.sum(), np.cumsum(counts)
    mean = (levels * counts).sum() / total
    values = {
        "min": levels[counts > 0][0],
        "max": levels[counts > 0][-1],
        "mean": mean,
        "std": np.sqrt(((levels - mean) ** 2 * counts).sum() / total),
        **{key: levels[np.searchsorted(below, q * total)] for key, q in QUANTILES.items()},
    }
    stats = {key: np.full((3, 1, 1), value) for key, value in values.items()}
    return {**stats, "count": np.array([span[1] - span[0]])}
