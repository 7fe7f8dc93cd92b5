"""Tables of numbers, CSV or Parquet, as a stream: a row is what an image is elsewhere."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.clock import NANOSECONDS
from cdmisfa.core.errors import LogDamagedError, UsageError
from cdmisfa.core.untrusted.regular import check_regular
from recorder.images.fields import EXACT, NUMBERS_RECIPE, Field, bounded
from recorder.images.options import IMAGES, Reading
from recorder.images.pixels import Shown
from replay.camera_logs.csv_table import Words, line_of, read_csv
from replay.camera_logs.stream import (
    LAST_NS,
    ChannelFacts,
    ImageStream,
    arrow_explained,
    sorted_times,
)

TABLES: Final = (".csv", ".parquet")

MAX_BYTES: Final = 1024**3
"""Largest file that is read as a table, which is held in memory."""

MAX_ROWS: Final = 4 * 1024**2
"""Most rows of a file with fewer bytes than rows: each has a place on the clock, too."""

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

    recipe = NUMBERS_RECIPE
    told_rounded = True

    def __init__(self, path: Path, topic: str | None, reading: Reading = IMAGES) -> None:
        self.path = self._file = path
        self.topic = path.stem
        self.encoding = path.suffix[1:]
        if topic not in (None, self.topic):
            raise UsageError(f"{path}: a table has no topics, leave {topic} out; see --field")
        table, words, notes = _table(path)
        if not table.num_rows:
            raise UsageError(f"{path}: it has names of columns, and no rows")
        times, of_times = _times(path, table, reading.time)
        empty = [n for n in table.column_names if table[n].null_count == table.num_rows]
        numeric = [n for n in table.column_names if _is_numeric(table[n])]
        names = reading.fields or [n for n in numeric if n not in (of_times, *empty)]
        if not names:
            raise UsageError(f"{path}: it has no column of numbers{_said_instead(table)}")
        with arrow_explained(path, remedy="take fewer columns, with --field"):
            columns = [_column(path, table, name) for name in names]
        numbers = np.concatenate(columns, axis=1)
        # A missing number is not out of bounds: --range keeps no row without one.
        known = ~np.any([np.isnan(own).all(axis=1) for own in columns], axis=0)
        whole = known & (np.isfinite(numbers).all(axis=1) | (reading.depth is not None))
        lacks = partial(_lacking, table, words, names, columns)
        if times is not None:
            whole &= times >= 0
        elif not whole.all():
            row = int(np.argmin(whole))
            raise UsageError(
                f"{path}: {_called(path, row)} lacks a number ({lacks(row)}): name the column "
                "of its times with --time, so that it can be left out"
                f"{', or keep numbers in a range, with --range' if known[row] else ''}"
            )
        self._places = np.flatnonzero(whole)
        self.fields = tuple(names)
        if not len(self._places):
            raise UsageError(f"{path}: there is no row with all of {', '.join(names)}")
        self.times, late = np.empty(0, np.uint64), self._places[:0]
        if times is not None:
            stamps = times[whole]
            late = self._places[stamps < np.maximum.accumulate(stamps)]
            order = np.argsort(stamps, kind="stable")
            self._places = self._places[order]
            self.times = sorted_times(str(path), stamps[order])
        numbers = bounded(numbers, reading.depth)
        self._numbers = numbers if whole.all() and not len(late) else numbers[self._places]
        used = {of_times, *names} if reading.fields else set(table.column_names)
        self.warnings = [*notes]
        self.warnings += [f"{path}: {said}" for name, said in words.items() if name in used]
        if not reading.fields:
            self.warnings += [f"{path}: {n} is empty in every row, and is left out" for n in empty]
        self.warnings += [
            f"{path}: {name} holds whole numbers beyond 2^53, which are rounded to float64"
            for name, own in zip(names, columns, strict=True)
            if _has_digits(path, table, name) and _beyond(bounded(own[whole], reading.depth))
        ]
        self.warnings += _said_of_rows(path, whole, late, of_times, lacks)

    @property
    def count(self) -> int:
        return len(self._numbers)

    def image(self, row: int) -> Shown:
        shown: Shown = self._numbers[row]
        return shown

    def where(self, row: int) -> str:
        return f"{self.path}: {_called(self._file, int(self._places[row]))}"

    def close(self) -> None:
        """Do nothing: no file stays open."""


def is_table(path: Path) -> bool:
    """Whether a file is a table, by its name."""
    return path.suffix.lower() in TABLES and path.is_file()


def table_channels(path: Path) -> list[ChannelFacts]:
    """What is in each column of a table; raises as `TableNumbers`."""
    (table, _, _), kind = _table(path), path.suffix[1:]
    return [
        ChannelFacts(n, kind, str(c.type), len(c) - c.null_count, None, None, images=False)
        for n, c in zip(table.column_names, table.columns, strict=True)
    ]


def table_notes(path: Path) -> list[str]:
    """What the user should know of a table; raises as `TableNumbers`, and where it was cut."""
    table, words, notes = _table(path)
    if notes:
        raise LogDamagedError(notes[0])
    return [
        *(f"{path}: {said}" for said in words.values()),
        f"{path}: {table.num_rows} rows of {table.num_columns} columns can be read; a table has "
        "no checksums, changed numbers would go unnoticed",
    ]


def _called(path: Path, row: int) -> str:
    """What a row is called: the line of a CSV file, from 1; of others the row, from 0."""
    return f"line {line_of(path, row)}" if path.suffix.lower() == ".csv" else f"row {row}"


def _has_digits(path: Path, table: Any, name: str) -> bool:
    """Whether the file may hold a field more exactly than float64 does."""
    import pyarrow.types as kinds

    if path.suffix.lower() == ".csv":
        return True
    kind = table[name if name in table.column_names else Field(name).first].type
    while kinds.is_list(kind) or kinds.is_large_list(kind) or kinds.is_fixed_size_list(kind):
        kind = kind.value_type
    return not kinds.is_floating(kind)


def _beyond(numbers: NDArray[np.float64]) -> bool:
    """Whether a whole number may be rounded among some, all of which are finite."""
    return bool((np.abs(numbers) > EXACT).any())


def _table(path: Path) -> tuple[Any, dict[str, Words], list[str]]:
    """A table, of its columns of numbers those with words, and what else is to be known."""
    check_regular(path, MAX_BYTES)
    with arrow_explained(path, remedy="write fewer columns or rows into a file"):
        if path.suffix.lower() == ".csv":
            table, words, notes = read_csv(path)
        else:
            import pyarrow.parquet

            table, words, notes = pyarrow.parquet.ParquetFile(path).read(), {}, []
        if table.num_rows > max(MAX_ROWS, path.stat().st_size):
            raise LogDamagedError(f"{path}: {table.num_rows} rows are too many for its few bytes")
        twice = [n for n in table.column_names if table.column_names.count(n) > 1]
        if twice:
            raise UsageError(f"{path}: two columns are called {twice[0]!r}: rename one of them")
        return table, words, notes


def _said_of_rows(
    path: Path,
    whole: NDArray[np.bool_],
    late: NDArray[np.intp],
    of_times: str,
    lacks: Callable[[int], str],
) -> Iterator[str]:
    """What the user should know of rows.

    Args:
        path: of the table.
        whole: (n,) which of them are taken.
        late: those of these that stand after later ones.
        of_times: the column of their times.
        lacks: what a row that is left out lacks, in words.
    """
    left, taken = int((~whole).sum()), int(whole.sum())
    if left:
        row = int(np.argmin(whole))
        rows = f"{_called(path, row)} is left out"
        if left > 1:
            rows = f"{left} of {len(whole)} rows lack a number or their time and are left out"
            rows += f", the first is {_called(path, row)}"
        yield f"{path}: {rows}: {lacks(row)}"
    if len(late):
        yield (
            f"{path}: rows that stand after later ones: {len(late)} of {taken}, the first is "
            f"{_called(path, late[0])}; they are taken in the order of {of_times}"
        )


def _said_instead(table: Any) -> str:
    """Of what kinds the columns of a table are, in words."""
    kinds = [f"{name} of {table[name].type}" for name in table.column_names[:20]]
    return f", but {', '.join(kinds)}"


def _lacking(
    table: Any,
    words: Mapping[str, Words],
    names: Sequence[str],
    columns: Sequence[NDArray[np.float64]],
    row: int,
) -> str:
    """What a row lacks, in words."""
    for name, numbers in zip(names, columns, strict=True):
        wrong = numbers[row][~np.isfinite(numbers[row])]
        if name in words and words[name].row == row:
            return f"{name} holds {words[name].text!r}"
        if len(wrong):
            held = "no number" if np.isnan(wrong[0]) else f"{wrong[0]}, which is not finite"
            return f"{name} holds {held}"
    return "it has no time"


def _is_numeric(column: Any) -> bool:
    import pyarrow.types as kinds

    kind = column.type
    return bool(kinds.is_integer(kind) or kinds.is_floating(kind) or kinds.is_boolean(kind))


def _column(path: Path, table: Any, name: str) -> NDArray[np.float64]:
    """The numbers of a field in each row, (n, I) float64; NaN where there is none.

    Raises:
        UsageError: there is none in the table, or no number in it.
    """
    field = Field(name, plain=name in table.column_names)
    first = field.first
    if first not in table.column_names:
        there = ", ".join(table.column_names[:20])
        raise UsageError(f"{path}: there is no column {name}; it has {there}")
    if table[first].null_count == len(table[first]):
        raise UsageError(f"{path}: {first} is empty in every row: leave it out")
    if first == name and _is_numeric(table[name]):
        return _floats(table[name])[:, None]
    found: list[list[float] | None] = []
    for place, value in enumerate(table[first].to_pylist()):
        try:
            found.append(None if value is None else field.numbers({first: value}))
        except UsageError as error:
            raise UsageError(f"{path}: {_called(path, place)}: {error}") from None
    size = next((len(own) for own in found if own is not None), 1)
    for place, own in enumerate(found):
        if own is not None and len(own) != size:
            raise UsageError(
                f"{path}: {name} holds {size} numbers, and {len(own)} in {_called(path, place)}: "
                f"choose a part of it, as --field {field.first}[0:{min(len(own), size)}]"
            )
    return np.array([[np.nan] * size if own is None else own for own in found], np.float64)


def _floats(column: Any) -> NDArray[np.float64]:
    import pyarrow

    found: NDArray[np.float64] = column.cast(pyarrow.float64(), safe=False).to_numpy()
    return found


def _unit_of(counted: NDArray[np.float64]) -> str:
    """The unit in which times, (n,), are of 1971 to 2100; "ns" where none is."""
    for unit, scale in UNITS.items():
        seconds = counted * (scale / NANOSECONDS)
        if seconds.min() >= _YEAR and seconds.max() < 130 * _YEAR:
            return unit
    return "ns"


def _times(path: Path, table: Any, named: str | None) -> tuple[NDArray[np.int64] | None, str]:
    """When each row was, nanoseconds, -1 where nobody knows; and the name of the column."""
    if named is None:
        return None, ""
    name, unit = named, "s"
    if name not in table.column_names:
        name, _, unit = named.rpartition(":")
    if name not in table.column_names or unit not in UNITS:
        there = ", ".join(table.column_names[:20])
        raise UsageError(
            f"{path}: there is no column {named}; it has {there}. A unit is one of "
            f"{', '.join(UNITS)}, as --time COLUMN:ns"
        )
    import pyarrow
    import pyarrow.types as kinds

    column = table[name]
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
