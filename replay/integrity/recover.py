"""Recover a damaged log: repair redundant parts, and write the readable messages to a new log.

The head of a chunk is also in the summary, and its message indexes follow from its messages. The
checksum over all data shows whether anything else was wrong.
"""

from __future__ import annotations

from bisect import bisect_right
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from cdmisfa.core.errors import LogDamagedError, UsageError
from recorder.log.files import make_folder, refuse_existing, refuse_unless
from recorder.log.logfile import LogFile
from recorder.log.messages import RECORDING_METADATA
from recorder.mcap.chunks import UNUSED, MessageTable, chunk_records, walked_table
from recorder.mcap.reader import LogReader
from recorder.mcap.records import CHUNK_HEADER, MalformedRecord, Problem, Segment
from recorder.mcap.store import PARTIAL, Store
from replay.integrity.info import ChannelCount, problems_of
from replay.integrity.report import SCHEMA
from replay.integrity.whole_dataset import write_whole
from replay.logs.formats.lerobot import dataset_channels
from replay.logs.open_logs import is_external_format, log_format
from replay.runs.folders import FINAL_METADATA
from replay.storage.location import location
from replay.storage.paths import log_files

# Most bytes that are repaired, because they are held in memory.
_MOST_BYTES: Final = 64 * 1024 * 1024


@dataclass(frozen=True, slots=True)
class ChannelRecovery:
    """Numbers of messages saved and lost on a channel; `lost` is None where nothing tells."""

    topic: str
    kept: int
    lost: int | None
    start_ns: int | None
    end_ns: int | None
    file: str


