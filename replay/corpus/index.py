"""The index of many logs: a Parquet file with a row for each stream, updated by what changed."""

from __future__ import annotations

import functools
import math
import os
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, NamedTuple

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from cdmisfa.core.clock import NANOSECONDS
from cdmisfa.core.errors import CdmisfaError, LogDamagedError, UsageError, one_line
from cdmisfa.core.processes import run_all
from cdmisfa.core.untrusted import check_regular, parse_json
from recorder.log.files import atomic_write, locked_folder, make_folder, refuse_unless
from replay.corpus.index_rows import MARK, SCHEMA, VERSION, read_rows
from replay.integrity.listing import INDEX, ListedLog, find_logs, may_be_corpus
from replay.storage.location import is_url, location
from replay.storage.paths import no_such

# Logs per task of a process: fewer cost time for messages, more delay an interrupt.
BATCH: Final = 32

# Logs with a problem that `index` prints, so that they fit on a screen.
MOST_PROBLEMS: Final = 20

# Logs after which the index is written, so that a kill loses no more than these.
SAVED_EVERY: Final = 5000

# Metadata that is the same in all views of one recording.
_SHARED: Final = ("scene", "seed", "config_sha256", "start_ns", "fps", "frame_shape", "dtype",
                  "truth")  # fmt: skip


@dataclass(slots=True)
class Indexed:
    """The outcome of indexing.

    Attributes:
        index: the file.
        logs: number of logs in it; the files of a recording are one.
        files: number of files, and of folders that are one log.
        streams: number of rows.
        read: number of files that were new or changed, and were read now.
        kept: number of unchanged files.
        gone: paths of files that no longer exist.
        broken: number of files with a problem.
        unread: number of files that were not read, as a package or a permission is missing.
        kinds: logs, files, streams, bytes and seconds of each kind of log; a recording is one log.
        problems: `path` and `problem` of the first `MOST_PROBLEMS` logs that have one.
        stopped: whether it was stopped before all logs were read.
    """

    index: Path
    logs: int = 0
    files: int = 0
    streams: int = 0
    read: int = 0
    kept: int = 0
    gone: list[str] = field(default_factory=list)
    broken: int = 0
    unread: int = 0
    kinds: list[dict[str, Any]] = field(default_factory=list)
    problems: list[dict[str, Any]] = field(default_factory=list)
    stopped: bool = False


class IndexedLog(NamedTuple):
    """Files that are opened as one log: a recording, or an external log.

    Attributes:
        name: path relative to the index.
        files: paths or URLs.
        states: size and time of change of each file.
    """

    name: str
    files: list[str]
    states: list[tuple[int, str]]


def index_logs(
    words: Sequence[str | Path],
    out: Path | None = None,
    *,
    deep: bool = False,
    jobs: int = 1,
    progress: Callable[[float, float | None], None] = lambda done, total: None,
    stop: Callable[[], bool] = lambda: False,
) -> Indexed:
    """Write the index of logs, or update an existing one.

    A log with the size and the time of change that the index has is not opened. An index that is
    interrupted keeps the logs that were read so far.

    Args:
        words: folders, patterns, files and URLs.
        out: the index; by default corpus.parquet in the folder that is the only word.
        deep: decode every log, for checksums, gaps and shapes.
        jobs: number of processes; the result does not depend on it.
        progress: called with the number of logs that were read, and of all to read.
        stop: called after each batch; true ends the work.

    Raises:
        UsageError: a word names nothing, another process writes the index, or the file exists and
            is no index.
        LogDamagedError: the index is damaged.
        LogWriteError: the index cannot be written.
    """
    index = _index_of(words, out)
    logs = _logs_by_path(words, index)
    if not logs and not index.exists():
        raise UsageError(f"{' '.join(map(str, words))}: no log is in this folder or below it")
    make_folder(index.parent)
    with locked_folder(index.parent):
        indexed = Indexed(index)
        table = SCHEMA.empty_table()
        if index.exists():
            table = read_index(index)
        known = _known_states(table, deep)
        to_read = [log for path, log in sorted(logs.items()) if known.get(path) != log[1:3]]
        indexed.gone = [path for path in pc.unique(table["path"]).to_pylist() if path not in logs]
        indexed.kept = len(logs) - len(to_read)
        table = table.filter(pc.is_in(table["path"], pa.array(logs, pa.string()))).cast(SCHEMA)
        new: list[pa.Table] = []
        try:
            batches = [to_read[at : at + BATCH] for at in range(0, len(to_read), BATCH)]
            work = functools.partial(read_rows, deep=deep)
            processes = min(jobs, math.ceil(len(batches) / 4))
            for number, (rows, gone) in run_all(work, batches, jobs=processes):
                batch = [log.path for log in batches[number]]
                table = table.filter(pc.invert(pc.is_in(table["path"], pa.array(batch))))
                new.append(rows)
                indexed.gone += gone
                indexed.read += len(batch)
                progress(indexed.read, len(to_read))
                if stop() and indexed.read < len(to_read):
                    indexed.stopped = True
                    break
                if indexed.read % SAVED_EVERY < len(batch):
                    _write([table, *new], index)
        finally:
            if indexed.read or indexed.gone or not index.exists():
                table = _write([table, *new], index)
    _summarize(indexed, table)
    return indexed


