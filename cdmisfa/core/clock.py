"""The clock that all streams of a source share: frame t against its log time.

The log time of a frame is the start plus t frames, never the wall clock. Every log, view and
export takes it from here, so that they agree to the nanosecond.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

NANOSECONDS = 1_000_000_000

# Log time of frame 0 where nothing else is set: 2016-01-01, the year of the paper.
START_NS = 1_451_606_400_000_000_000

# Frames a second of the slowest clock; the fastest has one a nanosecond, the unit of time.
SLOWEST = 1e-6

# Fewest and most frames a second that a recording can have, or logs of cameras be sampled at.
RECORDED_FPS = (1e-3, 1e6)

Times = NDArray[np.int64]


def time_of(t: int, fps: float, start_ns: int) -> int:
    """Log time of frame t, in nanoseconds: start + t / fps, rounded half to even."""
    # An int fps would be divided exactly, unlike the float in `times_of`.
    return start_ns + round(t * NANOSECONDS / float(fps))


def times_of(frames: NDArray[Any], fps: float, start_ns: int) -> Times:
    """Log times of frames: `time_of` each, exactly.

    Args:
        frames: (n,) frame counters, whole numbers below 2^33.
        fps: frames a second.
        start_ns: log time of frame 0.

    Returns:
        (n,) nanoseconds.
    """
    offsets = np.rint(np.asarray(frames, dtype=np.int64) * NANOSECONDS / float(fps))
    return np.asarray(start_ns + offsets.astype(np.int64))


def nearest_frames(times: NDArray[Any], fps: float, start_ns: int) -> Times:
    """Return the frames nearest to log times; the inverse of `times_of` up to 1e8 frames a second.

    Args:
        times: (n,) log times, nanoseconds.
        fps: frames a second.
        start_ns: log time of frame 0.

    Returns:
        (n,) frame counters.
    """
    offsets = np.asarray(times, dtype=np.int64) - start_ns
    return np.rint(offsets * float(fps) / NANOSECONDS).astype(np.int64)