@dataclass(frozen=True, slots=True)
class Recovery:
    """Result of recovering a log, or all logs of a folder.

    Attributes:
        out: the log or folder that was written.
        lost: damage that cost something.
        mended: damage that was repaired from other parts of the log, and cost nothing.
        unverified: messages saved from a cut chunk, whose checksum cannot be checked.
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
        """Return the result as JSON values."""
        values = asdict(self)
        return {"schema": SCHEMA, "out": values.pop("out"), "complete": self.complete, **values}


def recover_log(src: str | Path, dst: str | Path, *, force: bool = False) -> Recovery:
    """Write a complete, indexed log of everything in `src` that is readable.

    Of a LeRobot dataset the whole episodes are written. Each log of a folder is recovered into the
    folder `dst`.

    Raises:
        UsageError: no such log, one of another kind, or the output exists and `force` is
            not set.
        LogDamagedError: not an MCAP file, or nothing in it can be saved.
        LogWriteError: the disk does not take it.
    """
    src, dst = location(src), Path(dst)
    if src.exists() and is_external_format(src):
        if log_format(src) == "dataset":
            return _recover_dataset(src, dst, force)
        raise UsageError(
            f"{src} is not an MCAP file or LeRobot dataset, and only these can be recovered: skip "
            "broken images with --skip-damaged of learn and convert"
        )
    files, alone = log_files(src), not src.is_dir()
    if alone:
        refuse_unless(dst, "the log is an MCAP file", ".mcap", "")
    targets = [dst if alone else dst / file.name.removesuffix(PARTIAL) for file in files]
    make_folder(dst.parent if alone else dst)
    for file, target in zip(files, targets, strict=True):
        if target.exists() and file.samefile(target):
            raise UsageError(f"{target}: input and output are the same file; choose another output")
    results = [_recover_file(f, t, force) for f, t in zip(files, targets, strict=True)]
    if not any(result.channels or result.complete for result in results):
        raise LogDamagedError(f"{src}: no message can be recovered; no file was written")
    return Recovery(
        out=str(dst),
        channels=tuple(c for result in results for c in result.channels),
        lost=tuple(p for result in results for p in result.lost),
        mended=tuple(p for result in results for p in result.mended),
        unverified=sum(result.unverified for result in results),
    )


def _recover_dataset(src: Path, dst: Path, force: bool) -> Recovery:
    """Write the whole episodes of a LeRobot dataset; a channel is a feature."""
    refuse_existing(dst, force=force, resumable=False)
    places = src.resolve(), dst.resolve()
    if places[0].is_relative_to(places[1]) or places[1].is_relative_to(places[0]):
        raise UsageError(f"{dst}: it holds the input, or lies in it; choose another output")
    channels = [channel.info for channel in dataset_channels(src)]
    dataset, count, absent, lost = write_whole(src, dst)
    # A recorder that is killed leaves info.json behind the tables.
    stated = max(int(dataset.info["total_frames"]), dataset.listed)
    unread = max(stated - count, 0) if stated > count or not lost else None
    problems = [Problem(str(src / name), "this file of the dataset is missing") for name in absent]
    problems += [Problem(str(src), dataset.missing)] if dataset.missing else []
    return Recovery(
        str(dst),
        tuple(
            ChannelRecovery(c.topic, count, unread, c.start_ns, c.end_ns, dst.name)
            for c in channels
        ),
        tuple(problems if lost else ()),
        tuple(() if lost else problems),
        0,
    )


def _recover_file(src: Path, dst: Path, force: bool) -> Recovery:
    with ExitStack() as stack:
        reader = stack.enter_context(LogReader(src, skip_damaged=True))
        repaired: list[Problem] = []
        if reader.problems:
            store = repair(reader)
            repaired = [Problem(f"{src}: {p.where}", p.what) for p in store.repaired]
            reader = stack.enter_context(LogReader(store, skip_damaged=True))
        if not any(len(table) for _, table in reader.tables()) and (lost := _lost(reader)):
            return Recovery(str(dst), (), lost, (), 0)
        library = f"cdmisfa recover ({reader.library})" if reader.library else "cdmisfa recover"
        with LogFile(dst, force=force, library=library, profile=reader.profile) as log:
            saved, unverified = _copy(reader, log)
            lost, counts = _lost(reader), _lost_messages(reader, saved)
            _copy_metadata(reader, log, complete=not lost)
        channels = tuple(
            ChannelRecovery(
                reader.channels[n].topic, c.messages, counts[n], c.start, c.end, dst.name
            )
            for n, c in sorted(saved.items())
        )
        return Recovery(str(dst), channels, lost, tuple(repaired), unverified)


def _copy(reader: LogReader, log: LogFile) -> tuple[dict[int, ChannelCount], int]:
    """Write the readable attachments and messages.

    Returns:
        The saved messages of each channel, and the number of messages without a checksum.
    """
    for attachment in reader.attachments:
        log.add_attachment(
            attachment.name,
            attachment.media_type,
            reader.attachment_data(attachment),
            log_time=attachment.log_time,
            create_time=attachment.create_time,
        )
    saved: dict[int, ChannelCount] = {}
    written: dict[int, int] = {}

    def add_channels() -> None:
        for number in sorted(reader.channels.keys() - saved.keys()):
            channel = reader.channels[number]
            schema = reader.schemas.get(channel.schema_id)
            saved[number] = ChannelCount()
            written[number] = log.add_channel(
                channel.topic,
                log.add_schema(schema.name, schema.encoding, schema.data) if schema else 0,
                encoding=channel.message_encoding,
                metadata=channel.metadata,
            )

    add_channels()
    unverified = 0
    for segment, table in reader.tables():
        add_channels()  # the summary may lack channels that are defined in a chunk
        # The CRC of a cut chunk is that of all its records, of which the last are not there.
        unverified += len(table) if segment.cut and segment.crc else 0
        for number, sequence, log_time, published, data in table.rows():
            if number in written:
                log.write_all([(written[number], log_time, data, published, sequence)])
        for number in saved.keys() & np.unique(table.channel).tolist():
            saved[number].add(table.log_time[table.channel == number])
    return saved, unverified


def _copy_metadata(reader: LogReader, log: LogFile, *, complete: bool) -> None:
    """Write the metadata; that of an incomplete recording states that frames can be missing."""
    for record in reader.metadata:
        values = dict(record.metadata)
        if record.name == RECORDING_METADATA and not complete:
            values["gaps"] = str(True)
        if record.name != FINAL_METADATA or complete:  # it has the checksum of all signals of a run
            log.add_metadata(record.name, values)


def _lost(reader: LogReader) -> tuple[Problem, ...]:
    """Return the damage of a log, without damaged indexes of messages that are all there."""
    problems = [problem for problem in problems_of(reader) if not problem.what.endswith(UNUSED)]
    data = f"{reader.path}: data section"
    if reader.data_crc is not None:
        # Summary and footer only repeat what the data says, and are written again.
        index = {str(reader.path), *(f"{reader.path}: {part}" for part in ("summary", "footer"))}
        problems = [problem for problem in problems if problem.where not in index]
        proven = all(segment.crc for segment in reader.segments if segment.size)
        if proven and {problem.where for problem in problems} == {data}:
            # Every chunk matches its own CRC: the changed byte is in a record between them.
            what = "damaged between chunks: all messages are readable, metadata may be wrong"
            problems = [Problem(data, f"its CRC does not match: {what}")]
    return tuple(problems)


def _lost_messages(reader: LogReader, saved: dict[int, ChannelCount]) -> dict[int, int | None]:
    """Count lost messages by the writer's statistics, else by the index of each lost chunk."""
    stated = reader.statistics
    if stated is not None:
        return {
            n: max(stated.channel_message_counts.get(n, 0) - saved[n].messages, 0) for n in saved
        }
    counts = [s.channel_counts() for s in reader.segments if reader.table(s) is None]
    if reader.data_crc is None or None in counts:
        return dict.fromkeys(saved)
    return {n: sum(c.get(n, 0) for c in counts if c is not None) for n in saved}


