"""CSV as it is met: with other separators, words for what is missing, and words among numbers."""

from __future__ import annotations

import re
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

_NUMBER: Final = r"^[ \t]*[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?[ \t]*$"
"""What is a number, for PyArrow."""


@dataclass(frozen=True, slots=True)
class Words:
    """Cells of a column in which there are words and no numbers, where others hold numbers.

    Attributes:
        name: of the column.
        count: how many there are.
        rows: how many rows the table has.
        row: the first of them.
        text: what stands there.
        most: whether they are half of what stands in the column, or more.
    """

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
            f"is {self.text!r} in row {self.row}{left_out}"
        )


def read_csv(path: Path) -> tuple[Any, dict[str, Words]]:
    """Read a CSV file with a line of names.

    Columns are separated by commas or, where the line of names has none, by semicolons or tabs;
    then numbers may have a decimal comma. A column in which most of what stands there are numbers
    is one of numbers, and words in it are missing.

    Returns:
        The table, and by its name each column in which there are numbers and words.

    Raises:
        UsageError: it does not tell how its numbers are written.
        LogDamagedError: it is empty.
    """
    import pyarrow.csv as csv

    with path.open("rb") as file:
        head = file.read(_HEAD)
    if not head.strip():
        raise LogDamagedError(f"{path}: it is empty")
    names, ended, _ = head.partition(b"\n")
    try:
        names.decode("utf-8", "strict" if ended else "replace")
    except UnicodeDecodeError:
        raise UsageError(f"{path}: its line of names is no UTF-8: save it as CSV UTF-8") from None
    separator, decimal = _written(path, head.decode("utf-8", "replace"))
    missing = [*csv.ConvertOptions().null_values, *MISSING]
    table = csv.read_csv(
        path,
        parse_options=csv.ParseOptions(delimiter=separator),
        convert_options=csv.ConvertOptions(null_values=missing, decimal_point=decimal),
    )
    return _with_numbers(table, missing)


def _written(path: Path, head: str) -> tuple[str, str]:
    """What separates the columns of a CSV file, and what the decimals of its numbers."""
    names = next(iter(_QUOTED.sub("", head).splitlines()), "")
    separator = next((s for s in _SEPARATORS if s in names), ",")
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


def _with_numbers(table: Any, missing: list[str]) -> tuple[Any, dict[str, Words]]:
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
            found[name] = Words(name, count, len(column), row, short, most)
        if not most:
            only = compute.if_else(numbers, column, None).cast(pyarrow.string())
            plain = compute.utf8_ltrim(compute.utf8_trim(only, " \t"), "+")
            table = table.set_column(place, name, plain.cast(pyarrow.float64()))
    return table, found
