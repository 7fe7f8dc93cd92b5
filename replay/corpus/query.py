"""Questions to an index in SQL, and the answers that everybody wants."""

from __future__ import annotations

import contextlib
import importlib
import os
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import pyarrow as pa
import pyarrow.parquet as pq

from cdmisfa.core.errors import CdmisfaError, UsageError
from recorder.log.files import atomic_write, refuse_taken, refuse_unless
from replay.corpus.index import read_index

MOST_NAMED: Final = 20
"""Broken logs, doubles and kinds of streams that a summary names."""

_SAFE: Final = (
    "SET temp_directory = ''",
    "SET python_enable_replacements = false",
    "SET enable_external_access = false",
    "SET lock_configuration = true",
)
"""A query sees the index and nothing else: it reads and writes no file and no variable."""

_VIEWS: Final = """
CREATE VIEW streams AS SELECT * REPLACE (
    CASE WHEN contains(path, '://') THEN path ELSE getvariable('folder') || path END AS path,
    CASE WHEN log = '.' AND getvariable('folder') != '' THEN rtrim(getvariable('folder'), '/')
        WHEN contains(log, '://') THEN log ELSE getvariable('folder') || log END AS log
) FROM rows;
CREATE VIEW logs AS SELECT path, any_value(log) AS log, any_value(kind) AS kind,
    any_value(bytes) AS bytes, count(topic) AS streams, sum(messages)::BIGINT AS messages,
    min(start_ns) AS start_ns, max(end_ns) AS end_ns,
    (max(end_ns) - min(start_ns)) / 1e9 AS seconds,
    any_value(compression) AS compression, any_value(identity) AS identity,
    any_value(sha256) AS sha256, any_value(crc) AS crc, any_value(state) AS state,
    any_value(seed) AS seed, any_value(configuration) AS configuration,
    any_value(problem) AS problem
    FROM streams GROUP BY path;
CREATE VIEW doubles AS WITH files AS (SELECT * FROM rows WHERE number = 0),
    known AS (SELECT identity, max(contents) AS contents FROM files
        WHERE contents IS NOT NULL GROUP BY identity),
    same AS (SELECT coalesce(known.contents, identity) AS same, list(path ORDER BY path) AS paths,
        (sum(bytes) - max(bytes))::BIGINT AS bytes
        FROM files LEFT JOIN known USING (identity) WHERE identity IS NOT NULL
        GROUP BY same HAVING count(*) > 1)
    SELECT len(paths) AS copies, list_transform(paths, lambda path:
        CASE WHEN contains(path, '://') THEN path ELSE getvariable('folder') || path END) AS paths,
        bytes FROM same;
"""

_TOTALS: Final = """
WITH whole AS (SELECT any_value(kind) AS kind, count(*) FILTER (number = 0) AS files,
    sum(bytes) FILTER (number = 0) AS bytes, count(topic) AS streams,
    (max(end_ns) - min(start_ns)) / 1e9 AS seconds, min(start_ns) AS start_ns,
    max(end_ns) AS end_ns FROM rows GROUP BY log)
SELECT coalesce(kind, 'not read') AS kind, count(*) AS logs, sum(files)::BIGINT AS files,
    sum(streams)::BIGINT AS streams, sum(bytes)::BIGINT AS bytes, sum(seconds) AS seconds,
    min(start_ns) AS start_ns, max(end_ns) AS end_ns FROM whole GROUP BY ALL ORDER BY kind
"""
_STREAMS: Final = """
SELECT topic, schema, shape, count(*) AS streams, sum(messages)::BIGINT AS messages,
    sum(seconds) AS seconds, median(rate) AS rate, sum(gaps)::BIGINT AS gaps
    FROM streams WHERE topic IS NOT NULL GROUP BY topic, schema, shape
    ORDER BY seconds DESC NULLS LAST, topic, schema, shape
"""
_BROKEN: Final = """
SELECT path, state, problem FROM streams
    WHERE problem IS NOT NULL AND number = 0 ORDER BY path
"""
_DOUBLE: Final = "SELECT paths, bytes FROM doubles ORDER BY bytes DESC, paths"


@dataclass(frozen=True, slots=True)
class Summary:
    """What an index has; of lists the first `MOST_NAMED`, with how many there are.

    Attributes:
        kinds: how many logs of each kind there are, and how long they are; a recording is one,
            however many files it has.
        streams: the same of streams of a topic, a schema and a shape.
        broken: logs with a problem.
        double: files that are there more than once, and bytes that all but the largest take.
        counts: how many there are of each of the last three.
        saved: bytes that all doubles take.
    """

    kinds: list[dict[str, Any]]
    streams: list[dict[str, Any]]
    broken: list[dict[str, Any]]
    double: list[dict[str, Any]]
    counts: dict[str, int]
    saved: int

    def as_json(self) -> dict[str, Any]:
        """The summary as JSON values."""
        return asdict(self)


def ask(index: Path, sql: str) -> pa.Table:
    """The answer to a question in SQL, whose tables are `streams`, `logs` and `doubles`.

    Raises:
        UsageError: DuckDB is not installed, the SQL is wrong, or there is no such index.
        LogDamagedError: the index is damaged.
    """
    with _opened(index) as connection:
        return _asked(connection, sql)


def summary(index: Path) -> Summary:
    """What an index has, at a glance; raises as `ask`."""
    with _opened(index) as connection:
        kinds = _asked(connection, _TOTALS).to_pylist()
        tables = [_asked(connection, sql) for sql in (_STREAMS, _BROKEN, _DOUBLE)]
    streams, broken, double = (table.slice(0, MOST_NAMED).to_pylist() for table in tables)
    names = ("streams", "broken", "double")
    counts = {name: table.num_rows for name, table in zip(names, tables, strict=True)}
    saved = sum(tables[-1]["bytes"].to_pylist())
    return Summary(kinds, streams, broken, double, counts, saved)


@contextlib.contextmanager
def _opened(index: Path) -> Iterator[Any]:
    """A connection to a database in memory that has the index, and can reach nothing else."""
    rows = read_index(index)
    try:
        duckdb: Any = importlib.import_module("duckdb")
    except ImportError as error:
        raise UsageError(
            "query needs a package that is not installed: pip install 'cdmisfa[corpus]'"
        ) from error
    with duckdb.connect(":memory:") as connection:
        connection.register("rows", rows)
        folder = os.path.join(index.parent, "") if str(index.parent) != os.curdir else ""
        connection.execute("SET VARIABLE folder = ?", [folder])
        for statement in (_VIEWS, *_SAFE):
            connection.execute(statement)
        yield connection


def _asked(connection: Any, sql: str) -> pa.Table:
    duckdb: Any = importlib.import_module("duckdb")
    try:
        found = connection.sql(sql)
        return pa.table({}) if found is None else found.to_arrow_table()
    except duckdb.Error as error:
        said = str(error).partition("\n\nLINE")[0]
        raise UsageError(f"the query fails: {' '.join(said.split())}") from error
    except RuntimeError as error:  # what an interrupt becomes
        if "interrupt" in str(error).lower():
            raise KeyboardInterrupt from None
        raise CdmisfaError(f"the query fails: {error}") from error


def write_answer(answer: pa.Table, out: Path, *, force: bool = False) -> None:
    """Write the answer to a question as a Parquet file, whole or not at all.

    Raises:
        UsageError: something is there, without `force`.
        LogWriteError: it cannot be written.
    """
    refuse_unless(out, "an answer is a Parquet file", ".parquet")
    refuse_taken(out, force=force)
    with atomic_write(out) as partial:
        pq.write_table(answer, partial, compression="zstd")
