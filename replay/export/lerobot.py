"""Logs as a LeRobot dataset, layout v3.0: streams of images as videos, episodes without gaps.

The layout is as published (github.com/huggingface/lerobot), written with PyArrow and PyAV: the
package `lerobot` pins a Rerun older than the viewer's and cannot be installed beside it.
`LeRobotDataset("name", root=FOLDER)` and Rerun open the folder.
"""

from __future__ import annotations

import contextlib
import itertools
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from cdmisfa.core.errors import UsageError
from cdmisfa.core.names import ACTION, BEGINS, JOINT, stream_names
from recorder.images.fields import joint_places
from recorder.images.options import IMAGES, InputOptions
from replay.export.frames import image_shape, pieces, pixel_format, shared_spans, write_video
from replay.export.numbers import ACTIONS, READ, STATE, Columns, Message, log_columns
from replay.logs.clock import nearest_rows
from replay.logs.formats import lerobot
from replay.logs.formats import lerobot_layout as layout
from replay.logs.open_logs import log_format
from replay.logs.source import LoggedSource
from replay.stored_source import Span

FILE = "chunk-{chunk_index:03d}/file-{file_index:03d}"

# LeRobot's limit for files in a folder. Each log is one video a stream; numbers are one table.
FILES = 1000

# LeRobot's name of ground truth that is no state of a robot or an agent.
WORLD = "observation.environment_state"


@dataclass(frozen=True, slots=True)
class DatasetOptions:
    """Content of a dataset.

    Attributes:
        state: topics or TOPIC:FIELD of `observation.state`; empty for joint states.
        action: the same of `action`; empty for joint states on topics of commands.
        task: description of the task; None for that of each log.
        lossless: keep every pixel.
        inputs: options of logs.
    """

    state: Sequence[str] = ()
    action: Sequence[str] = ()
    task: str | None = None
    lossless: bool = False
    inputs: InputOptions = IMAGES


def write_dataset(
    logs: Iterable[tuple[Sequence[Path], LoggedSource]],
    folder: Path,
    options: DatasetOptions,
    warn: Message,
) -> int:
    """Write logs as a LeRobot dataset, and return its number of frames.

    An episode is a stretch of frames that every camera has; it ends where an episode of a recorded
    task ends. Images become videos `observation.images.STREAM`, numbers the features that
    `log_columns` states, and ground truth `action`, `observation.state` and
    `observation.environment_state`, all float32. Each log is read once for every stream.

    Args:
        logs: the paths and the source of logs with equal streams, each open until the next one.
        folder: the new folder.
        options: content of the dataset.
        warn: called with a line for everything that it does not hold.

    Raises:
        UsageError: no frame is in every stream, the frame rate is not a whole number, the logs
            have different numbers, or PyAV is not installed.
        CdmisfaError: a file cannot be written.
    """
    features: dict[str, dict[str, Any]] = {}
    tasks: dict[str, int] = {}
    episodes: list[dict[str, Any]] = []
    fps = start = 0
    with contextlib.ExitStack() as stack:
        table: pq.ParquetWriter | None = None
        for log, (paths, source) in enumerate(logs):
            fps, spans = _whole_rate(source), _episodes(source)
            named = [options.task] * len(spans) if options.task else _tasks(source, spans)
            of_spans = [tasks.setdefault(name, len(tasks)) for name in named]
            columns = _numbers(source, paths, spans, options, warn)
            columns |= _clock(spans, fps, start, len(episodes), of_spans)
            columns = _in_order(features, columns, paths[0])
            features |= {key: _feature(*column) for key, column in columns.items()}
            rows = _rows(columns, spans, start, len(episodes), named)
            for stream, view in enumerate(stream_names(source.spec.streams)):
                if len(source.spec.kind(stream)[0]) > 1:
                    key = f"observation.images.{view}"
                    features[key] = _video_feature(source, stream, fps, lossless=options.lossless)
                    file = _path(folder / "videos" / key, log, "mp4")
                    stats = [layout.ImageStats() for _ in spans]
                    write_video(
                        source, stream, file, lossless=options.lossless, spans=spans, stats=stats
                    )
                    for row, of_images in zip(rows, stats, strict=True):
                        row |= _file_number(f"videos/{key}", log)
                        for edge in ("from", "to"):
                            frame = row[f"dataset_{edge}_index"] - start
                            row[f"videos/{key}/{edge}_timestamp"] = frame / fps
                        row["stats"][key] = of_images.result()
            arrow = _table(columns)
            if table is None:
                file = _path(folder / "data", 0, "parquet")
                table = stack.enter_context(pq.ParquetWriter(file, arrow.schema))
            table.write_table(arrow)
            episodes += rows
            start = rows[-1]["dataset_to_index"]
    _write_meta(folder / "meta", episodes, tasks, features, fps)
    return start


