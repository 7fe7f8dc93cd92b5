"""Describe logs: channels, times, checksums, and whether they are whole."""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, TypeVar

import numpy as np
from mcap.records import Channel
from numpy.typing import NDArray

from cdmisfa.core.errors import CdmisfaError
from cdmisfa.core.untrusted import parse_json
from recorder.images.messages import SCHEMAS
from recorder.log.messages import RECORDING_METADATA
from recorder.mcap.chunks import MessageTable
from recorder.mcap.reader import LogReader
from recorder.mcap.records import Problem, Segment
from replay.integrity.listing import each_report
from replay.integrity.report import Crc, Kind, LogReport, SizeInfo, State, combined, failed
from replay.integrity.run_facts import run_facts
from replay.logs.formats.images import broken_images, image_files
from replay.logs.open_logs import channels_of, is_external_format, log_format
from replay.logs.stream import ChannelInfo
from replay.open_sources import locations
from replay.runs.folders import RUN_METADATA

# Bytes of a log, decompressed or not, that `info` decodes; it reads the index of larger logs.
CHECK_BYTES: Final = 1024 * 1024 * 1024

LogTimes = NDArray[np.uint64]
Outcome = TypeVar("Outcome")


def describe(*words: str | Path) -> LogReport:
    """Describe recordings, runs, MCAP files and camera logs; several as one.

    Torn and damaged files are described as far as they can be read. Of several, one that
    cannot be read is described as such.

    Raises:
        UsageError: no such log.
        LogDamagedError: not an MCAP file, or a camera log that cannot be read.
    """
    report = report_all(words, lambda place, alone: each_report(place, describe_log, alone))
    facts = {} if len(words) > 1 else run_facts(Path(report.path), report.channels)
    return replace(report, **facts)


def report_all(
    words: Sequence[str | Path], read: Callable[[Path, bool], Iterable[LogReport]]
) -> LogReport:
    """Report on the logs that words name, so that one broken log does not hide the others.

    Args:
        words: paths, patterns or URLs.
        read: returns the reports on a place, which is the only one or not.

    Raises:
        CdmisfaError: the only log cannot be read.
    """
    places: list[Path] = []
    reports: list[LogReport] = []
    failures: list[LogReport] = []
    for word in words:
        try:
            places += locations([word])
        except CdmisfaError as error:
            if len(words) == 1:
                raise
            failures.append(failed(word, error))
    alone = len(words) == len(places) == 1
    for place in places:
        reports += read(place, alone)
    path = " ".join([*map(str, places), *(report.path for report in failures)])
    return combined(path, reports + failures)


def describe_log(log: Path, *, decode: bool | None = None) -> LogReport:
    """Describe a file or a folder that is one log; raises as `describe`.

    Args:
        log: the file or the folder.
        decode: decode the content, or read its summary only; by default as its size allows.
    """
    if is_external_format(log):
        return _describe_external(log, 0 if decode is False else CHECK_BYTES)
    if decode or (decode is None and log.stat().st_size <= CHECK_BYTES):
        return read_once(log, lambda reader: describe_reader(reader, decode=decode))
    with LogReader(log, skip_damaged=True, check="chunks") as reader:
        return describe_reader(reader, decode=False)


def read_once(path: Path, work: Callable[[LogReader], Outcome]) -> Outcome:
    """Apply a function to the reader of a log and read each byte once if the log is whole.

    Args:
        path: the log.
        work: reads the log with `LogReader.one_pass`; may raise a CdmisfaError.

    Raises:
        CdmisfaError: it is no log, or raised by `work`.
    """
    with contextlib.suppress(CdmisfaError), LogReader(path, check="pass") as reader:
        result = work(reader)
        if not reader.problems:
            return result
    # The strict pass stopped at the first damage: read again and list all of it.
    with LogReader(path, skip_damaged=True, check="pass") as reader:
        return work(reader)


def _describe_external(place: Path, most: int) -> LogReport:
    """Describe a log in another format than MCAP; check up to `most` bytes of its images."""
    channels = channels_of(place)
    missing = tuple(Problem(str(place), c.missing) for c in channels if c.missing)
    kind, broken = log_format(place), None
    if most and kind == "images":
        broken = broken_images(image_files(place), most)
    crc: Crc = "absent" if broken is None else "bad" if broken else "ok"
    unchecked = broken is None and kind != "arrays"  # arrays are whole if they can be loaded
    state: State = "damaged" if broken else "unchecked" if unchecked else "whole"
    files = [place] if place.is_file() else place.rglob("*")
    return LogReport(
        path=str(place),
        channels=tuple(replace(c.info, file=place.name) for c in channels),
        complete=not missing,
        crc=crc,
        problems=(*missing, *(broken or ())),
        state="cut short" if missing else state,
        size=SizeInfo(sum(path.stat().st_size for path in files if path.is_file())),
        notes=tuple(dict.fromkeys(line for c in channels for line in c.remarks)),
    )


def describe_reader(reader: LogReader, *, decode: bool | None = None) -> LogReport:
    """Describe an MCAP file; by default decode it if its size allows."""
    if decode is None:
        decode = sum(s.size for s in reader.segments) <= CHECK_BYTES
    counts = count_decoded(reader) if decode else _count_by_index(reader)
    report = report_on(reader, counts)
    if not decode:
        report = replace(report, crc="unchecked")
    # Chunks may be whole and the images of other writers in them broken: only verify decodes these.
    images = any(schema.name in SCHEMAS for schema in reader.schemas.values())
    unchecked = not decode or (report.kind == "foreign" and images)
    return replace(report, state="unchecked") if unchecked and report.state == "whole" else report


