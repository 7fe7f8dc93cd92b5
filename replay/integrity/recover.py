"""Saving what can be read of a damaged log as a whole one."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from cdmisfa.core.errors import LogDamagedError, UsageError
from recorder.log.logfile import LogFile
from recorder.log.whole import PARTIAL
from replay.integrity.info import ChannelSurvey
from replay.mcap.reader import LogReader
from replay.mcap.records import Channel, Schema
from replay.mcap.tables import MessageTable
from replay.storage.copied import fetched
from replay.storage.listing import log_files
from replay.storage.location import Location, location


@dataclass(slots=True)
class _Tally:
    """What became of one channel; `digest` is over times and payloads in file order."""

    kept: ChannelSurvey = field(default_factory=ChannelSurvey)
    lost: int | None = 0
    digest: Any = field(default_factory=hashlib.sha256)


def recover(src: str | Location, dst: str | Path, *, force: bool = False) -> dict[str, Any]:
    """Write a complete, indexed log of everything in `src` that is readable.

    The new file is read again, with its checksums, and compared before this returns.
    Of a folder each log is recovered into the folder `dst`. What lies behind a URL is copied
    first.

    Returns:
        `schema`, `out`, `complete` (nothing was lost), `channels` (topic, kept, lost,
        start_ns, end_ns, file; lost is None where nothing tells how much), `lost`
        (where, what) and `unverified`: messages saved of a cut chunk, whose checksum
        cannot be checked.

    Raises:
        UsageError: no such log, or the output exists and `force` is not set.
        LogDamagedError: not an MCAP file, or nothing in it can be saved.
        LogWriteError: the disk does not take it.
    """
    place, dst = location(src), Path(dst)
    with fetched(place) as copy:
        report = _recover(copy, dst, force)
    for lost in report["lost"]:
        lost["where"] = lost["where"].replace(str(copy), str(place))
    return report


def _recover(src: Path, dst: Path, force: bool) -> dict[str, Any]:
    files = [file for file in log_files(src) if isinstance(file, Path)]
    if src.is_dir() and dst.exists() and not dst.is_dir():
        raise UsageError(f"{dst} is a file: name a folder for the logs of {src}")
    try:
        (dst if src.is_dir() else dst.parent).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"{dst}: {error.strerror}") from None
    targets = [dst]
    if src.is_dir():
        targets = [dst / file.name.removesuffix(PARTIAL) for file in files]
    for file, target in zip(files, targets, strict=True):
        if target.exists() and file.samefile(target):
            raise UsageError(f"{target}: cannot be recovered into itself, name another file")
    alone = not src.is_dir()  # else it may be that there is something in the other logs
    reports = [_recover_file(f, t, force, alone) for f, t in zip(files, targets, strict=True)]
    return {
        "schema": 1,
        "out": str(dst),
        "complete": all(r["complete"] for r in reports),
        "channels": [c for r in reports for c in r["channels"]],
        "lost": [p for r in reports for p in r["lost"]],
        "unverified": sum(r["unverified"] for r in reports),
    }


def _recover_file(src: Path, dst: Path, force: bool, alone: bool) -> dict[str, Any]:
    with LogReader(src, salvage=True) as reader:
        found = reader.channels or reader.metadata or reader.attachments
        if alone and reader.missing and not found:
            raise LogDamagedError(f"{src}: nothing in it can be saved, and nothing was written")
        library = f"cdmisfa recover ({reader.library})" if reader.library else "cdmisfa recover"
        with LogFile(dst, force=force, library=library, profile=reader.profile) as log:
            tallies, unverified = _copy(reader, log)
        _compare(dst, reader, tallies)
        lost = [{"where": f"{src}: {p.where}", "what": p.what} for p in reader.problems]
        if reader.missing:
            lost.append({"where": str(src), "what": reader.missing})
        channels = [
            {
                "topic": reader.channels[number].topic,
                "kept": tally.kept.messages,
                "lost": tally.lost,
                "start_ns": tally.kept.start,
                "end_ns": tally.kept.end,
                "file": dst.name,
            }
            for number, tally in sorted(tallies.items())
        ]
        return {
            "complete": not lost,
            "channels": channels,
            "lost": lost,
            "unverified": unverified,
        }


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
        known[number] = _register(log, channel, schemas.get(channel.schema_id))
    unverified = 0
    for segment, table in reader.tables(ordered=False):
        unverified += len(table) if segment.cut and segment.crc else 0
        for row, number in enumerate(table.channel.tolist()):
            if number in known:
                log.write(
                    known[number],
                    int(table.log_time[row]),
                    table.payload(row),
                    int(table.headers["sequence"][row]),
                    int(table.headers["publish_time"][row]),
                )
        _tally(tallies, table)
    _count_lost(reader, tallies)
    return tallies, unverified


def _register(log: LogFile, channel: Channel, schema: Schema | None) -> int:
    number = 0 if schema is None else log.add_schema(schema.name, schema.encoding, schema.data)
    return log.add_channel(
        channel.topic, number, encoding=channel.encoding, metadata=channel.metadata
    )


def _tally(tallies: dict[int, _Tally], table: MessageTable) -> None:
    for number in np.unique(table.channel).tolist():
        if number not in tallies:
            continue
        rows = table.select(table.channel == number)
        tally = tallies[number]
        tally.kept.add(rows.log_time)
        for row in range(len(rows)):
            tally.digest.update(rows.log_time[row].tobytes())
            tally.digest.update(rows.payload(row))


def _count_lost(reader: LogReader, tallies: dict[int, _Tally]) -> None:
    """How many messages are gone: by the writer's statistics, else by the index of each chunk."""
    stated = reader.statistics
    damaged = [s for s in reader.segments if reader.table(s) is None]
    for number, tally in tallies.items():
        if stated is not None:
            tally.lost = max(stated.per_channel.get(number, 0) - tally.kept.messages, 0)
            continue
        counts = [s.channel_counts() for s in damaged]
        if not reader.data_complete or None in counts:
            tally.lost = None
        else:
            tally.lost = sum(c.get(number, 0) for c in counts if c is not None)


def _compare(dst: Path, source: LogReader, tallies: dict[int, _Tally]) -> None:
    """Read the new log with every checksum and compare it with what was written.

    Raises:
        LogDamagedError: they differ.
    """
    found: dict[int, _Tally] = {}
    with LogReader(dst) as reader:
        numbers = dict(zip(sorted(reader.channels), sorted(tallies), strict=True))
        for number in reader.channels:
            found[number] = _Tally()
        for _, table in reader.tables(ordered=False):
            _tally(found, table)
        if reader.missing or reader.problems or len(reader.metadata) != len(source.metadata):
            raise LogDamagedError(f"{dst}: the recovered log is not whole; check the disk")
    for number, tally in found.items():
        if tally.digest.digest() != tallies[numbers[number]].digest.digest():
            raise LogDamagedError(f"{dst}: differs from what was recovered; check the disk")
