"""Tables of pandas, Polars and DuckDB themselves: what is learned from, and what is given."""

from __future__ import annotations

from typing import Any

import numpy as np
import pyarrow as pa
import pytest

import cdmisfa
from cdmisfa import Run
from cdmisfa.core.errors import UsageError
from replay.open_sources import open_arrays

ROWS = 60
COLUMNS = {
    "speed": np.sin(np.arange(ROWS) / 9),
    "gear": np.arange(ROWS) // 20,
    "brake": np.arange(ROWS) % 7 > 4,
}


def table(kind: str, columns: Any = COLUMNS) -> Any:
    """The same table of each kind."""
    library = pytest.importorskip(kind.partition(" ")[0])
    made = pa.table(columns)
    if kind in ("duckdb", "polars"):
        return library.from_arrow(made)
    frame = made.to_pandas()
    if kind == "pandas nullable":
        return frame.convert_dtypes()
    if kind == "pandas of Arrow":
        return frame.convert_dtypes(dtype_backend="pyarrow")
    return frame


KINDS = ("pandas", "pandas nullable", "pandas of Arrow", "polars", "duckdb")


@pytest.mark.parametrize("kind", KINDS)
def test_tables_of_each_library_are_the_same_frames(kind: str) -> None:
    expected = np.column_stack(list(COLUMNS.values()))
    given = table(kind)
    for _ in range(2):  # a result of DuckDB is not used up
        frames = open_arrays({"car": given}).take(0, ROWS).frames
        np.testing.assert_array_equal(frames, expected)
    recording = cdmisfa.Recording({"car": given, "again": table("pandas")})
    assert recording.spec.streams == ("car", "again")


@pytest.fixture(scope="module")
def module() -> Any:
    """What was learned from the columns."""
    rows = 100 * ROWS
    frames = np.resize(np.column_stack(list(COLUMNS.values())), (rows, len(COLUMNS)))
    frames[:, 0] = np.sin(np.arange(rows) / 90)
    return cdmisfa.learn(frames, tau=20, max_modules=1).modules[0]


@pytest.mark.parametrize("kind", KINDS)
def test_a_module_takes_tables_of_each_library(kind: str, module: Any) -> None:
    expected = module.transform(np.column_stack(list(COLUMNS.values())))
    np.testing.assert_array_equal(module.transform(table(kind)), expected)
    with pytest.raises(UsageError, match=r"which is not finite|column speed"):
        module.transform(table(kind, COLUMNS | {"speed": [None] * ROWS}))
    with pytest.raises(UsageError, match=r"column name has type .*, which is not numeric"):
        module.transform(table(kind, COLUMNS | {"name": ["a"] * ROWS}))


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """A run that is rewarded in some iterations and in others not."""
    return cdmisfa.learn("oscillatory", tmp_path_factory.mktemp("run") / "run", max_iterations=90)


def test_signals_of_a_run_are_tables_of_each_library(run: Run) -> None:
    pytest.importorskip("pandas")
    pytest.importorskip("polars")
    signals = run.signals
    missing = np.isnan(signals["reward"])
    assert 0 < missing.sum() < len(missing)
    names = ("iteration", "stream", "novel", "reward", "eta")
    pandas, polars = signals.to_pandas(*names), signals.to_polars(*names)
    for chosen in ((), ("reward",), names):
        pandas = signals.to_pandas(*chosen)
        assert list(pandas.columns) == signals.to_arrow(*chosen).column_names
        assert list(pandas.index) == list(range(len(missing)))
    assert str(pandas["novel"].dtype) == str(pandas["reward"].dtype).replace("float64", "bool")
    np.testing.assert_array_equal(pandas["reward"], signals["reward"])
    assert polars["reward"].null_count() == missing.sum()
    assert polars["reward"].is_nan().sum() == 0
    assert polars["reward"].mean() == pytest.approx(np.nanmean(signals["reward"]))
    assert [list(eta) for eta in pandas["eta"]] == polars["eta"].to_list()
