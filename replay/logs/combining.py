"""Streams of several logs: parts of one stream, names, and copies of one another."""

from __future__ import annotations

import hashlib
import itertools
import os
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

import numpy as np

from cdmisfa.core.errors import LogDamagedError, UsageError
from cdmisfa.core.names import stream_name, stream_names
from replay.logs.stream import LogStream, joined

COMPARED: Final = 9
"""Images of two streams that are compared, from the first to the last."""

NUMBERS: Final = 256
"""As many of streams of numbers, of which few can be the same by chance."""


def join_parts(streams: Sequence[LogStream]) -> list[LogStream]:
    """Join logs with one topic of which each begins after another ends; others stay streams."""
    found: list[LogStream] = []
    for topic in dict.fromkeys(stream.topic for stream in streams):
        own = [stream for stream in streams if stream.topic == topic]
        ordered = sorted(own, key=lambda s: 0 if s.times is None else int(s.times[0]))
        follow = len(own) > 1 and all(
            one.times is not None and two.times is not None and one.times[-1] < two.times[0]
            for one, two in itertools.pairwise(ordered)
        )
        found += [joined(ordered)] if follow else own
    return found if len(found) < len(streams) else list(streams)


def names_of(streams: Sequence[LogStream]) -> tuple[str, ...]:
    """Names of streams by their topics, with the file's and folders' where topics are shared.

    Raises:
        UsageError: a topic of a log is named twice.
    """
    topics = [stream.topic for stream in streams]
    if len(set(topics)) == len(topics):
        return stream_names(topics)
    paths = [str(stream.path.resolve()) for stream in streams]
    place, times = Counter(zip(paths, topics, strict=True)).most_common(1)[0]
    if times > 1:
        raise UsageError(f"{place[1]} of {place[0]} is named twice: leave one out")
    for folders in range(max(len(Path(path).parts) for path in paths)):
        names = [_in_folders(stream, folders) for stream in streams]
        if len(set(names)) == len(names):
            return stream_names(names)
    return stream_names([f"{i + 1}/{topic}" for i, topic in enumerate(topics)])


def _in_folders(stream: LogStream, folders: int) -> str:
    """A stream's name with those of its file, and of some of the folders this is in."""
    path, own = stream.path, stream_name(stream.topic)
    stems = [path.stem, path.resolve().name]
    if own not in map(stream_name, stems):
        own = f"{path.stem}/{own}"
    above = Path(os.path.abspath(path)).parts[:-1]
    return "/".join([*above[max(len(above) - folders, 0) :], own])


def copies(streams: Sequence[LogStream]) -> Iterator[str]:
    """Yield a line for each stream that shows the same as one before it, of another log.

    Their times are the same, and some of their images.
    """
    counts = Counter(stream.count for stream in streams)
    known: dict[tuple[int, bytes], list[LogStream]] = {}
    for stream in streams:
        if counts[stream.count] < 2 or (first := _hash(stream, 0)) is None:
            continue
        alike = known.setdefault((stream.count, first), [])
        other = next((other for other in alike if _same(other, stream)), None)
        if other is None:
            alike.append(stream)
        else:
            yield (
                f"{stream.path}: {stream.topic} shows the same as {other.topic} of {other.path}, "
                "as a copy does"
            )


def _same(one: LogStream, two: LogStream) -> bool:
    timed = one.times is not None and two.times is not None
    if one.path == two.path or (timed and not np.array_equal(one.times, two.times)):  # type: ignore[arg-type]
        return False
    most = NUMBERS if one.fields else COMPARED
    rows = np.unique(np.linspace(0, one.count - 1, most).astype(int)).tolist()
    pairs = ((_hash(one, row), _hash(two, row)) for row in rows)
    return all(first is not None and first == second for first, second in pairs)


def _hash(stream: LogStream, row: int) -> bytes | None:
    """The hash of an image, None of one that cannot be read."""
    try:
        image = stream.image(row)
    except (LogDamagedError, UsageError):
        return None
    return hashlib.sha256(repr(image.shape).encode() + image.tobytes()).digest()
