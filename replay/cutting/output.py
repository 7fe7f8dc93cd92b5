"""The log that is written of others, or its parts where it is split."""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final, Self

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.clock import NANOSECONDS
from cdmisfa.core.errors import UsageError
from recorder.log.files import make_folder, part_name
from recorder.log.logfile import LogFile
from recorder.log.manifest import ViewMetadata, version
from recorder.log.messages import RECORDING_METADATA, view_topic
from recorder.mcap.records import Segment
from recorder.mcap.tables import MessageTable
from replay.cutting.origin import Ids, Origin, Whole
from replay.segments import FOREVER

if TYPE_CHECKING:
    from recorder.config import Compression, Split

CUT_METADATA: Final = "cdmisfa.cut"
"""Name of the metadata record that says what a log was cut from."""
_SCHEMA: Final = 1
_OWN: Final = ("first_frame", "gaps")
"""What the files of a view may state each for itself."""


@dataclass(frozen=True, slots=True)
class Part:
    """A log that was written; times in nanoseconds."""

    file: str
    bytes: int
    messages: int
    start_ns: int
    end_ns: int


class Output:
    """Writes a log of others, or its parts; on an exception nothing of it is left.

    Args:
        path: of the log.
        origins: the logs.
        split: where a part ends; None for one file.
        force: overwrite what is there.
        ends: by view the frame at which the file of it that was written before ends.

    Raises:
        UsageError: files of several views are joined, or of several recordings.
    """

    def __init__(
        self,
        path: Path,
        origins: Sequence[Origin],
        split: Split | None,
        ends: dict[str, int],
        *,
        force: bool,
    ) -> None:
        self.parts: list[Part] = []
        self._path, self._origins, self._split, self._force = path, origins, split, force
        self._ends = ends
        self._every = 0 if split is None else round((split.seconds or 0) * NANOSECONDS)
        views = [origin for origin in origins if origin.view is not None]
        for origin in views[1:]:
            if _shared(origin.view) != _shared(views[0].view):
                raise UsageError(
                    f"{origin.path} and {views[0].path} are of different views or recordings, and "
                    f"each view has a file of its own: name a folder, as -o {path.stem}"
                )
        self._view = views[0].view if views else None
        self._topic = view_topic(self._view.view) if self._view else ""
        self._gaps = any(len(s) > 1 for o in views for s in o.spans.values())
        self._ids = Ids()
        for origin in origins:
            origin.name(self._ids)
        self._log: LogFile | None = None
        self._zero, self._period, self._last = -1, 0, 0

    def fits(self, chunk: Segment) -> bool:
        """Whether no part ends within a chunk."""
        return self._part_of(chunk.start) == self._part_of(chunk.end)

    def add_chunk(self, origin: Origin, whole: Whole) -> None:
        """Add a chunk as it is."""
        chunk = whole.chunk
        log = self._at(chunk.start, chunk.end, whole.messages)
        log.add_chunk(whole.data, chunk)
        for number, pairs in whole.pairs.items():
            self._see(origin, number, pairs[:, 0])

    def add_rows(self, origin: Origin, table: MessageTable) -> None:
        """Add messages, in their order."""
        renamed = origin.renamed
        for rows in self._runs(table):
            times = rows.log_time
            log = self._at(int(times.min()), int(times.max()), len(rows))
            log.write_all([(renamed[c], t, data, p, s) for c, s, t, p, data in rows.rows()])
            for number in np.unique(rows.channel).tolist() if self._view else ():
                self._see(origin, number, times[rows.channel == number])

    def finish(self) -> None:
        """End the last part."""
        if self._log is not None:
            self._end(self._log)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            return
        written = [Path(part.file) for part in self.parts]
        if self._log is not None:
            self._log.abandon()
            written.append(self._log.partial)
        with contextlib.suppress(OSError):  # what went wrong before is told
            for path in written:
                path.unlink(missing_ok=True)

    def _part_of(self, time: int) -> int:
        """The part that a log time is in, by its duration."""
        zero = time if self._zero < 0 else self._zero
        return max(time - zero, 0) // self._every if self._every else 0

    def _runs(self, table: MessageTable) -> Iterator[MessageTable]:
        """Messages in stretches that are of one part."""
        if not self._every:
            yield table
            return
        if self._zero < 0:
            self._zero = int(table.log_time.min())
        parts = np.array([self._part_of(time) for time in table.log_time.tolist()])
        edges = [0, *(np.flatnonzero(np.diff(parts)) + 1).tolist(), len(parts)]
        for low, high in itertools.pairwise(edges):
            yield table.select(np.arange(low, high))

    def _at(self, first: int, last: int, messages: int) -> LogFile:
        """The log for messages of such times, which are counted."""
        if self._zero < 0:
            self._zero = first
        period = self._part_of(first)
        if self._log is not None and self._split is not None:
            full = self._split.size is not None and self._log.size >= self._split.size
            if period > self._period or (full and first > self._last):
                self._end(self._log)
        self._period = max(self._period, period)
        if self._log is None:
            self._log = self._begin()
            self._first, self._last, self._messages = first, last, 0
            self._frames: tuple[int, int] | None = None
        self._first, self._last = min(self._first, first), max(self._last, last)
        self._messages += messages
        return self._log

    def _begin(self) -> LogFile:
        make_folder(self._path.parent)
        origins, ids = self._origins, self._ids
        number = None if self._split is None else len(self.parts)
        name = self._path.name if number is None else part_name(self._path.stem, number)
        profiles = {origin.reader.profile for origin in origins}
        libraries = sorted({origin.reader.library for origin in origins} - {""})
        of = {s.compression for origin in origins for s in origin.chunks[:1] if s.chunked}
        compression: Compression = "none" if of == {""} else "lz4" if of == {"lz4"} else "zstd"
        log = LogFile(
            self._path.with_name(name),
            force=self._force,
            library=f"cdmisfa cut ({', '.join(libraries)})",
            profile=profiles.pop() if len(profiles) == 1 else "",
            compression=compression,
            flush_ns=FOREVER,
            aside=True,
        )
        for number in sorted({o.renamed[own] for o in origins for own in o.spans}):
            channel = ids.channels[number]
            log.define(ids.schemas.get(channel.schema_id), channel)
        return log

    def _end(self, log: LogFile) -> None:
        """End a part, with what belongs to every one."""
        written: list[object] = []
        for origin in self._origins:
            for record in origin.reader.metadata:
                own = self._view is not None and record.name == RECORDING_METADATA
                values = self._recorded() if own else record.values
                if (record.name, values) not in written:
                    written.append((record.name, values))
                    log.add_metadata(record.name, values)
            for one in origin.reader.attachments:
                data = origin.reader.attachment_data(one)
                times = {"log_time": one.log_time, "create_time": one.create_time}
                key = (one.name, one.media_type, times, hashlib.sha256(data).digest())
                if key not in written:
                    written.append(key)
                    log.add_attachment(one.name, one.media_type, data, **times)
        about = [origin.as_json() for origin in self._origins]
        told = {"schema": str(_SCHEMA), "version_cdmisfa": version("cdmisfa")}
        log.add_metadata(CUT_METADATA, {**told, "logs": json.dumps(about)})
        log.finish()
        path = log.path
        size = path.stat().st_size
        self.parts.append(Part(str(path), size, self._messages, self._first, self._last))
        self._log = None

    def _see(self, origin: Origin, number: int, times: NDArray[np.uint64]) -> None:
        """Note the frames of a recording's view."""
        if origin.view is None or origin.reader.channels[number].topic != self._topic:
            return
        low, high = origin.view.frames_at(np.array([times.min(), times.max()])).tolist()
        first, stop = self._frames or (low, low)
        self._frames = min(first, low), max(stop, high + 1)

    def _recorded(self) -> dict[str, str]:
        """What a view's file states of itself: its frames begin and end elsewhere now."""
        assert self._view is not None
        view, values = self._view.view, dict(self._view.values)
        if self._frames is not None:
            first, stop = self._frames
            if self._gaps or self._view.gaps:
                first = min(self._ends.get(view, first), first)
                values["gaps"] = str(True)
            values["first_frame"] = str(first)
            self._ends[view] = stop
        return values


def _shared(view: ViewMetadata | None) -> dict[str, str]:
    """What all files of a view state alike."""
    values = view.values if view else {}
    return {key: value for key, value in values.items() if key not in _OWN}
