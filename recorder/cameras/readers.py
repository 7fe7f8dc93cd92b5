"""Cameras, each read in a thread of its own, and what is done about one that is lost."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple, Protocol

from cdmisfa.core.clock import NANOSECONDS
from cdmisfa.core.errors import CdmisfaError, UsageError, one_line
from recorder.images.fields import rounded
from recorder.images.framing import Framing, Vector, framings, size_of
from recorder.images.options import Fit, OnLoss, Size
from recorder.images.pixels import Shown

QUEUE_BYTES: Final = 64 * 1024 * 1024
"""Most bytes of pictures that wait of one camera."""

_DELAYS: Final = (0.5, 30.0)
"""Seconds from a loss to the first try to reconnect, and most that there are between two."""

_LEAVE: Final = 0.5
"""Seconds for which closing waits for the threads; they are daemons, and end with the process."""


class Picture(NamedTuple):
    """One image of a camera.

    Attributes:
        time_ns: when it was taken or came, by the clock that all cameras share.
        image: gray, (height, width) uint8, or in colours, (height, width, 3); or numbers, (I,)
            float64.
    """

    time_ns: int
    image: Shown


class Camera(Protocol):
    """A stream of images from outside, opened and read in a thread of its own.

    Attributes:
        name: of its stream.
        finite: whether its end is an end, and not a loss to recover from.
        rate: images a second that it states; None where it states none, or is not open yet.
    """

    name: str
    finite: bool

    @property
    def rate(self) -> float | None:
        """See above."""

    def pictures(self) -> Iterator[tuple[int, Shown]]:
        """Open it and give its images as they come, until it ends.

        Yields:
            How many nanoseconds ago the image was taken, 0 where only its coming is known; and
            the image at its own size, gray, (height, width) uint8, or in colours, (height, width,
            3) uint8; or numbers, (I,) float64, finite and as many each time.

        Raises:
            Exception: it cannot be opened, or is gone.
        """

    def describe(self) -> Mapping[str, Any]:
        """What identifies it, as JSON values, without secrets."""


class CameraFrames:
    """Makes the images of several cameras frames, all of one size.

    Without a size it is the `default_size` of the first camera's first image; images of others
    that come before are passed over.

    Args:
        names: of the cameras.
        size: (height, width) of a frame, or None.
        fit: see `fitted`.
        color: show red, green and blue beside one another.
        say: told in a line what is cut or added, and when a camera's images change their size.
    """

    def __init__(
        self,
        names: Sequence[str],
        size: Size | None,
        fit: Fit,
        *,
        color: bool = False,
        say: Callable[[str], None] = lambda line: None,
    ) -> None:
        self._names, self._say = names, say
        self._size, self._fit, self._color = size, fit, color
        self._numbers: Vector | None = None
        self._framings: dict[int, Framing | Vector] = {}
        self._changed: set[int] = set()

    def frame(self, camera: int, image: Shown) -> Shown | None:
        """An image as a frame; None as long as the size of frames is not known.

        Raises:
            UsageError: the image is smaller than a frame, or has other numbers than the first.
        """
        name = self._names[camera]
        framing = self._framings.get(camera)
        if framing is None:
            if image.ndim > 1 and self._size is None and camera:
                return None
            framing = self._framings[camera] = self._begin(name, image)
        if camera not in self._changed:
            change = rounded((), image) if image.ndim == 1 else framing.change(image.shape)
            if change:
                self._changed.add(camera)
                self._say(f"{name}: {change}")
        try:
            return framing.frame(image)
        except UsageError as error:
            raise type(error)(f"{name}: {error}") from None

    def _begin(self, name: str, first: Shown) -> Framing | Vector:
        """How a camera's images become frames, by the first of them."""
        framing = framings([first], self._size, self._fit, color=self._color)[0]
        if isinstance(framing, Framing):
            self._size = framing.size
            if size_of(first) != framing.size:
                self._say(f"{name}: {framing}")
        else:
            self._numbers = self._numbers or framing
            self._numbers.frame(first)
        return framing


@dataclass(eq=False)
class _Reading:
    """A camera being read.

    Attributes:
        connection: number of the thread that reads it: one that hangs is given up, and may still
            come back.
        waiting: pictures that nobody took yet.
        bytes: of these.
        lost: pictures that were thrown away because the queue was full.
        over: why nothing more comes; "" while it may.
        heard: when its last picture came, or its reading began.
        silent: whether it has been said that nothing comes.
        came: whether any picture ever came.
        away: whether it is not being read: it is gone, or its next connection is not due yet.
    """

    number: int
    camera: Camera
    heard: int
    connection: int = 0
    waiting: deque[Picture] = field(default_factory=deque)
    bytes: int = 0
    lost: int = 0
    over: str = ""
    silent: bool = False
    came: bool = False
    away: bool = False


