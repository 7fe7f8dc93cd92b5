"""`LiveSource`: live streams on one clock, with the times at which images were taken.

At a tick a stream has its last image at or before it, as `--align time` does for logs. An image
older than `hold` seconds is not used: the stream then has a gap. An image keeps its time: if it
arrives after the ticks at and after its time were decided, it is late and changes none of them.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

import numpy as np

from cdmisfa.core.blocks import Block, ForwardSource, SourceSpec, check_request, freeze
from cdmisfa.core.clock import NANOSECONDS, time_of
from cdmisfa.core.errors import LogExhaustedError, UsageError
from cdmisfa.core.gaps import stretches
from recorder.cameras.readers import CameraState, Readers, Stamped
from recorder.images.pixels import Content

# Seconds that a tick waits for images that can still arrive. Longer waits delay all streams,
# shorter ones make images late.
TICK_WAIT: Final = 0.2

# Seconds within which every camera must deliver its first image.
START: Final = 30.0

# Counters of each stream: images that arrived; ticks that use the image of the previous tick;
# images that no tick uses, because a newer one had arrived; images that arrived after a tick was
# decided that should have used them; images that are not newer than an earlier one, and are not
# used; ticks without an image.
COUNTED: Final = ("messages", "repeated", "dropped", "late", "disordered", "missing")

# Drift of a camera's clock that is followed, in seconds a second; crystals drift by 1e-4 at most.
DRIFT: Final = 1e-3

# Seconds by which presentation times must jump to count as restarted.
JUMP: Final = 1.0

# Number of consecutive images later than `JUMP` after which presentation times count as restarted.
LATE: Final = 60

_POLL: Final = NANOSECONDS // 10

# Images from which the rate of a camera is measured if it does not state one.
_MEASURED: Final = 12


class Steady:
    """Estimator of when images were taken, by their presentation times, without network jitter.

    The image with the smallest delay so far sets the offset between both clocks. The smallest delay
    is increased slowly, because clocks drift.
    """

    def __init__(self) -> None:
        self._offset = 0.0
        self._last = 0.0
        self._late = 0

    def age(self, now: float, presented: float | None) -> int:
        """Return how long ago an image that arrives now was taken (ns).

        Args:
            now: time of a monotonic clock (s).
            presented: presentation time of the image (s); None if it has none.
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
    """The images of one stream, and the image used last.

    Attributes:
        counts: see `COUNTED`.
        newest: time of the newest image (ns); -1 before the first.
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

    def image_at(self, tick: int, hold: int) -> Content | None:
        """Return the image at a tick (ns), or None if it is older than `hold` (ns)."""
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
    """Cameras as a source of frames, with gaps while a stream has no image.

    The source cannot go back: record it to have its frames again. `take_all` returns a block for
    each stretch of a stream without a gap, and none for a stream without images. The source ends
    with the first stream that ends.

    Args:
        readers: readers of the cameras, whose images have one size, and of numbers; they are
            closed with the source.
        names: names of the streams.
        about: identity of the cameras.
        rate: ticks a second; None: rate of the first camera, stated or measured.
        hold: time for which an image replaces missing ones (s).

    Attributes:
        stop: called while waiting; True ends the wait as if the cameras had ended.

    Raises:
        UsageError: a camera delivers no image, or has no rate.
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
        self._ahead: deque[list[Content | None]] = deque()
        self._ends: int | None = None
        self._end_reason = ""
        try:
            firsts = self._first_images(names, measure=rate is None)
            fps = rate or readers.states[0].camera.rate or _measured_rate(firsts[0])
        except BaseException:
            readers.close()
            raise
        # Half a tick later, so that a camera with the rate of the clock can jitter by as much.
        start = max(images[0].time_ns for images in firsts) + round(NANOSECONDS / fps / 2)
        kinds = [(images[0].image.shape, str(images[0].image.dtype)) for images in firsts]
        self._spec = SourceSpec.of_kinds(names, kinds, (), fps, start)
        self._about = {**about, "size": self._spec.size, "rate": fps, "hold": hold}
        for stream, images in zip(self._streams, firsts, strict=True):
            before = sum(stamped.time_ns <= start for stamped in images)
            for stamped in images[max(before - 1, 0) :]:
                stream.put(stamped, self._decided)

    @property
    def alignment(self) -> dict[str, dict[str, int]]:
        """The counters of each stream, see `COUNTED`, and the images that its queue lost."""
        streams = zip(self._spec.streams, self._streams, strict=True)
        return {name: {**stream.counts, "lost": stream.state.lost} for name, stream in streams}

    def take_all(self, n: int) -> tuple[Block, ...]:
        """Return the frames of all streams at the next n ticks, a block for each stretch.

        Raises:
            LogExhaustedError: a camera ended before; t does not move.
            ValueError: n < 1.
        """
        check_request(self._spec, 0, n)
        while len(self._ahead) < n:
            self._ahead.append(self._next_tick())
        rows = [self._ahead.popleft() for _ in range(n)]
        self._t += n
        return stretches(rows, self._t - n, freeze(np.empty((n, 0))))

    def describe(self) -> Mapping[str, Any]:
        """Return the identity of the cameras, and how their images become frames."""
        return {"kind": "cameras", **self._about}

    def close(self) -> None:
        """Close the cameras."""
        self._readers.close()

    def _next_tick(self) -> list[Content | None]:
        """Wait for the next tick, and return the image of every stream."""
        tick = time_of(self._tick, self._spec.fps, self._spec.start_ns)
        deadline = tick + round(TICK_WAIT * NANOSECONDS)
        while True:
            now = self._readers.now()  # before reading the queues, so that no image is missed
            waiting = [self._take_images(stream, tick) for stream in self._streams]
            if self._ends is not None and tick > self._ends:
                raise LogExhaustedError(self._end_reason)
            if not any(waiting) or now >= deadline:
                self._tick, self._decided = self._tick + 1, tick
                return [stream.image_at(tick, self._hold) for stream in self._streams]
            if self.stop():
                raise LogExhaustedError(f"stopped while waiting for frame {self._tick}")
            self._readers.wait(min(deadline, now + _POLL))

    def _take_images(self, stream: _Stream, tick: int) -> bool:
        """Take images from a stream's queue; return True if one for the tick can still arrive."""
        while stream.newest <= tick:
            reason = stream.state.over  # before reading the queue, as above
            stamped = self._readers.take(stream.state)
            if stamped is None:
                if reason and self._ends is None:
                    step = round(NANOSECONDS / self._spec.fps)
                    self._ends, self._end_reason = stream.newest + step, reason
                return not reason
            stream.put(stamped, self._decided)
        return False

    def _first_images(self, names: Sequence[str], *, measure: bool) -> list[list[Stamped]]:
        """Wait for the first image of each stream, and for those that measure the rate."""
        readers = self._readers
        images: list[list[Stamped]] = [[] for _ in names]
        deadline = readers.now() + round(START * NANOSECONDS)
        while True:
            now = readers.now()
            missing = []
            for name, state, stamps in zip(names, readers.states, images, strict=True):
                reason = state.over
                measured = measure and stamps is images[0] and not state.camera.rate
                needed = _MEASURED if measured else 1
                while len(stamps) < needed and (stamped := readers.take(state)):
                    stamps.append(stamped)
                if not stamps and (reason or now >= deadline):
                    raise UsageError(reason or f"{name} delivers no image: check the camera")
                if not reason and len(stamps) < needed:
                    missing.append(name)
            if not missing or now >= deadline:
                return images
            readers.wait(min(deadline, now + _POLL))


def _measured_rate(images: Sequence[Stamped]) -> float:
    """Return the rate of images (1/s) from the median of their intervals, with three digits."""
    steps = np.diff([stamped.time_ns for stamped in images])
    if not len(steps) or np.median(steps) <= 0:
        raise UsageError("the first camera states no rate: set one with --rate")
    return float(f"{NANOSECONDS / float(np.median(steps)):.3g}")
