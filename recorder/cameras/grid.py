"""Pictures on the common clock: which picture a stream shows at each tick, or that it has none.

At a tick a stream shows its last picture at or before it, as `--align time` does for logs; one
that is older than `hold` is shown no more: the stream has a gap there. A picture keeps its time:
one that comes when the ticks at and after its time are decided is late, and changes none of them.
"""

from __future__ import annotations

from collections import deque
from dataclasses import asdict, dataclass

from cdmisfa.core.arrays import ByteArray
from cdmisfa.core.clock import NANOSECONDS, time_of
from recorder.cameras.camera import Picture


@dataclass(slots=True)
class Counts:
    """What became of a stream's pictures.

    Attributes:
        messages: pictures that came.
        repeated: ticks that show the picture of the tick before.
        dropped: pictures that no tick shows, for a newer one had come.
        late: pictures that came after a tick was decided which should have shown them.
        disordered: pictures no newer than one that had come before; they are not shown.
        missing: ticks without a picture.
    """

    messages: int = 0
    repeated: int = 0
    dropped: int = 0
    late: int = 0
    disordered: int = 0
    missing: int = 0

    def as_json(self) -> dict[str, int]:
        """The counts by name."""
        return asdict(self)


class Grid:
    """Decides tick after tick what each stream shows.

    Args:
        streams: how many.
        fps: ticks a second.
        start_ns: time of tick 0.
        hold: seconds for which a picture stands for those that are missing.
        patience: seconds for which a tick waits for pictures that are on their way.

    Attributes:
        counts: of each stream.
        tick: the next to be decided.
    """

    def __init__(
        self, streams: int, fps: float, start_ns: int, *, hold: float, patience: float
    ) -> None:
        self.counts = [Counts() for _ in range(streams)]
        self.tick = 0
        self._fps, self._start = fps, start_ns
        self._hold, self._patience = round(hold * NANOSECONDS), round(patience * NANOSECONDS)
        self._coming: list[deque[Picture]] = [deque() for _ in range(streams)]
        self._last: list[Picture | None] = [None] * streams
        self._shown = [True] * streams
        self._newest = [-1] * streams

    @property
    def time_ns(self) -> int:
        """Time of the next tick."""
        return time_of(self.tick, self._fps, self._start)

    @property
    def deadline(self) -> int:
        """Time at which the next tick is decided without the pictures that have not come."""
        return self.time_ns + self._patience

    def needs(self, stream: int) -> bool:
        """Whether a picture may still come that the next tick would show."""
        return self._newest[stream] <= self.time_ns

    def newest(self, stream: int) -> int:
        """Time of the newest picture of a stream; -1 where none came."""
        return self._newest[stream]

    def put(self, stream: int, picture: Picture) -> None:
        """Take in a picture of a stream."""
        counts = self.counts[stream]
        counts.messages += 1
        if picture.time_ns <= self._newest[stream]:
            counts.disordered += 1
            return
        self._newest[stream] = picture.time_ns
        if self.tick > 0 and picture.time_ns <= time_of(self.tick - 1, self._fps, self._start):
            counts.late += 1
        self._coming[stream].append(picture)

    def decide(self) -> list[ByteArray | None]:
        """What each stream shows at the next tick, None where it shows nothing."""
        now = self.time_ns
        row = [self._show(stream, now) for stream in range(len(self.counts))]
        self.tick += 1
        return row

    def _show(self, stream: int, now: int) -> ByteArray | None:
        counts, coming = self.counts[stream], self._coming[stream]
        while coming and coming[0].time_ns <= now:
            counts.dropped += not self._shown[stream]
            self._last[stream], self._shown[stream] = coming.popleft(), False
        last = self._last[stream]
        if last is None or now - last.time_ns > self._hold:
            counts.missing += 1
            return None
        counts.repeated += self._shown[stream]
        self._shown[stream] = True
        return last.image
