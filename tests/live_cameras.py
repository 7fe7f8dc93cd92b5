"""Cameras for tests: scripted ones on a clock of their own, and real threads."""

from __future__ import annotations

import contextlib
import itertools
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence, Sized
from typing import Any, NamedTuple

import foxglove
import numpy as np

from cdmisfa.core.clock import NANOSECONDS
from recorder.cameras.readers import CameraState, Readers, Stamped

SHAPE = (12, 16)
BEGIN = 10**18
"""When the scripted cameras begin."""


class Arrival(NamedTuple):
    """A picture that comes at a time, taken at another, both in seconds from `BEGIN`."""

    comes: float
    stream: int
    image: np.ndarray[Any, Any]
    taken: float | None = None


class ScriptedReaders(Readers):
    """Pictures that come by a script; time passes only while they are waited for.

    A camera whose script is over has ended.
    """

    def __init__(self, script: Sequence[Arrival], streams: int, rate: float | None = 30.0) -> None:
        self._script = deque(sorted(script, key=lambda arrival: arrival.comes))
        self.states = [CameraState(n, Hand(f"camera {n}", rate), BEGIN) for n in range(streams)]
        self._now = BEGIN
        self.closed = 0
        self._look_ahead()

    def now(self) -> int:
        return self._now

    def wait(self, until: int) -> None:
        comes = self._script[0].comes if self._script else np.inf
        if BEGIN + comes * NANOSECONDS > until:
            self._now = max(self._now, until)
            return
        arrival = self._script.popleft()
        self._now = BEGIN + round(arrival.comes * NANOSECONDS)
        taken = arrival.comes if arrival.taken is None else arrival.taken
        stamped = Stamped(BEGIN + round(taken * NANOSECONDS), arrival.image)
        self.states[arrival.stream].queue.append(stamped)
        self._look_ahead()

    def take(self, state: CameraState) -> Stamped | None:
        return state.queue.popleft() if state.queue else None

    def close(self) -> None:
        self.closed += 1

    def _look_ahead(self) -> None:
        for number, state in enumerate(self.states):
            left = any(arrival.stream == number for arrival in self._script)
            state.over = "" if left else f"camera {number} ended"


def bar(seed: int, k: int) -> np.ndarray[Any, Any]:
    """What a camera sees at its k-th picture: a bar that moves, and noise."""
    picture = np.random.default_rng([seed, k]).integers(0, 40, SHAPE, np.uint8)
    picture[:, int(7.5 + 7 * np.sin((seed + 1) * k / 40))] += 200
    return picture


class Hand:
    """A camera that shows what it is handed: images, an error to raise, or None to end."""

    finite = False

    def __init__(self, name: str, rate: float | None = 50.0) -> None:
        self.name, self.rate = name, rate
        self.opened = 0
        self._given: deque[Any] = deque()
        self._there = threading.Condition()

    def give(self, *things: Any) -> None:
        with self._there:
            self._given.extend(things)
            self._there.notify_all()

    def images(self) -> Iterator[tuple[int, Any]]:
        self.opened += 1
        number = self.opened
        while True:
            with self._there:
                while not self._given or number != self.opened:  # an older connection hangs
                    self._there.wait()
                thing = self._given.popleft()
            if thing is None:
                return
            if isinstance(thing, Exception):
                raise thing
            yield 0, thing

    def describe(self) -> Mapping[str, Any]:
        return {"camera": self.name}


class Robot:
    """foxglove-sdk's server on loopback; what it shows is said by `showing`."""

    def __init__(self) -> None:
        self.context = foxglove.Context()
        self.server = foxglove.start_server(
            name="robot", host="127.0.0.1", port=0, context=self.context
        )

    @property
    def address(self) -> str:
        return f"foxglove://127.0.0.1:{self.server.port}"

    @contextlib.contextmanager
    def showing(
        self,
        channel: Callable[..., Any],
        topic: str,
        message: Callable[[int], Any],
        after: Sized = "at once",
    ) -> Iterator[None]:
        """Show messages on a topic, 50 a second, once something is in `after`."""
        over, there = threading.Event(), threading.Event()

        def show() -> None:
            while not after:
                time.sleep(0.02)
            opened = channel(topic, context=self.context)
            there.set()
            for k in itertools.takewhile(lambda _: not over.wait(0.02), itertools.count()):
                opened.log(message(k))

        thread = threading.Thread(target=show)
        thread.start()
        if after:
            there.wait()
        yield
        over.set()
        thread.join()

    def close(self) -> None:
        self.server.stop()
