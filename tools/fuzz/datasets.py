"""Folders that are read by more than one file: datasets of LeRobot, bags of ROS 2."""

from __future__ import annotations

import json
from collections.abc import Iterator
from functools import cache
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory

from bombs import METADATA
from camera_files import HEIGHT, WIDTH, pictures
from PIL import Image

from replay.camera_logs.opening import open_images

FRAMES = "data.parquet"

DATASET = {
    "codebase_version": "v3.0",
    "fps": 25,
    "total_frames": 3,
    "data_path": FRAMES,
    "features": {"cam": {"dtype": "image", "shape": [HEIGHT, WIDTH, 1]}},
}
EPISODE = {
    "episode_index": 0,
    "length": 3,
    "dataset_from_index": 0,
    "data/chunk_index": 0,
    "data/file_index": 0,
}


def first_and_last(path: Path, topic: str | None = None) -> None:
    """Decode the first image of a topic, and the last."""
    images = open_images(path, topic)
    try:
        for row in (0, images.count - 1):
            images.image(row)
    finally:
        images.close()


def frames() -> Iterator[bytes]:
    """The table of a dataset's pictures."""
    rows: list[dict[str, object]] = []
    for index, picture in enumerate(pictures(3)):
        Image.fromarray(picture).save(packed := BytesIO(), "PNG")
        rows.append({"index": index, "cam": {"bytes": packed.getvalue(), "path": ""}})
    return _tables(rows)


def episodes() -> Iterator[bytes]:
    """The table of a dataset's episodes."""
    return _tables([EPISODE])


def _tables(rows: list[dict[str, object]]) -> Iterator[bytes]:
    """Rows as parquet, plain and packed."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    for packing in ("none", "snappy", "zstd"):
        pq.write_table(pa.Table.from_pylist(rows), found := BytesIO(), compression=packing)
        yield found.getvalue()


@cache
def _whole() -> tuple[bytes, bytes]:
    """Both tables of a dataset."""
    return next(frames()), next(episodes())


def read_dataset(path: Path) -> None:
    """Read a dataset of which one table is the input."""
    whole = _whole()
    place = path.parent / "meta" / "episodes"
    place.mkdir(parents=True, exist_ok=True)
    (path.parent / "meta" / "info.json").write_text(json.dumps(DATASET))
    if path.name == FRAMES:
        (place / "a.parquet").write_bytes(whole[1])
    else:
        path.rename(place / "a.parquet")
        (path.parent / FRAMES).write_bytes(whole[0])
    first_and_last(path.parent)


def metadata() -> Iterator[bytes]:
    """The metadata of a bag of ROS 2."""
    plain = METADATA.format(mode='""', name="a.db3").replace("format: zstd", 'format: ""')
    yield plain.replace("/cam,", "/cam_left,").encode()


@cache
def _database() -> bytes:
    from test_bags import ros2_database

    with TemporaryDirectory() as folder:
        ros2_database(Path(folder))
        return next(Path(folder).rglob("*.db3")).read_bytes()


def read_bag(path: Path) -> None:
    """Read a bag of ROS 2 of which the metadata is the input."""
    (path.parent / "a.db3").write_bytes(_database())
    first_and_last(path.parent)
