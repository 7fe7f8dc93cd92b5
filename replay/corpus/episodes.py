"""Many logs as one source: each is an episode, and between two of them is a gap."""

from __future__ import annotations

import bisect
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, Literal

from cdmisfa.core.blocks import Block, SourceSpec
from cdmisfa.core.errors import LogDamagedError, UsageError
from cdmisfa.core.names import counted
from recorder.images.options import InputOptions
from replay.corpus.logs import (
    Episode,
    Found,
    Log,
    Told,
    find_episodes,
    kind_of,
    logs_of_corpus,
    sampled,
)
from replay.inputs import open_log
from replay.logs.clock import UNEVEN
from replay.logs.formats.lerobot import PAUSE
from replay.logs.source import LoggedSource
from replay.storage.identity import Identity
from replay.stored import Span, StoredSource

SAID: Final = 5
"""Lines of a kind, as of logs that are left out, that are said."""

MOST: Final = 20_000
"""Episodes of one source: so many are listed in the files of a run."""

_STATED: Final = ("recipe", "size", "fit", "color", "range_metres", "range", "time", "stamp")
"""What logs state of how images became frames, the same of all."""


def open_episodes(
    words: Sequence[str | Path],
    paths: Sequence[Path] | Literal[False],
    inputs: InputOptions | None = None,
    **how: Any,
) -> EpisodeSource | None:
    """Open the logs of an index, or each path by itself, as episodes.

    Args:
        words: what was named.
        paths: what the words stand for, where each is an episode whatever it is.
        inputs: see `EpisodeSource`.
        how: see there.

    Returns:
        None where the words name no index and no paths are given.

    Raises:
        UsageError: an index holds no logs, or as for `EpisodeSource`.
        LogDamagedError: the same.
    """
    logs = logs_of_corpus(words) or ([[path] for path in paths] if paths else None)
    return None if logs is None else EpisodeSource(logs, inputs, **how)