def _summarize(indexed: Indexed, table: pa.Table) -> None:
    """Count what an index has: its logs, those with a problem, and how much of each kind."""
    broken = table.filter(pc.and_(pc.equal(table["number"], 0), pc.is_valid(table["problem"])))
    indexed.streams, indexed.files = table.num_rows, len(pc.unique(table["path"]))
    indexed.logs = len(pc.unique(table["log"]))
    indexed.unread = broken["state"].to_pylist().count("not read")
    indexed.broken = len(broken) - indexed.unread
    indexed.problems = broken.slice(0, MOST_PROBLEMS).select(["path", "problem"]).to_pylist()
    columns = ["log", "kind", "topic", "number", "bytes", "start_ns", "end_ns"]
    logs: dict[str, list[dict[str, Any]]] = {}
    for row in table.select(columns).to_pylist():
        logs.setdefault(row["log"], []).append(row)
    kinds: dict[str, Any] = {}
    for rows in logs.values():
        files = [row for row in rows if row["number"] == 0]
        starts, ends = ([row[n] for row in rows if row[n] is not None] for n in columns[-2:])
        kinds.setdefault(rows[0]["kind"] or "not read", Counter()).update(
            logs=1,
            files=len(files),
            streams=sum(row["topic"] is not None for row in rows),
            bytes=sum(row["bytes"] for row in files),
            seconds=(max(ends) - min(starts)) / NANOSECONDS if starts and ends else 0.0,
        )
    indexed.kinds = [{"kind": kind, **kinds[kind]} for kind in sorted(kinds)]


def indexed_logs(index: Path) -> list[IndexedLog]:
    """Return the recordings and external logs of an index, ordered by their first files.

    The files of recordings in one folder are one log if they are views of one recording.

    Raises:
        UsageError: the file is not an index, or has another version.
        LogDamagedError: the file is damaged.
    """
    table = read_index(index)
    table = table.filter(pc.equal(table["number"], 0))
    views = table.filter(pc.equal(table["kind"], "recording")).select(["log", "configuration"])
    configurations: dict[str, list[str | None]] = {}
    for row in views.to_pylist():
        configurations.setdefault(row["log"], []).append(row["configuration"])
    try:
        recordings = {name for name, texts in configurations.items() if _are_views_of_one(texts)}
    except (ValueError, AttributeError) as error:
        raise _damaged(index, error) from error
    logs: dict[str, IndexedLog] = {}
    for row in table.select(["log", "path", "kind", "bytes", "changed"]).to_pylist():
        if row["kind"] != "run":
            path = row["path"]
            name = row["log"] if row["log"] in recordings else path
            log = logs.setdefault(name, IndexedLog(name, [], []))
            log.files.append(path if "://" in path else str(index.parent / path))
            log.states.append((row["bytes"], row["changed"]))
    return list(logs.values())


def _are_views_of_one(configurations: Sequence[str | None]) -> bool:
    if len(configurations) == 1 or None in configurations:
        return True
    facts = [parse_json(text or "") for text in configurations]
    views = {str((fact.get("view"), fact.get("first_frame"))) for fact in facts}
    shared = {str([fact.get(name) for name in _SHARED]) for fact in facts}
    return len(views) == len(facts) and len(shared) == 1


