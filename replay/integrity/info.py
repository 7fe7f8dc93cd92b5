"""What is in a log: channels, times, checksums, and whether it is whole."""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final, Literal

from mcap.records import Channel

from cdmisfa.core.errors import CdmisfaError, LogDamagedError
from cdmisfa.core.untrusted import parse_json
from recorder.images.messages import SCHEMAS
from recorder.log.messages import RECORDING_METADATA
from recorder.mcap.reader import LogReader
from recorder.mcap.records import Problem
from replay.arrays import are_arrays
from replay.camera_logs.opening import channels_of, log_format, only_foreign
from replay.camera_logs.pictures import FolderImages
from replay.integrity.counting import count_messages, read_once
from replay.integrity.learned import (
    ModuleInfo,
    RunInfo,
    held_out_of,
    modules_of,
    result_of,
    run_folder,
)
from replay.integrity.state import (
    Crc,
    State,
    crc_of,
    failed_state,
    located,
    state_of,
    worst,
)
from replay.runs.folders import RUN_METADATA
from replay.runs.log import SIGNALS_TOPIC
from replay.storage.arrays import load_numbers
from replay.storage.opening import log_files

SCHEMA: Final = 1
"""Rises whenever a key of the JSON of info, verify or recover changes its meaning."""
CHECK_BYTES: Final = 1024 * 1024 * 1024
"""Logs with more bytes, decompressed or not, are described by their index, not decoded."""

SIZES: Final = ("stored", "size")
"""Bytes of a part of a log, as they lie there and decompressed."""

Kind = Literal["recording", "run", "foreign"]


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

    @property
    def rate(self) -> float | None:
        """Messages a second between the first and the last; None where that takes no time."""
        if self.start_ns is None or self.end_ns is None or self.end_ns <= self.start_ns:
            return None
        return (self.messages - 1) * 1e9 / (self.end_ns - self.start_ns)


@dataclass(frozen=True, slots=True)
class SizeInfo:
    """How much room a log takes.

    Attributes:
        file: bytes of all of it.
        stored: bytes of its messages as they lie there, and of the records beside them.
        decompressed: those bytes decompressed.
        compression: how many chunks are compressed by which algorithm, "none" among them.
    """

    file: int = 0
    stored: int = 0
    decompressed: int = 0
    compression: Mapping[str, int] = field(default_factory=dict)

    def __add__(self, other: SizeInfo) -> SizeInfo:
        return SizeInfo(
            self.file + other.file,
            self.stored + other.stored,
            self.decompressed + other.decompressed,
            dict(Counter(self.compression) + Counter(other.compression)),
        )


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
        modules: of a run, where they lie in its folder.
        run: how it was learned, where it is a folder.
        held_out: how slow they are on frames that were held out, where its folder says so.
        state: the worst of the files; "unchecked" where only `check_log` reads what is in them.
        notes: what is no problem, and what nothing proves.
        size: in bytes.
        library: what wrote the file, where it says so; "" of several that differ.
        files: each file by itself.
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
    modules: tuple[ModuleInfo, ...] = ()
    run: RunInfo | None = None
    held_out: Mapping[str, Any] | None = None
    state: State = "whole"
    notes: tuple[str, ...] = ()
    size: SizeInfo = SizeInfo()
    library: str = ""
    files: tuple[LogInfo, ...] = ()

    @property
    def messages(self) -> int:
        """How many there are on all channels."""
        return sum(c.messages for c in self.channels)

    @property
    def span(self) -> tuple[int, int] | None:
        """Log times of the first and of the last message, nanoseconds."""
        starts = [c.start_ns for c in self.channels if c.start_ns is not None]
        ends = [c.end_ns for c in self.channels if c.end_ns is not None]
        return (min(starts), max(ends)) if starts and ends else None

    def as_json(self) -> dict[str, Any]:
        """The description as JSON values."""
        return {"schema": SCHEMA, **asdict(self)}