class EpisodeSource(StoredSource):
    """Logs one after the other, by when each begins and then by their paths.

    Streams of the same name are one. What lies between two logs is a gap, `PAUSE` frames of the
    clock, and so is all of a log to a stream that it lacks. One log is open at a time.

    Attributes:
        left_out: a line for each log that cannot be read, or not to its end.
        framings: for each stream how an image becomes a frame, None where that is not said.
        changes: for each stream the first line that says how its images changed.
        turns: see `turn_to`.
    """

    gaps = to_judge = True
    more = "name more logs, or "

    def __init__(
        self,
        logs: Sequence[Log],
        inputs: InputOptions | None = None,
        *,
        loop: bool = False,
        salvage: bool = False,
        told: Told = lambda done, total: None,
    ) -> None:
        """Open every log once, for its frames and what identifies it.

        Args:
            logs: what is opened as one, each.
            inputs: how images of others become frames.
            loop: begin again at the end.
            salvage: pass over what is damaged of a log; else what follows in it is left out.
            told: how many of the logs were opened.

        Raises:
            UsageError: none of them shows frames.
            LogDamagedError: nor can any be read.
        """
        if inputs is not None and inputs.color == "auto":
            raise UsageError("--color auto looks at one log: say --color or not, for all episodes")
        if len(logs) > MOST:
            raise UsageError(
                f"{len(logs):,} logs are more episodes than one run lists, {MOST:,}: index fewer"
            )
        self._inputs, self._loop, self._salvage = inputs, loop, salvage
        self._open_now: tuple[int, LoggedSource] | None = None
        self._reading = 0, 0
        self._lost: list[str] = []
        self.changes: dict[str, str] = {}
        self._set_clock(find_episodes(logs, self._opened, told))

    def _set_clock(self, found: Found) -> None:
        """Put the logs that show what the first one does on one clock."""
        first = found.episodes[0]
        one, kind = first.spec, found.kinds[kind_of(first.spec)]
        alike: list[Episode] = []
        others: list[str] = []
        for episode in found.episodes:
            said = [_said(spec) for spec in (episode.spec, one)]
            if kind_of(episode.spec) == kind_of(one) and (
                abs(episode.spec.fps / one.fps - 1) <= UNEVEN
            ):
                alike.append(episode)
            else:
                others.append(
                    f"{episode.name} has {said[0]}, {first.name}, the first, {said[1]}: it is left "
                    "out; --size and --rate make logs alike"
                )
        self._episodes, self._kind, self._folder = alike, kind, found.folder
        self.left_out = tuple(found.damaged)
        lines = found.damaged, [*found.unfit, *others], found.warnings
        self.warnings = tuple(line for some in lines for line in _few(some))
        names = dict.fromkeys(stream for episode in alike for stream in episode.spec.streams)
        about = [kind.streams[name] for name in names]
        self.framings = [framing for framing, _, _ in about]
        self._fields, self._pixels = [own for _, own, _ in about], [own for _, _, own in about]
        self.turns = kind.turns if len(kind.turns) == len(names) else ()
        end = 0
        for episode in alike:
            episode.start, end = end, end + episode.count + PAUSE
        self._starts = [episode.start for episode in alike]
        self.frames = end if self._loop else end - PAUSE
        length = None if self._loop else self.frames
        self._spec = replace(one, streams=tuple(names), length=length)
        order = "by when each begins, then by its path"
        ends = f"{alike[0].name} to {alike[-1].name}" if len(alike) > 1 else alike[0].name
        self.notes = (f"{counted(len(alike), 'episode')}, {order}: {ends}",)

    def pixels(self, stream: int) -> str:
        """See `LoggedSource`."""
        return self._pixels[stream]

    def salvaged(self) -> list[str]:
        """Lines for the logs that turned out to be damaged, and were left out from there on."""
        return list(_few(self._lost))

    def hold_out(self, count: int) -> None:
        """Keep the last episodes from `take` that lie within so many frames, or else these."""
        first = bisect.bisect_left(self._starts, self.frames - count)
        whole = first < len(self._starts)
        super().hold_out(self.frames - self._starts[first] if whole else count)

    def episode(self, stream: int, t: int) -> Span:
        """The log [start, stop) that a frame is of, or the episode of a dataset."""
        t %= self.frames
        one = self._episodes[bisect.bisect_right(self._starts, t) - 1]
        if one.many:
            spans = one.spans(self._spec.streams[stream])
            return next(span for span in spans if span[0] <= t < span[1])
        return one.start, one.start + one.count

    def take(self, stream: int, n: int) -> Block:
        """See `StoredSource.take`; what is damaged is left out."""
        while True:
            try:
                return super().take(stream, n)
            except LogDamagedError as error:
                self._leave_out(error)

    def take_all(self, n: int) -> tuple[Block, ...]:
        """See `StoredSource.take_all`; what is damaged is left out."""
        while True:
            try:
                return super().take_all(n)
            except LogDamagedError as error:
                self._leave_out(error)

    def pieces(self, stream: int, start: int, stop: int, n: int) -> Iterator[Block]:
        """See `StoredSource.pieces`; what is damaged is left out."""
        for low, high in self.spans(stream, start, stop):
            for t in range(low, high, n):
                try:
                    yield self._centred(stream, t, min(n, high - t))
                except LogDamagedError as error:
                    self._leave_out(error)
                    break

    def close(self) -> None:
        """See `FrameSource.close`."""
        if self._open_now is not None:
            number, source = self._open_now
            for stream, said in getattr(source, "changes", {}).items():
                self.changes.setdefault(self._episodes[number].spec.streams[stream], said)
            source.close()
            self._open_now = None

    def _spans(self, stream: int, start: int, stop: int) -> Iterable[Span]:
        name = self._spec.streams[stream]
        lap, at = divmod(start, self.frames)
        number = max(bisect.bisect_right(self._starts, at) - 1, 0)
        while True:
            for i in range(number, len(self._episodes)):
                episode = self._episodes[i]
                if lap * self.frames + episode.start >= stop:
                    return
                for low, high in episode.spans(name):
                    low, high = low + lap * self.frames, high + lap * self.frames
                    if max(low, start) < min(high, stop):
                        yield max(low, start), min(high, stop)
            if not self._loop:
                return
            lap, number = lap + 1, 0

    def _block(self, stream: int, t: int, n: int) -> Block:
        place = t % self.frames
        number = bisect.bisect_right(self._starts, place) - 1
        self._reading = number, place
        one, source = self._episodes[number], self._log(number)
        source.seek(place - one.start + one.first)
        block = source.take(one.spec.streams.index(self._spec.streams[stream]), n)
        return replace(block, stream=stream, t=t)

    def _log(self, number: int) -> LoggedSource:
        """A log, open, and no other one.

        Raises:
            LogDamagedError: it cannot be opened any more, or shows something else.
        """
        if self._open_now is None or self._open_now[0] != number:
            self.close()
            one = self._episodes[number]
            try:
                source = self._opened(one.log)
            except UsageError as error:
                raise LogDamagedError(str(error)) from None
            if sampled(source) != one.identity.sampled:
                source.close()
                raise LogDamagedError(f"{one.name}: it was changed since it was first opened")
            self._open_now = number, source
        return self._open_now[1]

    def _opened(self, log: Log) -> LoggedSource:
        return open_log(log, self._inputs, salvage=self._salvage)

    def _leave_out(self, error: LogDamagedError) -> None:
        """Leave out a log that is damaged, from the block that was read on."""
        number, t = self._reading
        one = self._episodes[number]
        one.whole = 0 if self.centre == "episode" else min(t - one.start, one.whole)
        rest = "what follows in it is" if one.whole else "the log is"
        self._lost.append(f"{error}: {rest} left out")
        self.left_out = (*self.left_out, self._lost[-1])

    def _logs(self) -> Sequence[Identity]:
        return [episode.identity for episode in self._episodes]

    def scene(self) -> Mapping[str, str]:
        """What was recorded, where that is one thing."""
        one = self._kind.scenes
        return {"scene": next(iter(one))} if len(one) == 1 and one != {""} else {}

    def described(self, logs: Sequence[Mapping[str, Any]]) -> Mapping[str, Any]:
        """The logs in their order with the frames [start, stop) of each."""
        files = [
            {
                "file": episode.name,
                "frames": [episode.start, episode.start + episode.count],
                **log,
            }
            for episode, log in zip(self._episodes, logs, strict=True)
        ]
        return {
            "kind": "episodes",
            **self.scene(),
            **{key: self._kind.stated[key] for key in _STATED if key in self._kind.stated},
            **({"fields": self._fields} if any(self._fields) else {}),
            "rate": self._spec.fps,
            "files": files,
            **({"held_out": self.held_out} if self.held_out else {}),
            "loop": self._loop,
        }

    def _name(self) -> str:
        return self._folder or str(self._episodes[0].log[0])


def _said(spec: SourceSpec) -> str:
    """What the frames of a log are, in words."""
    return f"frames of {'x'.join(map(str, spec.frame_shape))} {spec.dtype} at {spec.fps:g} Hz"


def _few(lines: Sequence[str]) -> Sequence[str]:
    """The first lines, and how many more there are."""
    more = len(lines) - SAID
    return [*lines[:SAID], *([f"and {more} more, alike"] if more > 0 else [])]
