"""Live streams on one clock: which picture each shows at each tick, or that it has none.

At a tick a stream shows its last picture at or before it, as `--align time` does for logs. One
that is older than `hold` is shown no more: the stream has a gap there. A picture keeps its time:
one that comes when the ticks at and after its time are decided is late, and changes none of them.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

import numpy as np

from cdmisfa.core.blocks import (
    Block,
    ForwardSource,
    SourceSpec,
    check_request,
    freeze,
    take_unbroken,
)
from cdmisfa.core.clock import NANOSECONDS, RECORDED_FPS, time_of
from cdmisfa.core.errors import LogExhaustedError, UsageError
from recorder.cameras.readers import Picture, Readers
from recorder.images.pixels import Shown

PATIENCE: Final = 0.2
"""Seconds for which a tick waits for a picture that is on its way."""

START: Final = 30.0
"""Seconds in which every camera must show its first picture."""

COUNTED: Final = ("messages", "repeated", "dropped", "late", "disordered", "missing")
"""What is counted of each stream: pictures that came; ticks that show the picture of the tick
before; pictures that no tick shows, for a newer one had come; pictures that came after a tick was
decided which should have shown them; pictures no newer than one before them, which are not shown;
ticks without a picture."""

_POLL: Final = NANOSECONDS // 10
_MEASURED: Final = 12
"""Pictures by which a camera's rate is measured that does not state it."""


class _Stream:
    """The pictures of one stream, and which of them are shown.

    Attributes:
        counts: see `COUNTED`.
        newest: time of the newest picture, -1 before the first.
    """

    def __init__(self) -> None:
        self.counts = dict.fromkeys(COUNTED, 0)
        self.newest = -1
        self._coming: deque[Picture] = deque()
        self._last: Picture | None = None
        self._shown = True

    def put(self, picture: Picture, decided: int) -> None:
        """Add a picture; ticks up to `decided` (ns) do not change any more."""
        self.counts["messages"] += 1
        if picture.time_ns <= self.newest:
            self.counts["disordered"] += 1
            return
        self.counts["late"] += picture.time_ns <= decided
        self.newest = picture.time_ns
        self._coming.append(picture)

    def show(self, tick: int, hold: int) -> Shown | None:
        """The image at a tick, None for a gap; both in nanoseconds."""
        while self._coming and self._coming[0].time_ns <= tick:
            self.counts["dropped"] += not self._shown
            self._last, self._shown = self._coming.popleft(), False
        if self._last is None or tick - self._last.time_ns > hold:
            self.counts["missing"] += 1
            return None
        self.counts["repeated"] += self._shown
        self._shown = True
        return self._last.image


