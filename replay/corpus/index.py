"""The index of many logs: what is new or changed is read, the rest is kept, by a join."""

from __future__ import annotations

import functools
import math
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, NamedTuple

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from cdmisfa.core.clock import NANOSECONDS
from cdmisfa.core.errors import CdmisfaError, LogDamagedError, UsageError, one_line
from cdmisfa.core.processes import WorkersError, run_all
from cdmisfa.core.untrusted import check_regular, parse_json
from recorder.log.files import atomic_write, held, make_folder, refuse_unless
from replay.corpus.finding import INDEX, Found, found_logs
from replay.corpus.rows import MARK, SCHEMA, VERSION, Answer, look
from replay.storage.location import is_url, location
from replay.storage.opening import no_such

BATCH: Final = 32
"""Logs that a process looks at in one go."""

MOST_NAMED: Final = 20
"""Logs with a problem that `index` prints, so that they fit on a screen."""

SAVED_EVERY: Final = 5000
"""Logs after which what is known is written, so that a kill costs no more than these."""

_SAME: Final = (
    "scene",
    "seed",
    "config_sha256",
    "start_ns",
    "fps",
    "frame_shape",
    "dtype",
    "truth",
)
"""What the views of a recording state alike."""


@dataclass(slots=True)
class Indexed:
    """What became of an index.

    Attributes:
        index: its file.
        logs: how many it has now.
        streams: how many rows.
        read: logs that were looked at, as they were new or had changed.
        kept: logs that were as before.
        gone: logs that it had and that are not there any more, and those that went meanwhile.
        broken: logs with a problem.
        kinds: for each kind of log how many there are, their files, streams, bytes and seconds; a
            recording is one log, however many files it has.
        problems: `path` and `problem` of the first `MOST_NAMED` of those with one.
        anew: why nothing was kept of an index that was there; "" where something may be.
        stopped: it was stopped before all logs were looked at; the rest is for the next time.
    """

    index: Path
    logs: int = 0
    streams: int = 0
    read: int = 0
    kept: int = 0
    gone: list[str] = field(default_factory=list)
    broken: int = 0
    kinds: list[dict[str, Any]] = field(default_factory=list)
    problems: list[dict[str, Any]] = field(default_factory=list)
    anew: str = ""
    stopped: bool = False


class IndexedLog(NamedTuple):
    """What is opened as one: a recording by its files, or a log of others.

    Attributes:
        name: as the index has it, relative to its folder.
        files: as they are opened.
        states: bytes of each, and what differs when it was written again, as `Found` has them.
    """

    name: str
    files: list[str]
    states: list[tuple[int, str]]


def indexed_logs(index: Path) -> list[IndexedLog]:
    """The logs of an index but runs, in the order of their first files.

    Files of recordings that lie in one folder and are not all views of one are a log each.

    Raises:
        UsageError: it is no index, or one of another version.
        LogDamagedError: it is damaged.
    """
    table = read_index(index)
    table = table.filter(pc.equal(table["number"], 0))
    views = table.filter(pc.equal(table["kind"], "recording")).select(["log", "configuration"])
    stated: dict[str, list[str | None]] = {}
    for row in views.to_pylist():
        stated.setdefault(row["log"], []).append(row["configuration"])
    try:
        recordings = {name for name, each in stated.items() if _of_one(each)}
    except (ValueError, AttributeError) as error:
        raise _damaged(index, error) from error
    found: dict[str, IndexedLog] = {}
    for row in table.select(["log", "path", "kind", "bytes", "changed"]).to_pylist():
        if row["kind"] != "run":
            path = row["path"]
            name = row["log"] if row["log"] in recordings else path
            log = found.setdefault(name, IndexedLog(name, [], []))
            log.files.append(path if "://" in path else str(index.parent / path))
            log.states.append((row["bytes"], row["changed"]))
    return list(found.values())


def _of_one(stated: Sequence[str | None]) -> bool:
    """Whether files are views of one recording, by what each states as JSON."""
    if len(stated) == 1 or None in stated:
        return True
    facts = [parse_json(text or "") for text in stated]
    views = {str((one.get("view"), one.get("first_frame"))) for one in facts}
    same = {str([one.get(name) for name in _SAME]) for one in facts}
    return len(views) == len(facts) and len(same) == 1


