"""What streams are called: after their topics."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from cdmisfa.core.errors import UsageError
from replay.camera_logs.stream import ImageStream
from replay.storage.location import Url


def stream_names(streams: Sequence[ImageStream]) -> tuple[str, ...]:
    """Topics as names of streams, with the file's and folders' where topics are shared.

    Raises:
        UsageError: a topic of a log is named twice.
    """
    topics = [s.topic for s in streams]
    if len(set(topics)) == len(topics):
        return tuple(topics)
    paths = [s.path.address if isinstance(s.path, Url) else str(s.path.resolve()) for s in streams]
    places = list(zip(paths, topics, strict=True))
    for i, place in enumerate(places):
        if place in places[:i]:
            raise UsageError(f"{topics[i]} of {streams[i].path} is named twice: leave one out")
    for folders in range(max(len(Path(path).parts) for path in paths)):
        names = [_in_folders(stream, folders) for stream in streams]
        if len(set(names)) == len(names):
            return tuple(names)
    return tuple(f"{i + 1}/{topic}" for i, topic in enumerate(topics))


def _in_folders(stream: ImageStream, folders: int) -> str:
    """A stream's name with those of its file, and of some of the folders this is in."""
    path, topic = stream.path, stream.topic
    of_file = topic == path.stem or (isinstance(path, Path) and topic == path.resolve().name)
    own = topic if of_file else path.stem + topic
    above = Path(str(path) if isinstance(path, Url) else os.path.abspath(path)).parts[:-1]
    return "/".join([*above[max(len(above) - folders, 0) :], own]).removeprefix("//")
