"""Frames that are kept, in a recording or in logs of others: so many, with gaps or without."""

from __future__ import annotations

import bisect
from abc import abstractmethod
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any, ClassVar, get_args

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.arrays import centred, mean_of
from cdmisfa.core.blocks import Block, ClockedSource, FrameSource, check_request, freeze
from cdmisfa.core.errors import LogExhaustedError, UsageError
from recorder.images.options import Centre

Span = tuple[int, int]
"""The frames [start, stop)."""

PIECE = 64
"""Frames of an episode that are held at once while its mean is taken."""


class StoredSource(ClockedSource):
    """A source of frames that are kept: all of them once, or looped, lap after lap.

    A class that derives from it sets `_spec`, `gaps` and, with gaps, `_held`, and has `describe`.

    Attributes:
        centre: what every frame is shown without: "episode", the mean of its episode; see
            `episode`.
        held_out: frames at the end that `take` does not give; see `hold_out`.
        more: what else than to begin again can be done where there are too few frames, in words.
    """

    centre: Centre = "run"
    held_out: int = 0
    more: ClassVar[str] = ""
    _loop: bool
    _first: int = 0
    _count: int
    _held: Sequence[Sequence[Span]]
    """The frames that each stream has of the first lap."""
    _means: dict[int, tuple[Span, NDArray[Any]]] | None = None

    @property
    def frames(self) -> int:
        """How many there are of every stream, those of gaps included."""
        return self._count

    @property
    def first_frame(self) -> int:
        """Number of the first frame."""
        return self._first

    @property
    def end(self) -> int:
        """The frame after the last that `take` gives, of the first lap."""
        return self._first + self._count - self.held_out

    def centre_by(self, centre: Centre) -> None:
        """Show every frame as it is, or without the mean of its episode.

        Raises:
            UsageError: there is no such way.
        """
        if centre not in get_args(Centre):
            raise UsageError(f"centre is {centre!r}: give {' or '.join(get_args(Centre))}")
        self.centre = centre

    def hold_out(self, count: int) -> None:
        """Keep the last frames from `take`: what is learned is judged on them, see `pieces`.

        Raises:
            UsageError: it loops, or no frame would be left.
        """
        if self._loop or not 0 <= count < self._count:
            raise UsageError(f"{self._name()}: no {count} frames of {self._count} can be held out")
        self.held_out = count
        self._spec = replace(self._spec, length=self._count - count)

    def pieces(self, stream: int, start: int, stop: int, n: int) -> Iterator[Block]:
        """What a stream shows of the frames [start, stop), in blocks of n or fewer.

        Those held out are among them; the clock stays.

        Raises:
            LogDamagedError: what is kept is damaged.
        """
        for low, high in self.spans(stream, start, stop):
            for t in range(low, high, n):
                yield self._centred(stream, t, min(n, high - t))

    def take(self, stream: int, n: int) -> Block:
        """The n frames that a stream shows at t .. t+n-1; moves t by n.

        With gaps the next n that follow one another; moves t behind them.

        Raises:
            LogExhaustedError: fewer than n frames are left; t stays.
            LogDamagedError: what is kept is damaged; t stays.
            ValueError: no such stream, or n < 1.
        """
        check_request(self._spec, stream, n)
        block = self._centred(stream, self._unbroken(stream, n), n)
        self._t = block.t + n
        return block

    def take_all(self, n: int) -> tuple[Block, ...]:
        """What every stream shows in the next n frames, a block for each unbroken stretch.

        Raises:
            LogExhaustedError: fewer than n frames are left; t stays.
            LogDamagedError: what is kept is damaged; t stays.
            ValueError: n < 1.
        """
        check_request(self._spec, 0, n)
        stop = self._t + n
        if not self._loop and stop > self.end:
            raise self._exhausted(n)
        blocks = tuple(
            self._centred(stream, low, high - low)
            for stream in range(len(self._spec.streams))
            for low, high in self.spans(stream, self._t, stop)
        )
        self._t = stop
        return blocks

    def spans(self, stream: int, start: int, stop: int) -> list[Span]:
        """The unbroken stretches [low, high) that a stream shows of the frames [start, stop)."""
        return [*self._spans(stream, start, stop)]

    def _spans(self, stream: int, start: int, stop: int) -> Iterable[Span]:
        """See `spans`."""
        if not self.gaps:
            return [(start, stop)]
        return in_laps(self._held[stream], self._first, self._count, start, stop)

    def episode(self, stream: int, t: int) -> Span:
        """The episode [start, stop) that a frame is of, of the first lap.

        Of what has no episodes of its own that is the stretch between two gaps.

        Args:
            stream: whose gaps count.
            t: a frame that it has, of any lap.
        """
        if not self.gaps:
            return self._first, self._first + self._count
        held, t = self._held[stream], self._first + (t - self._first) % self._count
        return held[bisect.bisect_right(held, t, key=lambda span: span[0]) - 1]

    def seek(self, t: int) -> None:
        """Move the clock to frame t.

        Raises:
            LogExhaustedError: the frames end before it.
            ValueError: t lies before the first frame.
        """
        if t < self._first:
            raise ValueError(f"frame {t} lies before the first, {self._first}")
        end = self.end
        if not self._loop and t > end:
            raise LogExhaustedError(
                f"{self._name()}: it ends at frame {end}, before frame {t}; begin again at its end "
                "with --loop"
            )
        self._t = t

    def _centred(self, stream: int, t: int, n: int) -> Block:
        """See `_block`; without the mean of its episode, where it is centred so."""
        block = self._block(stream, t, n)
        if self.centre == "run":
            return block
        shown, at = [], 0
        while at < n:  # where one lap ends an episode does
            place = (t + at - self._first) % self._count
            count = min(n - at, self._count - place)
            mean = self._mean(stream, self._first + place)
            shown.append(centred(block.frames[at : at + count], mean))
            at += count
        frames = shown[0] if len(shown) == 1 else np.concatenate(shown)
        return replace(block, frames=freeze(frames))

    def _mean(self, stream: int, t: int) -> NDArray[Any]:
        """The mean of the episode of a frame, for which all of it is read."""
        self._means = self._means or {}
        span = self.episode(stream, t)
        known = self._means.get(stream)
        if known is None or known[0] != span:
            pieces = (
                self._block(stream, at, min(PIECE, high - at)).frames
                for low, high in self.spans(stream, *span)
                for at in range(low, high, PIECE)
            )
            self._means[stream] = known = span, mean_of(pieces)
        return known[1]

    @abstractmethod
    def _block(self, stream: int, t: int, n: int) -> Block:
        """The frames [t, t + n) of a stream, none of a gap; their numbers may be of a later lap."""

    @abstractmethod
    def _name(self) -> str:
        """How an error names what is read."""

    def _unbroken(self, stream: int, n: int) -> int:
        """Where the next n frames of a stream begin that follow one another."""
        # Looping, a stretch that holds them is in the rest of this lap or in the next two.
        end = self._t + 3 * self._count + n if self._loop else self.end
        for low, high in self._spans(stream, self._t, end):
            if high - low >= n:
                return low
        raise self._exhausted(n)

    def _exhausted(self, n: int) -> LogExhaustedError:
        left = max(self.end - self._t, 0)
        unbroken = " without a gap" if self.gaps else ""
        held = f", before {self.held_out} held out" if self.held_out else ""
        return LogExhaustedError(
            f"{self._name()}: {left} frames are left at frame {self._t}{held}, {n} are needed"
            f"{unbroken}; {self.more}begin again at its end with --loop"
        )


