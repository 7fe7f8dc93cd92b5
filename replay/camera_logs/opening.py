"""Camera logs of any format: found by path, opened, and described."""

from __future__ import annotations

import contextlib
import fnmatch
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final, Literal

from cdmisfa.core.errors import UsageError
from recorder.images.options import IMAGES, InputOptions
from recorder.images.videos import VideoPackets
from replay.camera_logs.bag import BAGS, BagImages, bag_channels, bag_topics
from replay.camera_logs.lerobot import (
    LeRobotImages,
    LeRobotNumbers,
    dataset_cameras,
    dataset_channels,
    is_dataset,
)
from replay.camera_logs.mcap_log import McapImages, Readers, mcap_topics
from replay.camera_logs.pictures import PICTURES, VIDEOS, FolderImages, VideoImages, by_number
from replay.camera_logs.selected import VideoMessages, by_stamps, join_by_time
from replay.camera_logs.stream import ChannelFacts, ImageStream, NothingLoggedError, holds_none
from replay.camera_logs.table import TABLES, TableNumbers, table_channels
from replay.storage.identity import FilesIdentity, Identity, LogIdentity
from replay.storage.location import location
from replay.storage.opening import log_files

Format = Literal["mcap", "split", "bag", "dataset", "pictures", "video", "table"]

WHOLE_FILES: Final = frozenset((*VIDEOS, *BAGS, *TABLES, *PICTURES))
"""Endings of files that are read whole, and so by their paths alone."""

ALL: Final = ("*",)
"""Topics that mean every one with images."""


def log_format(path: Path) -> Format:
    """The format of a log; a folder of MCAP files that are parts of one log is "split"."""
    if path.is_dir():
        if is_dataset(path):
            return "dataset"
        parts, metadata = any(path.glob("*.mcap")), path / "metadata.yaml"
        if metadata.exists() and not parts:
            return "bag"
        if metadata.is_file():
            return "split"
        pictures = any(file.suffix.lower() in PICTURES for file in path.iterdir())
        return "pictures" if pictures and not any(path.glob("*.mcap*")) else "mcap"
    if path.suffix in BAGS:
        return "bag"
    if path.suffix.lower() in VIDEOS and path.is_file():
        return "video"
    return "table" if path.suffix.lower() in TABLES and path.is_file() else "mcap"


def only_foreign(path: Path) -> bool:
    """Whether a path cannot be one of our recordings, by its format."""
    return log_format(path) not in ("mcap", "split")


def image_logs(paths: Sequence[str | Path]) -> list[Path]:
    """The logs that paths mean, one at least: a folder of MCAP files is each, a rosbag2 one log."""
    found: list[Path] = []
    for path in map(location, paths):
        found += log_files(path) if log_format(path) == "mcap" else [path]
    return found


def open_images(
    path: Path,
    topic: str | None,
    *,
    salvage: bool = False,
    reading: InputOptions = IMAGES,
    readers: Readers | None = None,
) -> ImageStream:
    """Open the images on a topic of a log, or in a folder, or numbers, at the times wanted.

    Args:
        path: an MCAP log or its URL, a ROS bag, a video, a table or a folder of pictures.
        topic: may be left out where there is one topic of images.
        salvage: leave out what is damaged.
        reading: what is taken of messages and tables, and by which times.
        readers: of logs of which other topics are taken, too; closed behind all of them.

    Raises:
        UsageError: no such topic, or not what is wanted on it.
        LogDamagedError: the log is damaged.
    """
    how: dict[str, Any] = {"salvage": salvage, "reading": reading, "readers": readers}
    images = _open(path, topic, **how)
    try:
        if isinstance(images.decode, VideoPackets):
            images = VideoMessages(images, images.decode)
        return images if reading.stamp == "log" else by_stamps(images)
    except BaseException:
        images.close()
        raise


def _open(
    path: Path,
    topic: str | None,
    *,
    salvage: bool,
    reading: InputOptions,
    readers: Readers | None = None,
) -> ImageStream:
    """Open a log with the reader of its format, which raises as `open_images` does."""
    kind = log_format(path)
    if kind == "mcap":
        return McapImages(path, topic, salvage=salvage, reading=reading, readers=readers)
    if kind == "split":
        return _open_parts(path, topic, salvage=salvage, reading=reading, readers=readers)
    if kind == "bag":
        return BagImages(path, topic, reading=reading)
    if kind == "table":
        return TableNumbers(path, topic, reading)
    if kind == "dataset" and reading.fields:
        return LeRobotNumbers(path, topic, reading)
    if reading.fields:
        raise UsageError(f"{path} holds images: --field is for messages, tables and datasets")
    if kind == "dataset":
        return LeRobotImages(path, topic, color=(reading.color is True))
    if kind == "pictures":
        return FolderImages(path, topic, color=(reading.color is True))
    return VideoImages(path, topic, color=(reading.color is True))


