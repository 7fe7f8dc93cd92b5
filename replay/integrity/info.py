"""What is in a log: channels, times, checksums, and whether it is whole."""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

from cdmisfa.core.untrusted import parse_json
from recorder.mcap.reader import Check, LogReader
from recorder.mcap.records import Channel, Problem
from replay.camera_logs.opening import channels_of, only_foreign
from replay.inputs import locations
from replay.integrity.survey import SCHEMA, Crc, Kind, survey
from replay.runs.codec import missing_signals
from replay.runs.folders import RUN_FILE, RUN_METADATA, read_run_json
from replay.runs.log import record_version
from replay.storage.location import Location
from replay.storage.opening import log_files, open_store

CHECK_BYTES: Final = 1024 * 1024 * 1024
"""Logs with more bytes, decompressed or not, are described by their index, not decoded."""


@dataclass(frozen=True, slots=True)
class ChannelInfo:
    """A channel of a log; its times are log times in nanoseconds."""

    topic: str
    encoding: str
    schema: str
    messages: int
    start_ns: int | None
    end_ns: int | None
    file: str


@dataclass(frozen=True, slots=True)
class RecordInfo:
    """The version of the signals' record in a run, and the signals it lacks: they are NaN."""

    version: int
    missing: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class LogInfo:
    """What is in a log, or in all logs of a folder.

    Attributes:
        kind: what the logs are; "foreign" where they are of several kinds.
        chunks: how many there are.
        complete: no file is cut short.
        crc: what the checksums amount to.
        metadata: of each file by its name, or its path where others share that, each record by
            its own name.
        seed: the one that all files name, if they do.
        ended: why a run ended, where its folder says so.
        signals: of a run.
    """

    path: str
    kind: Kind
    channels: tuple[ChannelInfo, ...]
    chunks: int
    complete: bool
    crc: Crc
    problems: tuple[Problem, ...]
    metadata: Mapping[str, Mapping[str, Mapping[str, str]]]
    seed: int | None = None
    ended: str | None = None
    signals: RecordInfo | None = None

    def as_json(self) -> dict[str, Any]:
        """The description as JSON values."""
        return {"schema": SCHEMA, **asdict(self)}


def describe(*words: str | Location) -> LogInfo:
    """Describe a recording's or run's folder, any MCAP file, or camera logs; several as one.

    Torn and damaged files are described as far as they can be read. Of a URL whose summary
    accounts for every message no more than that is read, and `crc` is "unchecked".

    Raises:
        UsageError: no such log.
        LogDamagedError: not an MCAP file, or a camera log that cannot be read.
    """
    named = locations(words)
    files = [found for place in named for found in _describe_place(place)]
    kinds, states = {f.kind for f in files}, {f.crc for f in files}
    worst: tuple[Crc, ...] = ("bad", "unchecked", "absent", "ok")
    named_alike = Counter(name for f in files for name in f.metadata)
    metadata = {
        name if named_alike[name] == 1 else f.path: records
        for f in files
        for name, records in f.metadata.items()
    }
    records = [values for found in metadata.values() for values in found.values()]
    return LogInfo(
        path=" ".join(map(str, named)),
        kind=kinds.pop() if len(kinds) == 1 else "foreign",
        channels=tuple(c for f in files for c in f.channels),
        chunks=sum(f.chunks for f in files),
        complete=all(f.complete for f in files),
        crc=next(state for state in worst if state in states),
        problems=tuple(p for f in files for p in f.problems),
        metadata=metadata,
        seed=_seed(records),
        ended=_ended(named[0]) if len(named) == 1 and isinstance(named[0], Path) else None,
        signals=next((f.signals for f in files if f.signals is not None), None),
    )


def _describe_place(place: Location) -> list[LogInfo]:
    if not isinstance(place, Path) or not only_foreign(place):
        return [_describe_file(file) for file in log_files(place)]
    channels = [
        ChannelInfo(c.topic, c.encoding, c.schema, c.messages, c.start_ns, c.end_ns, place.name)
        for c in channels_of(place)
    ]
    return [LogInfo(str(place), "foreign", tuple(channels), 0, True, "absent", (), {})]


def _describe_file(path: Location) -> LogInfo:
    with LogReader(open_store(path), salvage=True, check=_check(path)) as reader:
        decode = not reader.by_index and sum(s.size for s in reader.segments) <= CHECK_BYTES
        surveyed, channels = survey(reader, decode=decode), []
        for number, found in sorted(surveyed.channels.items()):
            undefined = Channel(number, 0, f"(channel {number}, never defined)", "", {})
            channel = reader.channels.get(number, undefined)
            schema = reader.schemas.get(channel.schema_id)
            channels.append(
                ChannelInfo(
                    topic=channel.topic,
                    encoding=channel.encoding,
                    schema=schema.name if schema else "",
                    messages=found.messages,
                    start_ns=found.start,
                    end_ns=found.end,
                    file=path.name,
                )
            )
        metadata = {m.name: m.values for m in reader.metadata}
        version = record_version(metadata.get(RUN_METADATA, {}))
        return LogInfo(
            path=str(path),
            kind=surveyed.kind,
            channels=tuple(channels),
            chunks=sum(s.chunked for s in reader.segments),
            complete=reader.complete,
            crc=surveyed.crc,
            problems=surveyed.problems,
            metadata={path.name: metadata},
            signals=RecordInfo(version, missing_signals(version)) if version else None,
        )


def _check(path: Location) -> Check:
    return "pass" if isinstance(path, Path) and path.stat().st_size <= CHECK_BYTES else "chunks"


def _seed(records: Sequence[Mapping[str, str]]) -> int | None:
    """The one seed that all metadata names."""
    seeds: set[int] = set()
    for values in records:
        with contextlib.suppress(ValueError, TypeError, AttributeError):
            manifest = parse_json(values.get("manifest", "{}"))
            seeds.add(int(values.get("seed", manifest.get("seed"))))
    return seeds.pop() if len(seeds) == 1 else None


def _ended(path: Path) -> str | None:
    if path.name != RUN_FILE and not (path / RUN_FILE).is_file():
        return None
    result = read_run_json(path if path.is_dir() else path.parent).get("result")
    return str(result["ended"]) if isinstance(result, Mapping) and "ended" in result else None
