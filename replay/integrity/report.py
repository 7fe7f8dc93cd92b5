"""Report on logs: the content, problems and state of each, and of several together."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal

from cdmisfa.core.errors import CdmisfaError, LogDamagedError, UsageError
from recorder.mcap.records import Problem
from replay.logs.health import Health
from replay.logs.stream import ChannelInfo

if TYPE_CHECKING:
    from cdmisfa.modules import Module

# Rises whenever a key of the JSON of info, verify or recover changes its meaning.
SCHEMA: Final = 1

Kind = Literal["recording", "run", "foreign"]
Crc = Literal["ok", "absent", "bad", "unchecked"]

# Unchecked: no problem was found, but not everything was read. Not read: not a readable log.
State = Literal["whole", "unchecked", "not read", "cut short", "damaged"]

# Exit code of `info` and `verify` for each state; the best state is first.
EXIT_CODES: Final[Mapping[State, int]] = {
    "whole": 0,
    "unchecked": 0,
    "not read": UsageError.exit_code,
    "cut short": LogDamagedError.exit_code,
    "damaged": LogDamagedError.exit_code,
}

# The best state of checksums is first.
_CRCS: Final[tuple[Crc, ...]] = ("ok", "absent", "unchecked", "bad")


@dataclass(frozen=True, slots=True)
class SizeInfo:
    """Size of a log.

    Attributes:
        file: bytes of the file.
        stored: bytes of its messages as stored, with the records beside them.
        decompressed: the same bytes decompressed.
        compression: number of chunks by compression; "none" is one of them.
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
class ModuleInfo:
    """A module: the slowness of each output, and 1 or 0 where it is known to be slow or not.

    Attributes:
        kinds: kind of each output, "slow" or "principal".
        iteration: iteration at whose end the module was saved.
        policy: policy during learning; for each stream 0 to stay and 1 to switch.
    """

    index: int
    stream: str
    slowness: tuple[float, ...]
    slow: tuple[int, ...]
    iteration: int
    policy: tuple[int, ...]
    kinds: tuple[str, ...]

    @classmethod
    def of(cls, module: Module) -> ModuleInfo:
        """Return a module in short."""
        slowness, slow, policy = (
            tuple(m.tolist()) for m in (module.eta, module.slow, module.policy)
        )
        facts = module.iteration, policy, module.kinds
        return cls(module.index, module.stream, slowness, slow, *facts)


@dataclass(frozen=True, slots=True)
class LogReport:
    """The report of `info` or `verify` on one log, or on several logs together.

    Attributes:
        kind: kind of the logs; "foreign" if they are of several kinds.
        chunks: number of chunks.
        complete: no file is cut short.
        crc: result of the checksums.
        metadata: metadata records by file name (by path if names repeat) and record name.
        seed: the seed that all files state, if it is one.
        ended: why the run in a folder ended.
        modules: modules of the run in a folder.
        run: how the run in a folder was learned: its `algorithm`, `streams`, `tau` (frames of an
            iteration), `iterations` in its log, and `outcomes`, of each stream its `stream`,
            `state`, `module`, `blocks`, `slowness` and `why` if the learner reports them.
        held_out: slowness of its modules on held-out frames.
        state: the worst state of the files.
        notes: remarks that are no problems.
        size: bytes.
        library: writer of the file; "" for several writers.
        health: `topic` and columns of each stream of images, see `Health`; `verify` measures it.
        files: report on each file.
    """

    path: str
    kind: Kind = "foreign"
    channels: tuple[ChannelInfo, ...] = ()
    chunks: int = 0
    complete: bool = True
    crc: Crc = "absent"
    problems: tuple[Problem, ...] = ()
    metadata: Mapping[str, Mapping[str, Mapping[str, str]]] = field(default_factory=dict)
    seed: int | None = None
    ended: str | None = None
    modules: tuple[ModuleInfo, ...] = ()
    run: Mapping[str, Any] | None = None
    held_out: Mapping[str, Any] | None = None
    state: State = "whole"
    notes: tuple[str, ...] = ()
    size: SizeInfo = SizeInfo()
    library: str = ""
    health: tuple[Mapping[str, Any], ...] = ()
    files: tuple[LogReport, ...] = ()

    @property
    def ok(self) -> bool:
        """Whether there is no problem."""
        return not self.problems

    @property
    def messages(self) -> int:
        """Number of messages on all channels."""
        return sum(c.messages for c in self.channels)

    @property
    def span(self) -> tuple[int, int] | None:
        """Log times of the first and of the last message, nanoseconds."""
        starts = [c.start_ns for c in self.channels if c.start_ns is not None]
        ends = [c.end_ns for c in self.channels if c.end_ns is not None]
        return (min(starts), max(ends)) if starts and ends else None

    def logs(self) -> list[LogReport]:
        """Return a report for each log; the files of a recording in one folder are one."""
        groups: dict[str, list[LogReport]] = {}
        for file in self.files or (self,):
            whole = str(Path(file.path).parent) if file.kind == "recording" else file.path
            groups.setdefault(whole, []).append(file)
        return [combined(path, files) for path, files in groups.items()]

    @property
    def seconds(self) -> float | None:
        """Sum of the durations of the logs, in seconds; None if none is known."""
        spans = [log.span for log in self.logs() if log.span is not None]
        return sum(end - start for start, end in spans) / 1e9 if spans else None

    def as_json(self) -> dict[str, Any]:
        """Return the report of `info` as JSON values, with durations and rates."""
        document = asdict(self)
        for report, values in zip((self, *self.files), (document, *document["files"]), strict=True):
            values["seconds"] = report.seconds
            del values["health"]
            for channel, entry in zip(report.channels, values["channels"], strict=True):
                entry["rate"] = channel.rate
        return {"schema": SCHEMA, **document}

    def check_json(self) -> dict[str, Any]:
        """Return the report of `verify` as JSON values."""
        return {
            "schema": SCHEMA,
            "ok": self.ok,
            "state": self.state,
            "problems": [asdict(problem) for problem in self.problems],
            "files": [
                {"file": f.path, "crc": f.crc, "state": f.state, "streams": f.health}
                for f in self.files
            ],
            "notes": self.notes,
        }


