"""Cameras as a source of frames: what comes when it comes, on one clock."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, Protocol

import numpy as np

from cdmisfa.core.blocks import (
    Block,
    ForwardSource,
    SourceSpec,
    check_request,
    freeze,
    take_unbroken,
)
from cdmisfa.core.clock import NANOSECONDS, RECORDED_FPS
from cdmisfa.core.errors import LogExhaustedError, UsageError
from recorder.cameras.camera import Picture
from recorder.cameras.grid import Grid
from recorder.cameras.options import HOLD
from recorder.images.pixels import Shown

PATIENCE: Final = 0.2
"""Seconds for which a tick waits for a picture that is on its way."""

START: Final = 30.0
"""Seconds in which every camera must show its first picture."""

_POLL: Final = NANOSECONDS // 10
_MEASURED: Final = 12
"""Pictures by which a camera's rate is measured that does not state it."""


class Inbox(Protocol):
    """Where the pictures of all cameras come in, and the clock by which they do."""

    def now(self) -> int:
        """The time, in nanoseconds."""

    def take(self, stream: int) -> Picture | None:
        """The oldest picture of a stream that waits; None where none does."""

    def wait(self, until: int) -> None:
        """Return when something came in, or at a time."""

    def over(self, stream: int) -> str:
        """Why a stream shows nothing more than what waits; "" while it may."""

    def lost(self, stream: int) -> int:
        """Pictures of a stream that were thrown away because the queue was full."""

    def rate(self, stream: int) -> float | None:
        """Pictures a second that a stream states."""

    def close(self) -> None:
        """Let go of the cameras."""


