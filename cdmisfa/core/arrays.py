"""Types of arrays, and frames from arrays and tables of a user."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.errors import UsageError

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
ByteArray = NDArray[np.uint8]

_TYPES = (np.dtype(np.float64), np.dtype(np.uint8))

# Value of a pixel that is equal to the mean of its episode.
GRAY = 128


def as_array(given: Any, name: str = "frames") -> NDArray[Any]:
    """Return the frames of a user as an array, the columns of a table side by side.

    Args:
        given: an array, nested lists, or a table of pandas, Polars, Arrow or DuckDB.
        name: of the frames, for errors.

    Raises:
        UsageError: rows differ in length, values are masked, or a column holds no numbers.
    """
    try:
        return np.asarray(without_table(given, name))
    except ValueError as error:
        raise UsageError(f"{name} of unequal length given: give an array of them") from error


def without_table(given: Any, name: str = "frames") -> Any:
    """Return what a user gave, the values of a table, NaN where it has none; see `as_array`."""
    if np.ma.is_masked(given):
        raise UsageError(f"{name}: some values are masked: fill them, or leave out the rows")
    if hasattr(given, "to_frame"):  # one column of pandas or Polars
        given = given.to_frame()
    tabular = hasattr(given, "iloc") or hasattr(given, "__arrow_c_stream__")
    if not tabular or not hasattr(given, "columns"):
        return given.to_numpy() if hasattr(given, "to_numpy") else given
    import pyarrow

    if hasattr(given, "iloc"):  # pandas
        table = pyarrow.Table.from_pandas(given, preserve_index=False)
    else:
        table = pyarrow.table(given)
    columns = []
    for key, column in zip(table.column_names, table.columns, strict=True):
        kinds, kind = pyarrow.types, column.type
        if kinds.is_decimal(kind) or kinds.is_null(kind) or column.null_count:
            with contextlib.suppress(pyarrow.ArrowException):
                column = column.cast("float64")
        values: NDArray[Any] = column.to_numpy()
        if values.dtype.kind not in "biuf":
            raise UsageError(f"{name}: the column {key} is of type {kind}, no numbers")
        columns.append(values)
    return np.column_stack(columns) if columns else np.empty((len(table), 0))


def mean_of(pieces: Iterable[NDArray[Any]]) -> NDArray[Any]:
    """Return the mean of the frames of an episode, the same bits however they are cut.

    Args:
        pieces: (n, *frame_shape) each, one frame at least in all, uint8 pixels or float64 values.

    Returns:
        (*frame_shape) int16 of pixels, rounded, half of one up; float64 of values.
    """
    total: Any = 0
    count = 0
    for frames in pieces:
        count += len(frames)
        if frames.dtype == np.uint8:
            total = total + frames.sum(axis=0, dtype=np.int64)
        else:
            for frame in frames:  # one after the other: in what order numpy adds is its own
                total = total + frame
    if total.dtype == np.int64:
        return np.asarray((2 * total + count) // (2 * count), np.int16)
    return np.asarray(total / count)


def centred(frames: NDArray[Any], mean: NDArray[Any]) -> NDArray[Any]:
    """Return the frames of an episode without its mean.

    Of pixels that is `GRAY` and how far each is from the mean, no darker than black and no
    brighter than white. Where it was neither, centred once more they stay as they are.

    Args:
        frames: (n, *frame_shape) uint8 or float64.
        mean: of the whole episode, see `mean_of`.
    """
    if frames.dtype != np.uint8:
        return np.asarray(frames - mean)
    apart = frames - (mean - np.int16(GRAY))
    return np.clip(apart, 0, 255, out=apart).astype(np.uint8)


def as_frames(frames: Any, size: int | None = None) -> NDArray[Any]:
    """Return frames as rows of uint8 pixels or float64 values, in C order and read-only.

    Args:
        frames: (n, I).
        size: the I that there must be; None for any.

    Returns:
        The frames, a view, or a copy where they lie in another order.

    Raises:
        UsageError: they are of another shape or type.
    """
    array = frames if type(frames) is np.ndarray else as_array(frames)
    fits = array.ndim == 2 and size in (None, array.shape[1])
    if array.dtype not in _TYPES or not fits:
        wanted = f"uint8 pixels or float64 values, (n, {'values' if size is None else size})"
        raise UsageError(f"frames of {array.dtype} {array.shape} given: give {wanted}")
    flags = array.flags
    if not (flags.c_contiguous and flags.aligned):
        array = array.copy(order="C")
    elif flags.writeable:
        array = array.view()
    else:
        return array
    array.setflags(write=False)
    return array
