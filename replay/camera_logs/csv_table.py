"""Tables read by PyArrow; CSV also with other separators, and words among numbers."""

from __future__ import annotations

import contextlib
import csv as cells
import itertools
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

from cdmisfa.core.errors import LogDamagedError, UsageError
from cdmisfa.core.untrusted import check_regular
from replay.camera_logs.stream import arrow_explained

MAX_BYTES: Final = 1024**3
"""Largest file that is read as a table, which is held in memory."""

MAX_ROWS: Final = 4 * 1024**2
"""Most rows of a file with fewer bytes than rows: each has a place on the clock, too."""

MISSING: Final = [
    "-",
    "--",
    "?",
    "<NA>",
    "NAN",
    "Nan",
    "None",
    "none",
    "na",
    "n.a.",
    "N.A.",
    "Null",
]
"""Words for a missing value that PyArrow does not know by itself."""

_HEAD: Final = 64 * 1024
"""Bytes at the beginning which tell how numbers and columns are written."""

_QUOTED: Final = re.compile(r'"[^"]*"')
_WITH_COMMA: Final = re.compile(r"[+-]?\d*,\d+([eE][+-]?\d+)?")
_WITH_POINT: Final = re.compile(r"[+-]?\d*\.\d+([eE][+-]?\d+)?")
_NUMBER: Final = r"^[ \t]*[+-]?(([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?|[iI]nf(inity)?)[ \t]*$"
"""What is a number, for PyArrow."""


class Words(NamedTuple):
    """Words in a column of numbers: the row, from 0, and text of the first; and the warning."""

    row: int
    text: str
    said: str


class LoadedTable(NamedTuple):
    """A table in memory.

    Attributes:
        path: of the file.
        columns: PyArrow's table.
        words: of columns with numbers those that hold words, too.
        notes: what else the user should know: that its last line was cut.
    """

    path: Path
    columns: Any
    words: Mapping[str, Words]
    notes: Sequence[str]


def read_table(path: Path) -> LoadedTable:
    """Read a CSV or a Parquet file.

    Columns of CSV are separated by commas or, where the line of names has none, by semicolons or
    tabs; then numbers may have a decimal comma. A column in which most of what stands there are
    numbers is one of numbers, and words in it are missing. A last line that was cut is left out.

    Raises:
        UsageError: it does not tell how its numbers are written, or what its columns are called.
        LogDamagedError: it is empty, or a line has other cells than that of names.
    """
    check_regular(path, MAX_BYTES)
    with arrow_explained(path, remedy="write fewer columns or rows into a file"):
        if path.suffix.lower() == ".csv":
            table = _read_csv(path)
        else:
            import pyarrow.parquet

            table = LoadedTable(path, pyarrow.parquet.ParquetFile(path).read(), {}, [])
        rows, names = table.columns.num_rows, table.columns.column_names
        if rows > max(MAX_ROWS, path.stat().st_size):
            raise LogDamagedError(f"{path}: {rows} rows are too many for its few bytes")
        twice = [name for name in names if names.count(name) > 1]
        if twice:
            raise UsageError(f"{path}: two columns are called {twice[0]!r}: rename one of them")
        return table


def called(path: Path, row: int) -> str:
    """How warnings name a row: the line of a CSV file, from 1; of others the row, from 0."""
    return f"line {line_of(path, row)}" if path.suffix.lower() == ".csv" else f"row {row}"


def line_of(path: Path, row: int) -> int:
    """The line of a CSV file in which a row begins, as an editor counts them: from 1.

    Lines with nothing in them are no rows, and a cell in quotes may take several.

    Args:
        path: of the file.
        row: after the line of names, from 0.
    """
    with contextlib.suppress(cells.Error, OSError):
        for place, (line, _) in enumerate(_rows(path)):
            if place == row + 1:
                return line
    return row + 2  # a row in each line is the best guess


def _rows(path: Path) -> Iterator[tuple[int, list[str]]]:
    """The line in which each row of a CSV file begins, and its cells."""
    with path.open(encoding="utf-8-sig", errors="replace", newline="") as file:
        separator = _separator(file.readline(_HEAD))
        file.seek(0)
        reader, line = cells.reader(file, delimiter=separator), 1
        for row in reader:
            if row:
                yield line, row
            line = reader.line_num + 1