def is_index(path: Path) -> bool:
    """Whether a file is an index."""
    try:
        return path.suffix == ".parquet" and path.is_file() and _version(path) > 0
    except CdmisfaError:
        return False


def index_logs(
    words: Sequence[str | Path],
    out: Path | None = None,
    *,
    deep: bool = False,
    jobs: int = 1,
    told: Callable[[float, float | None], None] = lambda done, total: None,
    stop: Callable[[], bool] = lambda: False,
) -> Indexed:
    """Make the index of logs, or bring the one that is there up to date.

    What has the size and the time of change that the index knows is not opened. An index that is
    interrupted, or for which the disk has no room, is as it was, or has what was read so far.

    Args:
        words: folders, patterns, files and URLs.
        out: the index; by default corpus.parquet in the folder that is the one word.
        deep: decode every log, for its checksums, gaps and shapes.
        jobs: processes; what is found does not depend on them.
        told: how many of the logs that are to be read were.
        stop: asked now and then; true ends it with what was read.

    Raises:
        UsageError: a word names nothing, another process indexes there, or what is there is no
            index.
        LogDamagedError: the index is damaged.
        LogWriteError: it cannot be written.
    """
    index = _place_of(words, out)
    make_folder(index.parent)
    with held(index.parent):
        made = Indexed(index)
        there = _there(words, index.parent)
        old = _known(index, made)
        known = _states(old, deep)
        logs = [log for path, log in sorted(there.items()) if known.get(path) != log[1:3]]
        made.gone = [path for path in pc.unique(old["path"]).to_pylist() if path not in there]
        made.kept = len(there) - len(logs)
        old = old.filter(pc.is_in(old["path"], pa.array(there, pa.string())))
        looked: list[str] = []
        rows: dict[int, pa.Table] = {}
        saved = 0
        try:
            for at, some, answer in _looked(logs, deep, jobs):
                rows[at] = answer.rows
                made.gone += answer.gone
                looked += (log.path for log in some)
                told(len(looked), len(logs))
                if stop() and len(looked) < len(logs):
                    made.stopped = True
                    break
                if len(looked) - saved >= SAVED_EVERY:
                    saved = len(looked)
                    _write(old, looked, rows, index)
        except WorkersError:
            _write(old, looked, rows, index)
            raise
        made.read = len(looked)
        table = old
        if looked or made.gone or not index.exists() or made.anew:
            table = _write(old, looked, rows, index)
    made.streams, made.logs = table.num_rows, len(pc.unique(table["path"]))
    first = pc.equal(table["number"], 0)
    broken = table.filter(pc.and_(first, pc.is_valid(table["problem"])))
    made.broken = len(broken)
    made.problems = broken.slice(0, MOST_NAMED).select(["path", "problem"]).to_pylist()
    made.kinds = _kinds(table, first)
    return made


def _kinds(table: pa.Table, first: pa.ChunkedArray) -> list[dict[str, Any]]:
    """Return for each kind of log how much there is, as `Indexed.kinds` has it.

    Args:
        table: rows of streams.
        first: whether each is the first of its file, whose size it states.
    """
    of_log = ("log", "topic", "start_ns", "end_ns")
    columns = {name: table[name] for name in of_log}
    columns["kind"] = pc.cast(table["kind"], pa.string())
    columns["files"] = pc.cast(first, pa.int64())
    columns["bytes"] = pc.if_else(first, table["bytes"], 0)
    logs = pa.table(columns).group_by("log", use_threads=False).aggregate(
        [("kind", "first"), ("files", "sum"), ("topic", "count"), ("bytes", "sum"),
         ("start_ns", "min"), ("end_ns", "max")]
    )  # fmt: skip
    found: dict[str, dict[str, Any]] = {}
    for log in logs.to_pylist():
        kind = log["kind_first"] or "not read"
        none = {"kind": kind, "logs": 0, "files": 0, "streams": 0, "bytes": 0, "seconds": 0.0}
        own = found.setdefault(kind, none)
        own["logs"] += 1
        own["files"] += log["files_sum"]
        own["streams"] += log["topic_count"]
        own["bytes"] += log["bytes_sum"] or 0
        if log["start_ns_min"] is not None and log["end_ns_max"] is not None:
            own["seconds"] += (log["end_ns_max"] - log["start_ns_min"]) / NANOSECONDS
    return [found[kind] for kind in sorted(found)]