class Readers:
    """Reads cameras, each in a thread, and keeps their pictures until they are taken.

    A queue that is full is emptied, so that what follows is one hole and not every other picture.
    A camera that never showed anything ends with what is wrong; one that did and stalls or goes
    away is waited for, connected to anew with growing delays, or at its end, as `on_loss` says.

    Args:
        cameras: opened in their threads.
        frame: makes an image of the camera with this number a frame; None passes it over.
        on_loss: see above.
        stall: seconds without a picture after which a camera has stalled.
        queue_bytes: most bytes that wait of one camera.
        say: told in a line of every change of a camera's state.
    """

    def __init__(
        self,
        cameras: Sequence[Camera],
        frame: Callable[[int, Shown], Shown | None] = lambda camera, image: image,
        *,
        on_loss: OnLoss = "reconnect",
        stall: float = 5.0,
        queue_bytes: int = QUEUE_BYTES,
        say: Callable[[str], None] = lambda line: None,
    ) -> None:
        self._frame, self._on_loss, self._say = frame, on_loss, say
        self._stall, self._limit = round(stall * NANOSECONDS), queue_bytes
        # Time never goes back while cameras are read, whatever is done to the wall clock.
        self._offset = time.time_ns() - time.monotonic_ns()
        self._lock = threading.Lock()
        self._news, self._closed = threading.Event(), threading.Event()
        self._readings = [_Reading(n, camera, self.now()) for n, camera in enumerate(cameras)]
        self._threads = [self._connect(reading) for reading in self._readings]

    def now(self) -> int:
        """The time since 1970 in nanoseconds."""
        return time.monotonic_ns() + self._offset

    def take(self, camera: int) -> Picture | None:
        """Remove and return the oldest queued picture of a camera; None if there is none."""
        reading = self._readings[camera]
        with self._lock:
            if not reading.waiting:
                return None
            picture = reading.waiting.popleft()
            reading.bytes -= picture.image.nbytes
            return picture

    def wait(self, until: int) -> None:
        """Return when something came in since the last wait, or at a time."""
        self._look_for_stalls()
        self._news.wait(max((until - self.now()) / NANOSECONDS, 0))
        self._news.clear()

    def over(self, camera: int) -> str:
        """Why a camera has ended; "" while it has not."""
        return self._readings[camera].over

    def lost(self, camera: int) -> int:
        """Pictures of a camera that were thrown away because the queue was full."""
        return self._readings[camera].lost

    def rate(self, camera: int) -> float | None:
        """Pictures a second that a camera states."""
        return self._readings[camera].camera.rate

    def close(self) -> None:
        """Let go of the cameras; one that hangs is left to itself."""
        self._closed.set()
        end = time.monotonic() + _LEAVE
        for thread in self._threads:
            thread.join(max(end - time.monotonic(), 0))

    def _connect(self, reading: _Reading) -> threading.Thread:
        args = (reading, reading.connection)
        thread = threading.Thread(target=self._read, args=args, daemon=True)
        thread.start()
        return thread

    def _read(self, reading: _Reading, connection: int) -> None:
        """Read a camera until it is over, again and again where that is asked for."""
        shortest, longest = _DELAYS
        delay, name = shortest, reading.camera.name
        while self._is_on(reading, connection):
            came = False
            try:
                for age, image in reading.camera.pictures():
                    taken = self.now() - age
                    frame = self._frame(reading.number, image)
                    if frame is None:
                        continue
                    if not self._put(reading, connection, Picture(taken, frame)):
                        return
                    came, delay = True, shortest
                why = f"{name} ended{'' if reading.came else ' before a picture of it came'}"
            except CdmisfaError as error:
                why = str(error)
            except Exception as error:
                why = f"{name} is gone: {one_line(error)}"
            if not self._is_on(reading, connection):
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

    def _is_on(self, reading: _Reading, connection: int) -> bool:
        return reading.connection == connection and not self._closed.is_set()

    def _put(self, reading: _Reading, connection: int, picture: Picture) -> bool:
        """Queue a picture; false if its thread was abandoned."""
        name = reading.camera.name
        with self._lock:
            if not self._is_on(reading, connection):
                return False
            full = len(reading.waiting)
            if full and reading.bytes + picture.image.nbytes > self._limit:
                reading.lost += full
                reading.waiting.clear()
                reading.bytes = 0
                said = "pictures thrown away: they came faster than they were taken"
                self._say(f"{name}: {full} {said}")
            reading.waiting.append(picture)
            reading.bytes += picture.image.nbytes
            back = reading.silent
            reading.heard, reading.silent, reading.came = self.now(), False, True
        self._news.set()
        if back:
            self._say(f"{name} shows pictures again")
        return True

    def _end(self, reading: _Reading, why: str) -> None:
        reading.over = why
        self._news.set()

    def _look_for_stalls(self) -> None:
        """Handle cameras that showed nothing for too long."""
        now = self.now()
        for number, reading in enumerate(self._readings):
            read = reading.came and not reading.away and not reading.over
            if not read or now - reading.heard <= self._stall:
                continue
            said, reading.silent = reading.silent, True
            why = f"{reading.camera.name}: no picture for {self._stall / NANOSECONDS:g} s"
            if self._on_loss == "end":
                self._end(reading, why)
            elif not said:
                what = "waiting" if self._on_loss == "wait" else "connecting to it anew"
                self._say(f"{why}: {what}")
            if self._on_loss == "reconnect":
                with self._lock:
                    reading.connection += 1  # the thread that hangs is for the connection before
                    reading.heard = now
                self._threads[number] = self._connect(reading)
