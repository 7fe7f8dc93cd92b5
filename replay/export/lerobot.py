"""Recordings as a LeRobot dataset, layout v3.0: views as videos, an episode without gaps.

The layout is written as it is published (github.com/huggingface/lerobot), with PyArrow and
PyAV: the `lerobot` package itself pins a Rerun older than the viewer's and cannot be
installed beside it. `LeRobotDataset("name", root=FOLDER)` and Rerun open the folder.
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
from cdmisfa.core.names import ACTION, BEGINS, JOINT, counted, stream_names
from replay.export.frames import pieces, pixel_format, shared_spans, write_film
from replay.export.statistics import (
    Stats,
    aggregated,
    as_lists,
    image_stats,
    number_stats,
    values_shown,
)
from replay.inputs import Logged
from replay.recordings.source import RecordedSource
from replay.stored import Span

VERSION = "v3.0"
FILE = "chunk-{chunk_index:03d}/file-{file_index:03d}"
FILES = 1000
"""Most files of a folder. A log is a video a view, whatever its episodes; numbers are one table."""

KEY_EVERY = 2
"""Frames from a key frame to the next, as in LeRobot: training reads single frames."""

ACTIONS, STATE, WORLD = "action", "observation.state", "observation.environment_state"
"""LeRobot's names for what is done, for what a robot or an agent knows, and for ground truth."""

ABOUT = """# {name}

Made by cdmisfa, as a LeRobot dataset ({version}): {episodes}, {frames} in all, at {fps} frames per
second. `meta/info.json` names its features.

```python
from lerobot.datasets.lerobot_dataset import LeRobotDataset

dataset = LeRobotDataset("cdmisfa/{name}", root="{name}")
```
"""

Columns = dict[str, NDArray[Any]]
Feature = dict[str, Any]


def write_dataset(
    logs: Iterable[Logged],
    folder: Path,
    *,
    name: str,
    lossless: bool,
    task: str | None = None,
) -> int:
    """Write recordings as a LeRobot dataset, and return how many frames it has.

    An episode is a stretch of frames that every view has; where an episode of a recorded task
    begins, another one does. Images become videos `observation.images.VIEW`, a file a log; values
    become `observation.VIEW`; ground truth becomes `action`, `observation.state` and
    `observation.environment_state`. Numbers are float32, as LeRobot's own.

    Args:
        logs: each open until the next is asked for; of the same streams, shape and rate.
        folder: where to.
        name: what the dataset's card calls it.
        lossless: keep every pixel.
        task: what is done in it, in words; by default what each log says it shows.

    Raises:
        UsageError: there is no frame, logs do not show the same, the frame rate is not a whole
            number, which LeRobot's format asks for, or PyAV is not installed.
        CdmisfaError: a file cannot be written.
    """
    with contextlib.closing(_Dataset(folder, lossless=lossless)) as dataset:
        for source in logs:
            dataset.add(source, _episodes(source), task or _task(source))
        return dataset.finish(name)


