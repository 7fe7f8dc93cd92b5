"""Saving what can be read of a damaged log as a whole one."""

from __future__ import annotations

import contextlib
import hashlib
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from cdmisfa.core.errors import LogDamagedError, UsageError
from recorder.log.files import make_folder
from recorder.log.logfile import LogFile
from recorder.mcap.chunks import UNUSED
from recorder.mcap.mending import mended
from recorder.mcap.reader import LogReader
from recorder.mcap.records import Problem
from recorder.mcap.store import PARTIAL
from recorder.mcap.tables import MessageTable
from replay.camera_logs.opening import only_foreign
from replay.integrity.survey import SCHEMA, ChannelSurvey, moved, problems_of
from replay.storage.location import Location, location
from replay.storage.opening import fetched, log_files, open_store


@dataclass(slots=True)
class _Tally:
    """What became of one channel; `digest` is over times and payloads in file order."""

    kept: ChannelSurvey = field(default_factory=ChannelSurvey)
    lost: int | None = 0
    digest: Any = field(default_factory=hashlib.sha256)


@dataclass(frozen=True, slots=True)
class ChannelRecovery:
    """What was saved of a channel; `lost` is None where nothing tells how much."""

    topic: str
    kept: int
    lost: int | None
    start_ns: int | None
    end_ns: int | None
    file: str


@dataclass(frozen=True, slots=True)
class Recovery:
    """What was saved of a log, or of all logs of a folder.

    Attributes:
        out: the log or folder that was written.
        lost: what could not be saved.
        mended: what was damaged and is made again from what else the log says: nothing is lost.
        unverified: messages saved of a cut chunk, whose checksum cannot be checked.
    """

    out: str
    channels: tuple[ChannelRecovery, ...]
    lost: tuple[Problem, ...]
    mended: tuple[Problem, ...]
    unverified: int

    @property
    def complete(self) -> bool:
        """Whether nothing was lost."""
        return not self.lost

    def as_json(self) -> dict[str, Any]:
        """What was saved as JSON values."""
        found = asdict(self)
        return {"schema": SCHEMA, "out": found.pop("out"), "complete": self.complete, **found}


def recover_log(src: str | Location, dst: str | Path, *, force: bool = False) -> Recovery:
    """Write a complete, indexed log of everything in `src` that is readable.

    The new file is read again, with its checksums, and compared before this returns.
    Of a folder each log is recovered into the folder `dst`. What lies behind a URL is copied
    first.

    Raises:
        UsageError: no such log, one of another kind than MCAP, or the output exists and `force` is
            not set.
        LogDamagedError: not an MCAP file, or nothing in it can be saved.
        LogWriteError: the disk does not take it.
    """
    place, dst = location(src), Path(dst)
    with fetched(place) as copy:
        found = _recover(copy, dst, force)
    lost, right = ([moved(p, copy, place) for p in those] for those in (found.lost, found.mended))
    return replace(found, lost=tuple(lost), mended=tuple(right))


def _recover(src: Path, dst: Path, force: bool) -> Recovery:
    if src.exists() and only_foreign(src):
        raise UsageError(
            f"{src} is no MCAP file, and others are not recovered: learn and convert pass over "
            "broken images of them with --salvage"
        )
    files = [file for file in log_files(src) if isinstance(file, Path)]
    targets = [dst]
    if src.is_dir():
        if dst.exists() and not dst.is_dir():
            raise UsageError(f"{dst} is a file: name a folder for the logs of {src}")
        targets = [dst / file.name.removesuffix(PARTIAL) for file in files]
    try:
        make_folder(dst if src.is_dir() else dst.parent)
    except OSError as error:
        raise UsageError(f"{dst}: {error.strerror}") from None
    for file, target in zip(files, targets, strict=True):
        if target.exists() and file.samefile(target):
            raise UsageError(f"{target}: cannot be recovered into itself, name another file")
    alone = not src.is_dir()  # else it may be that there is something in the other logs
    found = [_recover_file(f, t, force, alone) for f, t in zip(files, targets, strict=True)]
    return Recovery(
        out=str(dst),
        channels=tuple(c for one in found for c in one.channels),
        lost=tuple(p for one in found for p in one.lost),
        mended=tuple(p for one in found for p in one.mended),
        unverified=sum(one.unverified for one in found),
    )


