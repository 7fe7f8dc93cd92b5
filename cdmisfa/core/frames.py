"""Frames as compiled code takes them, checked once where they come in.

Compiled code believes the shapes it is told: what is not checked here reads and writes beyond
its arrays.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.errors import UsageError

UINT8 = np.dtype(np.uint8)
"""The only type whose values are pixels."""

PIXEL = 1.0 / 255.0
"""What one step of a uint8 pixel counts."""

_TYPES = (np.dtype(np.float64), UINT8)


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
    array.setflags(write=False)  # arrays that can be written would be compiled for once more
    return array


def as_array(frames: Any) -> NDArray[Any]:
    """What a user gave as frames, as an array.

    Raises:
        UsageError: its rows differ in length.
    """
    try:
        return np.asarray(frames)
    except ValueError as error:
        raise UsageError("frames of unequal length given: give an array of them") from error
