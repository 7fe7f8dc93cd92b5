"""What was logged, given again when it is due."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Final, Protocol, TypeVar

from cdmisfa.core.clock import NANOSECONDS

SLICE: Final = 0.1
"""Most seconds between two looks at whether to stop."""


class Timed(Protocol):
    """Something with a log time."""

    @property
    def time_ns(self) -> int:
        """The log time, in nanoseconds."""


Item = TypeVar("Item", bound=Timed)


@dataclass
class Played:
    """What was played.

    Attributes:
        count: how many items.
        seconds: of log time, all rounds together.
        behind: seconds by which the last item came late.
        stopped: whether it was ended before the last item.
    """

    count: int = 0
    seconds: float = 0.0
    behind: float = 0.0
    stopped: bool = False


def rounds(
    feed: Callable[[], Iterable[Item]], start: int, stop: int, *, loop: bool
) -> Iterator[tuple[int, Item]]:
    """Items with the nanoseconds since the first, again and again where it loops.

    Args:
        feed: gives the items of one round, in the order of their times.
        start: log time of the first.
        stop: log time of the last.
        loop: begin again at the end, after the mean step between two times.
    """
    before = 0
    while True:
        times, last = 0, -1
        for item in feed():
            times, last = times + (item.time_ns != last), item.time_ns
            yield before + item.time_ns - start, item
        if not loop or times == 0:
            return
        before += round((stop - start) * times / max(times - 1, 1)) or NANOSECONDS


def paced(
    items: Iterable[tuple[int, Item]],
    rate: float,
    played: Played,
    *,
    stop: Callable[[], bool] = lambda: False,
    now: Callable[[], float] = time.monotonic,
    sleep: Callable[[float], None] = time.sleep,
) -> Iterator[tuple[int, Item]]:
    """Give each item at its own time, counted from the first: what is late delays none after it.

    Args:
        items: with the nanoseconds since the first.
        rate: how many seconds of log time pass in one.
        played: told of what was given.
        stop: asked while waiting; true ends it.
        now: the time, in seconds.
        sleep: waits so many seconds.
    """
    begin = None
    for since, item in items:
        begin = now() if begin is None else begin
        due = begin + since / NANOSECONDS / rate
        while (left := due - now()) > 0 and not stop():
            sleep(min(left, SLICE))
        if stop():
            played.stopped = True
            return
        played.count += 1
        played.seconds = since / NANOSECONDS
        played.behind = max(-left, 0.0)
        yield since, item