# Repair of heads and indexes of chunks


class RepairedStore(Store):
    """A log with some bytes replaced; `repaired` lists the repairs."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self.repaired: list[Problem] = []
        self._places: list[int] = []
        self._parts: list[bytes] = []

    def put(self, at: int, right: bytes, where: str, what: str) -> None:
        """Replace the bytes at an offset if they differ; offsets must increase between calls."""
        present = self.read(at, len(right))
        overlaps = self._places and at < self._places[-1] + len(self._parts[-1])
        fits = sum(map(len, self._parts)) + len(right) <= _MOST_BYTES
        if overlaps or not fits or present == right or len(present) < len(right):
            return
        self._places.append(at)
        self._parts.append(right)
        self.repaired.append(Problem(where, what))
        self._window = b""  # it may hold the bytes before the repair

    def read_at(self, offset: int, count: int) -> bytes:
        data = bytearray(super().read_at(offset, count))
        stop = offset + len(data)
        first = max(bisect_right(self._places, offset) - 1, 0)
        last = bisect_right(self._places, stop)
        for place, part in zip(self._places[first:last], self._parts[first:last], strict=True):
            low, high = max(place, offset), min(place + len(part), stop)
            if low < high:
                data[low - offset : high - offset] = part[low - place : high - place]
        return bytes(data)


def repair(reader: LogReader) -> RepairedStore:
    """Return a damaged log with the heads and message indexes of its chunks repaired."""
    store = RepairedStore(reader.path)
    stated = reader.summary.sound_chunks() if reader.summary else []
    chunks = stated or [s for s in reader.segments if s.chunked and not s.cut]
    ends = [chunk.offset for chunk in chunks[1:]] + [reader.data_end or store.size]
    for chunk, end in zip(chunks, ends, strict=False):
        try:
            if chunk.stated:  # the summary says everything of a chunk's head but its CRC
                crc_at = chunk.offset + CHUNK_HEADER.size - 4
                chunk.crc = int.from_bytes(store.read(crc_at, 4), "little")
                what = "its header was damaged and is restored from the summary"
                store.put(chunk.offset, chunk.head(chunk.crc), chunk.name, what)
            if not chunk.crc:
                continue
            table, *_ = walked_table(chunk_records(store, replace(chunk, stated=False)))
        except MalformedRecord:
            continue  # the damage is in the chunk's own data, which nothing repeats
        what = "its message index was damaged and is rebuilt from its messages"
        store.put(chunk.data_end, _indexes(store, chunk, end, table), chunk.name, what)
    return store


def _indexes(store: Store, chunk: Segment, end: int, table: MessageTable) -> bytes:
    """Make the message indexes of a chunk again, in their order in the file before place `end`.

    The order is not known: the index that is most like the bytes at a place was there.
    """
    left = [table.index(number) for number in np.unique(table.channel).tolist()]
    # Each of the channels is compared with each, so only up to 64 are repaired.
    if len(left) > 64 or sum(map(len, left)) > end - chunk.data_end:
        return b""
    made = b""
    while left:
        stored = np.frombuffer(
            store.read(chunk.data_end + len(made), max(map(len, left))), np.uint8
        )
        indexes = [np.frombuffer(index, np.uint8) for index in left]
        alike = [float((stored[: len(i)] == i[: len(stored)]).mean()) for i in indexes]
        best = int(np.argmax(alike))
        # Chance makes 1/256 of the bytes equal, and more for the zeros of small numbers.
        if alike[best] < 0.5 and not chunk.stated:
            return b""  # a chunk without indexes, as far as anything tells
        made += left.pop(best)
    return made
