"""The logs of a corpus, and each of them as an episode: its frames, and what identifies it."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, NamedTuple

from cdmisfa.core.blocks import SourceSpec
from cdmisfa.core.errors import CdmisfaError, LogDamagedError, UsageError
from replay.corpus.finding import INDEX, may_be_corpus
from replay.corpus.index import indexed_logs, is_index
from replay.logs.opening import log_format
from replay.logs.source import LoggedSource
from replay.storage.identity import Identity
from replay.storage.location import location
from replay.storage.opening import natural_order
from replay.stored import Span

STREAM: Final = "stream"
"""Name of the stream of a log that has one, where its file is what names it."""

SMALL: Final = 1 << 20
"""Bytes of a log of which all are hashed when it is first opened."""

Log = Sequence[Path]
"""What is opened as one: a log, or the files of a recording's views."""

Told = Callable[[float, float | None], None]
"""Told how many logs were opened, and of how many."""


def logs_of_corpus(words: Sequence[str | Path]) -> list[Log] | None:
    """The recordings and logs of others in an index; None where words name none.

    Args:
        words: one, a folder with its index, or an index.

    Raises:
        UsageError: it holds no log, or is of another version.
        LogDamagedError: it is damaged.
    """
    if not may_be_corpus(words):
        return None
    place = Path(str(words[0]))
    index = place / INDEX if place.is_dir() else place
    if not place.is_dir() and not is_index(index):
        return None  # it is a table
    logs = indexed_logs(index)
    if place.is_dir() and [log.name for log in logs] == [os.curdir]:
        return None  # the folder is one recording, which was indexed
    if not logs:
        raise UsageError(f"{index} holds no log to learn from: index a folder of logs")
    return [[location(file) for file in log.files] for log in logs]


@dataclass(slots=True)
class Kind:
    """What logs with frames of one shape and type have in common.

    Attributes:
        stated: how images became frames.
        turns: see `cdmisfa.core.blocks.turn_to`.
        scenes: what was recorded.
        streams: of each by its name how an image becomes a frame, the numbers that are taken, and
            the format of pixels.
    """

    stated: Mapping[str, Any]
    turns: Sequence[Sequence[int]]
    scenes: set[str] = field(default_factory=set)
    streams: dict[str, tuple[Any, list[str], str]] = field(default_factory=dict)


@dataclass(slots=True)
class Episode:
    """A log, and where it is on the clock of all.

    Attributes:
        log: what is opened.
        name: its path relative to what all lie in.
        spec: its own; a stream that its file names is `STREAM`.
        first: its first frame, on its own clock.
        count: its frames.
        held: of each of its streams the frames that it has, on its own clock; empty without gaps.
        many: whether its stretches are episodes themselves, as those of a dataset.
        identity: of it.
        start: its first frame on the clock of all.
        whole: frames before it is damaged.
    """

    log: Log
    name: str
    spec: SourceSpec
    first: int
    count: int
    held: tuple[tuple[Span, ...], ...]
    many: bool
    identity: LogIdentity
    start: int = 0
    whole: int = 0

    def spans(self, stream: str) -> Iterator[Span]:
        """The unbroken stretches of a stream, on the clock of all."""
        if stream not in self.spec.streams:
            return
        own = ((self.first, self.first + self.count),)
        for low, high in self.held[self.spec.streams.index(stream)] if self.held else own:
            start, end = (self.start + t - self.first for t in (low, high))
            if start < (end := min(end, self.start + self.whole)):
                yield start, end


class LogIdentity(Identity):
    """The identity of one of many logs, which is opened again for it.

    Args:
        source: the log.
        opened: opens it again.

    Attributes:
        sampled: the checksum of a sample.
    """

    def __init__(self, source: LoggedSource, opened: Callable[[], LoggedSource]) -> None:
        logs = source.identities()
        self.path, self.size = logs[0].path, sum(log.size for log in logs)
        self._opened, self._sha256 = opened, ""
        self.sampled = sampled(source)
        if self.size <= SMALL:
            self._sha256 = _digest([log.whole(lambda count: None) for log in logs])

    def sample(self) -> dict[str, Any]:
        """See `Identity`."""
        return {"sha256": self._sha256} if self._sha256 else {"sample_sha256": self.sampled}

    def whole(self, counted: Callable[[int], None] = lambda count: None) -> dict[str, Any]:
        """See `Identity`."""
        if not self._sha256:
            with contextlib.closing(self._opened()) as source:
                self._sha256 = _digest([log.whole(counted) for log in source.identities()])
        return {"sha256": self._sha256}


