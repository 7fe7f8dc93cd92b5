"""CSV as it is met: with other separators, words for what is missing, and words among numbers."""

from __future__ import annotations

import contextlib
import csv as cells
import itertools
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from cdmisfa.core.errors import LogDamagedError, UsageError

MISSING: Final = (
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
)
"""Words for a missing value that PyArrow does not know by itself."""

_HEAD: Final = 64 * 1024
"""Bytes at the beginning which tell how numbers and columns are written."""

_SEPARATORS: Final = (",", ";", "\t")

_QUOTED: Final = re.compile(r'"[^"]*"')

_WITH_COMMA: Final = re.compile(r"[+-]?\d*,\d+([eE][+-]?\d+)?")

_WITH_POINT: Final = re.compile(r"[+-]?\d*\.\d+([eE][+-]?\d+)?")

_NUMBER: Final = r"^[ \t]*[+-]?(([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?|[iI]nf(inity)?)[ \t]*$"
"""What is a number, for PyArrow."""


@dataclass(frozen=True, slots=True)
class Words:
    """Cells of a column in which there are words and no numbers, where others hold numbers.

    Attributes:
        path: of the table.
        name: of the column.
        count: how many there are.
        rows: how many rows the table has.
        row: the first of them, from 0.
        text: what stands there.
        most: whether they are half of what stands in the column, or more.
    """

    path: Path
    name: str
    count: int
    rows: int
    row: int
    text: str
    most: bool

    def __str__(self) -> str:
        left_out = ", and is left out" if self.most else ""
        return (
            f"{self.name} holds words, no numbers, in {self.count} of {self.rows} rows, the first "
            f"is {self.text!r} in line {line_of(self.path, self.row)}{left_out}"
        )


def line_of(path: Path, row: int) -> int:
    """The line of a CSV file in which a row begins, as an editor counts them: from 1.

    Lines with nothing in them are no rows, and a cell in quotes may take several.

    Args:
        path: of the file.
        row: after the line of names, from 0.
    """
    unread = contextlib.suppress(cells.Error, OSError)  # then a row in each line is the best guess
    with unread, path.open(encoding="latin-1", newline="") as file:
        separator = _separator(file.readline(_HEAD))
        file.seek(0)
        rows = _begun(cells.reader(file, delimiter=separator))
        starts = (begun for begun, found in rows if found)
        return next(itertools.islice(starts, row + 1, None), row + 2)
    return row + 2


def _begun(reader: Any) -> Iterator[tuple[int, list[str]]]:
    """Each row of a reader of the standard library, with the line where it begins."""
    before = 0
    for found in reader:
        yield before + 1, found
        before = reader.line_num


def read_csv(path: Path) -> tuple[Any, dict[str, Words], list[str]]:
    """Read a CSV file with a line of names.

    Columns are separated by commas or, where the line of names has none, by semicolons or tabs;
    then numbers may have a decimal comma. A column in which most of what stands there are numbers
    is one of numbers, and words in it are missing. A last line that was cut is left out.

    Returns:
        The table, by its name each column in which there are numbers and words, and what else the
        user should know.

    Raises:
        UsageError: it does not tell how its numbers are written, or what its columns are called.
        LogDamagedError: it is empty, or a line has other cells than that of names.
    """
    import pyarrow
    import pyarrow.csv as csv

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
    convert = csv.ConvertOptions(null_values=missing, decimal_point=decimal)
    said = []
    try:
        table = csv.read_csv(
            path, parse_options=csv.ParseOptions(delimiter=separator), convert_options=convert
        )
    except pyarrow.ArrowInvalid:
        table, cut = _without_cut(path, separator, convert)
        said = [cut] if cut else []
    names = separator.join(table.column_names)
    if all(re.match(_NUMBER, name) for name in re.split("[,;\t]", names)):
        raise UsageError(
            f"{path}: its first line, {names[:80]}, holds numbers, no names: "
            "write a line before it with the name of each column"
        )
    return *_with_numbers(path, table, missing), said


