"""Tables of numbers, CSV or Parquet, through PyArrow: each row is a frame."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from cdmisfa.core.arrays import FloatArray, IntArray
from cdmisfa.core.errors import LogDamagedError, UsageError
from cdmisfa.core.names import counted
from cdmisfa.core.untrusted import check_regular
from recorder.images.fields import EXACT, ROUNDED, Field, bounded, column_names, is_path
from recorder.images.options import NUMBERS_RECIPE, InputOptions
from recorder.images.pixels import losses, lost
from replay.logs.formats.messages import check_topics
from replay.logs.stream import LAST_NS, ChannelInfo, ExternalChannel, LogStream, limited, picked

ENDINGS: Final = (".csv", ".parquet")

# Units of a column of times, in nanoseconds.
UNITS: Final = {"s": 10**9, "ms": 10**6, "us": 1000, "ns": 1}

# Largest file that is read as a table, which is held in memory.
MAX_BYTES: Final = 1024**3

# Most rows of a file with fewer bytes than rows, as each has a place on the clock, too.
MAX_ROWS: Final = 4 * 1024**2

# Words for a missing value that PyArrow does not know by itself.
_MISSING: Final = (" ", "-", "--", "?", "<NA>", "None", "none", "na", "n.a.", "N.A.", "Null")

# Names of columns that are probably times.
TIME_NAMES: Final = ("time", "timestamp", "stamp", "log_time")

_NUMBER: Final = r"^[ \t]*[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?[ \t]*$"


def streams(
    path: Path, options: InputOptions, opened: ExitStack, *, skip_damaged: bool = False
) -> list[LogStream]:
    """Read the numbers of a table as one stream, in the order of time.

    The columns are `options.fields`, or by default all numeric ones except the times: numbers,
    decimals, truth as 0 and 1, durations in seconds. Warnings name all others. A column of lists
    or of structures is a message, with the fields that `Field` names. Times are in the column
    `options.time`: dates, or numbers of seconds, or of another unit as in `stamp:ns`. Without it
    the rows are at an even rate.

    Rows without a number or a time are left out, and those with one that is not finite where
    numbers are kept in no range.

    Raises:
        UsageError: no such column, or no numbers in it.
        LogDamagedError: the file is not a table, or has words among numbers.
    """
    check_topics(path, path.stem, options.topics)
    table, csv = _read(path), path.suffix.lower() == ".csv"
    if csv:
        _refuse_words(path, table, options.fields or table.column_names)
    times, time_column = _times(path, table, options.time)
    fields = options.fields or tuple(
        name for name in table.column_names if name != time_column and _is_numeric(table[name])
    )
    if not fields or not table.num_rows:
        kinds = ", ".join(f"{name} of {table[name].type}" for name in table.column_names[:20])
        raise UsageError(f"{path}: no column has numbers; its columns are {kinds}")
    with limited(path, "PyArrow", remedy="choose fewer columns with --field"):
        columns = [_column(path, table, name) for name in fields]
    numbers = dict(zip(fields, columns, strict=True))

    def where(row: int) -> str:  # by its line of CSV, from 1, or its row of Parquet, from 0
        return f"{path}: line {row + 2}" if csv else f"{path}: row {row}"

    stream = number_stream(path, path.stem, numbers, times, options, where)
    lines = [*([] if options.fields else _left_out(table, [*fields, time_column]))]
    lines += _converted(table, fields)
    if not time_column and (likely := [name for name in fields if name in TIME_NAMES]):
        lines.append(
            f"{likely[0]} is read as a number, not as the time of a row: for times, set "
            f"--set input.time={likely[0]}"
        )
    return [replace(stream, warnings=[*(f"{path}: {n}" for n in lines), *stream.warnings])]


def _left_out(table: Any, fields: Sequence[str]) -> list[str]:
    """Return a line that names the columns of a table that are not read, if there are any."""
    absent = [
        f"{name} ({'empty' if column.null_count == len(column) else column.type})"
        for name, column in zip(table.column_names, table.columns, strict=True)
        if name not in fields
    ]
    return [f"columns without plain numbers are left out: {', '.join(absent)}"] if absent else []


def _converted(table: Any, fields: Sequence[str]) -> list[str]:
    """Return a line for durations and one for decimals among the columns that are read."""
    import pyarrow.types as kinds

    read = {name: table[name].type for name in table.column_names if name in fields}
    durations = [name for name, kind in read.items() if kinds.is_duration(kind)]
    decimals = [name for name, kind in read.items() if kinds.is_decimal(kind)]
    lines = [f"durations are read in seconds: {', '.join(durations)}"] if durations else []
    return lines + [f"decimals are rounded to float64: {', '.join(decimals)}"] * bool(decimals)


def number_stream(
    path: Path,
    topic: str,
    columns: Mapping[str, FloatArray],
    times: IntArray | None,
    options: InputOptions,
    where: Callable[[int], str],
) -> LogStream:
    """Return the numbers of a table as a stream, in the order of time.

    Args:
        path: the log.
        topic: the name of the stream.
        columns: numbers of each field, (n, I); NaN if missing.
        times: (n,) nanoseconds, -1 if there is none; None of rows at an even rate.
        options: the range that numbers are kept in.
        where: names a row.

    Raises:
        UsageError: a row cannot be left out, as there are no times, or no row is left.
    """
    numbers = np.concatenate(list(columns.values()), axis=1)
    # A missing number is not out of bounds: input.range keeps no row without one.
    whole = ~np.any([np.isnan(column).all(axis=1) for column in columns.values()], axis=0)
    whole &= np.isfinite(numbers).all(axis=1) | (options.range is not None)
    if times is not None:
        whole &= times >= 0
    first = where(int(np.argmin(whole)))
    if not whole.any() or (times is None and not whole.all()):
        row = int(np.argmin(whole))
        empty = [name for name, column in columns.items() if not np.isfinite(column[row]).all()]
        raise UsageError(
            f"{first} has no finite number in {', '.join(empty or columns)}: to skip such rows, "
            "set the column of times with --set input.time=COLUMN, or choose columns with --field"
        )
    rows, lines = np.flatnonzero(whole), []
    if left_out := len(whole) - len(rows):
        lines.append(
            f"{left_out} of {len(whole)} rows have no finite number or no time and are skipped, "
            f"the first is {first.removeprefix(f'{path}: ')}"
        )
    if times is not None:
        if late := int((times[rows] < np.maximum.accumulate(times[rows])).sum()):
            lines.append(f"{late} rows are out of order: rows are sorted by time")
        rows = rows[np.argsort(times[rows], kind="stable")]
    with losses() as changed:
        frames = bounded(numbers[rows], options.range)
        lost(ROUNDED, (np.abs(frames) >= EXACT).any())
    lines += changed
    return LogStream(
        path=path,
        topic=topic,
        count=len(frames),
        times=None if times is None else times[rows],
        read=lambda wanted: (picked(frames, wanted), np.empty((len(wanted), 0))),
        where=lambda row: where(int(rows[row])),
        recipe=NUMBERS_RECIPE,
        fields=tuple(columns),
        columns=lambda: [n for name, x in columns.items() for n in column_names(name, x.shape[1])],
        warnings=[f"{path}: {line}" for line in lines],
    )


def table_channels(path: Path, *, whole: bool = False) -> list[ExternalChannel]:
    """Return the columns of a table, on request refusing words among numbers; as `streams`."""
    table, kind, channels = _read(path), path.suffix[1:], []
    if whole and kind.lower() == "csv":
        _refuse_words(path, table, table.column_names)
    numeric = [name for name in table.column_names if _is_numeric(table[name])]
    lines = ["a table has no checksums, so changed numbers cannot be detected"]
    lines += [*_left_out(table, numeric), *_converted(table, numeric)]
    remarks = tuple(f"{path}: {line}" for line in lines)
    for name, column in zip(table.column_names, table.columns, strict=True):
        info = ChannelInfo(name, kind, str(column.type), len(column) - column.null_count)
        channels.append(ExternalChannel(info, images=False, remarks=remarks))
    return channels


def _read(path: Path) -> Any:
    """Read a table, PyArrow's own.

    Raises:
        UsageError: its columns have no names, or the same.
        LogDamagedError: PyArrow cannot read it.
    """
    check_regular(path, MAX_BYTES)
    with limited(path, "PyArrow", remedy="split the file into fewer columns or rows"):
        if path.suffix.lower() == ".csv":
            table = _read_csv(path)
        else:
            from pyarrow import parquet

            table = parquet.ParquetFile(path).read()
        names = table.column_names  # not UTF-8 in some files
    if table.num_rows > max(MAX_ROWS, path.stat().st_size):
        raise LogDamagedError(f"{path}: {table.num_rows} rows are too many for a file of its size")
    if len(set(names)) < len(names) or all(re.match(_NUMBER, name) for name in names):
        raise UsageError(f"{path}: the first line must have unique column names, not numbers")
    return table


def _read_csv(path: Path, numbers: Sequence[str] = ()) -> Any:
    """Read a CSV file, with commas, semicolons or tabs between the cells, as its first line has.

    Args:
        path: the file.
        numbers: names of columns that must be of numbers.
    """
    from pyarrow import ArrowInvalid, csv, float64

    with path.open(encoding="utf-8-sig", errors="replace") as file:
        names = re.sub(r'"[^"]*"', "", file.readline(64 * 1024))
    separator = next((s for s in (",", ";", "\t") if s in names), ",")
    try:
        return csv.read_csv(
            path,
            csv.ReadOptions(use_threads=False),  # in several threads errors lack the line
            csv.ParseOptions(delimiter=separator),
            csv.ConvertOptions(
                null_values=[*csv.ConvertOptions().null_values, *_MISSING],
                column_types=dict.fromkeys(numbers, float64()),
            ),
        )
    except ArrowInvalid as error:
        if cells := re.search(r"Row #(\d+): Expected (\d+) columns, got (\d+)", str(error)):
            line, first, here = map(int, cells.groups())
            what = f"line {line} has {counted(here, 'cell')}, but the first line has {first}"
        elif word := re.search(r"Row #(\d+): .*invalid value ('.*')", str(error)):
            what = f"line {word[1]} has {word[2]}, which is not a number"
        else:
            raise
        raise LogDamagedError(f"{path}: {what}: correct the line, or choose --field") from None


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
        with limited(path, "PyArrow", remedy="choose columns of numbers with --field"):
            _read_csv(path, mixed)


def _is_numeric(column: Any) -> bool:
    import pyarrow.types as kinds

    names = "integer", "floating", "boolean", "decimal", "duration"
    numeric = any(getattr(kinds, f"is_{name}")(column.type) for name in names)
    return numeric and column.null_count < len(column)


def _floats(column: Any) -> FloatArray:
    """Return a numeric column as float64, NaN for null; durations in seconds."""
    import pyarrow.types as kinds

    if not kinds.is_duration(column.type):
        return np.array(column.cast("float64", safe=False))
    counts = np.array(column.cast("int64").cast("float64", safe=False))
    return counts * (UNITS[column.type.unit] / 1e9)


def _column(path: Path, table: Any, name: str) -> FloatArray:
    """Return the numbers of a field in each row, (n, I) float64; NaN where there is none.

    Raises:
        UsageError: the table has none such, or no number in it.
    """
    field = Field(name, plain=name in table.column_names or not is_path(name))
    first = field.first
    if first not in table.column_names:
        raise _no_column(path, table, name)
    if first == name and _is_numeric(table[name]):
        return _floats(table[name])[:, None]
    try:
        values = table[first].to_pylist()
        rows = [None if value is None else field.numbers({first: value}) for value in values]
    except UsageError as error:
        raise UsageError(f"{path}: {error}") from None
    sizes = {len(row) for row in rows if row is not None}
    if len(sizes) != 1:
        counts = " or ".join(map(str, sorted(sizes))) or "no"
        raise UsageError(f"{path}: {name} has {counts} numbers in a row: choose one, as {name}[0]")
    (size,) = sizes
    return np.array([[np.nan] * size if row is None else row for row in rows], np.float64)


def _times(path: Path, table: Any, named: str | None) -> tuple[IntArray | None, str]:
    """Return the time of each row, nanoseconds, -1 where it is missing; and the column's name."""
    if named is None:
        return None, ""
    name, unit = named, "s"
    if name not in table.column_names:
        name, _, unit = named.rpartition(":")
    if name not in table.column_names or unit not in UNITS:
        raise _no_column(path, table, named)
    import pyarrow
    import pyarrow.types as kinds

    column, scale = table[name], UNITS[unit]
    if kinds.is_timestamp(column.type):
        with limited(path, "PyArrow"):
            column = column.cast(pyarrow.timestamp("ns", column.type.tz)).cast("int64")
        scale = 1
    rough = np.full(len(column), np.nan)
    if _is_numeric(column):
        rough = column.cast("float64", safe=False).to_numpy() * scale
    known = np.isfinite(rough)
    if not known.any() or (rough[known] < 0).any() or (rough[known] >= LAST_NS).any():
        raise UsageError(
            f"{path}: {name} ({table[name].type}) has no times from 1970 to 2116, as dates or "
            f"in {unit}: state the unit ({', '.join(UNITS)}), as in --set input.time={name}:ns"
        )
    if kinds.is_floating(column.type):
        exact = np.round(np.where(known, rough, -1.0)).astype(np.int64)
    else:
        exact = column.cast("int64", safe=False).fill_null(-1).to_numpy() * np.int64(scale)
    return np.where(known, exact, -1), name


def _no_column(path: Path, table: Any, name: str) -> UsageError:
    return UsageError(
        f"{path}: no column {name}; it has {', '.join(table.column_names[:20])}; a column of times "
        f"may have a unit ({', '.join(UNITS)}), as in --set input.time=COLUMN:ns"
    )
