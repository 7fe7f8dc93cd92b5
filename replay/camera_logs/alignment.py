"""Streams of images on one clock: which image of each a frame shows, by their times alone."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.clock import NANOSECONDS, times_of
from cdmisfa.core.errors import UsageError

MAX_FRAMES: Final = 2**31
"""Most frames that streams are aligned to."""
_UNEVEN: Final = 0.01
"""By how much of itself a rate may differ from another that counts as the same."""

Times = NDArray[np.uint64]
"""When each image of a stream was taken, (n,) in nanoseconds, in order."""

Rows = NDArray[np.int64]
"""Which image of a stream each frame shows, (frames,)."""


def counts(times: Times, rows: Rows) -> dict[str, int]:
    """Images of a stream, frames that show one again, and images that no frame shows."""
    shown = len(np.unique(rows))
    repeated, dropped = len(rows) - shown, len(times) - shown
    return {"messages": len(times), "repeated": repeated, "dropped": dropped}


def step_of(times: Times) -> float:
    """Median time between images, in seconds; NaN of fewer than two."""
    return float(np.median(np.diff(times)) / NANOSECONDS) if len(times) > 1 else float("nan")


def even_times(count: int, fps: float) -> Times:
    """Times of images of which only the rate is known, from 0, in nanoseconds."""
    return times_of(np.arange(count), fps, 0).astype(np.uint64)


def overlap(streams: Sequence[Times]) -> tuple[int, int]:
    """The first and the last time at which every stream has images; the first may be the later."""
    return max(int(times[0]) for times in streams), min(int(times[-1]) for times in streams)


def of_other_rate(times: Times, fps: float) -> bool:
    """Whether images tell a rate, and another one, by more than a hundredth."""
    step = step_of(times)
    return step > 0 and abs(step * fps - 1) > _UNEVEN


def unlike(first: Times, times: Times) -> str:
    """Why the i-th images of two streams were not taken together, in words; "" if they were.

    They may be apart by half a step of the first stream.
    """
    if len(times) != len(first):
        return f"{len(first)} and {len(times)} images"
    apart = np.abs(times.astype(np.int64) - first.astype(np.int64)).max()
    return "images at different times" if apart > NANOSECONDS * step_of(first) / 2 else ""


def by_index(streams: Sequence[Times]) -> list[Rows]:
    """Show the i-th image of every stream in frame i, up to the end of the shortest."""
    return [np.arange(min(map(len, streams)))] * len(streams)


def by_time(streams: Sequence[Times], start: int, stop: int, fps: float) -> list[Rows]:
    """Show in each frame the last image at or before its time.

    Args:
        streams: the times of each, with an image at `start` or before.
        start: time of frame 0, nanoseconds.
        stop: no frame is later, nanoseconds.
        fps: frames a second.

    Raises:
        UsageError: that makes more frames than anybody can want.
    """
    ticks = (stop - start) * fps / NANOSECONDS + 1
    if ticks > MAX_FRAMES:
        raise UsageError(f"--rate {fps:g} makes {ticks:.0f} frames: choose a lower one")
    clock = times_of(np.arange(int(ticks)), fps, start).astype(np.uint64)
    return [np.searchsorted(times, clock, side="right") - 1 for times in streams]