def describe(*words: str | Path) -> LogInfo:
    """Describe a recording's or run's folder, any MCAP file, or camera logs; several as one.

    Torn and damaged files are described as far as they can be read. Of several, one that
    cannot be read is described as such.

    Raises:
        UsageError: no such log.
        LogDamagedError: not an MCAP file, or a camera log that cannot be read.
    """
    named, refused = located(words)
    alone = len(words) == len(named) == 1
    files = [info for place in named for info in _describe_place(place, alone=alone)]
    files += [_unread(word, error) for word, error in refused]
    kinds, states = {f.kind for f in files if f.channels or f.metadata}, {f.crc for f in files}
    by_weight: tuple[Crc, ...] = ("bad", "unchecked", "absent", "ok")
    named_alike = Counter(name for f in files for name in f.metadata)
    metadata = {
        name if named_alike[name] == 1 else f.path: records
        for f in files
        for name, records in f.metadata.items()
    }
    run = run_folder(named[0]) if len(named) == 1 else None
    result = {} if run is None else result_of(run)
    channels = tuple(c for f in files for c in f.channels)
    libraries = {f.library for f in files}
    records = [values for found in metadata.values() for values in found.values()]
    return LogInfo(
        path=" ".join([*map(str, named), *(word for word, _ in refused)]),
        kind=kinds.pop() if len(kinds) == 1 else "foreign",
        channels=channels,
        chunks=sum(f.chunks for f in files),
        complete=all(f.complete for f in files),
        crc=next(state for state in by_weight if state in states),
        problems=tuple(p for f in files for p in f.problems),
        metadata=metadata,
        seed=_seed(records),
        ended=None if result.get("ended") is None else str(result["ended"]),
        held_out=held_out_of(result),
        modules=() if run is None else modules_of(run),
        run=None if run is None else RunInfo.of(run, result, _iterations(channels)),
        state=worst(f.state for f in files),
        notes=tuple(note for f in files for note in f.notes),
        size=sum((f.size for f in files), SizeInfo()),
        library=libraries.pop() if len(libraries) == 1 else "",
        files=tuple(files),
    )


def _iterations(channels: Sequence[ChannelInfo]) -> int:
    """Iterations of a run whose log has these channels: the records of its signals."""
    return sum(c.messages for c in channels if c.topic == SIGNALS_TOPIC)


def _describe_place(place: Path, *, alone: bool) -> Iterator[LogInfo]:
    """Describe the logs at a place; of several one that cannot be read is described as such."""
    logs: list[Path] = [place]
    try:
        if not only_foreign(place) and not are_arrays([place]):
            logs = log_files(place)
    except CdmisfaError as error:
        if alone:
            raise
        yield _unread(place, error)
        return
    for log in logs:
        try:
            yield describe_log(log)
        except CdmisfaError as error:
            if alone and (len(logs) == 1 or not isinstance(error, LogDamagedError)):
                raise
            yield _unread(log, error)


def describe_log(log: Path, *, decode: bool | None = None) -> LogInfo:
    """Describe a file or a folder that is one log; raises as `describe`.

    What is in it is decoded, only its summary is read, or as much as `CHECK_BYTES` says.
    """
    if only_foreign(log):
        return _describe_foreign(log, 0 if decode is False else CHECK_BYTES)
    if are_arrays([log]):
        return _describe_arrays(log)
    if decode or (decode is None and log.stat().st_size <= CHECK_BYTES):
        return read_once(log, lambda reader: describe_reader(reader, decode=decode))
    with LogReader(log, salvage=True, check="chunks") as reader:
        return describe_reader(reader, decode=False)


def _unread(place: str | Path, error: CdmisfaError) -> LogInfo:
    crc, state = failed_state(error)
    wrong = (as_problem(place, error),)
    return LogInfo(str(place), "foreign", (), 0, False, crc, wrong, {}, state=state)


def _describe_foreign(place: Path, most: int) -> LogInfo:
    """Describe a log that is in no MCAP file; of pictures up to `most` bytes are checked."""
    known = channels_of(place)
    channels = [
        ChannelInfo(c.topic, c.encoding, c.schema, c.messages, c.start_ns, c.end_ns, place.name)
        for c in known
    ]
    missing = tuple(Problem(str(place), c.missing) for c in known if c.missing)
    broken = None
    if most and log_format(place) == "pictures":
        with contextlib.closing(FolderImages(place, None)) as pictures:
            broken = pictures.broken(most)
    state: State = "damaged" if broken else "unchecked" if broken is None else "whole"
    return LogInfo(
        path=str(place),
        kind="foreign",
        channels=tuple(channels),
        chunks=0,
        complete=not missing,
        crc="absent" if broken is None else "bad" if broken else "ok",
        problems=(*missing, *(broken or ())),
        metadata={},
        state="cut short" if missing else state,
        size=SizeInfo(_bytes_of(place)),
        notes=tuple(dict.fromkeys(line for c in known for line in c.remarks)),
    )