class _Dataset:
    """A dataset that is written log by log; what is kept of each episode is its row and statistics.

    Raises:
        UsageError, CdmisfaError: as `write_dataset`.
    """

    def __init__(self, folder: Path, *, lossless: bool) -> None:
        self._folder = folder
        self._film: dict[str, Any] = {"lossless": lossless, "key_every": KEY_EVERY}
        self._table: pq.ParquetWriter | None = None
        self._logs = self._fps = 0
        self._tasks: dict[str, int] = {}
        self._features: dict[str, Feature] = {}
        self._rows: list[dict[str, Any]] = []
        self._stats: list[dict[str, Stats]] = []

    @property
    def _frames(self) -> int:
        return int(self._rows[-1]["dataset_to_index"]) if self._rows else 0

    def add(self, source: Logged, spans: Sequence[Span], task: str) -> None:
        """Write the episodes of one more log, the frames [start, stop) of each."""
        self._fps = fps = _whole_rate(source.spec)
        ends = np.cumsum([0, *(high - low for low, high in spans)]).tolist()
        parts = list(itertools.pairwise(ends))
        columns = _numbers(source, spans, self._features)
        within = np.concatenate([np.arange(high - low) for low, high in spans])
        clock = {
            "timestamp": (within / fps).astype(np.float32),
            "frame_index": within,
            "episode_index": len(self._rows) + np.repeat(np.arange(len(spans)), np.diff(ends)),
            "index": self._frames + np.arange(ends[-1]),
            "task_index": np.full(ends[-1], self._tasks.setdefault(task, len(self._tasks))),
        }
        for key, values in clock.items():
            columns[key] = _described(self._features, key, values, None)
        rows = [
            {
                "episode_index": len(self._rows) + i,
                "tasks": [task],
                "length": high - low,
                **_numbered("data", 0),
                "dataset_from_index": self._frames + low,
                "dataset_to_index": self._frames + high,
            }
            for i, (low, high) in enumerate(parts)
        ]
        stats = [{key: number_stats(own[low:high]) for key, own in columns.items()}
                 for low, high in parts]  # fmt: skip
        for stream, key in enumerate(_videos(source.spec)):
            self._features[key] = _video_feature(source.spec.frame_shape, fps)
            file = _place(self._folder / "videos" / key, self._logs, "mp4")
            write_film(source, stream, file, spans=spans, **self._film)
            for (low, high), span, row, own in zip(parts, spans, rows, stats, strict=True):
                row |= _numbered(f"videos/{key}", self._logs)
                row[f"videos/{key}/from_timestamp"] = low / fps
                row[f"videos/{key}/to_timestamp"] = high / fps
                own[key] = image_stats(values_shown(source, stream, span), high - low)
        table = _table(columns, self._features)
        if self._table is None:
            self._table = pq.ParquetWriter(
                _place(self._folder / "data", 0, "parquet"), table.schema
            )
        self._table.write_table(table)
        self._logs += 1
        self._rows += rows
        self._stats += stats

    def finish(self, name: str) -> int:
        """Write what describes all of it, and return how many frames there are."""
        self.close()
        meta = self._folder / "meta"
        pq.write_table(self._episodes(), _place(meta / "episodes", 0, "parquet"))
        pq.write_table(_tasks(self._tasks), meta / "tasks.parquet")
        frames, episodes = self._frames, len(self._rows)
        info = _info(episodes, frames, len(self._tasks), self._fps, self._features)
        _write_json(meta / "info.json", info)
        stats = {key: aggregated([own[key] for own in self._stats]) for key in self._features}
        _write_json(meta / "stats.json", {key: as_lists(own) for key, own in stats.items()})
        about = {"name": name, "version": VERSION, "episodes": counted(episodes, "episode")}
        card = ABOUT.format(**about, frames=counted(frames, "frame"), fps=self._fps)
        (self._folder / "README.md").write_text(card, "utf-8")
        return frames

    def close(self) -> None:
        """Close the table of numbers."""
        if self._table is not None:
            self._table.close()

    def _episodes(self) -> pa.Table:
        """The table of episodes, a row each, with the statistics of each."""
        return pa.Table.from_pylist(
            [
                row
                | {f"stats/{k}/{n}": v for k, s in own.items() for n, v in as_lists(s).items()}
                | _numbered("meta/episodes", 0)
                for row, own in zip(self._rows, self._stats, strict=True)
            ]
        )


def _whole_rate(spec: SourceSpec) -> int:
    fps = round(spec.fps)
    if fps != spec.fps or fps < 1:
        raise UsageError(
            f"LeRobot knows whole frame rates only, not {spec.fps:g} per second: "
            "change it with cdmisfa convert --rate"
        )
    return fps


def _task(source: Logged) -> str:
    """What is done in a log, in words: the tasks that were played, or the scene that was seen."""
    tasks = source.origin().get("tasks") if isinstance(source, RecordedSource) else None
    if isinstance(tasks, list) and tasks:
        return " and ".join(map(str, tasks))
    return f"what {source.scene().get('scene', 'a recording')} shows"


def _episodes(source: Logged) -> list[Span]:
    """Return the spans of frames that every view has, cut where a recorded task begins again."""
    begins = [i for i, name in enumerate(source.spec.truth) if name.startswith(BEGINS)]
    found: list[Span] = []
    for low, high in shared_spans(source):
        edges = {low, high}
        for block in pieces(source, 0, [(low, high)]) if begins else ():
            edges |= {block.t + int(i) for i in np.flatnonzero(block.truth[:, begins].any(axis=1))}
        found += itertools.pairwise(sorted(edges))
    return found