class LiveSource(ForwardSource):
    """Live streams on one clock, with gaps where a stream has no picture; see `Grid`.

    It cannot go back: record what it shows to have it again. `take_all` gives a block for each
    unbroken stretch of a stream, and none for one that shows nothing. The source ends with the
    first stream that does.

    Args:
        inbox: where the pictures come in, all of one size; closed with the source.
        names: of the streams.
        about: what identifies the cameras.
        rate: ticks a second; by default the first camera's rate, stated or measured.
        hold, patience: see `Grid`.
        stop: asked while waiting; true ends the wait as if the cameras had ended.

    Attributes:
        stop: as given; it may be replaced.

    Raises:
        UsageError: a camera shows nothing, or tells no rate.
    """

    gaps = True

    def __init__(
        self,
        inbox: Inbox,
        names: Sequence[str],
        about: Mapping[str, Any],
        *,
        rate: float | None = None,
        hold: float = HOLD,
        patience: float = PATIENCE,
        stop: Callable[[], bool] = lambda: False,
    ) -> None:
        self.stop = stop
        self._inbox = inbox
        self._ahead: deque[list[Shown | None]] = deque()
        self._ends: int | None = None
        self._why = ""
        try:
            first = self._first(names, rate is None)
            fps = rate or self._rate(first[0])
            slowest, fastest = RECORDED_FPS
            if not slowest <= fps <= fastest:
                raise UsageError(f"--rate is {fps:g}: it must be in [{slowest:g}, {fastest:g}]")
            # Half a tick later, so that a camera at the rate of the clock may jitter by as much.
            step = NANOSECONDS / fps
            start = max(pictures[0].time_ns for pictures in first) + round(step / 2)
            size = first[0][0].image.shape
            self._spec = SourceSpec(
                tuple(names), size, str(first[0][0].image.dtype), (), fps, start
            )
        except BaseException:
            inbox.close()
            raise
        self._about = {**about, "size": list(size), "rate": fps, "hold": hold}
        self._grid = Grid(len(names), fps, start, hold=hold, patience=patience)
        for stream, pictures in enumerate(first):
            before = sum(picture.time_ns <= start for picture in pictures)
            for picture in pictures[max(before - 1, 0) :]:
                self._grid.put(stream, picture)

    @property
    def alignment(self) -> dict[str, dict[str, int]]:
        """What became of each stream's pictures so far: `Counts`, and what the queue lost."""
        counted = zip(self._spec.streams, self._grid.counts, strict=True)
        return {
            name: {**counts.as_json(), "lost": self._inbox.lost(stream)}
            for stream, (name, counts) in enumerate(counted)
        }

    def take(self, stream: int, n: int) -> Block:
        """The next n frames of a stream that follow one another without a gap.

        Raises:
            LogExhaustedError: a camera ended before.
            ValueError: no such stream, or n < 1.
        """
        return take_unbroken(self, stream, n)

    def take_all(self, n: int) -> tuple[Block, ...]:
        """What every stream shows in the next n ticks, a block for each unbroken stretch.

        Raises:
            LogExhaustedError: a camera ended before; t stays.
            ValueError: n < 1.
        """
        check_request(self._spec, 0, n)
        while len(self._ahead) < n:
            self._ahead.append(self._next())
        rows = [self._ahead.popleft() for _ in range(n)]
        blocks = [
            block
            for stream, column in enumerate(zip(*rows, strict=True))
            for block in _stretches(stream, self._t, column)
        ]
        self._t += n
        return tuple(blocks)

    def describe(self) -> Mapping[str, Any]:
        """The cameras, and how their pictures became frames."""
        return {"kind": "cameras", **self._about}

    def close(self) -> None:
        """Let go of the cameras."""
        self._inbox.close()

    def _next(self) -> list[Shown | None]:
        """What every stream shows at the next tick, waited for."""
        grid, inbox = self._grid, self._inbox
        streams = range(len(self._spec.streams))
        while True:
            now = inbox.now()  # before the look: what came until then is seen
            waiting = [stream for stream in streams if self._lacks(stream)]
            if self._ends is not None and grid.time_ns > self._ends:
                raise LogExhaustedError(self._why)
            if not waiting or now >= grid.deadline:
                return grid.decide()
            if self.stop():
                raise LogExhaustedError(f"stopped while waiting for frame {grid.tick}")
            inbox.wait(min(grid.deadline, now + _POLL))

    def _lacks(self, stream: int) -> bool:
        """Take in what came of a stream; whether it may still show another picture at the tick."""
        while self._grid.needs(stream):
            why = self._inbox.over(stream)  # before the look, as above
            picture = self._inbox.take(stream)
            if picture is not None:
                self._grid.put(stream, picture)
            elif not why:
                return True
            else:
                if self._ends is None:
                    step = round(NANOSECONDS / self._spec.fps)
                    self._ends, self._why = self._grid.newest(stream) + step, why
                return False
        return False

    def _first(self, names: Sequence[str], measure: bool) -> list[list[Picture]]:
        """The first picture of each stream, and more of the first where its rate is measured."""
        inbox = self._inbox
        found: list[list[Picture]] = [[] for _ in names]
        deadline = inbox.now() + round(START * NANOSECONDS)
        while True:
            now = inbox.now()
            wanted = []
            for stream, pictures in enumerate(found):
                stated = stream or not measure or inbox.rate(stream)
                while len(pictures) < (1 if stated else _MEASURED):
                    why = inbox.over(stream)
                    picture = inbox.take(stream)
                    if picture is None:
                        if why and not pictures:
                            raise UsageError(why)
                        if not why:
                            wanted.append(names[stream])
                        break
                    pictures.append(picture)
            if not wanted:
                return found
            if self.stop() or now >= deadline:
                raise UsageError(f"{wanted[0]} shows no picture: look at the camera and its name")
            inbox.wait(min(deadline, now + _POLL))

    def _rate(self, pictures: Sequence[Picture]) -> float:
        stated = self._inbox.rate(0)
        if stated:
            return stated
        steps = np.diff([picture.time_ns for picture in pictures])
        if not len(steps) or np.median(steps) <= 0:
            raise UsageError("the first camera tells no rate: set one with --rate")
        return float(f"{NANOSECONDS / float(np.median(steps)):.3g}")


def _stretches(stream: int, t: int, column: Sequence[Shown | None]) -> list[Block]:
    """The unbroken stretches of what a stream shows from tick t on."""
    blocks: list[Block] = []
    run: list[Shown] = []
    for at, image in enumerate([*column, None]):
        if image is not None:
            run.append(image)
        elif run:
            empty = freeze(np.empty((len(run), 0)))
            blocks.append(Block(stream, t + at - len(run), freeze(np.stack(run)), empty))
            run = []
    return blocks
