"""Decide whether a log needs color: whether hue adds information to brightness."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from replay.stored_source import StoredSource

# Frames at the start of a log that are examined.
LOOKED: Final = 2000

# Frames from one examined frame to the next: lasting changes correlate over it, noise does not.
STEP: Final = 5

# Cells across and down an image, whose mean colors are compared.
_CELLS = 8

# Of red, green and blue, as gray frames show them.
_BRIGHTNESS: Final = np.array((0.299, 0.587, 0.114))[:, None, None]

# Change of red or blue over that of brightness, up to which gray shows it as well; a red ball on
# black comes to that.
_MOST_RATIO: Final = 2.0

_FEWEST = 20

# Hue is worth three times the pixels from this share of the variance of brightness on.
_SHARE = 0.1

# Share of its variance that must persist from one examined frame to the next.
_LASTING = 0.3

# Variance, in steps of a pixel squared, below which hue is due to rounding in images.
_LEAST = 0.25


# Note on the choice.
CHOSEN: Final = {
    True: "--color auto: hue varies independently of brightness, so frames have color",
    False: "--color auto: hue adds nothing to brightness, so frames are gray",
}


def shows_hue(source: StoredSource) -> bool:
    """Return whether one stream of a source in colors shows more than it would in gray."""
    for stream in range(len(source.spec.streams)):
        times = range(0, min(source.frames, LOOKED), STEP)
        looked = [block.frames for t in times for block in source.pieces(stream, t, t + 1, 1)]
        if looked and hue_varies(np.concatenate(looked)):
            return True
    return False


def hue_varies(frames: NDArray[Any]) -> bool:
    """Return whether hue varies where brightness does not, and lasts, as noise does not.

    In each of 8 x 8 cells hue is red and blue less brightness, without what brightness in the
    same cell tells of it, at most `_MOST_RATIO` times itself. Of that, as of brightness, the
    covariance of frames that follow one another is taken, summed over the cells.

    Args:
        frames: (n, height, 3 width) uint8, each in red, green and blue beside one another.
    """
    if len(frames) < _FEWEST:
        return False
    cells = np.stack([_in_cells(plane) for plane in np.split(frames, 3, axis=2)])
    cells -= cells.mean(axis=1, keepdims=True)
    grey = (_BRIGHTNESS * cells).sum(axis=0)
    hue = cells[[0, 2]] - grey
    along = (hue * grey).sum(axis=1) / np.maximum((grey * grey).sum(axis=0), 1e-9)
    hue -= along.clip(-_MOST_RATIO, _MOST_RATIO)[:, None] * grey
    count = len(grey.T)
    of_brightness = _SHARE * _lasting(grey) / count
    of_hue = _LASTING * (hue * hue).mean(axis=1).sum() / count
    return bool(_lasting(hue) / count >= max(of_brightness, of_hue, _LEAST))


def _lasting(x: NDArray[np.float64]) -> float:
    """Return the covariance of frames (..., n, cells) with the next, summed."""
    return float((x[..., 1:, :] * x[..., :-1, :]).sum() / (x.shape[-2] - 1))


def _in_cells(plane: NDArray[Any]) -> NDArray[np.float64]:
    """Return the mean of each cell of images (n, height, width), (n, cells)."""
    for axis in (1, 2):
        size = plane.shape[axis]
        starts = np.unique(np.arange(_CELLS) * size // _CELLS)
        widths = np.diff(np.append(starts, size))
        shape = [-1 if i == axis else 1 for i in range(3)]
        plane = np.add.reduceat(plane, starts, axis=axis, dtype=np.float64) / widths.reshape(shape)
    return np.asarray(plane.reshape(len(plane), -1))
