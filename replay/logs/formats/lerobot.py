"""LeRobot datasets, layout v2.1 or v3.0: cameras, or numbers, of all episodes, in their order.

The layout is read as it is published (github.com/huggingface/lerobot), with PyArrow and PyAV.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from cdmisfa.core.arrays import ByteArray, FloatArray
from cdmisfa.core.clock import NANOSECONDS
from cdmisfa.core.errors import LogDamagedError, UsageError
from cdmisfa.core.untrusted import BUDGET, check_regular, parse_json, read_json, read_regular
from recorder.images.compressed import compressed_image
from recorder.images.fields import column_names
from recorder.images.options import RECIPE, VIDEO_RECIPE, InputOptions
from recorder.mcap.records import MAX_CHUNK, MalformedRecord
from replay.logs.formats import lerobot_layout as layout
from replay.logs.formats.messages import NoTopicError, check_topics, fits_topic, left_out
from replay.logs.formats.table import number_stream
from replay.logs.formats.video import VideoFile
from replay.logs.stream import (
    ChannelInfo,
    ExternalChannel,
    LogStream,
    MissingFileError,
    explained,
    limited,
)
from replay.stored_source import PAUSE

INFO: Final = "meta/info.json"

# Name of the layout in errors.
LAYOUT: Final = "LeRobot's layout"

_IMAGES: Final = ("video", "image")

# Features that number the frames.
CLOCK: Final = ("timestamp", "frame_index", "episode_index", "index", "task_index")


class Dataset:
    """The frames of a dataset: where each episode begins, and when each frame is.

    Attributes:
        info: description in meta/info.json.
        rows: rows of the tables of episodes, up to the last whole one.
        missing: why further episodes are not read, or "".
        listed: frames of all episodes in the tables, whole or not.
        starts: the first frame of each episode, and the end of the last.
        times: time of each frame in nanoseconds.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.info = path, _info(path)
        self.rows, self.missing, self.listed = _episodes(path, self.info)
        with limited(path, LAYOUT):
            lengths = np.array([int(row["length"]) for row in self.rows], np.int64)
            self.starts = np.concatenate([[0], np.cumsum(lengths)])
            ticks = np.arange(self.starts[-1]) + np.repeat(np.arange(len(lengths)) * PAUSE, lengths)
            times = np.round(ticks * (NANOSECONDS / float(self.info["fps"])))
        self.times = times.astype(np.int64)

    def notes(self, what: str) -> list[str]:
        """Return the warnings that episodes are joined, or not whole."""
        many = len(self.rows)
        note = f"{self.path}: {what} has {many} episodes, with gaps between them"
        return [note] * (many > 1) + ([f"{self.path}: {self.missing}"] if self.missing else [])


def streams(
    path: Path, options: InputOptions, opened: ExitStack, *, skip_damaged: bool = False
) -> list[LogStream]:
    """Open cameras of a dataset, features that are topics, and `options.fields` as one stream.

    A dataset without cameras is read as all its numbers, without the numbers of frames.

    Raises:
        UsageError: no such camera or numbers, another version of the layout, or PyAV is missing.
        LogDamagedError: its tables cannot be read, or contradict each other.
    """
    numeric, cameras = features(path)
    name, topics, fields = path.resolve().name, options.topics, options.fields
    chosen = [c for c in cameras if (fits_topic(c, topics) if topics else not fields)]
    numbers: dict[str, tuple[str, ...]] = {n: (n,) for n in numeric if n in topics}
    if not (cameras or topics or fields):
        fields = tuple(topic for topic in numeric if topic not in CLOCK)
    if fields and not numbers:
        if not chosen:
            check_topics(path, name, topics)
        numbers = {name: fields}
    if not (chosen or numbers) or (not topics and len(chosen) > 1):
        wrong = f"no topic {', '.join(topics)}" if topics else "choose a --topic"
        raise NoTopicError(f"{path}: {wrong}; it has images on: {', '.join(cameras) or 'none'}")
    if absent := [n for names in numbers.values() for n in names if n not in numeric]:
        raise UsageError(f"{path}: no field {absent[0]}; choose from {', '.join(numeric)}")
    dataset = Dataset(path)
    opened_streams = [_numbers(dataset, topic, names, options) for topic, names in numbers.items()]
    for topic in chosen:
        camera = _Camera(dataset, topic, color=options.color is True)
        opened.callback(camera.close)
        stream = LogStream(
            path=path,
            topic=topic,
            count=len(dataset.times),
            times=dataset.times,
            fetch=camera.fetch,
            decode=camera.decode,
            compressed=None if camera.video else bytes,
            memory_bytes=camera.memory_bytes,
            program=LAYOUT,
            recipe=VIDEO_RECIPE if camera.video else RECIPE,
            warnings=dataset.notes(topic),
            missing=dataset.missing,
        )
        opened_streams.append(stream)
    read = [(feature,) for feature in (*chosen, *fields, *topics, *CLOCK)]
    notes = left_out(path, dataset.info["features"], read, options)
    return [replace(stream, notes=notes) for stream in opened_streams]