def _numbers(source: Logged, spans: Sequence[Span], features: dict[str, Feature]) -> Columns:
    """What is known of each frame, and frames that are no images, (n,) or (n, k) float32."""
    spec, found = source.spec, Columns()
    if spec.truth:
        truth = np.concatenate([block.truth for block in pieces(source, 0, spans)])
        of_task = any(name.startswith(BEGINS) for name in spec.truth)
        keys = [_known_as(name, of_task=of_task) for name in spec.truth]
        for key in filter(None, dict.fromkeys(keys)):
            own = [i for i, known_as in enumerate(keys) if known_as == key]
            found[key] = _described(features, key, truth[:, own], [spec.truth[i] for i in own])
    for stream, view in enumerate(() if spec.images else stream_names(spec.streams)):
        frames = np.concatenate([block.frames for block in pieces(source, stream, spans)])
        names = [f"x{i + 1}" for i in range(frames.shape[1])]
        found[f"observation.{view}"] = _described(features, f"observation.{view}", frames, names)
    return found


def _known_as(truth: str, *, of_task: bool) -> str:
    """The feature that a truth is one of the numbers of; "" of none."""
    if truth.startswith(BEGINS):
        return ""
    if truth.startswith(ACTION):
        return ACTIONS
    return STATE if of_task or truth.startswith(JOINT) else WORLD


def _described(
    features: dict[str, Feature], key: str, values: NDArray[Any], names: list[str] | None
) -> NDArray[Any]:
    """Numbers as LeRobot has them, (n,) or (n, k), whose feature is told."""
    values = values.astype(np.float32) if names is not None else values
    values = values[:, 0] if values.ndim == 2 and values.shape[1] == 1 else values
    shape = list(values.shape[1:]) or [1]
    features[key] = {"dtype": str(values.dtype), "shape": shape, "names": names}
    return values


def _videos(spec: SourceSpec) -> list[str]:
    views = stream_names(spec.streams) if spec.images else ()
    return [f"observation.images.{view}" for view in views]


def _numbered(what: str, number: int) -> dict[str, int]:
    """Which file of its kind it is."""
    chunk, file = divmod(number, FILES)
    return {f"{what}/chunk_index": chunk, f"{what}/file_index": file}


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


def _table(columns: Mapping[str, NDArray[Any]], features: Mapping[str, Feature]) -> pa.Table:
    arrays = {}
    for key, values in columns.items():
        flat = pa.array(np.ascontiguousarray(values).reshape(-1))
        width = features[key]["shape"][0]
        arrays[key] = flat if width == 1 else pa.FixedSizeListArray.from_arrays(flat, width)
    return pa.table(arrays)


def _tasks(tasks: Mapping[str, int]) -> pa.Table:
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
    table = pa.table({"task_index": pa.array(tasks.values(), pa.int64()), index: pa.array(tasks)})
    return table.replace_schema_metadata({"pandas": json.dumps(pandas)})


def _info(
    episodes: int, frames: int, tasks: int, fps: int, features: Mapping[str, Feature]
) -> dict[str, Any]:
    videos = any(feature["dtype"] == "video" for feature in features.values())
    return {
        "codebase_version": VERSION,
        "robot_type": None,
        "total_episodes": episodes,
        "total_frames": frames,
        "total_tasks": tasks,
        "chunks_size": FILES,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "fps": fps,
        "splits": {"train": f"0:{episodes}"},
        "data_path": f"data/{FILE}.parquet",
        "video_path": f"videos/{{video_key}}/{FILE}.mp4" if videos else None,
        "features": features,
    }


def _place(folder: Path, number: int, ending: str) -> Path:
    chunk, file_of_it = divmod(number, FILES)
    file = folder / f"{FILE.format(chunk_index=chunk, file_index=file_of_it)}.{ending}"
    file.parent.mkdir(parents=True, exist_ok=True)
    return file


def _write_json(file: Path, document: Mapping[str, Any]) -> None:
    file.write_text(json.dumps(document, indent=4), "utf-8")
