"""Read cameras, each in a thread of its own, and reconnect to lost ones."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple, Protocol

from cdmisfa.core.clock import NANOSECONDS
from cdmisfa.core.errors import CdmisfaError, UsageError, one_line
from recorder.images.framing import Framing, framings, size_of
from recorder.images.options import Fit, OnLoss, Size
from recorder.images.pixels import Content

# Largest total size of the images in the queue of one camera (bytes).
QUEUE_BYTES: Final = 64 * 1024 * 1024

# Seconds from a loss to the first attempt to reconnect, and longest time between two attempts.
_DELAYS: Final = (0.5, 30.0)

# Seconds that closing waits for the threads; they are daemons, and end with the process.
_CLOSE_WAIT: Final = 0.5


class Stamped(NamedTuple):
    """Image of a camera, and the time when it was taken or arrived, by the clock of all cameras."""

    time_ns: int
    image: Content


class Camera(Protocol):
    """Interface of a stream of images that is opened and read in a thread of its own.

    Attributes:
        name: name of the stream.
        finite: True if the camera can end, False if its end is a loss to recover from.
        rate: images a second that it states; None if it states none, or is not open yet.
    """

    name: str
    finite: bool

    @property
    def rate(self) -> float | None:
        """Images a second that the camera states, or None."""

    def images(self) -> Iterator[tuple[int, Content]]:
        """Open the camera, and yield its images as they arrive, until it ends.

        Yields:
            The age of the image (ns), 0 if only its arrival is known, and the image in its own
            size: gray (height, width) uint8, color (height, width, 3) uint8, or finite numbers
            (I,) float64, equally many each time.

        Raises:
            Exception: the camera cannot be opened, or is lost.
        """

    def describe(self) -> Mapping[str, Any]:
        """Return the identity of the camera as JSON values, without secrets."""


class CameraFrames:
    """Converter of the images of several cameras to frames of one size.

    The default size is the `default_size` for the first image of the first camera with images;
    images of other cameras before all earlier streams began are skipped.

    Args:
        names: names of the cameras.
        size: (height, width) of a frame, or None.
        fit: see `fitted`.
        color: True to show the red, green and blue images side by side.
        say: called with a line about cropping or padding, and about images that change their size.
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
        self._framings: dict[int, Framing] = {}
        self._changed: set[int] = set()

    def frame(self, camera: int, image: Content) -> Content | None:
        """Convert an image to a frame; return None while the size of frames is unknown.

        Raises:
            UsageError: the image is smaller than a frame, or the number of values changed.
        """
        name = self._names[camera]
        if camera not in self._framings:
            earlier = [self._framings.get(number) for number in range(camera)]
            if image.ndim > 1 and self._size is None and None in earlier:
                return None
            images = any(framing.first for framing in self._framings.values())
            if image.ndim < 2 and (images or len(self._framings) + 1 < len(self._names)):
                framing = Framing((), image.shape)  # as another stream may have images
                self._say(f"{name}: {framing}")
            else:
                framing = framings([image], self._size, self._fit, color=self._color)[0]
            self._framings[camera] = framing
            if framing.first:
                self._size = framing.shape[0], framing.size[1]
                if size_of(image) != framing.size:
                    self._say(f"{name}: {framing}")
        framing = self._framings[camera]
        if camera not in self._changed and (change := framing.change(image)):
            self._changed.add(camera)
            self._say(f"{name}: {change}")
        try:
            return framing.frame(image)
        except UsageError as error:
            raise type(error)(f"{name}: {error}") from None


@dataclass(eq=False)
class CameraState:
    """State of a camera that is being read.

    Attributes:
        number: index of the camera.
        camera: the camera.
        last_ns: time of its last image, or of the start of reading (ns).
        connection: number of the thread that reads the camera: a thread that hangs is abandoned,
            and can still return later.
        queue: images that were not taken yet.
        bytes: total size of the queue.
        lost: number of images that were discarded because the queue was full.
        over: reason for which no more images arrive; "" while they can.
        silent: True if its silence was reported.
        started: True if an image has arrived.
        away: True while the camera is not read, until it is reconnected.
    """

    number: int
    camera: Camera
    last_ns: int
    connection: int = 0
    queue: deque[Stamped] = field(default_factory=deque)
    bytes: int = 0
    lost: int = 0
    over: str = ""
    silent: bool = False
    started: bool = False
    away: bool = False