def read_index(path: Path) -> pa.Table:
    """The rows of an index.

    Raises:
        UsageError: it is no index, or one of another version.
        LogDamagedError: it is damaged.
    """
    version = _version(path)
    if version != VERSION:
        raise UsageError(
            f"{path} is an index of version {version}, this program has {VERSION}: make it again "
            "with cdmisfa index"
        )
    try:
        with pq.ParquetFile(path) as file:  # `read_table` imports pandas, where that is there
            return file.read()
    except (pa.ArrowException, OSError) as error:
        raise _damaged(path, error) from error


def _version(path: Path) -> int:
    check_regular(path)
    try:
        stated = (pq.read_schema(path).metadata or {}).get(MARK, b"")
    except (pa.ArrowException, OSError) as error:
        if path.suffix != ".parquet":  # a log, say, which nobody should remove
            raise _no_index(path) from error
        raise _damaged(path, error) from error
    if not stated.isdigit():
        raise _no_index(path)
    return int(stated)


def _no_index(path: Path) -> UsageError:
    return UsageError(f"{path} is no index of logs: name another file, or the folder of an index")


def _damaged(path: Path, error: Exception) -> LogDamagedError:
    said = one_line(error)[:200]
    return LogDamagedError(f"{path} is damaged ({said}): remove it, and index again")


def _place_of(words: Sequence[str | Path], out: Path | None) -> Path:
    """Where the index of some logs is."""
    if out is not None:
        refuse_unless(out, "an index is a Parquet file", ".parquet")
        return out
    if len(words) == 1 and not is_url(words[0]):
        place = location(words[0])
        if place.is_dir():
            return place / INDEX
        if not (place.exists() or any(letter in str(place) for letter in "*?[")):
            raise no_such(place)
    named = " ".join(map(str, words))
    raise UsageError(f"{named}: no folder, which would hold its index: say where, with -o")


def _there(words: Sequence[str | Path], folder: Path) -> dict[str, Found]:
    """Return the logs that are there by their paths, which are relative to the index's folder."""
    below = os.path.join(folder, "")
    found: dict[str, Found] = {}
    for log in found_logs(words):
        path = log.file.removeprefix(below)
        if len(path) == len(log.file) and "://" not in path:
            path = os.path.relpath(path, folder)
        found[path] = log._replace(path=path)
    return found


def _known(index: Path, made: Indexed) -> pa.Table:
    """What an index has; nothing where there is none, or one of another version."""
    if not index.exists():
        return SCHEMA.empty_table()
    if (version := _version(index)) != VERSION:
        made.anew = f"{index} was an index of version {version}: it is made anew"
        return SCHEMA.empty_table()
    return read_index(index)


def _states(old: pa.Table, deep: bool) -> dict[str, tuple[int, str]]:
    """Return size and time of change by path of what an index knows, with `deep` of it decoded."""
    known = old.filter(pc.and_(pc.not_equal(old["changed"], ""), pc.or_(old["deep"], not deep)))
    columns = (known[name].to_pylist() for name in ("path", "bytes", "changed"))
    return {path: (size, changed) for path, size, changed in zip(*columns, strict=True)}


def _looked(
    logs: Sequence[Found], deep: bool, jobs: int
) -> Iterator[tuple[int, Sequence[Found], Answer]]:
    """Read logs, as many at a time as one process takes.

    Yields:
        The number of some logs that follow one another, the logs, and their rows.
    """
    batches = [logs[at : at + BATCH] for at in range(0, len(logs), BATCH)]
    work = functools.partial(look, deep=deep)
    for number, answer in run_all(work, batches, jobs=min(jobs, math.ceil(len(batches) / 4))):
        yield number, batches[number], answer


def _write(
    old: pa.Table, looked: Sequence[str], rows: Mapping[int, pa.Table], index: Path
) -> pa.Table:
    """Write what is known by now, in the order of paths: of what was not looked at, as before."""
    kept = old.filter(pc.invert(pc.is_in(old["path"], pa.array(looked, pa.string()))))
    tables = [kept.cast(SCHEMA), *(rows[at] for at in sorted(rows))]
    table = pa.concat_tables(tables).unify_dictionaries().combine_chunks()
    table = table.take(pc.sort_indices(table["path"])).replace_schema_metadata(SCHEMA.metadata)
    with atomic_write(index) as partial:
        pq.write_table(table, partial, compression="zstd")
    return table