def sampled(source: LoggedSource) -> str:
    """The checksum of a sample of a log's bytes."""
    return _digest([log.sample() for log in source.identities()])


def _digest(logs: Sequence[Mapping[str, Any]]) -> str:
    """What identifies a log: of one file its own checksum, of several that of all."""
    for name in ("sha256", "sample_sha256"):
        if len(logs) == 1 and name in logs[0]:
            return str(logs[0][name])
    return hashlib.sha256(json.dumps(logs, sort_keys=True).encode()).hexdigest()


class Found(NamedTuple):
    """What logs were found to be.

    Attributes:
        episodes: those that can be opened, by when they begin and then by their paths.
        kinds: what they have in common, by `kind_of`.
        folder: what all lie in; "" of addresses.
        damaged: a line for each log that is damaged.
        unfit: a line for each that shows no frames, or not what is asked for.
        warnings: what the logs have to say.
    """

    episodes: list[Episode]
    kinds: dict[Any, Kind]
    folder: str
    damaged: list[str]
    unfit: list[str]
    warnings: list[str]


def find_episodes(logs: Sequence[Log], opened: Callable[[Log], LoggedSource], told: Told) -> Found:
    """Open each log once, and close it.

    Raises:
        CdmisfaError: none can be opened.
    """
    ways = [_way(log) for log in logs]
    here = [os.path.dirname(way) for way in ways if "://" not in way]
    found = Found([], {}, os.path.commonpath(here) if here else "", [], [], [])
    names = [way if "://" in way else os.path.relpath(way, found.folder) for way in ways]
    order = sorted(range(len(logs)), key=lambda i: _by_numbers(names[i]))
    first: CdmisfaError | None = None
    for done, i in enumerate(order):
        try:
            with contextlib.closing(opened(logs[i])) as source:
                found.episodes.append(_episode(logs[i], names[i], source, opened, found.kinds))
                found.warnings.extend(source.warnings)
        except CdmisfaError as error:
            first = first or error
            lines = found.damaged if isinstance(error, LogDamagedError) else found.unfit
            lines.append(f"{error}: this log is left out")
        told(done + 1, len(order))
    if first is not None and not found.episodes:
        raise first
    found.episodes.sort(key=lambda episode: episode.spec.start_ns)
    return found


def _episode(
    log: Log,
    name: str,
    source: LoggedSource,
    opened: Callable[[Log], LoggedSource],
    kinds: dict[Any, Kind],
) -> Episode:
    spec = source.spec
    if len(spec.streams) == 1 and _named_by_file(log):
        spec = replace(spec, streams=(STREAM,))
    stated = source.origin() if source.recorded else source.described([])
    kind = kinds.setdefault(kind_of(spec), Kind(stated, getattr(source, "turns", ())))
    kind.scenes.add(source.scene().get("scene", ""))
    fields = stated.get("fields") or []
    framings = getattr(source, "framings", [None] * len(spec.streams))
    for i, stream in enumerate(spec.streams):
        own = fields[i] if fields and isinstance(fields[0], list) else fields
        kind.streams.setdefault(stream, (framings[i], own, source.pixels(i)))
    return Episode(
        log,
        name,
        spec,
        source.first_frame,
        source.frames,
        tuple(map(tuple, source._held)) if source.gaps else (),
        log_format(log[0]) == "dataset",
        LogIdentity(source, lambda: opened(log)),
        whole=source.frames,
    )


def kind_of(spec: SourceSpec) -> tuple[Any, ...]:
    """What logs have in common that are episodes of one source."""
    return spec.frame_shape, spec.dtype, spec.truth


def _way(log: Log) -> str:
    """The path of a log; of several files that of their folder."""
    path = os.path.abspath(log[0])
    return os.path.dirname(path) if len(log) > 1 else path


def _by_numbers(name: str) -> list[Any]:
    """Sort key that puts 9/log before 10/log."""
    return [natural_order(Path(part)) for part in Path(name).parts]


def _named_by_file(log: Log) -> bool:
    """Whether the stream of a log is named by its file, and so has another name in each."""
    return log_format(log[0]) in ("video", "table", "pictures", "arrays")
