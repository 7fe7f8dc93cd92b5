"""Live streams on one clock: when images were taken, and which image a stream shows at each tick.

At a tick a stream shows its last image at or before it, as `--align time` does for logs. After
`hold` seconds an image is no longer shown: the stream has a gap. An image keeps its time: if it
comes when the ticks at and after its time are decided, it is late, and changes none of them.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from itertools import groupby
from typing import Any, Final

import numpy as np

from cdmisfa.core.blocks import Block, ForwardSource, SourceSpec, check_request, freeze
from cdmisfa.core.clock import NANOSECONDS, time_of
from cdmisfa.core.errors import LogExhaustedError, UsageError
from recorder.cameras.readers import CameraState, Readers, Stamped
from recorder.images.pixels import Shown

# Seconds for which a tick waits for an image that is on its way.
PATIENCE: Final = 0.2

# Seconds in which every camera must show its first image.
START: Final = 30.0

# Counts of each stream: images that came; ticks that show the image of the tick before; images
# that no tick shows, as a newer one had come; images that came after a tick was decided which
# should have shown them; images no newer than one before them, which are not shown; ticks without
# an image.
COUNTED: Final = ("messages", "repeated", "dropped", "late", "disordered", "missing")

# Seconds a second by which a camera's clock may be slow.
DRIFT: Final = 1e-3

# Seconds by which presentation times differ from those due if they start again.
JUMP: Final = 1.0

# Images in a row that are later than `JUMP` before presentation times count as started again.
LATE: Final = 60

_POLL: Final = NANOSECONDS // 10

# Images by which a camera's rate is measured if the camera does not state it.
_MEASURED: Final = 12


class Steady:
    """Estimates when images were taken by their presentation times, which have no network jitter.

    The image with the least delay so far sets the offset between the two clocks. The least delay
    is forgotten slowly, as clocks drift.
    """

    def __init__(self) -> None:
        self._offset = 0.0
        self._last = 0.0
        self._late = 0

    def age(self, now: float, presented: float | None) -> int:
        """Return how many nanoseconds ago an image that comes now was taken.

        Args:
            now: seconds of a monotonic clock.
            presented: the image's own time in seconds; None if it has none.
        """
        if presented is None:
            return 0
        delay = now - presented
        drifted = self._offset + DRIFT * (now - self._last)
        self._late = self._late + 1 if delay > self._offset + JUMP else 0
        restarted = self._last == 0.0 or delay < self._offset - JUMP or self._late > LATE
        self._offset = delay if restarted else min(delay, drifted)
        self._last = now
        return round((delay - self._offset) * NANOSECONDS)


class _Stream:
    """The images of one stream, and the last one shown.

    Attributes:
        counts: see `COUNTED`.
        newest: time of the newest image, -1 before the first.
    """

    def __init__(self, state: CameraState) -> None:
        self.state = state
        self.counts = dict.fromkeys(COUNTED, 0)
        self.newest = -1
        self._coming: deque[Stamped] = deque()
        self._last: Stamped | None = None
        self._used = True

    def put(self, stamped: Stamped, decided: int) -> None:
        """Add an image; ticks up to `decided` (ns) do not change any more."""
        self.counts["messages"] += 1
        if stamped.time_ns <= self.newest:
            self.counts["disordered"] += 1
            return
        self.counts["late"] += stamped.time_ns <= decided
        self.newest = stamped.time_ns
        self._coming.append(stamped)

    def show(self, tick: int, hold: int) -> Shown | None:
        """Return the image at a tick, None for a gap; both in nanoseconds."""
        while self._coming and self._coming[0].time_ns <= tick:
            self.counts["dropped"] += not self._used
            self._last, self._used = self._coming.popleft(), False
        if self._last is None or tick - self._last.time_ns > hold:
            self.counts["missing"] += 1
            return None
        self.counts["repeated"] += self._used
        self._used = True
        return self._last.image


class LiveSource(ForwardSource):
    """Cameras as a source of frames, with gaps if a stream has no image.

    The source cannot go back: record its frames to have them again. `take_all` returns a block for
    each unbroken stretch of a stream, and none for a stream without images. The source ends with
    the first stream that ends.

    Args:
        readers: of the cameras, whose images have one size; closed with the source.
        names: of the streams.
        about: what identifies the cameras.
        rate: ticks a second; by default the first camera's rate, stated or measured.
        hold: seconds for which an image replaces missing ones.

    Attributes:
        stop: called while waiting; true ends the wait as if the cameras had ended.

    Raises:
        UsageError: a camera shows nothing, or states no rate.
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
        self._streams = [_Stream(state) for state in readers.states]
        self._tick, self._decided = 0, -1
        self._ahead: deque[list[Shown | None]] = deque()
        self._ends: int | None = None
        self._why = ""
        try:
            firsts = self._first_images(names, measure=rate is None)
            fps = rate or readers.states[0].camera.rate or _measured_rate(firsts[0])
        except BaseException:
            readers.close()
            raise
        # Half a tick later, so that a camera at the rate of the clock may jitter by as much.
        start = max(images[0].time_ns for images in firsts) + round(NANOSECONDS / fps / 2)
        image = firsts[0][0].image
        self._spec = SourceSpec(tuple(names), image.shape, str(image.dtype), (), fps, start)
        self._about = {**about, "size": list(image.shape), "rate": fps, "hold": hold}
        for stream, images in zip(self._streams, firsts, strict=True):
            before = sum(stamped.time_ns <= start for stamped in images)
            for stamped in images[max(before - 1, 0) :]:
                stream.put(stamped, self._decided)

    @property
    def alignment(self) -> dict[str, dict[str, int]]:
        """The counts of each stream so far: `COUNTED`, and the images that its queue lost."""
        streams = zip(self._spec.streams, self._streams, strict=True)
        return {name: {**stream.counts, "lost": stream.state.lost} for name, stream in streams}

    def take_all(self, n: int) -> tuple[Block, ...]:
        """Return the frames of all streams at the next n ticks, a block for each stretch.

        Raises:
            LogExhaustedError: a camera ended before; t stays.
            ValueError: n < 1.
        """
        check_request(self._spec, 0, n)
        while len(self._ahead) < n:
            self._ahead.append(self._next_tick())
        rows = [self._ahead.popleft() for _ in range(n)]
        blocks: list[Block] = []
        for stream, column in enumerate(zip(*rows, strict=True)):
            shown = enumerate(column, self._t)
            for is_gap, stretch in groupby(shown, lambda tick: tick[1] is None):
                if not is_gap:
                    ticks, images = zip(*stretch, strict=True)
                    empty = freeze(np.empty((len(images), 0)))
                    blocks.append(Block(stream, ticks[0], freeze(np.stack(images)), empty))
        self._t += n
        return tuple(blocks)

    def describe(self) -> Mapping[str, Any]:
        """Return what identifies the cameras, and how their images became frames."""
        return {"kind": "cameras", **self._about}

    def close(self) -> None:
        """Close the cameras."""
        self._readers.close()

    def _next_tick(self) -> list[Shown | None]:
        """Wait for the next tick and return the image of every stream."""
        tick = time_of(self._tick, self._spec.fps, self._spec.start_ns)
        deadline = tick + round(PATIENCE * NANOSECONDS)
        while True:
            now = self._readers.now()  # before the queues, so that all images until then are seen
            waiting = [self._take_images(stream, tick) for stream in self._streams]
            if self._ends is not None and tick > self._ends:
                raise LogExhaustedError(self._why)
            if not any(waiting) or now >= deadline:
                self._tick, self._decided = self._tick + 1, tick
                return [stream.show(tick, self._hold) for stream in self._streams]
            if self.stop():
                raise LogExhaustedError(f"stopped while waiting for frame {self._tick}")
            self._readers.wait(min(deadline, now + _POLL))

    def _take_images(self, stream: _Stream, tick: int) -> bool:
        """Take a stream's images from its queue; return whether one for the tick may still come."""
        while stream.newest <= tick:
            why = stream.state.over  # before the queue, as above
            stamped = self._readers.take(stream.state)
            if stamped is None:
                if why and self._ends is None:
                    step = round(NANOSECONDS / self._spec.fps)
                    self._ends, self._why = stream.newest + step, why
                return not why
            stream.put(stamped, self._decided)
        return False

    def _first_images(self, names: Sequence[str], *, measure: bool) -> list[list[Stamped]]:
        """Wait for the first image of each stream, and for those that measure the first's rate."""
        readers = self._readers
        images: list[list[Stamped]] = [[] for _ in names]
        deadline = readers.now() + round(START * NANOSECONDS)
        while True:
            now = readers.now()
            missing = []
            for name, state, stamps in zip(names, readers.states, images, strict=True):
                why = state.over
                measured = measure and stamps is images[0] and not state.camera.rate
                wanted = _MEASURED if measured else 1
                while len(stamps) < wanted and (stamped := readers.take(state)):
                    stamps.append(stamped)
                if not stamps and (why or now >= deadline):
                    raise UsageError(why or f"{name} shows no image: check the camera and its name")
                if not why and len(stamps) < wanted:
                    missing.append(name)
            if not missing or now >= deadline:
                return images
            readers.wait(min(deadline, now + _POLL))


def _measured_rate(images: Sequence[Stamped]) -> float:
    """Return images a second, by the median of the steps between them, with three digits."""
    steps = np.diff([stamped.time_ns for stamped in images])
    if not len(steps) or np.median(steps) <= 0:
        raise UsageError("the first camera states no rate: set one with --rate")
    return float(f"{NANOSECONDS / float(np.median(steps)):.3g}")
