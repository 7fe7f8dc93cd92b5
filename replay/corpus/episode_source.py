"""Many logs as one source of frames: each log is an episode, with a gap between episodes."""

from __future__ import annotations

import bisect
import contextlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, Final, TypeVar

from cdmisfa.core.blocks import Block, SourceSpec
from cdmisfa.core.errors import CdmisfaError, LogDamagedError, UsageError
from cdmisfa.core.names import counted, kind_of_frames
from recorder.images.options import InputOptions
from replay.corpus.episode import (
    Episode,
    Log,
    are_alike,
    by_numbers,
    episode_of,
    relative_names,
    sampled,
)
from replay.logs.source import LoggedSource
from replay.open_sources import open_log
from replay.storage.identity import Identity
from replay.stored_source import PAUSE, Span, StoredSource

# Largest number of warnings of one kind that are printed; the others are only counted, so that a
# folder with many damaged logs does not flood the terminal.
MOST_LINES: Final = 5

# Largest number of episodes of one source, because the files of a run list every episode.
MOST_EPISODES: Final = 20_000

# Keys of a source's description that state how images become frames. They are the same for all
# logs, so that `described` copies them from the first one.
_STATED: Final = ("recipe", "size", "fit", "color", "range_metres", "range", "time", "stamp")

Taken = TypeVar("Taken")

# Called with the number of opened logs and the total.
Progress = Callable[[float, float | None], None]