def _open_parts(path: Path, topic: str | None, **how: Any) -> ImageStream:
    """Open the images on a topic of a log in parts.

    A part may lack a topic that is named, and one that has nothing in it is left out.
    """
    parts: list[ImageStream] = []
    refusal: UsageError | None = None
    empty: list[NothingLoggedError] = []
    with contextlib.ExitStack() as opened:
        for file in sorted(path.glob("*.mcap"), key=by_number):
            try:
                parts.append(McapImages(file, topic, **how))
                opened.callback(parts[-1].close)
            except NothingLoggedError as error:
                empty.append(error)
            except UsageError as error:
                refusal = refusal or error
        if refusal is not None and (topic is None or not parts):
            raise refusal
        if not parts:
            raise empty[0]
        if len(topics := sorted({part.topic for part in parts})) > 1:
            raise UsageError(f"{path}: name one --topic or more; it has {', '.join(topics)}")
        opened.pop_all()
    return join_by_time(path, parts, [f"{error}: left out" for error in empty])


def identity_of(path: Path, streams: Sequence[ImageStream]) -> Identity:
    """The identity of a log: its bytes; of a folder, names and contents count.

    The streams hold the log open, where it is an MCAP file.
    """
    for stream in streams:
        if isinstance(stream, McapImages) and stream.path == path:
            return LogIdentity(stream.reader)
    if not path.is_dir():
        return FilesIdentity(path)
    found = path.rglob("*") if is_dataset(path) else path.iterdir()
    return FilesIdentity(path, (file for file in found if file.is_file()))


def image_topics(path: Path, reading: InputOptions = IMAGES) -> list[str]:
    """The topics of a camera log with images, or with the messages that are wanted.

    Raises:
        LogDamagedError: it cannot be read.
        CdmisfaError: a package that reads it is missing.
    """
    kind = log_format(path)
    if kind == "mcap":
        return mcap_topics(path, reading)
    if kind == "dataset":
        return dataset_cameras(path)
    if kind == "bag":
        return bag_topics(path, reading)
    if kind != "split":
        return [path.resolve().name if kind == "pictures" else path.stem]
    topics: dict[str, None] = {}
    for part in sorted(path.glob("*.mcap")):
        with contextlib.suppress(NothingLoggedError):
            topics |= dict.fromkeys(mcap_topics(part, reading))
    return list(topics)


def channels_of(path: Path, *, whole: bool = False) -> list[ChannelFacts]:
    """What is on each topic of a camera log that is not in MCAP files.

    Args:
        path: the log.
        whole: read all of a bag, of which otherwise an index may do.

    Raises:
        LogDamagedError: it cannot be read.
        CdmisfaError: a package that reads it is missing.
    """
    kind = log_format(path)
    if kind == "dataset":
        return dataset_channels(path)
    if kind == "bag":
        return bag_channels(path, whole=whole)
    if kind == "table":
        return table_channels(path)
    with contextlib.closing(_open(path, None, salvage=False, reading=IMAGES)) as images:
        first, last = map(int, images.times[[0, -1]]) if len(images.times) else (None, None)
        kind_of_image = "picture" if kind == "pictures" else "video"
        facts = (images.topic, images.encoding, kind_of_image, images.count, first, last)
        return [ChannelFacts(*facts, missing=images.missing, remarks=tuple(images.remarks))]


def named_streams(
    files: Sequence[Path], topics: Sequence[str], reading: InputOptions = IMAGES
) -> list[tuple[Path, str | None]]:
    """The log and the topic of each stream that is meant.

    Without topics each log has one stream. As many topics as logs are one of each log in turn;
    otherwise a topic, or every one that a pattern fits, is looked for in every log.

    Raises:
        UsageError: a log has no topic that a pattern fits, or no log has a topic.
    """
    if not topics:
        return [(file, None) for file in files]
    if not any(letter in topic for topic in topics for letter in "*?["):
        if len(files) == 1 or len(topics) == 1:
            return [(file, topic) for topic in topics for file in files]
        if len(topics) == len(files):
            return list(zip(files, topics, strict=True))
    known = [(file, name) for file in files for name in image_topics(file, reading)]
    found: dict[tuple[Path, str | None], None] = {}
    for topic in topics:
        fits = [(file, name) for file, name in known if fits_topic(name, topic)]
        if not known:
            raise UsageError(holds_none(files[0], reading))
        if not fits:
            there = ", ".join(sorted({name for _, name in known}))
            where = files[0] if len(files) == 1 else f"none of the {len(files)} logs"
            raise UsageError(f"{where}: no topic {topic}; there are: {there}")
        found |= dict.fromkeys(fits)
    return list(found)


def fits_topic(name: str, topic: str) -> bool:
    """Whether a name is the topic that is asked for, or matches the pattern."""
    return name == topic or fnmatch.fnmatchcase(name, topic)
