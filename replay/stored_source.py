"""Base class of sources with stored frames: recordings and external logs, with or without gaps."""

from __future__ import annotations

import bisect
from abc import abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, Final

from numpy.typing import NDArray

from cdmisfa.core.arrays import centred, mean_of
from cdmisfa.core.blocks import Block, ClockedSource, FrameSource, check_request, freeze, one_block
from cdmisfa.core.errors import LogExhaustedError, UsageError
from recorder.images.options import Centre
from replay.storage.identity import Identity

# The frames [start, stop).
Span = tuple[int, int]

# Frames that are read at a time for the mean of an episode, to bound the memory.
PIECE: Final = 64

# Logs with up to this many bytes are hashed when they are opened; larger ones after the run.
AT_ONCE: Final = 64 * 1024 * 1024

# Length in frames of the gap between two episodes, whose times a dataset does not state, and
# between two passes over a log.
PAUSE: Final = 20

# Called with the number of hashed bytes and the total.
HashProgress = Callable[[int, int], None]


class StoredSource(ClockedSource):
    """A source of stored frames: all of them once, several times, or looped without end.

    A derived class sets `_spec`, `_loop`, `frames`, `gaps` and, with gaps, `_ranges`.

    Attributes:
        frames: number of frames of every stream, including gaps.
        first_frame: number of the first frame.
        centre: "episode": frames are shown without the mean of their episode; see `episode`.
        held_out: frames at the end that `take` does not return; see `hold_out`.
        passes: number of times that `take` returns the frames; see `repeat`.
        more: a remedy, beside looping, for too few frames.
        to_judge: whether the last frames are held out by default; see `hold_out`.
        recorded: whether it is a recording of ours.
        left_out: a line for each log that could not be read and was left out.
        notes: a line for each choice that was made by default.
        warnings: a line for each thing that the user should know.
    """

    frames: int
    first_frame: int = 0
    centre: Centre = "run"
    held_out: int = 0
    passes: int = 1
    more: str = ""
    to_judge: bool = False
    recorded: bool = False
    left_out: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    _loop: bool
    # The frames of the first lap that each stream has.
    _ranges: Sequence[Sequence[Span]]
    _means: dict[int, tuple[Span, NDArray[Any]]] | None = None
    _identities: Sequence[Identity] | None = None

    @property
    def end(self) -> int:
        """The frame after the last that `take` returns, of the first pass."""
        return self.first_frame + self.frames - self.held_out

    @property
    def lap(self) -> int:
        """Number of frames from the beginning of a pass to that of the next.

        Between two passes is a gap, except in a loop.
        """
        return self.frames + (PAUSE if self.passes > 1 else 0)

    @property
    def passes_begun(self) -> int:
        """Number of passes over the frames that have begun."""
        return max(self._t - self.first_frame - 1, 0) // self.lap + 1

    @property
    def last(self) -> int:
        """The frame after the last that `take` returns, of all passes."""
        return self.end + (self.passes - 1) * self.lap

    def repeat(self, passes: int) -> None:
        """Return the frames this number of times, unless they loop; call it after `hold_out`."""
        if not self._loop:
            self.passes = passes
            self._spec = replace(self._spec, length=self.last - self.first_frame)

    def hold_out(self, count: int) -> None:
        """Keep the last frames from `take`: modules are judged on them, see `pieces`.

        Raises:
            UsageError: the source loops, or no frame would be left.
        """
        if self._loop or not 0 <= count < self.frames:
            raise UsageError(f"{self._name()}: {count} of {self.frames} frames cannot be held out")
        self.held_out = count
        self._spec = replace(self._spec, length=self.frames - count)

    def pieces(self, stream: int, start: int, stop: int, n: int) -> Iterator[Block]:
        """Yield the frames [start, stop) of a stream in blocks of n or fewer; the clock stays.

        Held-out frames are among them.

        Raises:
            LogDamagedError: the log is damaged.
        """
        for low, high in self.spans(stream, start, stop):
            for t in range(low, high, n):
                yield self._centred(stream, t, min(n, high - t))

    def take(self, stream: int, n: int) -> Block:
        """Return the frames of a stream at t .. t+n-1, and move t by n.

        With gaps the next n frames that follow one another; moves t behind them.

        Raises:
            LogExhaustedError: fewer than n frames are left; t stays.
            LogDamagedError: the log is damaged; t stays.
            ValueError: no such stream, or n < 1.
        """
        check_request(self._spec, stream, n)
        block = self._centred(stream, self._unbroken(stream, n), n)
        self._t = block.t + n
        return block

    def take_all(self, n: int) -> tuple[Block, ...]:
        """Return the next n frames of every stream, a block for each unbroken stretch.

        Raises:
            LogExhaustedError: fewer than n frames are left; t stays.
            LogDamagedError: the log is damaged; t stays.
            ValueError: n < 1.
        """
        check_request(self._spec, 0, n)
        stop = self._t + n
        if not self._loop and stop > self.last:
            raise self._exhausted(n, self.end - self.first_frame)
        blocks = tuple(
            self._centred(stream, low, high - low)
            for stream in range(len(self._spec.streams))
            for low, high in self._in_passes(stream, self._t, stop, self.frames - self.held_out)
        )
        self._t = stop
        return blocks

    def spans(self, stream: int, start: int, stop: int) -> list[Span]:
        """Return the unbroken stretches [low, high) of a stream within the frames [start, stop)."""
        return [*self._in_passes(stream, start, stop, self.frames)]

    def _in_passes(self, stream: int, start: int, stop: int, frames: int) -> Iterator[Span]:
        """Yield the unbroken stretches in the first `frames` frames of each pass; see `spans`."""
        first, low, high = self.first_frame, start, start
        laps = (stop - 1 - first) // self.lap + 1
        for number in range((start - first) // self.lap, laps if self._loop else self.passes):
            by = number * self.lap
            if stop <= first + by:
                break
            span = max(start - by, first), min(stop - by, first + frames)
            for begin, end in self._spans(stream, number, *span):
                if begin + by != high:  # else a loop, which continues without a gap
                    if low < high:
                        yield low, high
                    low = begin + by
                high = end + by
        if low < high:
            yield low, high

    def _spans(self, stream: int, lap: int, start: int, stop: int) -> Iterable[Span]:
        """Return the unbroken stretches in a part of a lap, by the frames of the first one."""
        ranges = self._ranges[stream] if self.gaps else [(start, stop)]
        clipped = ((max(low, start), min(high, stop)) for low, high in ranges)
        return [(low, high) for low, high in clipped if low < high]

    def episode(self, stream: int, t: int) -> Span:
        """Return the episode [start, stop) of a frame, in the first lap.

        In a log without episodes of its own it is the stretch between two gaps.

        Args:
            stream: the stream whose gaps count.
            t: a frame that the stream has, of any lap.
        """
        if not self.gaps:
            return self.first_frame, self.first_frame + self.frames
        ranges, t = self._ranges[stream], self.first_frame + (t - self.first_frame) % self.lap
        return ranges[bisect.bisect_right(ranges, t, key=lambda span: span[0]) - 1]

    def seek(self, t: int) -> None:
        """Move the clock to frame t.

        Raises:
            LogExhaustedError: the source ends before frame t.
            ValueError: t is before the first frame.
        """
        if t < self.first_frame:
            raise ValueError(f"frame {t} lies before the first, {self.first_frame}")
        if not self._loop and t > self.last:
            raise LogExhaustedError(
                f"{self._name()}: it ends at frame {self.last}, before frame {t}; read it more "
                "often with --passes"
            )
        self._t = t

    def pixels(self, stream: int) -> str:
        """Return the format of pixels that a stream's messages state, "" if they state none."""
        return ""

    def scene(self) -> Mapping[str, str]:
        """Return the recorded scene, its seed and configuration, if the logs state them."""
        return {}

    def origin(self) -> Mapping[str, Any]:
        """Return the description of the recorded source; empty for scenes and external logs."""
        return {}

    def skipped_damage(self) -> list[str]:
        """Return a line for each stream with damaged parts that were replaced or skipped so far."""
        return []

    def describe(self, progress: HashProgress = lambda done, size: None) -> Mapping[str, Any]:
        """Return the logs with the SHA-256 of all their bytes, and how they became frames.

        Args:
            progress: called with the number of hashed bytes and the total, if there are many.

        Raises:
            LogDamagedError: a log is damaged, or was changed since it was opened.
        """
        logs = self.identities()
        size, done = sum(log.size for log in logs), 0

        def counted(count: int) -> None:
            nonlocal done
            done += count
            if size > AT_ONCE:
                progress(done, size)

        return self._with_centre([log.whole(counted) for log in logs])

    def describe_at_once(self) -> Mapping[str, Any]:
        """See `cdmisfa.core.blocks.LongSource`."""
        logs = self.identities()
        if sum(log.size for log in logs) <= AT_ONCE:
            return self.describe()
        return self._with_centre([log.sample() for log in logs])

    def identities(self) -> Sequence[Identity]:
        """Return the identity of each log that the source is read from."""
        if self._identities is None:
            self._identities = self._logs()
        return self._identities

    def _with_centre(self, logs: Sequence[Mapping[str, Any]]) -> Mapping[str, Any]:
        described = dict(self.described(logs))
        if self.passes > 1:
            described["passes"] = self.passes
        return described if self.centre == "run" else {**described, "centre": self.centre}

    @abstractmethod
    def _logs(self) -> Sequence[Identity]:
        """Return the identity of each log that the source is read from, made now."""

    @abstractmethod
    def described(self, logs: Sequence[Mapping[str, Any]]) -> Mapping[str, Any]:
        """Return the description of the source, with the hash of each log."""

    @abstractmethod
    def _block(self, stream: int, t: int, n: int) -> Block:
        """Read the frames [t, t + n) of a stream, all of one lap and none of a gap."""

    @abstractmethod
    def _name(self) -> str:
        """Return the name of the source in errors."""

    def _centred(self, stream: int, t: int, n: int) -> Block:
        """Read frames of any laps; without the mean of their episode if they are centred so."""
        parts, at = list[Block](), t
        while at < t + n:  # an episode ends where a lap does
            left = self.frames - (at - self.first_frame) % self.lap
            block = self._block(stream, at, min(t + n - at, left))
            if self.centre != "run":
                frames = centred(block.frames, self._mean(stream, at))
                block = replace(block, frames=freeze(frames))
            parts.append(block)
            at += len(block)
        return one_block(parts)

    def _mean(self, stream: int, t: int) -> NDArray[Any]:
        """Return the mean of the episode of a frame, for which all of it is read."""
        self._means = self._means or {}
        span, lap = self.episode(stream, t), (t - self.first_frame) // self.lap * self.lap
        known = self._means.get(stream)
        if known is None or known[0] != span:
            pieces = (
                self._block(stream, at, min(PIECE, high - at)).frames
                for low, high in self.spans(stream, span[0] + lap, span[1] + lap)
                for at in range(low, high, PIECE)
            )
            self._means[stream] = known = span, mean_of(pieces)
        return known[1]

    def _unbroken(self, stream: int, n: int) -> int:
        """Return the first of the next n frames of a stream that follow one another."""
        # Looping, a stretch that holds them is in the rest of this lap or in the next two.
        end = self._t + 3 * self.frames + n if self._loop else self.last
        for low, high in self._in_passes(stream, self._t, end, self.frames - self.held_out):
            if high - low >= n:
                return low
        spans = self._in_passes(stream, self.first_frame, self.end, self.frames - self.held_out)
        raise self._exhausted(n, max((high - low for low, high in spans), default=0))

    def _exhausted(self, n: int, longest: int) -> LogExhaustedError:
        """Return the error for too few frames; the longest stretch of a pass has `longest`."""
        reserved = f", before {self.held_out} held-out frames" if self.held_out else ""
        if longest < n and self.gaps:
            return LogExhaustedError(
                f"{self._name()}: a block has {n} frames, but the longest part without a gap has "
                f"{longest}{reserved}; {self.more}set a smaller learner.tau"
            )
        if self.passes > 1 and self.passes_begun > 1:
            return LogExhaustedError(f"{self._name()} was read {self.passes} times")
        left = max(self.end - self._t, 0)
        remedy = "read it more often with --passes" if longest >= n else "repeat it with --loop"
        return LogExhaustedError(
            f"{self._name()}: {left} frames are left at frame {self._t}{reserved}, but a block "
            f"has {n}{' without a gap' if self.gaps else ''}; {self.more}{remedy}"
        )


def centre_as(centre: Centre, source: FrameSource, name: str) -> FrameSource:
    """Return a source with frames as modules learned from them; see `StoredSource`.

    Raises:
        UsageError: the source is live, so that its episodes have no mean yet; it is closed.
    """
    if isinstance(source, StoredSource):
        source.centre = centre
    elif centre == "episode":
        source.close()
        raise UsageError(
            f"{name} is live: the modules need the mean of each episode, which is unknown until "
            "the episode ends; record it first"
        )
    return source


def outside(gaps: Iterable[Span], first: int, stop: int) -> list[Span]:
    """Return the spans of the frames [first, stop) between gaps, which are in their order."""
    ends = [first, *(end for gap in gaps for end in gap), stop]
    return [(low, high) for low, high in zip(ends[::2], ends[1::2], strict=True) if low < high]


def merged(spans: Iterable[Span]) -> list[Span]:
    """Merge ranges that touch, given in their order, and leave out empty ones."""
    result: list[Span] = []
    for start, stop in spans:
        if start < stop:
            touches = result and result[-1][1] == start
            result.append((result.pop()[0], stop) if touches else (start, stop))
    return result