def centre_as(centre: Centre, source: FrameSource, name: str) -> FrameSource:
    """A source that shows frames as modules learned from them; see `StoredSource.centre_by`.

    Raises:
        UsageError: its episodes are not over, and so have no mean; the source is closed.
    """
    if isinstance(source, StoredSource):
        source.centre_by(centre)
    elif centre == "episode":
        source.close()
        raise UsageError(
            f"{name} is live: the modules learned from frames without the mean of their episode, "
            "which is known when it is over: record it first"
        )
    return source


def merged(spans: Iterable[Span]) -> list[Span]:
    """Ranges in their order, with those that touch merged."""
    found: list[Span] = []
    for start, stop in spans:
        if found and found[-1][1] == start:
            found[-1] = (found[-1][0], stop)
        else:
            found.append((start, stop))
    return found


def outside(gaps: Iterable[Span], count: int) -> list[Span]:
    """The spans of the frames [0, count) that lie between gaps, which are in their order."""
    ends = [0, *(end for gap in gaps for end in gap), count]
    return [(low, high) for low, high in zip(ends[::2], ends[1::2], strict=True) if low < high]


def in_laps(held: Sequence[Span], first: int, count: int, start: int, stop: int) -> list[Span]:
    """The unbroken ranges of the frames [start, stop), where every lap has the same gaps.

    Args:
        held: the frames that are there of the first lap.
        first: the first frame.
        count: frames of a lap.
        start: the first frame that is wanted.
        stop: the frame after the last.
    """
    laps = range((start - first) // count, (stop - 1 - first) // count + 1)
    there = (
        (max(low + lap * count, start), min(high + lap * count, stop))
        for lap in laps
        for low, high in held
    )
    return merged((low, high) for low, high in there if low < high)