def _read_csv(path: Path) -> LoadedTable:
    import pyarrow
    from pyarrow import csv

    with path.open("rb") as file:
        head = file.read(_HEAD)
    if not head.strip():
        raise LogDamagedError(f"{path}: it is empty")
    first, ended, _ = head.partition(b"\n")
    try:
        first.decode("utf-8", "strict" if ended else "replace")
    except UnicodeDecodeError:
        raise UsageError(f"{path}: its line of names is no UTF-8: save it as CSV UTF-8") from None
    separator, decimal = _written(path, head.decode("utf-8", "replace"))
    missing = [*csv.ConvertOptions().null_values, *MISSING]
    options = {
        "parse_options": csv.ParseOptions(delimiter=separator),
        "convert_options": csv.ConvertOptions(null_values=missing, decimal_point=decimal),
    }
    notes = []
    try:
        table = csv.read_csv(path, **options)
    except pyarrow.ArrowInvalid:
        cut = _cut_line(path, separator)
        if cut is None:
            raise
        with path.open("rb") as file:
            size = sum(map(len, itertools.islice(file, cut[0] - 1)))
        with pyarrow.memory_map(str(path)) as data:
            table = csv.read_csv(pyarrow.BufferReader(data.read_buffer(size)), **options)
        notes = [cut[1]]
    names = separator.join(table.column_names)
    if all(re.match(_NUMBER, name) for name in re.split("[,;\t]", names)):
        raise UsageError(
            f"{path}: its first line, {names[:80]}, holds numbers, no names: "
            "write a line before it with the name of each column"
        )
    return _with_numbers(LoadedTable(path, table, {}, notes), missing)


def _cut_line(path: Path, separator: str) -> tuple[int, str] | None:
    """The last line and a warning, if it was cut; None where all lines have as many cells.

    Raises:
        UsageError: the file begins with a comment.
        LogDamagedError: another line than a last one that was cut has other cells than the names.
    """
    rows = _rows(path)
    _, names = next(rows)
    for place, (line, row) in enumerate(rows):
        if len(row) == len(names):
            continue
        text = separator.join(row)[:40]
        said = f"{path}: line {line} holds {_in_words(len(row))}, {text!r}, and the line of names "
        said += _in_words(len(names))
        if names[0].startswith("#") and place == 0:
            raise UsageError(f"{said}: leave out the comment before it")
        with path.open("rb") as file:
            file.seek(-1, 2)
            ended = file.read() in (b"\n", b"\r")
        if next(rows, None) is None and not ended and len(row) < len(names):
            return line, f"{said}: the file was cut there, and the line is left out"
        raise LogDamagedError(f"{said}: mend the line or leave it out")
    return None


def _in_words(count: int) -> str:
    return "a cell" if count == 1 else f"{count} cells"


def _written(path: Path, head: str) -> tuple[str, str]:
    """The separator and the decimal sign of a CSV file."""
    names, *lines = head.splitlines() or [""]
    separator = _separator(names)
    if separator == ",":
        return separator, "."
    found = [cell.strip(' "') for line in lines for cell in line.split(separator)]
    comma = next((cell for cell in found if _WITH_COMMA.fullmatch(cell)), None)
    point = next((cell for cell in found if _WITH_POINT.fullmatch(cell)), None)
    if comma is not None and point is not None:
        raise UsageError(
            f"{path}: it has numbers with a decimal comma ({comma}) and with a point ({point}): "
            "write all of them alike"
        )
    return separator, "." if comma is None else ","


def _separator(names: str) -> str:
    """The separator, by the line of names."""
    bare = _QUOTED.sub("", names)
    return next((s for s in (",", ";", "\t") if s in bare), ",")


def _with_numbers(table: LoadedTable, missing: Sequence[str]) -> LoadedTable:
    """Turn the columns of a table into numbers that were taken for text for a few words."""
    import pyarrow
    import pyarrow.compute as compute

    columns, words = table.columns, {}
    blank = rf"^[ \t]*(?:{'|'.join(map(re.escape, missing))})[ \t]*$"
    for place, name in enumerate(columns.column_names):
        column = columns.column(place)
        if not (pyarrow.types.is_string(column.type) or pyarrow.types.is_binary(column.type)):
            continue
        numbers = compute.match_substring_regex(column, _NUMBER)
        many = compute.sum(numbers).as_py() or 0
        if not many:
            continue
        known = compute.or_(numbers, compute.match_substring_regex(column, blank))
        count = compute.sum(compute.invert(known)).as_py()
        if count:
            row = compute.index(known, False).as_py()
            text = column[row].as_py()
            text = text.decode("utf-8", "replace") if isinstance(text, bytes) else text
            text = text if len(text) <= 40 else f"{text[:40]}..."
            said = (
                f"{name} holds words, no numbers, in {count} of {len(column)} rows, the first "
                f"is {text!r} in line {line_of(table.path, row)}"
            )
            words[name] = Words(row, text, said + (", and is left out" if count >= many else ""))
        if count < many:
            only = compute.if_else(numbers, column, None).cast(pyarrow.string())
            plain = compute.utf8_ltrim(compute.utf8_trim(only, " \t"), "+")
            columns = columns.set_column(place, name, plain.cast(pyarrow.float64()))
    return table._replace(columns=columns, words=words)
