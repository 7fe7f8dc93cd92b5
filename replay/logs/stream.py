"""One stream of a log: its times, and how its images or numbers are read and decoded."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.arrays import FloatArray, IntArray
from cdmisfa.core.errors import CdmisfaError, LogDamagedError, UsageError
from cdmisfa.core.untrusted import BUDGET, budget
from recorder.images.fields import joint_places
from recorder.images.options import RECIPE
from recorder.images.pixels import Content, MalformedImage
from recorder.mcap.reader import LogReader
from recorder.mcap.records import MalformedRecord

# Log times from here on count as damage, in nanoseconds: the year 2116.
LAST_NS: Final = 2**62

# Images per second of a stream that states no times.
RATE: Final = 30.0

Value = TypeVar("Value")

# Numbers of rows of a stream, from 0. A row is one message, image or row of a table.
Rows = range | IntArray


class UnreadableError(LogDamagedError):
    """A library cannot read a file."""


class MissingFileError(LogDamagedError):
    """A file of a dataset is missing."""


class NothingLoggedError(LogDamagedError):
    """The log was cut before its first message."""


# Errors of a single image; later images may be readable.
BROKEN: Final = (MalformedImage, MalformedRecord, UnreadableError)


@dataclass(frozen=True, slots=True, kw_only=True)
class LogStream:
    """One topic, video, folder of images, table, array, or view of a recording.

    Rows are read one at a time with `fetch` and `decode`. Formats in which a single row cannot be
    damaged by itself have `read`, which reads many rows at once.

    Attributes:
        path: the log.
        topic: the topic; in formats without topics the name of the file or column.
        count: number of rows.
        times: (count,) log times (ns), not decreasing; None for rows that may have any even rate.
        begins: log time of the first row if `times` is None (ns).
        fetch: reads the stored bytes of a row; one thread at a time may call it.
        decode: turns these bytes into a gray image of its original size, or numbers (I,).
        compressed: returns the JPEG or PNG in these bytes, which threads can decode ahead; None if
            the images have another encoding.
        read: returns the frames or images of rows, (n, ...), and their ground truth, (n, D).
        memory_bytes: returns the bytes of the memory budget that `fetch` holds.
        program: name of the decoding library in errors.
        where: returns the name of a row in errors.
        stamp: returns the time in the header of a message (ns); None without a header.
        pixel_format: returns the pixel format that a message states; None if it states none.
        encoding: encoding of its images in formats without messages.
        recipe: text that states how an image becomes a frame, stored with runs.
        fields: fields that are read instead of images, in order.
        columns: returns the name of each number of a row.
        elements: returns the same by the names of joints, as `elbow`; () where none are stated.
        warnings: lines to print for the user.
        notes: lines on topics that are left out.
        remarks: a line for each property that the format cannot guarantee, as without checksums.
        missing: the missing part of a truncated file, or "".
        reader: the MCAP file, if all rows are in one.
        digest: returns name, type, shape and hash of an array of the caller, as JSON values.
        views: in recordings the files of the view, by first frame; rows are frame numbers.
    """

    path: Path
    topic: str
    count: int
    times: IntArray | None = None
    begins: int = 0
    fetch: Callable[[int], Any] = int
    decode: Callable[[Any], Content] = np.asarray
    compressed: Callable[[Any], bytes | None] | None = None
    read: Callable[[Rows], tuple[NDArray[Any], FloatArray]] | None = None
    memory_bytes: Callable[[], int] = int
    program: str = "its decoder"
    where: Callable[[int], str] | None = None
    stamp: Callable[[Any], int] | None = None
    pixel_format: Callable[[Any], str] | None = None
    encoding: str = ""
    recipe: str = RECIPE
    fields: Sequence[str] = ()
    columns: Callable[[], Sequence[str]] = tuple
    elements: Callable[[], Sequence[str]] = tuple
    warnings: Sequence[str] = ()
    notes: Sequence[str] = ()
    remarks: Sequence[str] = ()
    missing: str = ""
    reader: LogReader | None = None
    digest: Callable[[], Mapping[str, Any]] | None = None
    views: Sequence[Any] = ()

    def __post_init__(self) -> None:
        """Check that there are rows, at times between 1970 and the end of any clock.

        Raises:
            UsageError: there are no rows.
            LogDamagedError: a time lies outside.
        """
        if not self.count:
            raise UsageError(f"{self.path}: {self.topic} has no messages or frames")
        if self.times is not None:
            check_times(f"{self.path}: {self.topic}", self.times)

    def image(self, row: int) -> Content:
        """Decode a row.

        Raises:
            MalformedRecord: the row is damaged.
            LogDamagedError: the log is damaged there.
        """
        if self.read is not None:
            image: Content = self.read(range(row, row + 1))[0][0]
            return image
        return self.taken(row, self.decode)

    def taken(self, row: int, function: Callable[[Any], Value]) -> Value:
        """Apply a function to the stored bytes of a row; raises as `image`."""
        with limited(self.path, self.program, memory_bytes=self.memory_bytes()):
            return function(self.fetch(row))

    def seconds(self) -> FloatArray:
        """Return the time of each row (s)."""
        if self.times is None:
            return np.arange(self.count) / RATE
        return np.asarray(self.times / 1e9, np.float64)

    def name_of(self, row: int) -> str:
        """Return how an error names a row."""
        if self.where is not None:
            return self.where(row)
        at = f" at {self.times[row]} ns" if self.times is not None else ""
        return f"{self.path}: {self.topic}{at}"

    def part(self, rows: IntArray, times: IntArray | None) -> LogStream:
        """Return a stream of some of the rows, at the given times."""

        def at(function: Callable[[int], Any]) -> Callable[[int], Any]:
            return lambda row: function(int(rows[row]))

        changes: dict[str, Any] = {"fetch": at(self.fetch), "where": at(self.name_of)}
        if (read := self.read) is not None:
            changes["read"] = lambda wanted: read(picked(rows, wanted))
        return replace(self, count=len(rows), times=times, **changes)


def check_times(where: object, times: IntArray) -> None:
    """Refuse sorted times before 1970 or beyond any clock, as damage of `where`."""
    if not 0 <= times[0] <= times[-1] < LAST_NS:
        raise LogDamagedError(f"{where} has times before 1970 or after 2116")


def _in_order(stream: LogStream, elements: Sequence[str]) -> LogStream:
    """Return a stream with the numbers of its rows in the order of `elements`."""
    present, decode = list(stream.elements()), stream.decode
    if not (present and elements) or present == list(elements):
        return stream
    places = joint_places(f"{stream.path}: {stream.topic}", elements, present)
    return replace(stream, decode=lambda data: decode(data)[places])


def joined(parts: Sequence[LogStream]) -> LogStream:
    """Merge streams with times into one, ordered by time, ties in the order of the streams.

    Raises:
        UsageError: they have other joints.
    """
    parts = [_in_order(part, parts[0].elements()) for part in parts]
    times = np.concatenate([part.times for part in parts if part.times is not None])
    order = np.argsort(times, kind="stable")
    part_of = np.repeat(np.arange(len(parts)), [part.count for part in parts])[order]
    rows = np.concatenate([np.arange(part.count) for part in parts])[order]

    def fetch(row: int) -> tuple[LogStream, Any]:
        part, part_row = parts[part_of[row]], int(rows[row])
        return part, part.image(part_row) if part.read else part.fetch(part_row)

    def of_part(attribute: str, default: Any = None) -> Callable[[tuple[LogStream, Any]], Any]:
        def function(stored: tuple[LogStream, Any]) -> Any:
            part, data = stored
            method = getattr(part, attribute)
            return method(data) if method else default

        return function

    first = parts[0]
    note = f"{first.path}: {first.topic} is joined from {len(parts)} logs in order of time"
    return replace(
        first,
        count=len(times),
        times=times[order],
        fetch=fetch,
        decode=of_part("decode"),
        compressed=of_part("compressed"),
        read=None,
        memory_bytes=lambda: max(part.memory_bytes() for part in parts),
        where=lambda row: parts[part_of[row]].name_of(int(rows[row])),
        pixel_format=of_part("pixel_format", ""),
        warnings=[note, *(warning for part in parts for warning in part.warnings)],
    )


def picked(array: NDArray[Any], rows: Rows) -> NDArray[Any]:
    """Return rows of an array; a range of rows is not copied."""
    return array[rows.start : rows.stop] if isinstance(rows, range) else array[rows]


@contextmanager
def explained(path: object, program: str, remedy: str = "") -> Iterator[None]:
    """Turn any error of a library that reads a file into an error of one line.

    Raises:
        UnreadableError: the library raised an error, or would take more memory than its budget.
    """
    try:
        yield
    except (CdmisfaError, ImportError):
        raise
    except MemoryError:
        limit = f"the limit of {BUDGET >> 20} MiB of memory"
        hint = f": {remedy}" if remedy else ""
        raise UnreadableError(f"{path}: {program} needs more than {limit}{hint}") from None
    except Exception as error:
        reason = " ".join(f"{type(error).__name__}: {error}".split())[:200]
        raise UnreadableError(f"{path}: {program} cannot read it ({reason})") from None


@contextmanager
def limited(
    path: object, program: str, *, memory_bytes: int = 0, remedy: str = ""
) -> Iterator[None]:
    """Limit the memory to the budget for untrusted files, and do as `explained`.

    PyArrow then uses the system's memory, because its own pool reserves memory outside any budget.
    """
    if program == "PyArrow":
        import pyarrow

        pyarrow.set_memory_pool(pyarrow.system_memory_pool())
    with explained(path, program, remedy), budget(max(BUDGET - memory_bytes, 0)):
        yield


@dataclass(frozen=True, slots=True)
class ChannelInfo:
    """A channel of a log, or one stream of a log that has no channels.

    Attributes:
        topic: name of the topic; of the file or column in formats without topics.
        encoding: encoding of its messages: "protobuf", "cdr", "ros1", "png", codec of a video.
        schema: type of its messages.
        messages: number of messages.
        start_ns: log time of the first message in nanoseconds; None if unknown.
        end_ns: log time of the last message in nanoseconds; None if unknown.
        file: name of the file.
    """

    topic: str
    encoding: str
    schema: str
    messages: int
    start_ns: int | None = None
    end_ns: int | None = None
    file: str = ""

    @property
    def rate(self) -> float | None:
        """Messages per second between the first and the last; None without a duration."""
        if self.start_ns is None or self.end_ns is None or self.end_ns <= self.start_ns:
            return None
        return (self.messages - 1) * 1e9 / (self.end_ns - self.start_ns)


@dataclass(frozen=True, slots=True)
class ExternalChannel:
    """A channel of an external log, and what its format cannot guarantee.

    Attributes:
        info: the channel.
        images: whether its messages are images that can be read.
        missing: the missing part of a truncated file, or "".
        remarks: a line for each property that the format cannot guarantee, as without checksums.
    """

    info: ChannelInfo
    images: bool = True
    missing: str = ""
    remarks: tuple[str, ...] = ()
