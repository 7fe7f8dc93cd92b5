"""LeRobot datasets, layout v3.0: a camera's images, or numbers, of all episodes, in their order.

The layout is read as it is published (github.com/huggingface/lerobot), with PyArrow and PyAV.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.arrays import ByteArray, FloatArray, IntArray
from cdmisfa.core.clock import NANOSECONDS
from cdmisfa.core.errors import LogDamagedError, UsageError
from cdmisfa.core.untrusted import check_regular, read_json
from recorder.images.compressed import compressed_image
from recorder.images.fields import bounded
from recorder.images.options import NUMBERS_RECIPE, InputOptions
from recorder.images.pixels import Shown
from recorder.mcap.records import MAX_CHUNK, MalformedRecord
from replay.camera_logs.pictures import VideoImages
from replay.camera_logs.stream import (
    ChannelFacts,
    ImageStream,
    arrow_explained,
    explained,
    in_one_line,
)

INFO: Final = "meta/info.json"
PAUSE: Final = 20
"""Frames that would fit between two episodes, of which nobody knows when they were."""


class LeRobotImages(ImageStream):
    """The images of one camera of a dataset, the episodes in their order.

    Raises:
        UsageError: no such camera, another version of the layout, or PyAV is missing.
        LogDamagedError: its tables cannot be read, or contradict each other.
    """

    path: Path

    def __init__(self, path: Path, topic: str | None, *, color: bool = False) -> None:
        self.path, self._color = path, color
        self._info = _info(path)
        cameras = dataset_cameras(path)
        if topic is None and len(cameras) == 1:
            topic = cameras[0]
        if topic not in cameras:
            wrong = "name one --topic" if topic is None else f"no topic {topic}"
            known = ", ".join(cameras) or "none"
            raise UsageError(f"{path}: {wrong}; it has images on: {known}")
        self.topic = topic
        self._video = self._info["features"][topic]["dtype"] == "video"
        self._fps = float(self._info["fps"])
        place = f"videos/{topic}/" if self._video else "data/"
        keys = [f"{place}chunk_index", f"{place}file_index"]
        start = f"{place}from_timestamp" if self._video else "dataset_from_index"
        rows = _episodes(path, ["episode_index", "length", *keys, start])
        with explained(path, "LeRobot's layout"):
            self._files = [(int(row[keys[0]]), int(row[keys[1]])) for row in rows]
            scale = self._fps if self._video else 1
            self._first = [round(float(row[start]) * scale) for row in rows]
        self._starts, self.times = _clock(path, rows, self._fps)
        self._file: Path | None = None
        self._images: Any = None
        self.warnings = _of_episodes(path, topic, rows)
        if self._video:
            self.recipe = VideoImages.recipe

    def image(self, row: int) -> ByteArray:
        episode = int(np.searchsorted(self._starts, row, side="right")) - 1
        place = self._first[episode] + row - int(self._starts[episode])
        chunk, number = self._files[episode]
        template = self._info["video_path" if self._video else "data_path"]
        with explained(self.path, "LeRobot's layout"):
            name = template.format(video_key=self.topic, chunk_index=chunk, file_index=number)
            file = self.path / name
        if self._file != file:
            self.close()
            if not file.is_file():
                raise LogDamagedError(f"{file}: there is no such file, its dataset names it")
            opened = (
                VideoImages(file, None, color=self._color) if self._video else self._table(file)
            )
            self._file, self._images = file, opened
        images = self._images
        if not self._video:
            return self._picture(images, place)
        if not (
            place < images.count
            and abs(int(images.times[place]) / NANOSECONDS * self._fps - place) < 0.5
        ):
            raise MalformedRecord(f"{name} has no frame at {place / self._fps:g} s")
        found: ByteArray = images.image(place)
        return found

    def close(self) -> None:
        if self._video and self._images is not None:
            self._images.close()
        self._file = self._images = None

    def _table(self, file: Path) -> Any:
        import pyarrow.parquet as pq

        with arrow_explained(file, held=MAX_CHUNK):
            return pq.read_table(file, columns=["index", self.topic], use_threads=False)

    def _picture(self, table: Any, index: int) -> ByteArray:
        # without the budget: what is copied is a part of the table, and PyArrow aborts where a
        # small allocation fails
        with in_one_line(self.path, "LeRobot's layout"):
            row = index - int(table["index"][0].as_py())
            value = table[self.topic][row].as_py() if 0 <= row < table.num_rows else None
        data = value.get("bytes") if isinstance(value, Mapping) else None
        if not isinstance(data, bytes):
            raise MalformedRecord("its table holds no picture there")
        with explained(self.path, "Pillow", held=table.nbytes + len(data)):
            return compressed_image(data, color=self._color)


class LeRobotNumbers(ImageStream):
    """Numbers of a dataset, as observation.state and action: those of each frame one message.

    Raises:
        UsageError: it has no such feature of numbers, or one of them is not finite.
        LogDamagedError: its tables cannot be read, or contradict each other.
    """

    path: Path
    recipe = NUMBERS_RECIPE

    def __init__(self, path: Path, topic: str | None, reading: InputOptions) -> None:
        self.path, self.topic, self.fields = path, path.resolve().name, reading.fields
        if topic not in (None, self.topic):
            raise UsageError(f"{path}: its numbers have no topics, leave {topic} out; see --field")
        info, (known, _), what = _info(path), _features(path), ", ".join(reading.fields)
        for name in reading.fields:
            if name not in known:
                raise UsageError(f"{path}: no numbers {name}; it has {', '.join(known)}")
        rows = _episodes(path, ["episode_index", "length", "dataset_from_index"])
        starts, self.times = _clock(path, rows, float(info["fps"]))
        files = sorted((path / "data").rglob("*.parquet"))
        if not files:
            raise LogDamagedError(f"{path}: there is no table of its frames")
        numbers = np.concatenate([_numbers(file, reading.fields) for file in files])
        with explained(path, "LeRobot's layout", held=numbers.nbytes):
            firsts = np.array([int(row["dataset_from_index"]) for row in rows]) - starts[:-1]
            at = np.arange(starts[-1]) + np.repeat(firsts, np.diff(starts))
            self._numbers = bounded(numbers[at], reading.range)
        if not (whole := np.isfinite(self._numbers).all(axis=1)).all():
            frame = int(np.argmin(whole))
            raise UsageError(
                f"{path}: frame {frame} lacks a number of {what}, or has one that is not finite: "
                "name others with --field"
            )
        self.warnings = _of_episodes(path, what, rows)

    def image(self, row: int) -> Shown:
        shown: Shown = self._numbers[row]
        return shown


def is_dataset(path: Path) -> bool:
    """Whether a folder is a LeRobot dataset."""
    return (path / INFO).is_file()


def dataset_cameras(path: Path) -> list[str]:
    """The features of a dataset that are images."""
    return _features(path)[1]


def dataset_channels(path: Path) -> list[ChannelFacts]:
    """What a dataset states of each of its features, one value a frame."""
    info = _info(path)
    found = []
    for name, feature in info["features"].items():
        kind, shape = feature.get("dtype"), "x".join(map(str, feature.get("shape", ())))
        frames = int(info["total_frames"])
        found.append(ChannelFacts(name, str(kind), shape, frames, images=kind in _IMAGES))
    return found


_IMAGES: Final = ("video", "image")


def _features(path: Path) -> tuple[list[str], list[str]]:
    """The features of a dataset that are numbers, and those that are images."""
    kinds = {name: str(own.get("dtype")) for name, own in _info(path)["features"].items()}
    numbers = [name for name, kind in kinds.items() if kind.startswith(("float", "int", "bool"))]
    return numbers, [name for name, kind in kinds.items() if kind in _IMAGES]


def _numbers(file: Path, names: Sequence[str]) -> FloatArray:
    """The numbers of each frame in a table, one after the other, (n, I)."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    check_regular(file)
    found = []
    with arrow_explained(file, remedy="take fewer, with --field"):
        table = pq.ParquetFile(file).read(columns=list(names), use_threads=False)
        for name in names:
            column = table[name].combine_chunks()
            while pa.types.is_nested(column.type):
                column = column.flatten()
            flat = column.cast(pa.float64()).to_numpy(zero_copy_only=False)
            found.append(flat.reshape(table.num_rows, -1))
        return np.concatenate(found, axis=1)