def _describe_arrays(place: Path) -> LogInfo:
    """What `numpy` saved: to open it is to find that it is all there."""
    channels = []
    for name, array in load_numbers(place).items():
        shape = "x".join(map(str, array.shape[1:]))
        kind = f"{array.dtype} {shape}".rstrip()
        rows = len(array) if array.ndim else 1
        channels.append(ChannelInfo(name, "numpy", kind, rows, None, None, place.name))
    about: Any = {"complete": True, "crc": "absent", "problems": (), "metadata": {}}
    size = SizeInfo(_bytes_of(place))
    return LogInfo(str(place), "foreign", tuple(channels), 0, size=size, **about)


def _bytes_of(place: Path) -> int:
    """Bytes of a file, or of all files in a folder."""
    files = [place] if place.is_file() else place.rglob("*")
    return sum(path.stat().st_size for path in files if path.is_file())


def describe_reader(reader: LogReader, *, decode: bool | None = None) -> LogInfo:
    """Describe an MCAP file."""
    if decode is None:
        decode = sum(s.size for s in reader.segments) <= CHECK_BYTES
    counts, channels = count_messages(reader, decode=decode), []
    name = reader.path.name
    for number, found in sorted(counts.items()):
        undefined = Channel(number, f"(channel {number}, never defined)", "", {}, 0)
        channel = reader.channels.get(number, undefined)
        schema = reader.schemas.get(channel.schema_id)
        kind, times = schema.name if schema else "", (found.start, found.end)
        entry = (channel.topic, channel.message_encoding, kind, found.messages, *times, name)
        channels.append(ChannelInfo(*entry))
    metadata = {m.name: m.metadata for m in reader.metadata}
    state = state_of(reader)
    if state == "whole" and not (decode and _all_checked(reader)):
        state = "unchecked"
    stored, decompressed = (sum(getattr(s, n) for s in reader.segments) for n in SIZES)
    compression = Counter(s.compression or "none" for s in reader.segments if s.chunked)
    return LogInfo(
        path=str(reader.path),
        kind=kind_of(reader),
        channels=tuple(channels),
        chunks=sum(s.chunked for s in reader.segments),
        complete=reader.complete,
        crc=crc_of(reader) if decode else "unchecked",
        problems=problems_of(reader),
        metadata={name: metadata},
        seed=_seed([*metadata.values()]),
        state=state,
        notes=tuple(reader.unproven()),
        size=SizeInfo(reader.size, stored, decompressed, dict(compression)),
        library=reader.library,
    )


def _all_checked(reader: LogReader) -> bool:
    """Whether checksums are all there is to check; images of others may be broken within."""
    images = any(schema.name in SCHEMAS for schema in reader.schemas.values())
    return kind_of(reader) != "foreign" or not images


def kind_of(reader: LogReader) -> Kind:
    """Tell a recording and a run from other logs by their metadata."""
    names = {m.name for m in reader.metadata}
    if RECORDING_METADATA in names:
        return "recording"
    return "run" if RUN_METADATA in names else "foreign"


def as_problem(path: str | Path, error: CdmisfaError) -> Problem:
    """An error as a problem of the file that it names."""
    return Problem(str(path), str(error).removeprefix(f"{path}: "))


def problems_of(reader: LogReader) -> tuple[Problem, ...]:
    """What was found to be wrong so far, and what is missing at the end."""
    found = [Problem(f"{reader.path}: {p.where}", p.what) for p in reader.problems]
    return (*found, *([Problem(str(reader.path), reader.missing)] if reader.missing else ()))


def _seed(records: Sequence[Mapping[str, str]]) -> int | None:
    """The one seed that all metadata names."""
    seeds: set[int] = set()
    for values in records:
        with contextlib.suppress(ValueError, TypeError, AttributeError):
            manifest = parse_json(values.get("manifest", "{}"))
            seeds.add(int(values.get("seed", manifest.get("seed"))))
    return seeds.pop() if len(seeds) == 1 else None
