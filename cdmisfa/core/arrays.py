"""Types of arrays, and what a user gives as one."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.errors import UsageError

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
ByteArray = NDArray[np.uint8]


def as_array(given: Any, name: str = "frames") -> NDArray[Any]:
    """What a user gave as frames, as an array, of a table its columns side by side.

    Args:
        given: an array, nested lists, or a table of pandas, Polars, Arrow or DuckDB.
        name: what it is, for what is refused.

    Raises:
        UsageError: its rows differ in length, values are masked, or a column holds no numbers.
    """
    try:
        return np.asarray(without_table(given, name))
    except ValueError as error:
        raise UsageError(f"{name} of unequal length given: give an array of them") from error


def without_table(given: Any, name: str = "frames") -> Any:
    """What a user gave, the values of a table, NaN where it has none; see `as_array`."""
    if np.ma.isMaskedArray(given) and np.ma.getmaskarray(given).any():
        raise UsageError(f"{name}: some values are masked: fill them, or leave out the rows")
    if hasattr(given, "to_frame"):  # one column of pandas or Polars
        given = given.to_frame()
    if hasattr(given, "iloc"):  # pandas
        columns = [(str(key), given.iloc[:, i]) for i, key in enumerate(given.columns)]
    elif hasattr(given, "__arrow_c_stream__") and hasattr(given, "columns"):  # Arrow, Polars
        import pyarrow

        table = pyarrow.table(given)
        columns = list(zip(table.column_names, table.columns, strict=True))
    else:
        return given.to_numpy() if hasattr(given, "to_numpy") else given
    if not columns:
        raise UsageError(f"{name}: a table without columns given")
    return np.column_stack([_column(name, *column) for column in columns])


def _column(name: str, key: str, given: Any) -> NDArray[Any]:
    """A column of a table as numbers, NaN where it has none."""
    import pyarrow

    try:
        column = given if hasattr(given, "chunks") else pyarrow.array(given, from_pandas=True)
        kinds, kind = pyarrow.types, column.type
        if kinds.is_decimal(kind) or (kinds.is_boolean(kind) and column.null_count):
            column = column.cast("float64")
        numbers: NDArray[Any] = column.to_numpy(zero_copy_only=False)
    except (pyarrow.ArrowException, NotImplementedError):  # of what Arrow has no type for
        numbers = np.asarray(given)
    if numbers.dtype.kind not in "biuf":
        held = getattr(given, "dtype", getattr(given, "type", ""))
        raise UsageError(
            f"{name}: the column {key} is of type {held}, no numbers: choose the columns of numbers"
        )
    return numbers
