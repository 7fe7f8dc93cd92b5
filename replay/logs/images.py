"""Images of streams: decoded ahead, and replaced if they are broken."""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Final

from cdmisfa.core.arrays import ByteArray
from cdmisfa.core.errors import CdmisfaError, LogDamagedError, UsageError
from cdmisfa.core.processes import thread_count
from recorder.images.compressed import MAX_THREAD_PIXELS, compressed_image
from recorder.images.pixels import Content, UnknownPixels, losses, lost
from replay.logs.stream import BROKEN, LogStream

REMEDY: Final = "learn, convert and apply replace broken images with --skip-damaged"

# Images that are decoded at once.
CORES: Final = thread_count()

# The number of a stream, and a row of it.
StreamRow = tuple[int, int]


class Images:
    """The images of streams, one by one; every error of a row is raised here, with its name.

    Threads decode images ahead; with one thread there are none. No more than two a thread are held,
    images that no thread can decode among them.

    Args:
        streams: the streams.
        color: whether images are decoded in their colors.
        skip_damaged: show for a broken image the last whole one before it, else the first of all.
    """

    def __init__(self, streams: Sequence[LogStream], *, color: bool, skip_damaged: bool) -> None:
        self._streams, self._color, self._skip_damaged = streams, color, skip_damaged
        self._threads = ThreadPoolExecutor(CORES)
        self._pending: dict[StreamRow, Future[tuple[ByteArray, list[str]]] | None] = {}
        self._coming: Iterator[StreamRow] = iter(())
        self._whole: dict[int, tuple[int, Content]] = {}
        self._broken: dict[int, dict[int, LogDamagedError]] = {}

    def expect(self, places: Iterable[StreamRow]) -> None:
        """Announce the rows that are asked for next, in this order; others are forgotten."""
        wanted = dict.fromkeys(places if CORES > 1 else ())
        for place in self._pending.keys() - wanted:
            self._forget(place)
        self._coming = iter([place for place in wanted if place not in self._pending])
        self._begin()

    def pop(self, place: StreamRow) -> ByteArray | None:
        """Return an image; None if no thread has decoded it, or the caller shall see the error."""
        coming = self._pending.pop(place, None)
        self._begin()
        if coming is None or coming.exception() is not None:
            return None
        image, lines = coming.result()
        for line in lines:
            lost(line)
        return image

    def close(self) -> None:
        """Decode no more, and wait for running threads; harmless when called twice."""
        for place in [*self._pending]:
            self._forget(place)
        self._threads.shutdown()

    def _begin(self) -> None:
        for place in itertools.islice(self._coming, max(2 * CORES - len(self._pending), 0)):
            self._pending[place] = self._decode(*place)

    def _decode(self, number: int, row: int) -> Future[tuple[ByteArray, list[str]]] | None:
        """Fetch a row in this thread, and let another decode it; None for other images."""
        stream, data = self._streams[number], None
        if stream.compressed is not None:
            with contextlib.suppress(CdmisfaError):  # the caller shall see it
                data = stream.taken(row, stream.compressed)
        if data is None:
            return None
        return self._threads.submit(_image_and_losses, data, self._color)

    def _forget(self, place: StreamRow) -> None:
        if (coming := self._pending.pop(place)) is not None:
            coming.cancel()

    def image(self, stream: int, row: int) -> Content:
        """Read an image of a stream.

        Raises:
            UsageError: the image has no pixels, or the message no fields, that are read.
            LogDamagedError: the image is broken, or with `skip_damaged` all are.
        """
        name = self._streams[stream].name_of
        try:
            read = self._whole_image if self._skip_damaged else self._decoded
            return read(stream, row)
        except UnknownPixels as error:
            raise UsageError(f"{name(row)}: {error}") from None
        except BROKEN as error:
            remedy = "" if self._skip_damaged else f": {REMEDY}"
            raise LogDamagedError(f"{name(row)}: {error}{remedy}") from None
        except UsageError as error:
            raise UsageError(f"{name(row)}: {error}") from None

    def _decoded(self, stream: int, row: int) -> Content:
        image = self.pop((stream, row))
        return self._streams[stream].image(row) if image is None else image

    def _whole_image(self, stream: int, row: int) -> Content:
        """Return the last whole image up to a row, else the first behind it: of the log alone."""
        broken = self._broken.setdefault(stream, {})
        count = self._streams[stream].count
        for near in itertools.chain(range(row, -1, -1), range(row + 1, count)):
            if near in broken:
                continue
            known = self._whole.get(stream)
            if known is not None and known[0] == near:
                return known[1]
            try:
                image = self._decoded(stream, near)
            except BROKEN as error:
                broken[near] = error
                continue
            self._whole[stream] = near, image
            return image
        raise broken[row]

    def broken_lines(self) -> list[str]:
        """Return a line for each stream with broken images that were replaced so far."""
        lines = []
        for stream, broken in sorted(self._broken.items()):
            if broken:
                log, first = self._streams[stream], min(broken)
                what = "messages" if log.fields else "images"
                lines.append(
                    f"{log.name_of(first)}: {broken[first]}: {len(broken)} of {log.count} "
                    f"{what} are broken and replaced by the last readable one"
                )
        return lines


def _image_and_losses(data: bytes, color: bool) -> tuple[ByteArray, list[str]]:
    with losses() as lines:
        return compressed_image(data, color=color, limit=MAX_THREAD_PIXELS), lines
