"""What is in camera logs of any kind, and which streams are meant by topics and patterns."""

from __future__ import annotations

import contextlib
import fnmatch
from collections.abc import Sequence
from pathlib import Path

from cdmisfa.core.errors import UsageError
from recorder.images.decoding import IMAGES, Reading
from replay.camera_logs.formats.bag import bag_channels, bag_topics
from replay.camera_logs.formats.lerobot import dataset_cameras, dataset_channels, is_dataset
from replay.camera_logs.formats.mcap_log import mcap_topics
from replay.camera_logs.formats.picture_folder import FolderImages
from replay.camera_logs.formats.table import is_table, table_channels
from replay.camera_logs.formats.video import VideoImages
from replay.camera_logs.opening import is_bag, is_picture_folder, is_split, is_video
from replay.camera_logs.stream import ChannelFacts, NothingLoggedError, holds_none
from replay.storage.location import Location

ALL = ("*",)
"""Topics that mean every one with images."""


def image_topics(path: Location, reading: Reading = IMAGES) -> list[str]:
    """The topics of a camera log with images, or with the messages that are wanted.

    Raises:
        LogDamagedError: it cannot be read.
        CdmisfaError: a package that reads it is missing.
    """
    if isinstance(path, Path):
        if is_dataset(path):
            return dataset_cameras(path)
        if is_bag(path):
            return bag_topics(path, reading)
        if is_split(path):
            topics: dict[str, None] = {}
            for part in sorted(path.glob("*.mcap")):
                with contextlib.suppress(NothingLoggedError):
                    topics |= dict.fromkeys(mcap_topics(part, reading))
            return list(topics)
        if is_picture_folder(path):
            return [path.resolve().name]
        if is_video(path) or is_table(path):
            return [path.stem]
    return mcap_topics(path, reading)


def channels_of(path: Path, *, whole: bool = False) -> list[ChannelFacts]:
    """What is on each topic of a camera log that is not in MCAP files.

    Args:
        path: the log.
        whole: read all of a bag, of which otherwise an index may do.

    Raises:
        LogDamagedError: it cannot be read.
        CdmisfaError: a package that reads it is missing.
    """
    if is_dataset(path):
        return dataset_channels(path)
    if is_bag(path):
        return bag_channels(path, whole=whole)
    if is_table(path):
        return table_channels(path)
    images = FolderImages(path, None) if path.is_dir() else VideoImages(path, None)
    try:
        ends = [int(t) for t in images.times[[0, -1]]] if len(images.times) else [None, None]
        kind = "picture" if path.is_dir() else "video"
        return [ChannelFacts(images.topic, images.encoding, kind, images.count, ends[0], ends[1])]
    finally:
        images.close()


def named_streams(
    files: Sequence[Location], topics: Sequence[str], reading: Reading = IMAGES
) -> list[tuple[Location, str | None]]:
    """The log and the topic of each stream that is meant.

    Without topics each log has one stream. As many topics as logs are one of each log in turn;
    otherwise a topic, or every one that a pattern fits, is looked for in every log.

    Raises:
        UsageError: a log has no topic that a pattern fits, or no log has a topic.
    """
    if not topics:
        return [(file, None) for file in files]
    patterns = any(map(_is_pattern, topics))
    if not patterns and (len(files) == 1 or len(topics) == 1):
        return [(file, topic) for topic in topics for file in files]
    if not patterns and len(topics) == len(files):
        return list(zip(files, topics, strict=True))
    known = [(file, image_topics(file, reading)) for file in files]
    found: list[tuple[Location, str | None]] = []
    for topic in topics:
        fits = [(file, name) for file, names in known for name in names if fits_topic(name, topic)]
        if not fits:
            there = ", ".join(sorted({name for _, names in known for name in names}))
            if not there:
                raise UsageError(holds_none(files[0], reading))
            where = files[0] if len(files) == 1 else f"none of the {len(files)} logs"
            raise UsageError(f"{where}: no topic {topic}; there are: {there}")
        found += [pair for pair in fits if pair not in found]
    return found


def _is_pattern(topic: str) -> bool:
    return any(letter in topic for letter in "*?[")


def fits_topic(name: str, topic: str) -> bool:
    """Whether a topic is the one that is asked for, or of the pattern."""
    return name == topic or fnmatch.fnmatchcase(name, topic)