class Readers:
    """Readers of several cameras; each reads in a thread and queues images until they are taken.

    A full queue is emptied, so that the loss is one gap and not every second image. A camera that
    never delivered an image ends with its error. One that stalls or is lost later is waited for,
    reconnected with growing delays, or ended, according to `on_loss`.

    Args:
        cameras: cameras, which are opened in their threads.
        frame: converts an image of the camera with a number to a frame; None skips the image.
        on_loss: "reconnect", "wait" or "end".
        stall: time without an image after which a camera has stalled (s).
        queue_bytes: largest total size of the queue of one camera.
        say: called with a line for every change of a camera's state.

    Attributes:
        states: states of the cameras, in their order.
    """

    def __init__(
        self,
        cameras: Sequence[Camera],
        frame: Callable[[int, Content], Content | None] = lambda camera, image: image,
        *,
        on_loss: OnLoss = "reconnect",
        stall: float = 5.0,
        queue_bytes: int = QUEUE_BYTES,
        say: Callable[[str], None] = lambda line: None,
    ) -> None:
        self._frame, self._on_loss, self._say = frame, on_loss, say
        self._stall, self._limit = round(stall * NANOSECONDS), queue_bytes
        # Monotonic time plus a constant offset: it never goes back if the wall clock is set.
        self._offset = time.time_ns() - time.monotonic_ns()
        self._lock = threading.Lock()
        self._news, self._closed = threading.Event(), threading.Event()
        self.states = [CameraState(n, camera, self.now()) for n, camera in enumerate(cameras)]
        self._threads = [self._connect(state) for state in self.states]

    def now(self) -> int:
        """Return the time since 1970 (ns)."""
        return time.monotonic_ns() + self._offset

    def take(self, state: CameraState) -> Stamped | None:
        """Remove and return the oldest image in a camera's queue; None if the queue is empty."""
        with self._lock:
            if not state.queue:
                return None
            stamped = state.queue.popleft()
            state.bytes -= stamped.image.nbytes
            return stamped

    def wait(self, until: int) -> None:
        """Wait until an image arrives or the time `until` (ns) is reached."""
        for state in self.states:
            read = state.started and not state.away and not state.over
            if read and self.now() - state.last_ns > self._stall:
                self._handle_stall(state)
        self._news.wait(max((until - self.now()) / NANOSECONDS, 0))
        self._news.clear()

    def close(self) -> None:
        """Stop reading; a camera that hangs is abandoned."""
        self._closed.set()
        end = time.monotonic() + _CLOSE_WAIT
        for thread in self._threads:
            thread.join(max(end - time.monotonic(), 0))

    def _connect(self, state: CameraState) -> threading.Thread:
        args = (state, state.connection)
        thread = threading.Thread(target=self._read, args=args, daemon=True)
        thread.start()
        return thread

    def _read(self, state: CameraState, connection: int) -> None:
        """Read a camera until it is over; reconnect to it if `on_loss` says so."""
        shortest, longest = _DELAYS
        delay, name = shortest, state.camera.name
        while self._is_current(state, connection):
            received = False
            try:
                for age, image in state.camera.images():
                    taken = self.now() - age
                    frame = self._frame(state.number, image)
                    if frame is None:
                        continue
                    if not self._put(state, connection, Stamped(taken, frame)):
                        return
                    received, delay = True, shortest
                reason = f"{name} ended{'' if state.started else ' before an image of it arrived'}"
            except CdmisfaError as error:
                reason = str(error)
            except Exception as error:  # libraries of cameras raise various exceptions
                reason = f"{name} is lost: {one_line(error)}"
            if not self._is_current(state, connection):
                return
            state.away = True
            waits = self._on_loss == "wait"
            alone = all(other.away or other.over for other in self.states)
            ends = state.camera.finite or self._on_loss == "end" or (waits and alone)
            if ends or not state.started:
                state.over = reason
                self._news.set()
                return
            if waits:
                self._say(f"{reason}: the other cameras continue without it")
                return
            if received or delay == shortest:
                self._say(f"{reason}: reconnecting")
            self._closed.wait(delay)
            state.away, state.last_ns = False, self.now()
            delay = min(2 * delay, longest)

    def _is_current(self, state: CameraState, connection: int) -> bool:
        return state.connection == connection and not self._closed.is_set()

    def _put(self, state: CameraState, connection: int, stamped: Stamped) -> bool:
        """Queue an image; return False if its thread was abandoned."""
        name, size = state.camera.name, stamped.image.nbytes
        with self._lock:
            if not self._is_current(state, connection):
                return False
            count = len(state.queue)
            if count and state.bytes + size > self._limit:
                state.lost += count
                state.queue.clear()
                state.bytes = 0
                self._say(f"{name}: discarded {count} images: they came faster than they were used")
            state.queue.append(stamped)
            state.bytes += size
            resumed = state.silent
            state.last_ns, state.silent, state.started = self.now(), False, True
        self._news.set()
        if resumed:
            self._say(f"{name} delivers images again")
        return True

    def _handle_stall(self, state: CameraState) -> None:
        reported, state.silent = state.silent, True
        reason = f"{state.camera.name}: no image for {self._stall / NANOSECONDS:g} s"
        if self._on_loss == "end":
            state.over = reason
            self._news.set()
        elif not reported:
            self._say(f"{reason}: {'waiting' if self._on_loss == 'wait' else 'reconnecting'}")
        if self._on_loss == "reconnect":
            with self._lock:
                state.connection += 1  # abandons the thread, which hangs
                state.last_ns = self.now()
            self._threads[state.number] = self._connect(state)
