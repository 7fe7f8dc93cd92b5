"""Tables of numbers, CSV or Parquet, as streams: each row is a frame."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.arrays import FloatArray, IntArray
from cdmisfa.core.clock import NANOSECONDS
from cdmisfa.core.errors import LogDamagedError, UsageError
from recorder.images.fields import EXACT, Field, bounded, is_path
from recorder.images.options import IMAGES, NUMBERS_RECIPE, Reading
from recorder.images.pixels import Shown
from replay.camera_logs.csv_table import LoadedTable, called, read_table
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

_YEAR: Final = 365.25 * 24 * 3600
"""In seconds."""


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
        LogDamagedError: it is no table.
    """

    path: Path
    recipe = NUMBERS_RECIPE
    told_rounded = True

    def __init__(self, path: Path, topic: str | None, reading: Reading = IMAGES) -> None:
        self.path, self.topic, self.encoding = path, path.stem, path.suffix[1:]
        if topic not in (None, self.topic):
            raise UsageError(f"{path}: a table has no topics, leave {topic} out; see --field")
        table = read_table(path)
        if not table.columns.num_rows:
            raise UsageError(f"{path}: it has names of columns, and no rows")
        times, of_times = _times(table, reading.time)
        names = self.fields = reading.fields or _numeric(table, of_times)
        with arrow_explained(path, remedy="take fewer columns, with --field"):
            columns = {name: _column(table, name) for name in names}
        numbers = np.concatenate(list(columns.values()), axis=1)
        # A missing number is not out of bounds: --range keeps no row without one.
        known = ~np.any([np.isnan(own).all(axis=1) for own in columns.values()], axis=0)
        whole = known & (np.isfinite(numbers).all(axis=1) | (reading.depth is not None))
        if times is not None:
            whole &= times >= 0
        elif not whole.all():
            row = int(np.argmin(whole))
            in_range = ", or keep numbers in a range, with --range" if known[row] else ""
            raise UsageError(
                f"{path}: {called(path, row)} lacks a number ({_lacking(table, columns, row)}): "
                "name the column of its times with --time, so that it can be left out" + in_range
            )
        if not whole.any():
            raise UsageError(f"{path}: there is no row with all of {', '.join(names)}")
        self._rows, late = np.flatnonzero(whole), np.empty(0, np.intp)
        self.times = np.empty(0, np.uint64)
        if times is not None:
            stamps = times[whole]
            late = self._rows[stamps < np.maximum.accumulate(stamps)]
            order = np.argsort(stamps, kind="stable")
            self._rows = self._rows[order]
            self.times = sorted_times(str(path), stamps[order])
        numbers = bounded(numbers, reading.depth)
        self._numbers = numbers if whole.all() and not len(late) else numbers[self._rows]
        used = {of_times, *names} if reading.fields else set(table.columns.column_names)
        said = [*_said_of_columns(table, used, columns, whole, reading)]
        if left := int((~whole).sum()):
            row = int(np.argmin(whole))
            which = f"{called(path, row)} is left out"
            if left > 1:
                which = f"{left} of {len(whole)} rows lack a number or their time and are left out"
                which += f", the first is {called(path, row)}"
            said.append(f"{which}: {_lacking(table, columns, row)}")
        if len(late):
            said.append(
                f"rows that stand after later ones: {len(late)} of {self.count}, the first is "
                f"{called(path, late[0])}; they are taken in the order of {of_times}"
            )
        self.warnings = [*table.notes, *(f"{path}: {line}" for line in said)]

    @property
    def count(self) -> int:
        return len(self._numbers)

    def image(self, row: int) -> Shown:
        shown: Shown = self._numbers[row]
        return shown

    def where(self, row: int) -> str:
        return f"{self.path}: {called(self.path, int(self._rows[row]))}"


def table_channels(path: Path) -> list[ChannelFacts]:
    """What is in each column of a table; raises as `TableNumbers`."""
    columns, kind = read_table(path).columns, path.suffix[1:]
    return [
        ChannelFacts(name, kind, str(own.type), len(own) - own.null_count, images=False)
        for name, own in zip(columns.column_names, columns.columns, strict=True)
    ]


def table_notes(path: Path) -> list[str]:
    """What `verify` says of a table; raises as `TableNumbers`, and where it was cut."""
    table = read_table(path)
    if table.notes:
        raise LogDamagedError(table.notes[0])
    return [
        *(f"{path}: {words.said}" for words in table.words.values()),
        f"{path}: {table.columns.num_rows} rows of {table.columns.num_columns} columns can be "
        "read; a table has no checksums, changed numbers would go unnoticed",
    ]


def _numeric(table: LoadedTable, of_times: str) -> tuple[str, ...]:
    """The columns of numbers but that of the times; refuses a table without."""
    columns = table.columns
    found = [name for name in columns.column_names if _is_numeric(columns[name])]
    found = [name for name in found if name != of_times and not _is_empty(columns[name])]
    if not found:
        kinds = ", ".join(f"{name} of {columns[name].type}" for name in columns.column_names[:20])
        raise UsageError(f"{table.path}: it has no column of numbers, but {kinds}")
    return tuple(found)


def _said_of_columns(
    table: LoadedTable,
    used: Collection[str],
    columns: Mapping[str, FloatArray],
    whole: NDArray[np.bool_],
    reading: Reading,
) -> Iterator[str]:
    """Warnings about the columns that are used."""
    yield from (words.said for name, words in table.words.items() if name in used)
    if not reading.fields:
        for name in table.columns.column_names:
            if _is_empty(table.columns[name]):
                yield f"{name} is empty in every row, and is left out"
    for name, own in columns.items():
        taken = np.abs(bounded(own[whole], reading.depth))
        if (taken > EXACT).any() and _has_digits(table, name):
            yield f"{name} holds whole numbers beyond 2^53, which are rounded to float64"


