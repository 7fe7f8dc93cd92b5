"""Tables: other separators, missing numbers, and errors that name the line."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import timedelta
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from folders import external
from message_files import write_table

from cdmisfa.core.errors import CdmisfaError, LogDamagedError, UsageError

ROWS = 12


def written(folder: Path, rows: Mapping[int, str], *, names: str = "t,a,b") -> Path:
    """A table of three columns at 10 Hz, with other lines instead of some."""
    lines = [f"{i / 10},{i},{2 * i}.5" for i in range(ROWS)]
    for row, line in rows.items():
        lines[row] = line
    path = folder / "t.csv"
    path.write_text("\n".join([names, *lines]) + "\n")
    return path


def taken(path: Path, **options: Any) -> tuple[list[list[float]], tuple[str, ...]]:
    """All frames of a table, and what is said of it but of its times: see test_gaps."""
    with external(path, **{"time": "t", **options}) as source:
        said = tuple(line for line in source.warnings if "is read one image a frame" not in line)
        return source.take(0, source.frames).frames.tolist(), said


@pytest.mark.parametrize("cell", ["", " ", "NA", "n/a", "-", "--", "None", "nan", "NaN", "?"])
def test_words_for_what_is_missing_are_no_words(tmp_path: Path, cell: str) -> None:
    frames, said = taken(written(tmp_path, {7: f"0.7,7,{cell}"}))
    assert frames == [[i, 2 * i + 0.5] for i in range(ROWS) if i != 7]
    assert len(said) == 1
    lack = "1 of 12 rows have no finite number or no time and are skipped, the first is line 9"
    assert said[0].endswith(f"t.csv: {lack}")


@pytest.mark.parametrize("cell", ["broken", "'1'", "1,2", "0x1F", "1.2.3", "12 V"])
def test_a_word_among_numbers_is_an_error_that_names_the_line(tmp_path: Path, cell: str) -> None:
    path = written(tmp_path, {7: f'0.7,7,"{cell}"'})
    with pytest.raises(LogDamagedError, match="t.csv: line 9 has '" + cell):
        taken(path)
    assert taken(path, fields=["a"])[0] == [[i] for i in range(ROWS)]


def test_a_column_of_words_alone_is_left_out(tmp_path: Path) -> None:
    path = written(tmp_path, {i: f"{i / 10},{i},ok" for i in range(ROWS)})
    frames, said = taken(path)
    assert frames == [[i] for i in range(ROWS)]
    assert said == (f"{path}: columns without plain numbers are left out: b (string)",)
    with pytest.raises(UsageError, match="--field b: it is not a number but a text"):
        taken(path, fields=["b"])


@pytest.mark.parametrize(("name", "place"), [("t.csv", "line 5"), ("t.parquet", "row 3")])
def test_what_is_not_finite_is_left_out_by_its_name_or_kept_in_a_range(
    tmp_path: Path, name: str, place: str
) -> None:
    values = np.arange(ROWS) - 4.0
    values[3] = np.inf
    path = write_table(tmp_path / name, {"t": np.arange(ROWS) / 10, "a": values})
    frames, said = taken(path)
    assert [a for (a,) in frames] == [*range(-4, -1), *range(8)]
    assert said[0].endswith(f"skipped, the first is {place}")
    remaining, said = taken(path, range=(-3.0, 5.0))
    assert [a for (a,) in remaining] == [-3, -3, -2, -3, *range(6), 5, 5]
    assert said == (f"{path}: numbers that are not finite become -3",)
    with pytest.raises(UsageError, match=f"{place} has no finite number in a: to skip"):
        taken(path, time=None, rate=5)


@pytest.mark.parametrize("separator", [";", "\t"])
def test_semicolons_and_tabs_separate_cells(tmp_path: Path, separator: str) -> None:
    path = written(tmp_path, {})
    text = path.read_text().replace(",", separator)
    path.write_text(text.replace("a", '"a, of all"', 1))
    frames, said = taken(path)
    assert frames == [[i, 2 * i + 0.5] for i in range(ROWS)]
    assert said == ()


@pytest.mark.parametrize(
    ("text", "options", "error", "why"),
    [
        ("", {}, LogDamagedError, "Empty CSV file"),
        (
            "t,a\n",
            {"time": None, "rate": 5},
            UsageError,
            "no column has numbers; its columns are t",
        ),
        (
            "t;a\n0,5;1\n",
            {},
            UsageError,
            r"t \(string\) has no times from 1970 to 2116, as dates or",
        ),
        ("t,a\xb5\n0,1\n", {}, LogDamagedError, "PyArrow cannot read it .UnicodeDecodeError"),
        ("t,a\nx,y\n", {"time": None, "rate": 5}, UsageError, "columns are t of string, a of s"),
        ("0.0,1\n0.1,2\n", {}, UsageError, "the first line must have unique column names"),
        ("t,a,a\n0,1,2\n", {}, UsageError, "the first line must have unique column names"),
        ("t,a\n0,1\n1,2,3", {}, LogDamagedError, "line 3 has 3 cells, but the first line has 2"),
        ("t,a\n0,1\n1", {}, LogDamagedError, "line 3 has 1 cell, but the first line has 2"),
        (
            "t,a\n0,1\n\xff,2,3\n",
            {},
            LogDamagedError,
            "line 3 has 3 cells, but the first line has 2",
        ),
        (
            "# a log\nt,a\n0,1\n",
            {},
            LogDamagedError,
            "line 2 has 2 cells, but the first line has 1",
        ),
        ("t,a\n0,\n1,\n", {"fields": ["a"]}, UsageError, "a has no numbers"),
        ("t,a\n0,1\n1,2\n2,3\n", {"time": "t:ns"}, UsageError, "has no frame rate: .*ns.*:UNIT"),
    ],
)
def test_what_is_wrong_with_a_table_is_said(
    tmp_path: Path, text: str, options: Any, error: type[CdmisfaError], why: str
) -> None:
    path = tmp_path / "t.csv"
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(error, match=why):
        taken(path, **options)


def test_an_empty_column_and_rows_out_of_order_are_said(tmp_path: Path) -> None:
    rows = {i: f"{i / 10},,{i}" for i in range(ROWS)}
    rows |= {4: "0.7,,7", 7: "0.4,,4", 9: "0.9,,"}
    frames, said = taken(written(tmp_path, rows))
    assert [b for (b,) in frames] == [i for i in range(ROWS) if i != 9]
    assert [line.partition("t.csv: ")[2] for line in said[:3]] == [
        "columns without plain numbers are left out: a (empty)",
        "1 of 12 rows have no finite number or no time and are skipped, the first is line 11",
        "3 rows are out of order: rows are sorted by time",
    ]


def test_distances_in_a_list_that_were_not_measured_are_the_end_of_a_range(tmp_path: Path) -> None:
    lists = [[1.0, None], [np.nan, 2.0], None, [3.0, np.inf]]
    path = write_table(tmp_path / "t.parquet", {"t": np.arange(4) / 10, "r": lists})
    remaining, said = taken(path, fields=["r"], range=(0.5, 9.0), align="index")
    assert remaining == [[1, 0.5], [0.5, 2], [3, 0.5]]
    assert said[0].endswith("skipped, the first is row 2")


def test_decimals_durations_and_truth_are_numbers_and_other_columns_are_named(
    tmp_path: Path, cdmisfa: Any
) -> None:
    columns = {
        "t": np.arange(ROWS) / 10,
        "price": pa.array([Decimal(i) / 4 for i in range(ROWS)], pa.decimal128(9, 2)),
        "lasts": pa.array([timedelta(milliseconds=250 * i) for i in range(ROWS)], "duration[ms]"),
        "on": [i % 3 == 0 for i in range(ROWS)],
        "word": ["x"] * ROWS,
        "when": pa.array(range(ROWS), pa.timestamp("ns")),
    }
    path = write_table(tmp_path / "t.parquet", columns)
    frames, said = taken(path)
    assert frames == [[i / 4, i / 4, float(i % 3 == 0)] for i in range(ROWS)]
    lines = (
        "columns without plain numbers are left out: word (string), when (timestamp[ns])",
        "durations are read in seconds: lasts",
        "decimals are rounded to float64: price",
    )
    assert said == tuple(f"{path}: {line}" for line in lines)
    assert set(said) < set(cdmisfa("info", path, "--json").json["notes"])
    convert = cdmisfa("convert", path, "--rate", "5", "-o", tmp_path / "rec", "--json")
    assert convert.json["warnings"] == [*said]
    assert all(f"warning: {line}\n" in convert.err for line in said)
    timed = write_table(tmp_path / "timed.parquet", {"time": columns["t"], "a": columns["t"]})
    assert "time is read as a number, not as the time" in taken(timed, time=None, rate=5)[1][0]


@pytest.mark.parametrize(
    ("rows", "why"), [("0,1\n", "one row"), ("0,1\n0,2\n0,3\n", "most rows at the time of the row")]
)
def test_rows_without_a_step_in_time_have_no_rate(tmp_path: Path, rows: str, why: str) -> None:
    path = tmp_path / "t.csv"
    path.write_text("t,a\n" + rows)
    with pytest.raises(UsageError, match=f"t.csv has {why}.*, so it has no frame rate: set --rate"):
        taken(path)


@pytest.mark.parametrize("times", [[0, 2.0**70], [0, 2**62]])
def test_times_beyond_any_clock_are_refused(tmp_path: Path, times: Any) -> None:
    path = write_table(tmp_path / "t.parquet", {"t": times, "a": [1, 2]})
    with pytest.raises(UsageError, match=r"t .* has no times from 1970 to 2116"):
        taken(path, time="t:ns")