class LiveSource(ForwardSource):
    """Cameras as a source of frames, with gaps where a stream has no picture.

    It cannot go back: record what it shows to have it again. `take_all` gives a block for each
    unbroken stretch of a stream, and none for one that shows nothing. The source ends with the
    first stream that does.

    Args:
        readers: of the cameras, whose images are of one size; closed with the source.
        names: of the streams.
        about: what identifies the cameras.
        rate: ticks a second; by default the first camera's rate, stated or measured.
        hold: seconds for which a picture stands for those that are missing.

    Attributes:
        stop: asked while waiting; true ends the wait as if the cameras had ended.

    Raises:
        UsageError: a camera shows nothing, or tells no rate.
    """

    gaps = True

    def __init__(
        self,
        readers: Readers,
        names: Sequence[str],
        about: Mapping[str, Any],
        *,
        rate: float | None = None,
        hold: float = 0.25,
    ) -> None:
        self.stop: Callable[[], bool] = lambda: False
        self._readers = readers
        self._hold = round(hold * NANOSECONDS)
        self._streams = [_Stream() for _ in names]
        self._tick, self._decided = 0, -1
        self._ahead: deque[list[Shown | None]] = deque()
        self._ends: int | None = None
        self._why = ""
        try:
            firsts = self._first_pictures(names, measure=rate is None)
            fps = rate or self._rate(firsts[0])
            slowest, fastest = RECORDED_FPS
            if not slowest <= fps <= fastest:
                raise UsageError(f"--rate is {fps:g}: it must be in [{slowest:g}, {fastest:g}]")
        except BaseException:
            readers.close()
            raise
        # Half a tick later, so that a camera at the rate of the clock may jitter by as much.
        start = max(pictures[0].time_ns for pictures in firsts) + round(NANOSECONDS / fps / 2)
        image = firsts[0][0].image
        self._spec = SourceSpec(tuple(names), image.shape, str(image.dtype), (), fps, start)
        self._about = {**about, "size": list(image.shape), "rate": fps, "hold": hold}
        for stream, pictures in zip(self._streams, firsts, strict=True):
            before = sum(picture.time_ns <= start for picture in pictures)
            for picture in pictures[max(before - 1, 0) :]:
                stream.put(picture, self._decided)

    @property
    def alignment(self) -> dict[str, dict[str, int]]:
        """What became of each stream's pictures so far: `COUNTED`, and what the queue lost."""
        return {
            name: {**stream.counts, "lost": self._readers.lost(number)}
            for number, (name, stream) in enumerate(
                zip(self._spec.streams, self._streams, strict=True)
            )
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
            self._ahead.append(self._next_tick())
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
        self._readers.close()

    def _next_tick(self) -> list[Shown | None]:
        """What every stream shows at the next tick, waited for."""
        tick = time_of(self._tick, self._spec.fps, self._spec.start_ns)
        deadline = tick + round(PATIENCE * NANOSECONDS)
        while True:
            now = self._readers.now()  # before looking, so that all that came until then is seen
            waiting = [self._take_in(number, tick) for number in range(len(self._streams))]
            if self._ends is not None and tick > self._ends:
                raise LogExhaustedError(self._why)
            if not any(waiting) or now >= deadline:
                self._tick, self._decided = self._tick + 1, tick
                return [stream.show(tick, self._hold) for stream in self._streams]
            if self.stop():
                raise LogExhaustedError(f"stopped while waiting for frame {self._tick}")
            self._readers.wait(min(deadline, now + _POLL))

    def _take_in(self, number: int, tick: int) -> bool:
        """Take in what came of a stream; whether a picture for the tick may still come."""
        stream = self._streams[number]
        while stream.newest <= tick:
            why = self._readers.over(number)  # before looking, as above
            picture = self._readers.take(number)
            if picture is None:
                if why and self._ends is None:
                    step = round(NANOSECONDS / self._spec.fps)
                    self._ends, self._why = stream.newest + step, why
                return not why
            stream.put(picture, self._decided)
        return False

    def _first_pictures(self, names: Sequence[str], *, measure: bool) -> list[list[Picture]]:
        """The first picture of each stream, and more of the first where its rate is measured."""
        readers = self._readers
        found: list[list[Picture]] = [[] for _ in names]
        deadline = readers.now() + round(START * NANOSECONDS)
        while True:
            now = readers.now()
            missing = []
            for number, pictures in enumerate(found):
                why = readers.over(number)
                measured = measure and not number and not readers.rate(number)
                wanted = _MEASURED if measured else 1
                while len(pictures) < wanted and (picture := readers.take(number)):
                    pictures.append(picture)
                if why and not pictures:
                    raise UsageError(why)
                if not why and len(pictures) < wanted:
                    missing.append(names[number])
            if not missing:
                return found
            if now >= deadline:
                raise UsageError(f"{missing[0]} shows no picture: look at the camera and its name")
            readers.wait(min(deadline, now + _POLL))

    def _rate(self, pictures: Sequence[Picture]) -> float:
        """Pictures a second of the first camera, stated or measured."""
        if stated := self._readers.rate(0):
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