def _rows(
    columns: Columns, spans: Sequence[Span], start: int, first: int, tasks: Sequence[str]
) -> list[dict[str, Any]]:
    """Return the rows of the table of episodes, without their videos."""
    ends = itertools.accumulate((high - low for low, high in spans), initial=0)
    return [
        {
            "episode_index": first + i,
            "tasks": [tasks[i]],
            "length": end - begin,
            **_file_number("data", 0),
            "dataset_from_index": start + begin,
            "dataset_to_index": start + end,
            "stats": {k: layout.number_stats(v[begin:end]) for k, (v, _) in columns.items()},
        }
        for i, (begin, end) in enumerate(itertools.pairwise(ends))
    ]


def _in_order(features: Mapping[str, Mapping[str, Any]], columns: Columns, path: Path) -> Columns:
    """Return numbers in the order of the logs before; refuse a log with other numbers."""
    for key in features.keys() | columns.keys() if features else ():
        if features.get(key, {}).get("dtype") == "video":
            continue
        one = features[key]["shape"] if key in features else "nothing"
        two = _feature(*columns[key])["shape"] if key in columns else "nothing"
        if one != two:
            raise UsageError(
                f"{path} has {two} for {key}, but the logs before have {one}: choose topics that "
                "all have with --topic, --state and --action, or export them separately"
            )
        values, names = columns[key]
        if names and names != (expected := features[key]["names"]):
            places = joint_places(path, expected, names)
            columns[key] = values[:, places] if values.ndim > 1 else values, expected
    return columns


def _whole_rate(source: LoggedSource) -> int:
    fps = source.spec.fps
    if fps != round(fps) or fps < 1:
        rate = max(round(fps), 1)
        raise UsageError(
            f"LeRobot needs a whole number of frames per second, not {fps:g}: resample with "
            f"--rate {rate}, which shows the image nearest to each time"
        )
    return round(fps)


def _tasks(source: LoggedSource, spans: Sequence[Span]) -> list[str]:
    """Return the task of each span: as a dataset or a recording states it, or else the scene."""
    if log_format(path := source.streams[0].path) == "dataset":
        dataset = lerobot.Dataset(path)
        starts = np.array([source.spec.times(*span)[0] for span in spans])
        frames = nearest_rows(dataset.times, starts)
        episodes = np.searchsorted(dataset.starts, frames, side="right") - 1
        return [
            " and ".join(map(str, dataset.rows[i].get("tasks") or ["unknown"])) for i in episodes
        ]
    return [_task(source)] * len(spans)


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


def _numbers(
    source: LoggedSource,
    paths: Sequence[Path],
    spans: Sequence[Span],
    options: DatasetOptions,
    warn: Message,
) -> Columns:
    """Return the numbers of a log and its ground truth, as float32."""
    spec, columns = source.spec, Columns()
    if not source.recorded:
        times = np.concatenate([spec.times(*span) for span in spans])
        chosen = {STATE: options.state, ACTIONS: options.action}
        columns |= log_columns(source, paths, times, options.inputs, chosen, warn)
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
        read = not source.recorded and log_format(source.streams[stream].path) in READ
        if len(spec.kind(stream)[0]) > 1 or read:
            continue
        frames = np.concatenate([block.frames for block in pieces(source, stream, spans)])
        columns[f"observation.{name}"] = frames, [f"x{i + 1}" for i in range(frames.shape[1])]
    return {
        key: ((values[:, 0] if values.shape[1] == 1 else values).astype(np.float32), names)
        for key, (values, names) in columns.items()
    }


def _clock(
    spans: Sequence[Span], fps: int, start: int, episode: int, tasks: Sequence[int]
) -> Columns:
    """Return the columns that number frames, episodes and tasks."""
    lengths = [high - low for low, high in spans]
    within = np.concatenate([np.arange(length) for length in lengths])
    columns = {
        "timestamp": (within / fps).astype(np.float32),
        "frame_index": within,
        "episode_index": episode + np.repeat(np.arange(len(spans)), lengths),
        "index": start + np.arange(len(within)),
        "task_index": np.repeat(tasks, lengths),
    }
    return {key: (values, None) for key, values in columns.items()}


def _feature(values: NDArray[Any], names: list[str] | None) -> dict[str, Any]:
    return {"dtype": str(values.dtype), "shape": list(values.shape[1:]) or [1], "names": names}


def _video_feature(
    source: LoggedSource, stream: int, fps: int, *, lossless: bool
) -> dict[str, Any]:
    height, width, channels = image_shape(source, stream)
    return {
        "dtype": "video",
        "shape": [height, width, 3],
        "names": ["height", "width", "channels"],
        "info": {
            "video.height": height,
            "video.width": width,
            "video.codec": "h264",
            "video.pix_fmt": pixel_format((height, width, channels), lossless=lossless),
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
    stats: list[dict[str, layout.Stats]] = [row.pop("stats") for row in episodes]
    for row, of_episode in zip(episodes, stats, strict=True):
        for key, values in of_episode.items():
            row |= {f"stats/{key}/{name}": value.tolist() for name, value in values.items()}
        row |= _file_number("meta/episodes", 0)
    pq.write_table(pa.Table.from_pylist(episodes), _path(meta / "episodes", 0, "parquet"))
    pq.write_table(layout.table_of_tasks(tasks), meta / "tasks.parquet")
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
    layout.write_stats(
        meta / "stats.json", {key: [part[key] for part in stats] for key in features}
    )
