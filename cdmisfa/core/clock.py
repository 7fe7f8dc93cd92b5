"""Conversion between frame numbers and log times, for the clock that all streams share.

The log time of frame t is the start plus t / fps, never the wall clock. Every log, view and
export uses these functions, so that they agree to the nanosecond.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

NANOSECONDS = 1_000_000_000

# Default log time of frame 0: 2016-01-01, the year of the paper.
START_NS = 1_451_606_400_000_000_000

# Slowest clock in frames a second, one frame in 11 days. The fastest clock has one frame in a
# nanosecond, the unit of log time.
SLOWEST = 1e-6

# Range of the frame rate of recordings, and of the rate at which external logs are sampled. Inside
# of it 2^33 frames have distinct log times.
RECORDED_FPS = (1e-3, 1e6)

Times = NDArray[np.int64]


def time_of(t: int, fps: float, start_ns: int) -> int:
    """Return the log time of frame t in ns: start + t / fps, rounded half to even."""
    # float(): an integer fps would be divided exactly, unlike the float in `times_of`.
    return start_ns + round(t * NANOSECONDS / float(fps))


def times_of(frames: NDArray[Any], fps: float, start_ns: int) -> Times:
    """Return the log times of frames, equal to `time_of` of each.

    Args:
        frames: (n,) frame numbers below 2^33.
        fps: frames a second.
        start_ns: log time of frame 0 (ns).

    Returns:
        (n,) log times (ns).
    """
    offsets = np.rint(np.asarray(frames, dtype=np.int64) * NANOSECONDS / float(fps))
    return np.asarray(start_ns + offsets.astype(np.int64))


def nearest_frames(times: NDArray[Any], fps: float, start_ns: int) -> Times:
    """Return the frames nearest to log times; inverse of `times_of` up to 1e8 frames a second.

    Args:
        times: (n,) log times (ns).
        fps: frames a second.
        start_ns: log time of frame 0 (ns).

    Returns:
        (n,) frame numbers.
    """
    offsets = np.asarray(times, dtype=np.int64) - start_ns
    return np.rint(offsets * float(fps) / NANOSECONDS).astype(np.int64)
