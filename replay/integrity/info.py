"""What is in a log: channels, times, checksums, and whether it is whole."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.errors import LogDamagedError
from recorder.log.messages import METADATA
from replay.mcap.reader import Crc, LogReader
from replay.mcap.records import MalformedRecord
from replay.mcap.segments import Segment
from replay.runs.folders import METADATA as RUN_METADATA
from replay.runs.folders import RUN_FILE
from replay.runs.messages import missing
from replay.storage.listing import log_files
from replay.storage.location import Location, location

SCHEMA: Final = 1
"""Rises whenever a key of what `describe` gives changes its meaning."""
CHECK_BYTES: Final = 1024 * 1024 * 1024
"""Logs with more decompressed bytes are described by their index, not decoded."""


@dataclass(slots=True)
class ChannelSurvey:
    """How many messages of a channel are there, from when to when (log time, nanoseconds)."""

    messages: int = 0
    start: int | None = None
    end: int | None = None

    def add(self, times: Any) -> None:
        """Take more log times in."""
        if len(times):
            low, high = int(times.min()), int(times.max())
            self.messages += len(times)
            self.start = low if self.start is None else min(self.start, low)
            self.end = high if self.end is None else max(self.end, high)


def describe(path: str | Location) -> dict[str, Any]:
    """Describe a recording's or run's folder, or any MCAP file, as JSON values.

    Torn and damaged files are described as far as they can be read. Of a URL whose summary
    accounts for every message no more than that is read, and `crc` is "unchecked".

    Returns:
        `schema`, `path`, `kind` ("recording", "run" or "foreign"), `channels` (topic,
        encoding, schema, messages, start_ns, end_ns, file), `chunks`, `complete`, `crc`
        ("ok", "absent", "bad" or "unchecked"), `problems` (where, what), `seed` and, of a
        run's folder, `ended` (why); None where nothing says so. `signals` of a run: the
        `version` of its record and the signals `missing` in it, which are read as NaN.

    Raises:
        UsageError: no such log.
        LogDamagedError: not an MCAP file.
    """
    path = location(path)
    files = log_files(path)
    documents = [_describe_file(file) for file in files]
    kinds = {d["kind"] for d in documents}
    crcs = [d["crc"] for d in documents]
    return {
        "schema": SCHEMA,
        "path": str(path),
        "kind": kinds.pop() if len(kinds) == 1 else "foreign",
        "channels": [c for d in documents for c in d["channels"]],
        "chunks": sum(d["chunks"] for d in documents),
        "complete": all(d["complete"] for d in documents),
        "crc": next(c for c in ("bad", "unchecked", "absent", "ok") if c in crcs),
        "problems": [p for d in documents for p in d["problems"]],
        "metadata": {d["file"]: d["metadata"] for d in documents},
        "seed": _seed(documents),
        "ended": _ended(path) if isinstance(path, Path) else None,
        "signals": _signals(documents),
    }


def _seed(documents: Sequence[Mapping[str, Any]]) -> int | None:
    """The one seed that every file's own record names."""
    seeds: set[Any] = set()
    for document in documents:
        for values in document["metadata"].values():
            with contextlib.suppress(ValueError, TypeError, AttributeError, RecursionError):
                manifest = json.loads(values.get("manifest", "{}"))
                seeds.add(int(values.get("seed", manifest.get("seed"))))
    return seeds.pop() if len(seeds) == 1 else None


def _signals(documents: Sequence[Mapping[str, Any]]) -> dict[str, Any] | None:
    """Which version of the record a run was written with, and what that lacks."""
    for document in documents:
        text = document["metadata"].get(RUN_METADATA, {}).get("schema", "")
        if text.isascii() and text.isdigit() and len(text) < 10:
            return {"version": int(text), "missing": list(missing(int(text)))}
    return None


def _ended(path: Path) -> str | None:
    folder = path if path.is_dir() else path.parent
    if path.name != RUN_FILE and not (path / RUN_FILE).is_file():
        return None
    try:
        document = json.loads((folder / "run.json").read_text("utf-8"))
        return str(document["result"]["ended"])
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return None


def kind_of(reader: LogReader) -> str:
    """Tell a recording and a run from other logs by their metadata."""
    names = {m.name for m in reader.metadata}
    if METADATA in names:
        return "recording"
    return "run" if RUN_METADATA in names else "foreign"


