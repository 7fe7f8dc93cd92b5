"""A thread for each camera, and queues with a bound between them and who takes the pictures."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Final

from cdmisfa.core.clock import NANOSECONDS
from cdmisfa.core.errors import CdmisfaError, one_line
from recorder.cameras.camera import Camera, Picture
from recorder.cameras.options import STALL, OnLoss

QUEUE_BYTES: Final = 64 * 1024 * 1024
"""Most bytes of pictures that wait of one camera."""

_DELAYS: Final = (0.5, 30.0)
"""Seconds from a loss to the first try to reconnect, and most that there are between two."""

_LEAVE: Final = 1.0
"""Seconds for which closing waits for the threads; they are daemons, and end with the process."""


@dataclass(eq=False)
class _Reading:
    """A camera being read.

    Attributes:
        epoch: which thread reads it: one that was given up on may come back from where it hangs.
        waiting: pictures that nobody took yet.
        bytes: of these.
        lost: pictures that were thrown away because the queue was full.
        over: why nothing more comes; "" while it may.
        heard: when its last picture came, or its reading began.
        silent: whether it has been said that nothing comes.
        came: whether any picture ever came.
        away: whether it is not being read: it is gone, or its next connection is not due yet.
    """

    camera: Camera
    epoch: int = 0
    waiting: deque[Picture] = field(default_factory=deque)
    bytes: int = 0
    lost: int = 0
    over: str = ""
    heard: int = 0
    silent: bool = False
    came: bool = False
    away: bool = False


class Readers:
    """Reads cameras, each in a thread; an `Inbox` on the clock of this machine.

    A queue that is full is emptied, so that what follows is one hole and not every other picture.
    A camera that never showed anything ends with what is wrong; one that did and stalls or goes
    away is waited for, connected to anew with growing delays, or at its end, as `on_loss` says.

    Args:
        cameras: opened in their threads.
        on_loss: see above.
        stall: seconds without a picture after which a camera has stalled.
        queue_bytes: most bytes that wait of one camera.
        say: told in a line of every change of a camera's state.
    """

    def __init__(
        self,
        cameras: Sequence[Camera],
        *,
        on_loss: OnLoss = "reconnect",
        stall: float = STALL,
        queue_bytes: int = QUEUE_BYTES,
        say: Callable[[str], None] = lambda line: None,
    ) -> None:
        self._on_loss, self._say = on_loss, say
        self._stall, self._limit = round(stall * NANOSECONDS), queue_bytes
        # Time never goes back while cameras are read, whatever is done to the wall clock.
        self._offset = time.time_ns() - time.monotonic_ns()
        self._changed = threading.Condition()
        self._news = self._heard = 0
        self._closed = threading.Event()
        self._readings = [_Reading(camera, heard=self.now()) for camera in cameras]
        self._threads = [self._begin(reading) for reading in self._readings]

    def now(self) -> int:
        """The time since 1970 in nanoseconds."""
        return time.monotonic_ns() + self._offset

    def take(self, stream: int) -> Picture | None:
        """See `Inbox`."""
        reading = self._readings[stream]
        with self._changed:
            if not reading.waiting:
                return None
            picture = reading.waiting.popleft()
            reading.bytes -= picture.image.nbytes
            return picture

    def wait(self, until: int) -> None:
        """See `Inbox`."""
        self._look_for_stalls()
        with self._changed:
            if self._news == self._heard:
                self._changed.wait(max((until - self.now()) / NANOSECONDS, 0))
            self._heard = self._news

    def over(self, stream: int) -> str:
        """See `Inbox`."""
        return self._readings[stream].over

    def lost(self, stream: int) -> int:
        """See `Inbox`."""
        return self._readings[stream].lost

    def rate(self, stream: int) -> float | None:
        """See `Inbox`."""
        return self._readings[stream].camera.rate

    def close(self) -> None:
        """Let go of the cameras; one that hangs is left to itself."""
        self._closed.set()
        end = time.monotonic() + _LEAVE
        for thread in self._threads:
            thread.join(max(end - time.monotonic(), 0))

    def _begin(self, reading: _Reading) -> threading.Thread:
        thread = threading.Thread(target=self._read, args=(reading, reading.epoch), daemon=True)
        thread.start()
        return thread

    def _read(self, reading: _Reading, epoch: int) -> None:
        """Read a camera until it is over, again and again where that is asked for."""
        shortest, longest = _DELAYS
        delay, name = shortest, reading.camera.name
        while self._is_on(reading, epoch):
            came = False
            try:
                for age, image in reading.camera.pictures():
                    picture = Picture(self.now() - age, image)
                    if not self._put(reading, epoch, picture):
                        return
                    came, delay = True, shortest
                why = (
                    f"{name} ended" if reading.came else f"{name} ended before a picture of it came"
                )
            except CdmisfaError as error:
                why = str(error)
            except Exception as error:
                why = f"{name} is gone: {one_line(error)}"
            if not self._is_on(reading, epoch):
                return
            if not reading.came or reading.camera.finite or self._on_loss == "end":
                self._end(reading, why)
                return
            reading.away = True
            if self._on_loss == "wait":
                if all(other.away or other.over for other in self._readings):
                    self._end(reading, why)
                else:
                    self._say(f"{why}: the others go on without it")
                return
            if came or delay == shortest:
                self._say(f"{why}: connecting to it anew")
            self._closed.wait(delay)
            reading.away, reading.heard = False, self.now()
            delay = min(2 * delay, longest)

    def _is_on(self, reading: _Reading, epoch: int) -> bool:
        return reading.epoch == epoch and not self._closed.is_set()

    def _put(self, reading: _Reading, epoch: int, picture: Picture) -> bool:
        """Let a picture wait; false where its thread was given up on."""
        with self._changed:
            if not self._is_on(reading, epoch):
                return False
            if reading.bytes + picture.image.nbytes > self._limit and reading.waiting:
                full = len(reading.waiting)
                reading.lost += full
                reading.waiting.clear()
                reading.bytes = 0
                self._say(
                    f"{reading.camera.name}: {full} pictures thrown away: they came faster than "
                    "they were taken"
                )
            reading.waiting.append(picture)
            reading.bytes += picture.image.nbytes
            back = reading.silent
            reading.heard, reading.silent, reading.came = self.now(), False, True
            self._tell()
        if back:
            self._say(f"{reading.camera.name} shows pictures again")
        return True

    def _end(self, reading: _Reading, why: str) -> None:
        with self._changed:
            reading.over = why
            self._tell()

    def _tell(self) -> None:
        self._news += 1
        self._changed.notify_all()

    def _look_for_stalls(self) -> None:
        """Do what is to be done about cameras of which nothing came for long."""
        now = self.now()
        for number, reading in enumerate(self._readings):
            read = reading.came and not reading.away and not reading.over
            quiet = read and now - reading.heard > self._stall
            if not quiet or (reading.silent and self._on_loss != "reconnect"):
                continue
            said = reading.silent
            reading.silent = True
            name = reading.camera.name
            why = f"{name}: no picture for {self._stall / NANOSECONDS:g} s"
            if self._on_loss == "end":
                self._end(reading, why)
            elif self._on_loss == "wait":
                self._say(f"{why}: waiting")
            else:
                if not said:
                    self._say(f"{why}: connecting to it anew")
                with self._changed:
                    reading.epoch += 1  # the thread that hangs is given up
                    reading.heard = now
                self._threads[number] = self._begin(reading)
