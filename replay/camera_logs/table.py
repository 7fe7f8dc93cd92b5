"""Tables of numbers, CSV or Parquet, as streams: PyArrow reads them, and each row is a frame."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from cdmisfa.core.arrays import FloatArray, IntArray
from cdmisfa.core.errors import LogDamagedError, UsageError
from cdmisfa.core.untrusted import check_regular
from recorder.images.fields import EXACT, Field, bounded, is_path
from recorder.images.options import IMAGES, NUMBERS_RECIPE, InputOptions
from recorder.images.pixels import Shown
from replay.camera_logs.stream import (
    LAST_NS,
    ChannelFacts,
    ImageStream,
    arrow_explained,
    sorted_times,
)

TABLES: Final = (".csv", ".parquet")

UNITS: Final = {"s": 10**9, "ms": 10**6, "us": 1000, "ns": 1}
"""What a column of times may count, in nanoseconds."""

MAX_BYTES: Final = 1024**3
"""Largest file that is read as a table, which is held in memory."""

MAX_ROWS: Final = 4 * 1024**2
"""Most rows of a file with fewer bytes than rows: each has a place on the clock, too."""

_MISSING: Final = (" ", "-", "--", "?", "<NA>", "None", "none", "na", "n.a.", "N.A.", "Null")
"""Words for a missing value that PyArrow does not know by itself."""

_NUMBER: Final = r"^[ \t]*[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?[ \t]*$"


class TableNumbers(ImageStream):
    """The numbers in the rows of a table, in the order of time.

    The columns are those that `reading` names, or all of numbers but that of the times; a column
    of lists or of structures is a message, with the fields that `Field` names. Times stand in the
    column `reading.time`: dates, or numbers of seconds, or of another unit as in `stamp:ns`.
    Without it the rows are at an even rate.

    Rows without a number or a time are left out, and those with one that is not finite where
    numbers are kept in no range.

    Raises:
        UsageError: no such column, or no numbers in it.
        LogDamagedError: it is no table, or a line has other cells than that of names, or words
            among numbers.
    """

    path: Path
    recipe = NUMBERS_RECIPE
    told_rounded = True

    def __init__(self, path: Path, topic: str | None, reading: InputOptions = IMAGES) -> None:
        self.path, self.topic, self.encoding = path, path.stem, path.suffix[1:]
        if topic not in (None, self.topic):
            raise UsageError(f"{path}: a table has no topics, leave {topic} out; see --field")
        table = _read(path)
        if not table.num_rows:
            raise UsageError(f"{path}: it has names of columns, and no rows")
        if path.suffix.lower() == ".csv":
            _refuse_words(path, table, reading.fields or table.column_names)
        times, of_times = _times(path, table, reading.time)
        names = self.fields = reading.fields or _numeric(path, table, of_times)
        with arrow_explained(path, remedy="take fewer columns, with --field"):
            columns = {name: _column(path, table, name) for name in names}
        numbers = np.concatenate(list(columns.values()), axis=1)
        # A missing number is not out of bounds: input.range keeps no row without one.
        whole = ~np.any([np.isnan(own).all(axis=1) for own in columns.values()], axis=0)
        whole &= np.isfinite(numbers).all(axis=1) | (reading.range is not None)
        if times is not None:
            whole &= times >= 0
        elif not whole.all():
            raise UsageError(
                f"{path}: {_called(path, int(np.argmin(whole)))} lacks a finite number: name the "
                "column of its times with --set input.time=COLUMN, so that it can be left out"
            )
        if not whole.any():
            raise UsageError(f"{path}: there is no row with all of {', '.join(names)}")
        self._rows, self.times = np.flatnonzero(whole), np.empty(0, np.uint64)
        said = []
        if left := int((~whole).sum()):
            said.append(
                f"{left} of {len(whole)} rows lack a finite number or their time and are left "
                f"out, the first is {_called(path, int(np.argmin(whole)))}"
            )
        if times is not None:
            stamps = times[whole]
            order = np.argsort(stamps, kind="stable")
            if late := int((stamps < np.maximum.accumulate(stamps)).sum()):
                said.append(f"{late} rows stand after later ones: taken in the order of {of_times}")
            self._rows = self._rows[order]
            self.times = sorted_times(str(path), stamps[order])
        self._numbers = bounded(numbers, reading.range)[self._rows]
        if (np.abs(self._numbers) > EXACT).any():
            said.append("numbers beyond 2^53 may be rounded, to float64")
        self.warnings = [f"{path}: {line}" for line in said]

    @property
    def count(self) -> int:
        return len(self._numbers)

    def image(self, row: int) -> Shown:
        shown: Shown = self._numbers[row]
        return shown

    def where(self, row: int) -> str:
        return f"{self.path}: {_called(self.path, int(self._rows[row]))}"


def table_channels(path: Path) -> list[ChannelFacts]:
    """Return the columns of a table; raises as `TableNumbers`."""
    table, kind = _read(path), path.suffix[1:]
    return [
        ChannelFacts(name, kind, str(own.type), len(own) - own.null_count, images=False)
        for name, own in zip(table.column_names, table.columns, strict=True)
    ]


def table_notes(path: Path) -> list[str]:
    """Return what `verify` prints of a table; raises as `TableNumbers`."""
    table = _read(path)
    return [
        f"{path}: {table.num_rows} rows of {table.num_columns} columns can be read; a table has "
        "no checksums, changed numbers would go unnoticed"
    ]


def _read(path: Path) -> Any:
    """Read a table, PyArrow's own.

    Raises:
        UsageError: its columns have no names, or the same.
        LogDamagedError: PyArrow cannot read it.
    """
    check_regular(path, MAX_BYTES)
    with arrow_explained(path, remedy="write fewer columns or rows into a file"):
        if path.suffix.lower() == ".csv":
            table = _read_csv(path)
        else:
            from pyarrow import parquet

            table = parquet.ParquetFile(path).read()
        names = table.column_names
    if table.num_rows > max(MAX_ROWS, path.stat().st_size):
        raise LogDamagedError(f"{path}: {table.num_rows} rows are too many for its few bytes")
    if len(set(names)) < len(names):
        raise UsageError(f"{path}: two columns have the same name: rename one of them")
    if all(re.match(_NUMBER, name) for name in names):
        raise UsageError(
            f"{path}: its first line holds numbers: write a line with the names of the columns "
            "before it"
        )
    return table


def _read_csv(path: Path, numbers: Sequence[str] = ()) -> Any:
    """Read a CSV file, with commas, semicolons or tabs between the cells, as its first line has.

    Args:
        path: of the file.
        numbers: names of columns that must be of numbers.
    """
    import pyarrow
    from pyarrow import csv

    with path.open(encoding="utf-8-sig", errors="replace") as file:
        names = re.sub(r'"[^"]*"', "", file.readline(64 * 1024))
    separator = next((s for s in (",", ";", "\t") if s in names), ",")
    return csv.read_csv(
        path,
        csv.ReadOptions(use_threads=False),  # in several threads errors lack the line
        csv.ParseOptions(delimiter=separator),
        csv.ConvertOptions(
            null_values=[*csv.ConvertOptions().null_values, *_MISSING],
            column_types=dict.fromkeys(numbers, pyarrow.float64()),
        ),
    )


def _refuse_words(path: Path, table: Any, names: Sequence[str]) -> None:
    """Refuse words in those columns of a CSV file that hold a number; PyArrow names the line."""
    import pyarrow.compute as compute

    mixed = [
        name
        for name in names
        if name in table.column_names
        and str(table[name].type) in ("string", "binary")
        and compute.any(compute.match_substring_regex(table[name], _NUMBER)).as_py()
    ]
    if mixed:
        with arrow_explained(path, remedy="choose columns of numbers with --field"):
            _read_csv(path, mixed)


def _called(path: Path, row: int) -> str:
    """Name a row: the line of a CSV file, from 1; of Parquet the row, from 0."""
    return f"line {row + 2}" if path.suffix.lower() == ".csv" else f"row {row}"


def _numeric(path: Path, table: Any, of_times: str) -> tuple[str, ...]:
    """Return the columns of numbers but that of the times; refuse a table without any."""
    names = (name for name in table.column_names if name != of_times)
    found = tuple(name for name in names if _is_numeric(table[name]))
    if not found:
        kinds = ", ".join(f"{name} of {table[name].type}" for name in table.column_names[:20])
        raise UsageError(f"{path}: it has no column of numbers, but {kinds}")
    return found


def _is_numeric(column: Any) -> bool:
    import pyarrow.types as kinds

    kind = column.type
    numbers = kinds.is_integer(kind) or kinds.is_floating(kind) or kinds.is_boolean(kind)
    return bool(numbers) and column.null_count < len(column)


def _column(path: Path, table: Any, name: str) -> FloatArray:
    """Return the numbers of a field in each row, (n, I) float64; NaN where there is none.

    Raises:
        UsageError: the table has none such, or no number in it.
    """
    field = Field(name, plain=name in table.column_names or not is_path(name))
    first = field.first
    if first not in table.column_names:
        there = ", ".join(table.column_names[:20])
        raise UsageError(f"{path}: there is no column {name}; it has {there}")
    if first == name and _is_numeric(table[name]):
        return _floats(table[name])[:, None]
    try:
        values = table[first].to_pylist()
        found = [None if value is None else field.numbers({first: value}) for value in values]
    except UsageError as error:
        raise UsageError(f"{path}: {error}") from None
    sizes = {len(own) for own in found if own is not None}
    if len(sizes) != 1:
        counts = " or ".join(map(str, sorted(sizes))) or "no"
        raise UsageError(f"{path}: {name} holds {counts} numbers in a row: choose a part of it")
    (size,) = sizes
    return np.array([[np.nan] * size if own is None else own for own in found], np.float64)


def _floats(column: Any) -> FloatArray:
    import pyarrow

    found: FloatArray = column.cast(pyarrow.float64(), safe=False).to_numpy()
    return found


def _times(path: Path, table: Any, named: str | None) -> tuple[IntArray | None, str]:
    """Return the time of each row, nanoseconds, -1 where it is missing; and the column's name."""
    if named is None:
        return None, ""
    name, unit = named, "s"
    if name not in table.column_names:
        name, _, unit = named.rpartition(":")
    if name not in table.column_names or unit not in UNITS:
        raise UsageError(
            f"{path}: there is no column {named}; it has {', '.join(table.column_names[:20])}. A "
            f"unit is one of {', '.join(UNITS)}, as --set input.time=COLUMN:ns"
        )
    import pyarrow
    import pyarrow.types as kinds

    column, scale = table[name], UNITS[unit]
    if kinds.is_timestamp(column.type):
        with arrow_explained(path):
            column = column.cast(pyarrow.timestamp("ns", column.type.tz)).cast(pyarrow.int64())
        scale = 1
    elif not _is_numeric(column):
        raise UsageError(
            f"{path}: {name} holds {column.type}, neither numbers nor dates such as "
            "2024-12-31 23:59:59.5"
        )
    rough = _floats(column) * scale
    known = np.isfinite(rough)
    if not known.any() or (rough[known] < 0).any() or (rough[known] >= LAST_NS).any():
        raise UsageError(
            f"{path}: {name} holds no times since 1970, counted in {unit}: say what they count "
            f"({', '.join(UNITS)}), as --set input.time={name}:ns"
        )
    if kinds.is_floating(column.type):
        exact = np.round(np.where(known, rough, -1.0)).astype(np.int64)
    else:
        exact = column.cast(pyarrow.int64(), safe=False).fill_null(-1).to_numpy() * np.int64(scale)
    return np.where(known, exact, -1), name
