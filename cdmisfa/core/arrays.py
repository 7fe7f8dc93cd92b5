"""Types of arrays, and what a user gives as one."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.errors import UsageError

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
ByteArray = NDArray[np.uint8]

_TYPES = (np.dtype(np.float64), np.dtype(np.uint8))

GRAY = 128
"""What a pixel that is as in the mean of its episode becomes."""


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


def mean_of(pieces: Iterable[NDArray[Any]]) -> NDArray[Any]:
    """The mean of the frames of an episode, the same bits however they are cut.

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
    """Frames of an episode without its mean.

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


def as_frames(frames: Any, size: int | None = None) -> NDArray[Any]:
    """Frames as rows of uint8 pixels or float64 values, in C order and not to be written.

    Args:
        frames: (n, I).
        size: the I that there must be; None for any.

    Returns:
        The frames, a view, or a copy where they lie in another order.

    Raises:
        UsageError: they are of another shape or type.
    """
    array = frames if type(frames) is np.ndarray else as_array(frames)
    if array.dtype not in _TYPES:
        raise UsageError(f"frames of {array.dtype} given: give uint8 pixels or float64 values")
    if array.ndim != 2 or (size is not None and array.shape[1] != size):
        wanted = "values" if size is None else size
        raise UsageError(f"frames of shape {array.shape} given: give (n, {wanted}), a row a frame")
    flags = array.flags
    if not (flags.c_contiguous and flags.aligned):
        array = array.copy(order="C")
    elif flags.writeable:
        array = array.view()
    else:
        return array
    array.setflags(write=False)
    return array
