"""Pictures that are decoded in threads before they are asked for."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Final

import numpy as np

from cdmisfa.core.arrays import ByteArray
from cdmisfa.core.blocks import Block
from cdmisfa.core.processes import thread_count
from recorder.images.pixels import Shown
from replay.camera_logs.alignment import Rows
from replay.camera_logs.stream import ImageStream
from replay.storage.identity import LoggedSource

CORES: Final = thread_count()
"""Pictures that are decoded at once."""

Place = tuple[int, int]
"""The number of a stream, and the row of a picture in it."""

LIKELY: Final = 32
"""Frames behind a block that are taken for asked for next, at least: some show the same image."""


class DecodingAhead:
    """Pictures of streams that are decoded in threads before they are asked for.

    No more than two a thread are held, those of which nothing is known until they are asked for
    among them; with one thread there are none.
    """

    def __init__(self) -> None:
        self._streams: Sequence[ImageStream] = ()
        self._threads = ThreadPoolExecutor(CORES)
        self._begun: dict[Place, Future[ByteArray] | None] = {}
        self._coming: Iterator[Place] = iter(())

    def expect(self, streams: Sequence[ImageStream], places: Iterable[Place]) -> None:
        """Say what is asked for next, in this order; what is begun of others is forgotten."""
        self._streams = streams
        wanted = dict.fromkeys(places if CORES > 1 else ())
        for place in self._begun.keys() - wanted:
            self._forget(place)
        self._coming = iter([place for place in wanted if place not in self._begun])
        self._begin()

    def pop(self, place: Place) -> ByteArray | None:
        """A picture; None where it was not begun, or who asks shall see why not."""
        coming = self._begun.pop(place, None)
        self._begin()
        return None if coming is None or coming.exception() is not None else coming.result()

    def close(self) -> None:
        """Decode no more, and wait for what is being decoded; harmless when called twice."""
        for place in [*self._begun]:
            self._forget(place)
        self._threads.shutdown()

    def _begin(self) -> None:
        for stream, row in itertools.islice(self._coming, max(2 * CORES - len(self._begun), 0)):
            self._begun[stream, row] = self._streams[stream].begin(row, self._threads)

    def _forget(self, place: Place) -> None:
        if (coming := self._begun.pop(place)) is not None:
            coming.cancel()


class AheadSource(LoggedSource):
    """A source of streams of images, of which those that follow a block are decoded meanwhile."""

    _rows: Sequence[Rows]
    """Which image of each stream every frame shows."""

    def __init__(self) -> None:
        self._ahead, self._together = DecodingAhead(), False
        self._streams: list[ImageStream] = []
        self._shown: dict[int, tuple[int, Shown]] = {}  # the last of each, and its row

    def take_all(self, n: int) -> tuple[Block, ...]:
        """See `StoredSource`."""
        self._together = True
        try:
            return super().take_all(n)
        finally:
            self._together = False

    def _expect(self, stream: int, t: int, rows: Sequence[int]) -> None:
        """Begin to decode rows from frame t on, and what is likely asked for behind them.

        That is the next stream at the same frames, where all are taken, else what follows.
        """
        after, start = stream, t + len(rows)
        if self._together:
            after, start = stream + 1, t
            if after == len(self._streams):
                after, start = 0, t + len(rows)
        stop = start + max(len(rows), LIKELY)
        ahead = np.arange(start, stop if self._loop else min(stop, self.end)) % self._count
        places = [(stream, row) for row in rows]
        places += [(after, row) for row in self._rows[after][ahead].tolist()]
        shown = {(number, row) for number, (row, _) in self._shown.items()}
        self._ahead.expect(self._streams, (place for place in places if place not in shown))
