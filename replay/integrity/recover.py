"""Saving what can be read of a damaged log as a whole one."""

from __future__ import annotations

import contextlib
import hashlib
import struct
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from cdmisfa.core.errors import LogDamagedError, UsageError
from recorder.log.files import make_folder, refuse_unless
from recorder.log.logfile import LogFile
from recorder.mcap.chunks import UNUSED
from recorder.mcap.reader import LogReader
from recorder.mcap.records import Problem
from recorder.mcap.store import PARTIAL, FileStore
from replay.camera_logs.opening import only_foreign
from replay.integrity.counting import ChannelCount
from replay.integrity.info import SCHEMA, problems_of
from replay.integrity.mending import mended
from replay.storage.location import location
from replay.storage.opening import log_files

_HASHED: Final = struct.Struct("<HIQQ")
"""Of a message, before its payload: channel, sequence, log time, publish time."""


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


def recover_log(src: str | Path, dst: str | Path, *, force: bool = False) -> Recovery:
    """Write a complete, indexed log of everything in `src` that is readable.

    The new file is read again, with its checksums, and compared before this returns.
    Of a folder each log is recovered into the folder `dst`.

    Raises:
        UsageError: no such log, one of another kind than MCAP, or the output exists and `force` is
            not set.
        LogDamagedError: not an MCAP file, or nothing in it can be saved.
        LogWriteError: the disk does not take it.
    """
    src, dst = location(src), Path(dst)
    if src.exists() and only_foreign(src):
        raise UsageError(
            f"{src} is no MCAP file, and others are not recovered: learn and convert pass over "
            "broken images of them with --salvage"
        )
    files = log_files(src)
    targets = [dst]
    if src.is_dir():
        if dst.exists() and not dst.is_dir():
            raise UsageError(f"{dst} is a file: name a folder for the logs of {src}")
        targets = [dst / file.name.removesuffix(PARTIAL) for file in files]
    else:
        refuse_unless(dst, "the log is an MCAP file", ".mcap", "")
    try:
        make_folder(dst if src.is_dir() else dst.parent)
    except OSError as error:
        raise UsageError(f"{dst}: {error.strerror}") from None
    for file, target in zip(files, targets, strict=True):
        if target.exists() and file.samefile(target):
            raise UsageError(f"{target}: cannot be recovered into itself, name another file")
    alone = not src.is_dir()  # of a folder, other logs may hold something
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
            digest, kept, unverified = _copy(reader, log)
        _compare(dst, len(reader.metadata), digest)
        channels, lost = [], _lost_messages(reader, kept)
        for number, channel in sorted(reader.channels.items()):
            count = kept[number]
            counts = count.messages, lost[number], count.start, count.end
            channels.append(ChannelRecovery(channel.topic, *counts, dst.name))
        return Recovery(str(dst), tuple(channels), _lost(reader), right, unverified)


@contextlib.contextmanager
def _opened(src: Path) -> Iterator[tuple[LogReader, tuple[Problem, ...]]]:
    """A log, where it is damaged with what can be made right of it, and what that was."""
    with LogReader(src, salvage=True) as reader:
        if not reader.problems:
            yield reader, ()
            return
    store = mended(FileStore(src))
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


def _copy(reader: LogReader, log: LogFile) -> tuple[str, dict[int, ChannelCount], int]:
    """Write what is readable.

    Returns:
        A digest of all messages, what is kept of each channel, and how many messages no checksum
        proves.
    """
    for record in reader.metadata:
        log.add_metadata(record.name, record.metadata)
    for attachment in reader.attachments:
        log.add_attachment(
            attachment.name,
            attachment.media_type,
            reader.attachment_data(attachment),
            log_time=attachment.log_time,
            create_time=attachment.create_time,
        )
    kept: dict[int, ChannelCount] = {}
    written: dict[int, int] = {}

    def add_channels() -> None:
        for number in sorted(reader.channels.keys() - kept.keys()):
            channel = reader.channels[number]
            schema = reader.schemas.get(channel.schema_id)
            kept[number] = ChannelCount()
            written[number] = log.add_channel(
                channel.topic,
                log.add_schema(schema.name, schema.encoding, schema.data) if schema else 0,
                encoding=channel.message_encoding,
                metadata=channel.metadata,
            )

    add_channels()
    digest, unverified = hashlib.sha256(), 0
    for segment, table in reader.tables():
        add_channels()  # the summary may lack channels that are defined in a chunk
        unverified += len(table) if segment.cut and segment.crc else 0
        for number, sequence, log_time, published, data in table.rows():
            if number in written:
                log.write(written[number], log_time, data, sequence, published)
                digest.update(_HASHED.pack(written[number], sequence, log_time, published))
                digest.update(data)
        for number in kept.keys() & np.unique(table.channel).tolist():
            kept[number].add(table.log_time[table.channel == number])
    return digest.hexdigest(), kept, unverified


def _lost_messages(reader: LogReader, kept: dict[int, ChannelCount]) -> dict[int, int | None]:
    """How many messages are gone: by the writer's statistics, else by the index of each chunk."""
    stated = reader.statistics
    if stated is not None:
        return {n: max(stated.channel_message_counts.get(n, 0) - kept[n].messages, 0) for n in kept}
    counts = [s.channel_counts() for s in reader.segments if reader.table(s) is None]
    if not reader.data_complete or None in counts:
        return dict.fromkeys(kept)
    return {n: sum(c.get(n, 0) for c in counts if c is not None) for n in kept}


def _compare(path: Path, metadata: int, digest: str) -> None:
    """Read the new log with every checksum and compare it with what was written."""
    found = hashlib.sha256()
    with LogReader(path) as reader:
        for _, table in reader.tables():
            for number, sequence, log_time, published, data in table.rows():
                found.update(_HASHED.pack(number, sequence, log_time, published))
                found.update(data)
        if reader.missing or reader.problems or len(reader.metadata) != metadata:
            raise LogDamagedError(f"{path}: the recovered log is not whole; check the disk")
    if found.hexdigest() != digest:
        raise LogDamagedError(f"{path}: differs from what was recovered; check the disk")