class _Camera:
    """The images of one camera, in videos or in tables."""

    def __init__(self, dataset: Dataset, topic: str, *, color: bool) -> None:
        self._dataset, self._topic, self._color = dataset, topic, color
        self._fps = float(dataset.info["fps"])
        self.video = topic in layout.video_cameras(dataset.info)
        key, start, scale = "", "dataset_from_index", 1.0
        if self.video:
            key, start, scale = topic, f"videos/{topic}/from_timestamp", self._fps
        with explained(dataset.path, LAYOUT):
            self._files = [layout.episode_file(dataset.info, row, key) for row in dataset.rows]
            self._first = [round(float(row[start]) * scale) for row in dataset.rows]
        self._file: Path | None = None
        self._images: Any = None

    def fetch(self, row: int) -> Any:
        """Read the JPEG or PNG of a frame, or find its place in a video; the file stays open."""
        dataset = self._dataset
        episode = int(np.searchsorted(dataset.starts, row, side="right")) - 1
        place = self._first[episode] + row - int(dataset.starts[episode])
        name = self._files[episode]
        file = dataset.path / name
        if self._file != file:
            self.close()
            if not file.is_file():
                raise MissingFileError(f"{file}: this file of the dataset is missing")
            self._images = self._table(file) if not self.video else VideoFile(file, self._color)
            self._file = file
        if not self.video:
            return self._compressed(place)
        times, half = self._images.times, NANOSECONDS / self._fps / 2
        at = int(np.searchsorted(times, place * 2 * half - half))  # an earlier frame may be missing
        if at >= len(times) or abs(times[at] / NANOSECONDS * self._fps - place) >= 0.5:
            raise MalformedRecord(f"{name} has no frame at {place / self._fps:g} s")
        return at

    def decode(self, stored: Any) -> ByteArray:
        """Decode what `fetch` returns."""
        if not self.video:
            return compressed_image(stored, color=self._color)
        return np.asarray(self._images.image(stored))

    def memory_bytes(self) -> int:
        """Return bytes of the file that is open."""
        return int(getattr(self._images, "memory_bytes" if self.video else "nbytes", 0))

    def close(self) -> None:
        """Close the file that is open; harmless when called twice."""
        if self.video and self._images is not None:
            self._images.close()
        self._file = self._images = None

    def _table(self, file: Path) -> Any:
        import pyarrow.parquet as pq

        with limited(file, "PyArrow"):
            table = pq.read_table(file, columns=["index", self._topic], use_threads=False)
            if table.nbytes > BUDGET - MAX_CHUNK:  # PyArrow aborts where a small allocation fails
                raise MemoryError
        return table

    def _compressed(self, index: int) -> bytes:
        table = self._images
        row = index - int(table["index"][0].as_py())
        value = table[self._topic][row].as_py() if 0 <= row < table.num_rows else None
        data = value.get("bytes") if isinstance(value, Mapping) else None
        if not isinstance(data, bytes):
            raise MalformedRecord("its table has no image there")
        return data


def _numbers(
    dataset: Dataset, topic: str, names: tuple[str, ...], options: InputOptions
) -> LogStream:
    """Return fields of a dataset, as observation.state and action, one row of numbers a frame."""
    path, what = dataset.path, ", ".join(names)
    frames = frame_numbers(dataset, names)
    stream = number_stream(
        path, topic, {what: frames}, dataset.times, options, lambda row: f"{path}: frame {row}"
    )
    widths = {name: math.prod(dataset.info["features"][name].get("shape", ())) for name in names}
    columns = [column for name in names for column in column_names(name, widths[name])]
    warnings = [*stream.warnings, *dataset.notes(what)]
    missing = dataset.missing
    stated = dataset.info["features"][names[0]].get("names")
    if isinstance(stated, Mapping):  # {"motors": [...]}
        stated = next(iter(stated.values()), None)
    whole = (
        isinstance(stated, list) and len(names) == 1 and len({*map(str, stated)}) == len(columns)
    )
    return replace(
        stream,
        fields=names,
        columns=lambda: columns,
        elements=lambda: list(map(str, stated)) if whole else (),
        warnings=warnings,
        missing=missing,
    )


def frame_numbers(dataset: Dataset, names: Sequence[str]) -> FloatArray:
    """Return numbers of each frame of a dataset, (frames, n)."""
    path = dataset.path
    files = sorted({path / layout.episode_file(dataset.info, row) for row in dataset.rows})
    if absent := [str(file) for file in files if not file.is_file()]:
        raise LogDamagedError(f"{absent[0]}: this file of the dataset is missing")
    numbers = np.concatenate([_columns(file, names) for file in files])
    with limited(path, LAYOUT, memory_bytes=numbers.nbytes):
        starts = dataset.starts
        firsts = np.array([int(row["dataset_from_index"]) for row in dataset.rows]) - starts[:-1]
        return np.asarray(numbers[np.arange(starts[-1]) + np.repeat(firsts, np.diff(starts))])