def _recover_file(src: Path, dst: Path, force: bool, alone: bool) -> Recovery:
    with _opened(src) as (reader, right):
        found = reader.channels or reader.metadata or reader.attachments
        if alone and reader.missing and not found:
            raise LogDamagedError(f"{src}: nothing in it can be saved, and nothing was written")
        library = f"cdmisfa recover ({reader.library})" if reader.library else "cdmisfa recover"
        with LogFile(dst, force=force, library=library, profile=reader.profile) as log:
            tallies, unverified = _copy(reader, log)
        _compare(dst, reader, tallies)
        channels = [
            ChannelRecovery(
                topic=reader.channels[number].topic,
                kept=tally.kept.messages,
                lost=tally.lost,
                start_ns=tally.kept.start,
                end_ns=tally.kept.end,
                file=dst.name,
            )
            for number, tally in sorted(tallies.items())
        ]
        return Recovery(str(dst), tuple(channels), _lost(reader), right, unverified)


@contextlib.contextmanager
def _opened(src: Path) -> Iterator[tuple[LogReader, tuple[Problem, ...]]]:
    """A log, where it is damaged with what can be made right of it, and what that was."""
    with LogReader(src, salvage=True) as reader:
        if not reader.problems:
            yield reader, ()
            return
    store = mended(open_store(src))
    with LogReader(store, salvage=True) as reader:
        yield reader, tuple(Problem(f"{src}: {p.where}", p.what) for p in store.mended)


def _lost(reader: LogReader) -> tuple[Problem, ...]:
    """What is wrong with a log, but for what only says where the messages are that are there."""
    found = [problem for problem in problems_of(reader) if not problem.what.endswith(UNUSED)]
    data = f"{reader.path}: data section"
    if reader.data_complete:
        index = {str(reader.path), *(f"{reader.path}: {part}" for part in ("summary", "footer"))}
        found = [problem for problem in found if problem.where not in index]
        proven = all(segment.crc for segment in reader.segments if segment.size)
        if proven and {problem.where for problem in found} == {data}:
            what = "damaged between the chunks: every message is there, metadata may be wrong"
            found = [Problem(data, f"its CRC does not match: {what}")]
    return tuple(found)


def _copy(reader: LogReader, log: LogFile) -> tuple[dict[int, _Tally], int]:
    for record in reader.metadata:
        log.add_metadata(record.name, record.values)
    for attachment in reader.attachments:
        log.add_attachment(
            attachment.name,
            attachment.media_type,
            reader.attachment_data(attachment),
            log_time=attachment.log_time,
            create_time=attachment.create_time,
        )
    channels, schemas = reader.channels, reader.schemas
    tallies = {number: _Tally() for number in channels}
    known: dict[int, int] = {}
    for number, channel in sorted(channels.items()):
        schema = schemas.get(channel.schema_id)
        known[number] = log.add_channel(
            channel.topic,
            log.add_schema(schema.name, schema.encoding, schema.data) if schema else 0,
            encoding=channel.encoding,
            metadata=channel.metadata,
        )
    unverified = 0
    for segment, table in reader.tables(ordered=False):
        unverified += len(table) if segment.cut and segment.crc else 0
        for row, number in enumerate(table.channel.tolist()):
            if number in known:
                log.write(
                    known[number],
                    int(table.log_time[row]),
                    table.payload(row),
                    int(table.records["sequence"][row]),
                    int(table.records["publish_time"][row]),
                )
        _tally(tallies, table)
    _count_lost(reader, tallies)
    return tallies, unverified


def _tally(tallies: dict[int, _Tally], table: MessageTable) -> None:
    for number in tallies.keys() & np.unique(table.channel).tolist():
        rows = table.select(table.channel == number)
        tally = tallies[number]
        tally.kept.add(rows.log_time)
        for row in range(len(rows)):
            tally.digest.update(rows.log_time[row].tobytes())
            tally.digest.update(rows.payload(row))


def _count_lost(reader: LogReader, tallies: dict[int, _Tally]) -> None:
    """How many messages are gone: by the writer's statistics, else by the index of each chunk."""
    stated = reader.statistics
    counts = [s.channel_counts() for s in reader.segments if reader.table(s) is None]
    for number, tally in tallies.items():
        if stated is not None:
            tally.lost = max(stated.per_channel.get(number, 0) - tally.kept.messages, 0)
        elif not reader.data_complete or None in counts:
            tally.lost = None
        else:
            tally.lost = sum(c.get(number, 0) for c in counts if c is not None)


def _compare(dst: Path, source: LogReader, tallies: dict[int, _Tally]) -> None:
    """Read the new log with every checksum and compare it with what was written."""
    with LogReader(dst) as reader:
        found = {number: _Tally() for number in reader.channels}
        for _, table in reader.tables(ordered=False):
            _tally(found, table)
        if reader.missing or reader.problems or len(reader.metadata) != len(source.metadata):
            raise LogDamagedError(f"{dst}: the recovered log is not whole; check the disk")
    read, written = ([one[n].digest.digest() for n in sorted(one)] for one in (found, tallies))
    if read != written:
        raise LogDamagedError(f"{dst}: differs from what was recovered; check the disk")