def survey(reader: LogReader) -> dict[int, ChannelSurvey]:
    """Decode every chunk, and count the messages of each channel."""
    found = {number: ChannelSurvey() for number in reader.channels}
    for _, table in reader.tables(ordered=False):
        for number in np.unique(table.channel).tolist():
            times = table.log_time[table.channel == number]
            found.setdefault(number, ChannelSurvey()).add(times)
    return found


def survey_index(reader: LogReader) -> dict[int, ChannelSurvey]:
    """Count the messages of each channel by the message indexes, where there are any."""
    found = {number: ChannelSurvey() for number in reader.channels}
    for segment in reader.segments:
        if segment.indexes:
            try:
                for number, pairs in reader.index(segment):
                    found.setdefault(number, ChannelSurvey()).add(pairs[:, 0])
            except MalformedRecord as error:
                raise LogDamagedError(f"{reader.path}: {segment.name}: {error}") from None
        elif (table := reader.table(segment)) is not None:
            for number in np.unique(table.channel).tolist():
                times = table.log_time[table.channel == number]
                found.setdefault(number, ChannelSurvey()).add(times)
    return found


def survey_summary(reader: LogReader) -> dict[int, ChannelSurvey]:
    """Count the messages of each channel by the summary, reading few message indexes.

    A channel begins in one of the chunks that begin before any message of it that is known.
    """
    found = {number: ChannelSurvey() for number in reader.channels}
    chunks: dict[int, list[Segment]] = {}
    for segment in reader.segments:
        for number, count in (segment.channel_counts() or {}).items():
            if count:
                found[number].messages += count
                chunks.setdefault(number, []).append(segment)
    for number, segments in chunks.items():
        channel = found[number]
        for segment in sorted(segments, key=lambda s: s.start):
            if channel.start is not None and segment.start >= channel.start:
                break
            low = int(_indexed_times(reader, segment, number).min())
            channel.start = low if channel.start is None else min(low, channel.start)
        for segment in sorted(segments, key=lambda s: s.end, reverse=True):
            if channel.end is not None and segment.end <= channel.end:
                break
            channel.end = max(int(_indexed_times(reader, segment, number).max()), channel.end or 0)
    return found


def _indexed_times(reader: LogReader, segment: Segment, number: int) -> NDArray[np.uint64]:
    try:
        pairs = [pairs[:, 0] for n, pairs in reader.index(segment) if n == number]
    except MalformedRecord as error:
        raise LogDamagedError(f"{reader.path}: {segment.name}: {error}") from None
    return np.concatenate(pairs)


def crc_state(reader: LogReader, *, decoded: bool) -> Crc:
    """Say what the checksums of a log amount to."""
    if any("CRC" in problem.what for problem in reader.problems):
        return "bad"
    if not decoded:
        return "unchecked"
    return "absent" if reader.crc_absent() else "ok"


def _describe_file(path: Location) -> dict[str, Any]:
    with LogReader(path, salvage=True) as reader:
        decode = not reader.by_index and sum(s.size for s in reader.segments) <= CHECK_BYTES
        if reader.by_index:
            surveys = survey_summary(reader)
        else:
            surveys = survey(reader) if decode else survey_index(reader)
        channels = []
        for number, found in sorted(surveys.items()):
            channel = reader.channels.get(number)
            schema = reader.schemas.get(channel.schema_id) if channel else None
            channels.append(
                {
                    "topic": channel.topic if channel else f"(channel {number}, never defined)",
                    "encoding": channel.encoding if channel else "",
                    "schema": schema.name if schema else "",
                    "messages": found.messages,
                    "start_ns": found.start,
                    "end_ns": found.end,
                    "file": path.name,
                }
            )
        problems = [{"where": f"{path}: {p.where}", "what": p.what} for p in reader.problems]
        if reader.missing:
            problems.append({"where": str(path), "what": reader.missing})
        return {
            "file": path.name,
            "kind": kind_of(reader),
            "channels": channels,
            "chunks": sum(1 for s in reader.segments if s.chunked),
            "complete": reader.complete,
            "crc": crc_state(reader, decoded=decode),
            "problems": problems,
            "metadata": {m.name: m.values for m in reader.metadata},
        }