def _has_digits(table: LoadedTable, name: str) -> bool:
    """Whether the file may hold a field in more digits than float64."""
    import pyarrow.types as kinds

    if table.path.suffix.lower() == ".csv":
        return True
    columns = table.columns
    kind = columns[name if name in columns.column_names else Field(name).first].type
    while kinds.is_list(kind) or kinds.is_large_list(kind) or kinds.is_fixed_size_list(kind):
        kind = kind.value_type
    return not kinds.is_floating(kind)


def _lacking(table: LoadedTable, columns: Mapping[str, FloatArray], row: int) -> str:
    """Why a row is left out, in words."""
    for name, numbers in columns.items():
        words = table.words.get(name)
        if words is not None and words.row == row:
            return f"{name} holds {words.text!r}"
        wrong = numbers[row][~np.isfinite(numbers[row])]
        if len(wrong):
            held = "no number" if np.isnan(wrong[0]) else f"{wrong[0]}, which is not finite"
            return f"{name} holds {held}"
    return "it has no time"


def _is_numeric(column: Any) -> bool:
    import pyarrow.types as kinds

    kind = column.type
    return bool(kinds.is_integer(kind) or kinds.is_floating(kind) or kinds.is_boolean(kind))


def _is_empty(column: Any) -> bool:
    return bool(column.null_count == len(column))


def _column(table: LoadedTable, name: str) -> FloatArray:
    """The numbers of a field in each row, (n, I) float64; NaN where there is none.

    Raises:
        UsageError: there is none in the table, or no number in it.
    """
    path, columns = table.path, table.columns
    field = Field(name, plain=name in columns.column_names or not is_path(name))
    first = field.first
    if first not in columns.column_names:
        there = ", ".join(columns.column_names[:20])
        raise UsageError(f"{path}: there is no column {name}; it has {there}")
    if _is_empty(columns[first]):
        raise UsageError(f"{path}: {first} is empty in every row: leave it out")
    if first == name and _is_numeric(columns[name]):
        return _floats(columns[name])[:, None]
    found: list[list[float] | None] = []
    size = None
    for row, value in enumerate(columns[first].to_pylist()):
        try:
            own = None if value is None else field.numbers({first: value})
        except UsageError as error:
            raise UsageError(f"{path}: {called(path, row)}: {error}") from None
        size = len(own) if size is None and own is not None else size
        if own is not None and len(own) != size:
            raise UsageError(
                f"{path}: {name} holds {size} numbers, and {len(own)} in {called(path, row)}: "
                f"choose a part of it, as --field {first}[0:{min(len(own), size or 0)}]"
            )
        found.append(own)
    return np.array([[np.nan] * (size or 1) if own is None else own for own in found], np.float64)


def _floats(column: Any) -> FloatArray:
    import pyarrow

    found: FloatArray = column.cast(pyarrow.float64(), safe=False).to_numpy()
    return found


def _times(table: LoadedTable, named: str | None) -> tuple[IntArray | None, str]:
    """The time of each row, nanoseconds, -1 where it is missing; and the name of the column."""
    if named is None:
        return None, ""
    path, names = table.path, table.columns.column_names
    name, unit = named, "s"
    if name not in names:
        name, _, unit = named.rpartition(":")
    if name not in names or unit not in UNITS:
        raise UsageError(
            f"{path}: there is no column {named}; it has {', '.join(names[:20])}. A unit is one of "
            f"{', '.join(UNITS)}, as --time COLUMN:ns"
        )
    import pyarrow
    import pyarrow.types as kinds

    column = table.columns[name]
    if kinds.is_timestamp(column.type):
        with arrow_explained(path):
            whole = column.cast(pyarrow.timestamp("ns", column.type.tz)).cast(pyarrow.int64())
        scale = 1
    elif _is_numeric(column):
        whole, scale = column, UNITS[unit]
    else:
        example = f", as {column[0].as_py()!r}" if kinds.is_string(column.type) else ""
        raise UsageError(
            f"{path}: {name} holds {column.type}{example}, neither numbers nor dates such as "
            "2024-12-31 23:59:59.5"
        )
    rough = _floats(whole) * scale
    known = np.isfinite(rough)
    if (np.abs(rough[known]) >= LAST_NS).any():
        raise UsageError(
            f"{path}: {name} holds times beyond any clock, counted in {unit}: say what they count, "
            f"as --time {name}:{_unit_of(rough[known] / scale)}"
        )
    if not known.any() or (rough[known] < 0).any():
        raise UsageError(f"{path}: {name} holds no times, or some before 1970: name another column")
    if kinds.is_floating(whole.type):
        exact = np.round(np.where(known, rough, -1.0)).astype(np.int64)
    else:
        exact = whole.cast(pyarrow.int64(), safe=False).fill_null(-1).to_numpy() * np.int64(scale)
    return np.where(known, exact, -1), name


def _unit_of(counted: FloatArray) -> str:
    """The unit in which times, (n,), are of 1971 to 2100; "ns" where none is."""
    for unit, scale in UNITS.items():
        seconds = counted * (scale / NANOSECONDS)
        if seconds.min() >= _YEAR and seconds.max() < 130 * _YEAR:
            return unit
    return "ns"