def is_dataset(path: Path) -> bool:
    """Return whether a folder is a LeRobot dataset."""
    return (path / INFO).is_file()


def dataset_channels(path: Path) -> list[ExternalChannel]:
    """Return the features of a dataset, one value a frame."""
    dataset, channels = Dataset(path), []
    info, count = dataset.info, len(dataset.times)
    last = round(max(count - 1, 0) * NANOSECONDS / float(info["fps"]))
    for name, feature in info["features"].items():
        kind, shape = feature.get("dtype"), "x".join(map(str, feature.get("shape", ())))
        channel = ChannelInfo(name, str(kind), shape, count, 0, last)
        channels.append(ExternalChannel(channel, kind in _IMAGES, dataset.missing))
    return channels


def features(path: Path) -> tuple[list[str], list[str]]:
    """Return the names of numeric features of a dataset, and of its images."""
    kinds = {name: str(feature.get("dtype")) for name, feature in _info(path)["features"].items()}
    numbers = [name for name, kind in kinds.items() if kind.startswith(("float", "int", "bool"))]
    return numbers, [name for name, kind in kinds.items() if kind in _IMAGES]


def _columns(file: Path, names: Sequence[str]) -> FloatArray:
    """Return the numbers of each frame in a table, one after the other, (n, I)."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    check_regular(file)
    columns = []
    with limited(file, "PyArrow", remedy="choose fewer fields with --field"):
        table = pq.ParquetFile(file).read(columns=list(names), use_threads=False)
        for name in names:
            column = table[name].combine_chunks()
            while pa.types.is_nested(column.type):
                column = column.flatten()
            flat = column.cast(pa.float64()).to_numpy(zero_copy_only=False)
            columns.append(flat.reshape(table.num_rows, -1))
        return np.concatenate(columns, axis=1)


def _info(path: Path) -> Any:
    with explained(path / INFO, LAYOUT):
        info = read_json(path / INFO, "it does not describe a LeRobot dataset")
        version = str(info["codebase_version"])
        if not version.startswith(("v2.1", "v3")):
            raise UsageError(
                f"{path} is a LeRobot dataset {version}, but v2.1 or v3.0 is needed: convert it "
                "with the scripts of LeRobot"
            )
        dicts = all(isinstance(feature, dict) for feature in info["features"].values())
        if not (dicts and info["fps"] > 0 and int(info["total_frames"]) >= 0):
            raise LogDamagedError(f"{path / INFO}: it does not describe a LeRobot dataset")
        return info


def _episodes(path: Path, info: Any) -> tuple[list[dict[str, Any]], str, int]:
    """Return the rows of whole episodes in order, a message about others, and all their frames."""
    import pyarrow.parquet as pq

    damage, rows = list[str](), list[dict[str, Any]]()
    if (path / layout.V21).is_file():
        rows = _v21_episodes(path, info, damage)
    elif not (files := tables(path, "meta/episodes")):
        damage.append("the tables of episodes (meta/episodes/*.parquet) are missing")
    else:
        for file in files:
            if layout.table_rows(file) is None:
                damage.append(f"{file.relative_to(path)} {layout.NO_FOOTER}")
                break
            with limited(file, "PyArrow"):
                parquet = pq.ParquetFile(file)
                names = [n for n in parquet.schema_arrow.names if not n.startswith("stats/")]
                rows += parquet.read(columns=names, use_threads=False).to_pylist()
    with explained(path, LAYOUT):
        rows.sort(key=lambda row: int(row["episode_index"]))
        listed = sum(int(row["length"]) for row in rows)
        return *layout.whole_episodes(path, info, rows, damage), listed


def tables(path: Path, folder: str = "data") -> list[Path]:
    """Return the tables in a folder of a dataset, in their order."""
    return sorted((path / folder).rglob("*.parquet"))


def _v21_episodes(path: Path, info: Any, damage: list[str]) -> list[dict[str, Any]]:
    """Return the episodes of layout v2.1, with the columns that v3.0 has for their files."""
    start, cameras = 0, features(path)[1]
    with explained(path / layout.V21, LAYOUT):
        rows = json_lines(path / layout.V21, damage)
        rows.sort(key=lambda row: int(row["episode_index"]))
        for row in rows:
            number = int(row["episode_index"])
            chunk = number // int(info["chunks_size"])
            row |= layout.file_columns("", chunk, number)
            row["dataset_from_index"], start = start, start + int(row["length"])
            for key in cameras:
                row |= layout.file_columns(key, chunk, number)
                row[f"videos/{key}/from_timestamp"] = 0.0
    return rows


def json_lines(file: Path, damage: list[str]) -> list[dict[str, Any]]:
    """Return the values of the lines of a file; note in `damage` if the last one is cut."""
    lines = [line for line in read_regular(file, BUDGET).splitlines() if line.strip()]
    values = [parse_json(line) for line in lines[:-1]]
    try:
        values += map(parse_json, lines[-1:])
    except ValueError:
        damage.append(f"meta/{file.name} ends within a line")
    return values