def _without_cut(path: Path, separator: str, convert: Any) -> tuple[Any, str]:
    """A table with lines that have other cells than that of names.

    Returns:
        The table, and what the user should know of its last line.

    Raises:
        UsageError: it begins with a comment.
        LogDamagedError: it has another such line than a last one that was cut.
    """
    import pyarrow.csv as csv

    wrong: list[Any] = []

    def left_out(row: Any) -> str:
        if len(wrong) < 2:
            wrong.append(row)
        return "skip"

    table = csv.read_csv(
        path,
        # Without threads rows are counted; PyArrow hands out only lines that can be decoded.
        read_options=csv.ReadOptions(use_threads=False, encoding="latin-1"),
        parse_options=csv.ParseOptions(delimiter=separator, invalid_row_handler=left_out),
        convert_options=convert,
    )
    table = table.rename_columns(list(map(_decoded, table.column_names)))
    if not wrong:
        return table, ""
    first = wrong[0]
    line, held = line_of(path, first.number - 2), _in_words(first.actual_columns)
    said = (
        f"{path}: line {line} holds {held}, {_decoded(first.text)[:40]!r}, and the line of names "
    )
    said += _in_words(first.expected_columns)
    last = len(wrong) == 1 and first.number == table.num_rows + 2
    with path.open("rb") as file:
        names = file.readline()
        file.seek(-1, 2)
        ended = file.read() in (b"\n", b"\r")
    if names.startswith(b"#") and first.number == 2:
        raise UsageError(f"{said}: leave out the comment before it")
    if last and not ended and first.actual_columns < first.expected_columns:
        return table, f"{said}: the file was cut there, and the line is left out"
    raise LogDamagedError(f"{said}: mend the line or leave it out")


def _decoded(text: str) -> str:
    """What was read as Latin-1 and is UTF-8."""
    return text.encode("latin-1").decode("utf-8-sig", "replace")


def _in_words(count: int) -> str:
    return "a cell" if count == 1 else f"{count} cells"


def _written(path: Path, head: str) -> tuple[str, str]:
    """What separates the columns of a CSV file, and what the decimals of its numbers."""
    separator = _separator(next(iter(head.splitlines()), ""))
    if separator == ",":
        return separator, "."
    cells = [cell.strip(' "') for line in head.splitlines()[1:] for cell in line.split(separator)]
    comma = next((cell for cell in cells if _WITH_COMMA.fullmatch(cell)), None)
    point = next((cell for cell in cells if _WITH_POINT.fullmatch(cell)), None)
    if comma is not None and point is not None:
        raise UsageError(
            f"{path}: it has numbers with a decimal comma ({comma}) and with a point ({point}): "
            "write all of them alike"
        )
    return separator, "." if comma is None else ","


def _separator(names: str) -> str:
    """What separates the columns, by the line of their names."""
    bare = _QUOTED.sub("", names)
    return next((s for s in _SEPARATORS if s in bare), ",")


def _with_numbers(path: Path, table: Any, missing: list[str]) -> tuple[Any, dict[str, Words]]:
    """Turn the columns of a table into numbers that were taken for text for a few words."""
    import pyarrow
    import pyarrow.compute as compute

    found: dict[str, Words] = {}
    blank = rf"^[ \t]*(?:{'|'.join(map(re.escape, missing))})[ \t]*$"
    for place, name in enumerate(table.column_names):
        column = table.column(place)
        if not (pyarrow.types.is_string(column.type) or pyarrow.types.is_binary(column.type)):
            continue
        numbers = compute.match_substring_regex(column, _NUMBER)
        many = compute.sum(numbers).as_py() or 0
        if not many:
            continue
        known = compute.or_(numbers, compute.match_substring_regex(column, blank))
        count = compute.sum(compute.invert(known)).as_py()
        most = count >= many
        if count:
            row = compute.index(known, False).as_py()
            text = column[row].as_py()
            text = text.decode("utf-8", "replace") if isinstance(text, bytes) else text
            short = text if len(text) <= 40 else f"{text[:40]}..."
            found[name] = Words(path, name, count, len(column), row, short, most)
        if not most:
            only = compute.if_else(numbers, column, None).cast(pyarrow.string())
            plain = compute.utf8_ltrim(compute.utf8_trim(only, " \t"), "+")
            table = table.set_column(place, name, plain.cast(pyarrow.float64()))
    return table, found