def combined(
    path: str, reports: Sequence[LogReport], problems: Iterable[Problem] = ()
) -> LogReport:
    """Return one report on the files of several reports.

    Args:
        path: the logs, as the user named them.
        reports: one report or more.
        problems: further problems, of the files together.
    """
    files = [file for report in reports for file in report.files or (report,)]
    problems = (*(p for report in reports for p in report.problems), *problems)
    kinds = {f.kind for f in files if f.channels or f.metadata}
    names = Counter(name for f in files for name in f.metadata)
    libraries = {f.library for f in files}
    seeds = {f.seed for f in files if f.seed is not None}
    state = max((f.state for f in files), key=list(EXIT_CODES).index)
    unread = {f.path for f in files if f.state == "not read"}
    if state in ("whole", "not read") and any(p.where not in unread for p in problems):
        state = "damaged"  # whole files that contradict one another, or the run they belong to
    return LogReport(
        path=path,
        kind=kinds.pop() if len(kinds) == 1 else "foreign",
        channels=tuple(c for f in files for c in f.channels),
        chunks=sum(f.chunks for f in files),
        complete=all(f.complete for f in files),
        crc=max((f.crc for f in files), key=_CRCS.index),
        problems=tuple(dict.fromkeys(problems)),
        metadata={
            name if names[name] == 1 else f.path: records
            for f in files
            for name, records in f.metadata.items()
        },
        seed=seeds.pop() if len(seeds) == 1 else None,
        state=state,
        notes=tuple(dict.fromkeys(note for report in reports for note in report.notes)),
        size=sum((f.size for f in files), SizeInfo()),
        library=libraries.pop() if len(libraries) == 1 else "",
        files=tuple(files),
    )


def with_health(report: LogReport, streams: Mapping[str, Health]) -> LogReport:
    """Add the health of streams, with a note on each in which something is remarkable."""
    health = [{"topic": topic, **stream.columns()} for topic, stream in streams.items()]
    remarks = [(topic, stream.remark()) for topic, stream in streams.items()]
    notes = [f"{report.path}: {topic}: {text}" for topic, text in remarks if text]
    health = [columns for columns in health if len(columns) > 1]
    return replace(report, health=tuple(health), notes=(*report.notes, *notes))


def failed(place: str | Path, error: CdmisfaError) -> LogReport:
    """Report on a log that cannot be read."""
    report = LogReport(str(place), complete=False, problems=(as_problem(place, error),))
    if isinstance(error, LogDamagedError):
        return replace(report, crc="bad", state="damaged")
    return replace(report, crc="unchecked", state="not read")


def as_problem(path: str | Path, error: CdmisfaError) -> Problem:
    """Return an error as a problem of the file that it names."""
    return Problem(str(path), str(error).removeprefix(f"{path}: "))
