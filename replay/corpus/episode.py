"""One log as an episode: its frames, its streams and its identity."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

from cdmisfa.core.blocks import SourceSpec
from replay.logs.clock import UNEVEN
from replay.logs.open_logs import log_format
from replay.logs.source import LoggedSource
from replay.storage.identity import Identity
from replay.storage.paths import natural_order
from replay.stored_source import Span

# A log with at most this many bytes is hashed as a whole when it is opened first.
SMALL: Final = 1 << 20

# Files that are opened as one log: an external log, or the views of a recording.
Log = Sequence[Path]


@dataclass(slots=True)
class Episode:
    """A log, and its place on the clock of all logs.

    Attributes:
        log: the files.
        name: the path relative to the folder of all logs.
        spec: specification of the log; a stream that is named by its file is called "stream".
        first: number of its first frame on its own clock.
        count: number of its frames.
        ranges: frames of each stream, on the clock of the log; empty without gaps.
        many: whether the log has several episodes, as a LeRobot dataset.
        identity: the identity of the log.
        scene: the scene that was recorded, or "".
        stated: how images became frames, as the description of a source states it.
        turns: see `cdmisfa.core.blocks.turn_to`.
        streams: for each stream its framing, its fields, and its pixel format.
        start: its first frame on the clock of all.
        whole: number of frames before damage, for each lap in which damage was read. A resumed run
            does not know of the damage in earlier laps, and must read the same frames.
    """

    log: Log
    name: str
    spec: SourceSpec
    first: int
    count: int
    ranges: Sequence[Sequence[Span]]
    many: bool
    identity: EpisodeIdentity
    scene: str
    stated: Mapping[str, Any]
    turns: Sequence[Sequence[int]]
    streams: Mapping[str, tuple[Any, list[str], str]]
    start: int = 0
    whole: dict[int, int] = field(default_factory=dict)

    def spans(self, stream: str, lap: int = -1) -> Iterator[Span]:
        """Yield the unbroken stretches of a stream on the clock of all, in a lap up to damage."""
        if stream not in self.spec.streams:
            return
        frames = ((self.first, self.first + self.count),)
        for low, high in self.ranges[self.spec.streams.index(stream)] if self.ranges else frames:
            start, end = (self.start + t - self.first for t in (low, high))
            if lap in self.whole:
                end = min(end, self.start + self.whole[lap])
            if start < end:
                yield start, end


class EpisodeIdentity(Identity):
    """The identity of one of many logs, which is opened again to compute it.

    Args:
        source: the log.
        reopen: opens it again.

    Attributes:
        sampled: the checksum of a sample.
    """

    def __init__(self, source: LoggedSource, reopen: Callable[[], LoggedSource]) -> None:
        identities = source.identities()
        self.path, self.size = identities[0].path, sum(log.size for log in identities)
        self._reopen, self._sha256 = reopen, ""
        self.sampled = sampled(source)
        if self.size <= SMALL:
            self._sha256 = _digest([log.whole(lambda count: None) for log in identities])

    def sample(self) -> dict[str, Any]:
        """See `Identity`."""
        return {"sha256": self._sha256} if self._sha256 else {"sample_sha256": self.sampled}

    def whole(self, counted: Callable[[int], None] = lambda count: None) -> dict[str, Any]:
        """See `Identity`."""
        if not self._sha256:
            with contextlib.closing(self._reopen()) as source:
                self._sha256 = _digest([log.whole(counted) for log in source.identities()])
        return {"sha256": self._sha256}


def sampled(source: LoggedSource) -> str:
    """Return the checksum of a sample of a log's bytes."""
    return _digest([log.sample() for log in source.identities()])


def _digest(logs: Sequence[Mapping[str, Any]]) -> str:
    """Return the checksum of a log: that of its file, or one over all of its files."""
    for name in ("sha256", "sample_sha256"):
        if len(logs) == 1 and name in logs[0]:
            return str(logs[0][name])
    return hashlib.sha256(json.dumps(logs, sort_keys=True).encode()).hexdigest()


def relative_names(logs: Sequence[Log]) -> tuple[str, list[str]]:
    """Return the folder of all logs, "" for URLs, and the path of each log relative to it."""
    paths = [os.path.abspath(log[0]) for log in logs]
    paths = [os.path.dirname(p) if len(log) > 1 else p for p, log in zip(paths, logs, strict=True)]
    folder = os.path.commonpath([os.path.dirname(path) for path in paths])
    return folder, [os.path.relpath(path, folder) for path in paths]


def by_numbers(name: str) -> list[Any]:
    """Return a sort key that puts 9/log before 10/log."""
    return [natural_order(Path(part)) for part in Path(name).parts]


def episode_of(
    log: Log, name: str, source: LoggedSource, reopen: Callable[[Log], LoggedSource]
) -> Episode:
    spec, format = source.spec, log_format(log[0])
    if len(spec.streams) == 1 and format in ("video", "table", "images", "arrays"):
        spec = replace(spec, streams=("stream",))  # else each file would be another stream
    stated = source.origin() if source.recorded else source.described([])
    streams, fields = {}, stated.get("fields") or []
    for i, stream in enumerate(spec.streams):
        names = fields[i] if fields and isinstance(fields[0], list) else fields
        streams[stream] = source.framings[i], names, source.pixels(i)
    return Episode(
        log,
        name,
        spec,
        first=source.first_frame,
        count=source.frames,
        ranges=tuple(map(tuple, source._ranges)) if source.gaps else (),
        many=format == "dataset",
        identity=EpisodeIdentity(source, lambda: reopen(log)),
        scene=source.scene().get("scene", ""),
        stated=stated,
        turns=source.turns,
        streams=streams,
    )


def are_alike(spec: SourceSpec, first: SourceSpec) -> bool:
    """Return whether logs can be episodes of one source."""
    kinds = [(one.every_kind, one.truth, one.streams if one.kinds else ()) for one in (spec, first)]
    return kinds[0] == kinds[1] and abs(spec.fps / first.fps - 1) <= UNEVEN