class EpisodeSource(StoredSource):
    """Source that reads logs one after the other, ordered by start time, then by path.

    Streams of the same name form one stream. Between two logs is a gap of `PAUSE` frames; a log
    that lacks a stream is a gap of that stream. Only one log is open at a time.

    Attributes:
        left_out: a line for each log that cannot be read completely.
        framings: for each stream how an image becomes a frame, or None.
        changes: for each stream the first line that states how its images changed.
        turns: frames that are lost when a head turns to another stream; see `turn_to`.
    """

    gaps = to_judge = True
    more = "add more logs, or "

    def __init__(
        self,
        logs: Sequence[Log],
        inputs: InputOptions | None = None,
        *,
        loop: bool = False,
        skip_damaged: bool = False,
        progress: Progress = lambda done, total: None,
    ) -> None:
        """Open every log once, for its frames and its identity.

        Args:
            logs: the files of each log.
            inputs: how images of external logs become frames.
            loop: True to start again at the end.
            skip_damaged: skip damaged parts of a log; else the rest of the log is left out.
            progress: called with the number of opened logs and the total.

        Raises:
            UsageError: no log has frames.
            LogDamagedError: no log can be read.
        """
        if inputs is not None and inputs.color == "auto":
            raise UsageError(
                "--color auto needs a single log: use --color on or --color off for several"
            )
        if len(logs) > MOST_EPISODES:
            raise UsageError(
                f"{len(logs):,} logs are too many for one run: choose at most {MOST_EPISODES:,}"
            )
        self._inputs, self._loop, self._skip_damaged = inputs, loop, skip_damaged
        self._open_now: tuple[int, LoggedSource] | None = None
        self._reading = 0, 0
        self._lost: list[str] = []
        self.changes: dict[str, str] = {}
        episodes: list[Episode] = []
        errors: list[CdmisfaError] = []
        warnings: list[str] = []
        self._folder, names = relative_names(logs)
        order = sorted(zip(names, logs, strict=True), key=lambda named: by_numbers(named[0]))
        for done, (name, log) in enumerate(order, 1):
            try:
                with contextlib.closing(self._open(log)) as source:
                    episodes.append(episode_of(log, name, source, self._open))
                    warnings.extend(source.warnings)
            except CdmisfaError as error:
                errors.append(error)
            progress(done, len(logs))
        if not episodes:
            raise errors[0]
        episodes.sort(key=lambda episode: episode.spec.start_ns)
        damaged, unfit = list[str](), list[str]()
        for reason in errors:
            lines = damaged if isinstance(reason, LogDamagedError) else unfit
            lines.append(f"{reason}: this log is skipped")
        unfit += self._set_clock(episodes)
        self.left_out = tuple(damaged)
        self.warnings = tuple(line for lines in (damaged, unfit, warnings) for line in _few(lines))

    def _set_clock(self, episodes: Sequence[Episode]) -> Iterator[str]:
        """Put logs with the frame shape, type and rate of the first log on one clock.

        Yields:
            A warning for each other log, which is skipped.
        """
        first = episodes[0]
        alike = [episode for episode in episodes if are_alike(episode.spec, first.spec)]
        streams: dict[str, tuple[Any, list[str], str]] = {}
        end = 0
        for episode in alike:
            streams = {**episode.streams, **streams}
            episode.start, end = end, end + episode.count + PAUSE
        self._episodes = alike
        self._starts = [episode.start for episode in alike]
        self.frames = end if self._loop else end - PAUSE
        names = tuple(dict.fromkeys(name for episode in alike for name in episode.spec.streams))
        length = None if self._loop else self.frames
        self._spec = replace(first.spec, streams=names, length=length)
        self.framings = [streams[name][0] for name in names]
        self._fields = [streams[name][1] for name in names]
        self._pixels = [streams[name][2] for name in names]
        self.turns = first.turns if len(first.turns) == len(names) else ()
        ends = f"{first.name} to {alike[-1].name}" if len(alike) > 1 else first.name
        order = "ordered by start time, then by path"
        self.notes = (f"{counted(len(alike), 'episode')}, {order}: {ends}",)
        for episode in episodes:
            if not are_alike(episode.spec, first.spec):
                images = episode.spec.images and first.spec.images
                yield (
                    f"{episode.name} is skipped: it has {_described(episode.spec)}, but the first "
                    f"log, {first.name}, has {_described(first.spec)}"
                    f"{': --size and --rate make logs alike' if images else ''}"
                )

    def pixels(self, stream: int) -> str:
        """See `LoggedSource`."""
        return self._pixels[stream]

    def skipped_damage(self) -> list[str]:
        """Return a warning for each damaged log, whose frames are skipped from the damage on."""
        return list(_few(self._lost))

    def hold_out(self, count: int) -> None:
        """Hold out the last episodes that fit into `count` frames, or else the last frames."""
        first = bisect.bisect_left(self._starts, self.frames - count)
        whole = first < len(self._starts)
        super().hold_out(self.frames - self._starts[first] if whole else count)

    def episode(self, stream: int, t: int) -> Span:
        """Return the frames [start, stop) of the log, or dataset episode, that contains frame t."""
        t %= self.lap
        episode = self._episodes[bisect.bisect_right(self._starts, t) - 1]
        if episode.many:
            spans = episode.spans(self._spec.streams[stream])
            return next(span for span in spans if span[0] <= t < span[1])
        return episode.start, episode.start + episode.count

    def take(self, stream: int, n: int) -> Block:
        """See `StoredSource.take`; damaged parts are skipped."""
        return self._whole(super().take, stream, n)

    def take_all(self, n: int) -> tuple[Block, ...]:
        """See `StoredSource.take_all`; damaged parts are skipped."""
        return self._whole(super().take_all, n)

    def _whole(self, take: Callable[..., Taken], *request: int) -> Taken:
        """Take frames; on damage skip the rest of that log and try again."""
        while True:
            try:
                return take(*request)
            except LogDamagedError as error:
                self._leave_out(error)

    def pieces(self, stream: int, start: int, stop: int, n: int) -> Iterator[Block]:
        """See `StoredSource.pieces`; damaged parts are skipped."""
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
            for stream, change in source.changes.items():
                self.changes.setdefault(self._episodes[number].spec.streams[stream], change)
            source.close()
            self._open_now = None

    def _spans(self, stream: int, lap: int, start: int, stop: int) -> Iterable[Span]:
        for episode in self._episodes[max(bisect.bisect_right(self._starts, start) - 1, 0) :]:
            if episode.start >= stop:
                return
            for low, high in episode.spans(self._spec.streams[stream], lap):
                if max(low, start) < min(high, stop):
                    yield max(low, start), min(high, stop)

    def _block(self, stream: int, t: int, n: int) -> Block:
        place = t % self.lap
        number = bisect.bisect_right(self._starts, place) - 1
        self._reading = number, t
        episode, source = self._episodes[number], self._log(number)
        source.seek(place - episode.start + episode.first)
        block = source.take(episode.spec.streams.index(self._spec.streams[stream]), n)
        return replace(block, stream=stream, t=t)

    def _log(self, number: int) -> LoggedSource:
        """Return a log; open it and close the previous one if it is not open yet.

        Raises:
            LogDamagedError: the log can no longer be opened, or has changed.
        """
        if self._open_now is None or self._open_now[0] != number:
            self.close()
            episode = self._episodes[number]
            try:
                source = self._open(episode.log)
            except UsageError as error:
                raise LogDamagedError(str(error)) from None
            if sampled(source) != episode.identity.sampled:
                source.close()
                raise LogDamagedError(
                    f"{episode.name}: the file has changed since it was opened; start again"
                )
            self._open_now = number, source
        return self._open_now[1]

    def _open(self, log: Log) -> LoggedSource:
        return open_log(log, self._inputs, skip_damaged=self._skip_damaged)

    def _leave_out(self, error: LogDamagedError) -> None:
        """Skip a damaged log from the current block on, to the end of the lap."""
        number, t = self._reading
        episode = self._episodes[number]
        lap, place = divmod(t, self.lap)
        whole = 0 if self.centre == "episode" else place - episode.start
        episode.whole[lap] = whole
        rest = "the rest of this log is" if whole else "this log is"
        line = f"{error}: {rest} skipped"
        if line not in self._lost:
            self._lost.append(line)
            self.left_out = (*self.left_out, line)

    def _logs(self) -> Sequence[Identity]:
        return [episode.identity for episode in self._episodes]

    def scene(self) -> Mapping[str, str]:
        """Return the scene that was recorded, if it is the same in all logs."""
        scenes = {episode.scene for episode in self._episodes}
        return {"scene": scenes.pop()} if len(scenes) == 1 and scenes != {""} else {}

    def described(self, logs: Sequence[Mapping[str, Any]]) -> Mapping[str, Any]:
        """Return the description of the source: its logs with the frames [start, stop) of each."""
        files = [
            {"file": episode.name, "frames": [episode.start, episode.start + episode.count], **log}
            for episode, log in zip(self._episodes, logs, strict=True)
        ]
        stated = self._episodes[0].stated
        return {
            "kind": "episodes",
            **self.scene(),
            **{key: stated[key] for key in _STATED if key in stated},
            **({"fields": self._fields} if any(self._fields) else {}),
            "rate": self._spec.fps,
            "files": files,
            **({"held_out": self.held_out} if self.held_out else {}),
            "loop": self._loop,
        }

    def _name(self) -> str:
        return self._folder or str(self._episodes[0].log[0])


def _described(spec: SourceSpec) -> str:
    """Return kind, rate and ground truth of the frames of a log as text."""
    truth = f" with ground truth {', '.join(spec.truth)}" if spec.truth else ""
    frames = " and ".join(kind_of_frames(shape) for shape, _ in spec.every_kind)
    return f"{frames} at {spec.fps:g} Hz{truth}"


def _few(lines: Sequence[str]) -> Sequence[str]:
    """Return the first `MOST_LINES` lines and the number of further ones."""
    more = len(lines) - MOST_LINES
    return [*lines[:MOST_LINES], *([f"and {more} more like these"] if more > 0 else [])]