def report_on(reader: LogReader, counts: Mapping[int, ChannelCount]) -> LogReport:
    """Report on an MCAP file that was decoded, with the messages of each channel."""
    name = reader.path.name
    channels = []
    for number, count in sorted(counts.items()):
        undefined = Channel(number, f"(undefined channel {number})", "", {}, 0)
        channel = reader.channels.get(number, undefined)
        schema = reader.schemas.get(channel.schema_id)
        entry = (channel.topic, channel.message_encoding, schema.name if schema else "")
        channels.append(ChannelInfo(*entry, count.messages, count.start, count.end, name))
    segments = reader.segments
    metadata = {m.name: m.metadata for m in reader.metadata}
    state: State = "damaged" if reader.problems else "cut short" if reader.missing else "whole"
    crc: Crc = "ok" if state == "whole" else "unchecked"
    if reader.problems:
        crc = "bad"
    elif reader.crc_absent():
        crc = "absent"
    return LogReport(
        path=str(reader.path),
        kind=kind_of(reader),
        channels=tuple(channels),
        chunks=sum(s.chunked for s in segments),
        complete=reader.complete,
        crc=crc,
        problems=problems_of(reader),
        metadata={name: metadata},
        seed=_seed([*metadata.values()]),
        state=state,
        notes=tuple(reader.unproven()),
        size=SizeInfo(
            reader.file.size,
            sum(s.stored for s in segments),
            sum(s.size for s in segments),
            dict(Counter(s.compression or "none" for s in segments if s.chunked)),
        ),
        library=reader.library,
    )


def kind_of(reader: LogReader) -> Kind:
    """Tell a recording and a run from other logs by their metadata."""
    names = {m.name for m in reader.metadata}
    if RECORDING_METADATA in names:
        return "recording"
    return "run" if RUN_METADATA in names else "foreign"


def problems_of(reader: LogReader) -> tuple[Problem, ...]:
    """Return the damage that the reader detected, and the missing end of a truncated log."""
    problems = [Problem(f"{reader.path}: {p.where}", p.what) for p in reader.problems]
    missing = [Problem(str(reader.path), reader.missing)] if reader.missing else []
    return (*problems, *missing)


def _seed(records: Sequence[Mapping[str, str]]) -> int | None:
    """Return the one seed that all metadata states; anybody may have written the metadata."""
    seeds: set[int] = set()
    for values in records:
        with contextlib.suppress(ValueError, TypeError, AttributeError):
            manifest = parse_json(values.get("manifest", "{}"))
            seeds.add(int(values.get("seed", manifest.get("seed"))))
    return seeds.pop() if len(seeds) == 1 else None


# Messages of each channel


@dataclass(slots=True)
class ChannelCount:
    """Number of messages on a channel, and their range of log times in nanoseconds."""

    messages: int = 0
    start: int | None = None
    end: int | None = None

    def add(self, times: LogTimes) -> None:
        """Add messages by their log times, (n,) nanoseconds."""
        self.messages += len(times)
        self.widen(times)

    def widen(self, times: LogTimes) -> None:
        """Widen the range by log times, (n,) nanoseconds."""
        if len(times):
            low, high = int(times.min()), int(times.max())
            self.start = low if self.start is None else min(self.start, low)
            self.end = high if self.end is None else max(self.end, high)


def count_decoded(
    reader: LogReader, each: Callable[[Segment], None] = lambda segment: None
) -> dict[int, ChannelCount]:
    """Decode every chunk of a log, which finds all damage, and count the messages.

    Args:
        reader: reader of the log, which reads it in one pass.
        each: called with every chunk after it was decoded, in file order.
    """
    counts = {number: ChannelCount() for number in reader.channels}
    for segment, table in reader.one_pass():
        each(segment)
        for number in () if table is None else np.unique(table.channel).tolist():
            counts.setdefault(number, ChannelCount()).add(_times_in(table, number))
    return counts


def _count_by_index(reader: LogReader) -> dict[int, ChannelCount]:
    """Count the messages by the indexes of chunks and read as few of them as possible.

    A channel starts in one of the chunks that start before any known message of it.
    """
    counts = {number: ChannelCount() for number in reader.channels}
    chunks: dict[int, list[Segment]] = {}
    for segment in reader.segments:
        in_chunk = segment.channel_counts()
        if in_chunk is None:
            table = reader.table(segment)
            in_chunk = {} if table is None else Counter(table.channel.tolist())
        for number, count in in_chunk.items():
            if count:
                chunks.setdefault(number, []).append(segment)
                counts.setdefault(number, ChannelCount()).messages += count
    for number, segments in chunks.items():
        channel = counts[number]
        for segment in sorted(segments, key=lambda s: s.start):
            if channel.start is None or segment.start < channel.start:
                channel.widen(_times_of(reader, segment, number))
        for segment in sorted(segments, key=lambda s: s.end, reverse=True):
            if channel.end is None or segment.end > channel.end:
                channel.widen(_times_of(reader, segment, number))
    return counts


def _times_of(reader: LogReader, segment: Segment, number: int) -> LogTimes:
    """Return the log times of a channel's messages in a chunk, by its message index if any."""
    if not segment.indexes:
        return _times_in(reader.table(segment), number)
    return np.concatenate([pairs[:, 0] for _, pairs in reader.index(segment, (number,))])


def _times_in(table: MessageTable | None, number: int) -> LogTimes:
    return np.empty(0, np.uint64) if table is None else table.log_time[table.channel == number]