def _clock(
    path: Path, rows: Sequence[Mapping[str, Any]], fps: float
) -> tuple[IntArray, NDArray[np.uint64]]:
    """Where each episode begins, and where the last ends; when each frame is, nanoseconds."""
    with explained(path, "LeRobot's layout"):
        lengths = np.array([int(row["length"]) for row in rows], np.int64)
        starts = np.concatenate([[0], np.cumsum(lengths)])
        ticks = np.arange(starts[-1]) + np.repeat(np.arange(len(rows)) * PAUSE, lengths)
        times = np.round(ticks * (NANOSECONDS / fps)).astype(np.uint64)
    if not len(times):
        raise UsageError(f"{path}: there is no frame in it")
    return starts, times


def _of_episodes(path: Path, what: str, rows: Sequence[Any]) -> list[str]:
    said = f"{path}: {what} is of {len(rows)} episodes, with pauses between"
    return [said] if len(rows) > 1 else []


def _info(path: Path) -> Any:
    try:
        info = read_json(path / INFO, "it describes no LeRobot dataset")
        version = str(info["codebase_version"])
        sound = all(isinstance(f, dict) for f in info["features"].values()) and info["fps"] > 0
        int(info["total_frames"])
    except (LogDamagedError, ValueError, KeyError, TypeError, AttributeError):
        sound, version = False, "v3"
    if not version.startswith("v3"):
        raise UsageError(
            f"{path} is a LeRobot dataset {version}, v3.0 is read: convert it with LeRobot's "
            "convert_dataset_v21_to_v30"
        )
    if not sound:
        raise LogDamagedError(f"{path / INFO}: it describes no LeRobot dataset")
    return info


def _episodes(path: Path, columns: list[str]) -> list[dict[str, Any]]:
    """The rows of the tables of episodes, in their order."""
    import pyarrow.parquet as pq

    rows: list[dict[str, Any]] = []
    files = sorted((path / "meta" / "episodes").rglob("*.parquet"))
    if not files:
        raise LogDamagedError(f"{path}: there is no table of its episodes")
    for file in files:
        check_regular(file)
        with arrow_explained(file):
            rows += pq.ParquetFile(file).read(columns=columns, use_threads=False).to_pylist()
    with explained(path, "LeRobot's layout"):
        return sorted(rows, key=lambda row: int(row["episode_index"]))
