"""Array types, and conversion of a user's arrays and tables to frames."""

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

# The element types of frames: values and pixels.
_TYPES = (np.dtype(np.float64), np.dtype(np.uint8))

# Gray level that stands for the episode's mean in a centred pixel: the middle of 0 to 255, so that
# brighter and darker pixels have the same range.
GRAY = 128


class MaskedError(UsageError, ValueError):
    """Masked array; NumPy functions would use the values below its mask."""


def refuse_masked(data: Any, name: str = "frames") -> None:
    """Raise a `MaskedError` if values of an array, or of a list of arrays, are masked."""
    if any(map(np.ma.is_masked, data if isinstance(data, list | tuple) else [data])):
        raise MaskedError(f"{name}: some values are masked: fill them, or leave out the rows")


def as_array(data: Any, name: str = "frames") -> NDArray[Any]:
    """Return a user's frames as an array; the columns of a table become the values of a frame.

    Args:
        data: an array, nested lists, or a table of pandas, Polars, Arrow or DuckDB.
        name: name of the frames in errors.

    Raises:
        UsageError: rows differ in length, values are masked, or a column is not numeric.
    """
    values = without_table(data, name)
    try:
        return np.asarray(values)
    except ValueError as error:
        raise UsageError(f"{name} differ in length: give an array of equal frames") from error


def without_table(data: Any, name: str = "frames") -> Any:
    """Return `data`, or the values of a table with NaN for missing ones; see `as_array`."""
    refuse_masked(data, name)
    if hasattr(data, "toarray"):
        raise UsageError(f"{name}: the array is sparse: give it as x.toarray()")
    if hasattr(data, "to_frame"):  # one column of pandas or Polars
        data = data.to_frame()
    tabular = hasattr(data, "iloc") or hasattr(data, "__arrow_c_stream__")
    if not tabular or not hasattr(data, "columns"):
        return data.to_numpy() if hasattr(data, "to_numpy") else data
    import pyarrow

    if hasattr(data, "iloc"):  # pandas
        table = pyarrow.Table.from_pandas(data, preserve_index=False)
    else:
        table = pyarrow.table(data)
    columns = []
    for key, column in zip(table.column_names, table.columns, strict=True):
        kinds, kind = pyarrow.types, column.type
        if kinds.is_decimal(kind) or kinds.is_null(kind) or column.null_count:
            with contextlib.suppress(pyarrow.ArrowException):
                column = column.cast("float64")
        values: NDArray[Any] = column.to_numpy()
        if values.dtype.kind not in "biuf":
            raise UsageError(f"{name}: column {key} has type {kind}, which is not numeric: drop it")
        columns.append(values)
    return np.column_stack(columns) if columns else np.empty((len(table), 0))


def mean_of(pieces: Iterable[NDArray[Any]]) -> NDArray[Any]:
    """Return the mean of an episode's frames; how the frames are cut changes no bit of it.

    Args:
        pieces: arrays (n, *frame_shape) of uint8 pixels or float64 values, at least one frame
            in all.

    Returns:
        (*frame_shape) of pixels int16, rounded, halves up; of values float64.
    """
    total: Any = 0
    count = 0
    for frames in pieces:
        count += len(frames)
        if frames.dtype == np.uint8:
            total = total + frames.sum(axis=0, dtype=np.int64)
        else:
            # One frame after the other: the order in which numpy adds depends on the cut.
            for frame in frames:
                total = total + frame
    if total.dtype == np.int64:
        return np.asarray((2 * total + count) // (2 * count), np.int16)
    return np.asarray(total / count)


def centred(frames: NDArray[Any], mean: NDArray[Any]) -> NDArray[Any]:
    """Return the frames of an episode without the episode's mean.

    A centred pixel is `GRAY` plus its difference from the mean, limited to 0 to 255. If no pixel
    was limited, centring the result again does not change it.

    Args:
        frames: (n, *frame_shape) uint8 or float64.
        mean: mean of the whole episode, see `mean_of`.
    """
    if frames.dtype != np.uint8:
        return np.asarray(frames - mean)
    difference = frames - (mean - np.int16(GRAY))
    return np.clip(difference, 0, 255, out=difference).astype(np.uint8)


def as_frames(frames: Any, size: int | None = None) -> NDArray[Any]:
    """Return frames as rows of uint8 pixels or float64 values, in C order and read-only.

    Args:
        frames: (n, I).
        size: required number of values I; None for any.

    Returns:
        The frames: a view, or a copy if they are not in C order.

    Raises:
        UsageError: the frames have a different shape or type.
    """
    array = frames if type(frames) is np.ndarray else as_array(frames)
    fits = array.ndim == 2 and size in (None, array.shape[1])
    if array.dtype not in _TYPES or not fits:
        expected = f"uint8 pixels or float64 values, (n, {'values' if size is None else size})"
        raise UsageError(f"frames are {array.dtype} {array.shape}: give {expected}")
    flags = array.flags
    if not (flags.c_contiguous and flags.aligned):
        array = array.copy(order="C")
    elif flags.writeable:
        array = array.view()
    else:
        return array
    array.setflags(write=False)
    return array
