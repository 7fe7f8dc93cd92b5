"""LeRobot datasets, layout v3.0: a camera's images of all episodes, one after the other.

The layout is read as it is published (github.com/huggingface/lerobot), with PyArrow and PyAV.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from cdmisfa.core.arrays import ByteArray
from cdmisfa.core.clock import NANOSECONDS
from cdmisfa.core.errors import LogDamagedError, UsageError
from cdmisfa.core.untrusted import check_regular, read_json
from recorder.images.options import Size
from recorder.images.pixels import compressed_image
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
            lengths = np.array([int(row["length"]) for row in rows], np.int64)
            self._starts = np.concatenate([[0], np.cumsum(lengths)])
            ticks = np.arange(self._starts[-1]) + np.repeat(np.arange(len(rows)) * PAUSE, lengths)
            self.times = np.round(ticks * (NANOSECONDS / self._fps)).astype(np.uint64)
        if not len(self.times):
            raise UsageError(f"{path}: there is no frame in it")
        self._file: Path | None = None
        self._images: Any = None
        if len(rows) > 1:
            self.warnings = [f"{path}: {topic} is of {len(rows)} episodes, with pauses between"]
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

    def stated_size(self, row: int) -> Size | None:
        shape = self._info["features"][self.topic].get("shape", ())
        if len(shape) != 3 or not all(isinstance(n, int) and n > 0 for n in shape):
            return None
        return (shape[1], shape[2]) if shape[0] in (1, 3) else (shape[0], shape[1])

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


def is_dataset(path: Path) -> bool:
    """Whether a folder is a LeRobot dataset."""
    return (path / INFO).is_file()


def dataset_cameras(path: Path) -> list[str]:
    """The features of a dataset that are images."""
    features = _info(path)["features"]
    return [name for name, feature in features.items() if feature.get("dtype") in _IMAGES]


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