def logs_of_corpus(words: Sequence[str | Path]) -> list[list[Path]] | None:
    """Return the files of each log of an index; None if the words name no index of many logs.

    Args:
        words: an index, or a folder that has one.

    Raises:
        UsageError: the index holds no log, or has another version.
        LogDamagedError: the file is damaged.
    """
    if not may_be_corpus(words):
        return None
    place = Path(words[0])
    index = place / INDEX if place.is_dir() else place
    if not place.is_dir() and not is_index(index):
        return None  # it is a table
    logs = indexed_logs(index)
    if place.is_dir() and [log.name for log in logs] == [os.curdir]:
        return None  # the folder is a single recording
    if not logs:
        raise UsageError(f"{index} lists no log to learn from: index a folder that has logs")
    return [[location(file) for file in log.files] for log in logs]


def is_index(path: Path) -> bool:
    """Return whether a file is an index."""
    try:
        if path.suffix == ".parquet" and path.is_file():
            _check_index(path)
            return True
    except CdmisfaError:
        pass
    return False


def read_index(path: Path) -> pa.Table:
    """Return the rows of an index.

    Raises:
        UsageError: the file is not an index, or has another version.
        LogDamagedError: the file is damaged.
    """
    _check_index(path)
    try:
        with pq.ParquetFile(path) as file:  # `read_table` would import pandas if installed
            return file.read()
    except (pa.ArrowException, OSError) as error:
        raise _damaged(path, error) from error


def _check_index(path: Path) -> None:
    """Raise an error if a file is no index of this version."""
    check_regular(path)
    version = b""
    if path.suffix == ".parquet":  # else it is a log, which nobody should remove
        try:
            version = (pq.read_schema(path).metadata or {}).get(MARK, b"")
        except (pa.ArrowException, OSError) as error:
            raise _damaged(path, error) from error
    if version != str(VERSION).encode():
        raise UsageError(
            f"{path} is not an index of version {VERSION}: choose another file, or index again"
        )


def _damaged(path: Path, error: Exception) -> LogDamagedError:
    return LogDamagedError(f"{path} is damaged ({one_line(error)}): delete it and index again")


def _index_of(words: Sequence[str | Path], out: Path | None) -> Path:
    """Return the path of the index of some logs."""
    if out is not None:
        refuse_unless(out, "an index is a Parquet file", ".parquet")
        return out
    if len(words) == 1 and not is_url(words[0]):
        place = location(words[0])
        if place.is_dir():
            return place / INDEX
        if not place.exists() and not set("*?[") & set(str(place)):
            raise no_such(place)
    raise UsageError(
        f"{' '.join(map(str, words))}: the index has no default file here; add -o FILE.parquet"
    )


def _logs_by_path(words: Sequence[str | Path], index: Path) -> dict[str, ListedLog]:
    """Return the logs but the index by their paths, relative to the folder of the index."""
    folder = index.parent
    below = os.path.join(folder, "")
    logs: dict[str, ListedLog] = {}
    for log in find_logs(words):
        path = log.file.removeprefix(below)
        if path == log.file and "://" not in path:
            path = os.path.relpath(path, folder)
        if path != index.name:
            logs[path] = log._replace(path=path)
    return logs


def _known_states(table: pa.Table, deep: bool) -> dict[str, tuple[int, str]]:
    """Return size and time of change of the logs in an index; with `deep`, of decoded logs."""
    rows = table.select(["path", "bytes", "changed", "deep", "state"]).to_pylist()
    # A log that was not read may be readable now, as when the missing package is installed.
    known = (row for row in rows if row["changed"] and row["state"] != "not read")
    return {r["path"]: (r["bytes"], r["changed"]) for r in known if r["deep"] or not deep}


def _write(tables: Sequence[pa.Table], index: Path) -> pa.Table:
    """Write rows in the order of paths, and return them."""
    table = pa.concat_tables(tables).unify_dictionaries().combine_chunks()
    order = pc.sort_indices(table, [("path", "ascending"), ("number", "ascending")])
    table = table.take(order).replace_schema_metadata(SCHEMA.metadata)
    with atomic_write(index) as partial:
        pq.write_table(table, partial, compression="zstd")
    return table
