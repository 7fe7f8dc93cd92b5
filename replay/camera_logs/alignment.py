"""Streams on one clock: which image of each a frame shows, by their times alone."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.clock import NANOSECONDS, RECORDED_FPS, times_of
from cdmisfa.core.errors import UsageError
from replay.camera_logs.stream import ImageStream
from replay.camera_logs.table import TableNumbers
from replay.stored import Span

MAX_FRAMES: Final = 2**31
"""Most frames that streams are aligned to."""
GAP_STEPS: Final = 10
"""A pause between two images of more than so many median steps is a gap."""
UNEVEN: Final = 0.01
"""By how much of itself a rate may differ from another that counts as the same."""
_JITTER: Final = 0.75
"""By how much of a frame the time of an image may differ from that of its frame."""

Times = NDArray[np.uint64]
"""When each image of a stream was taken, (n,) in nanoseconds, in order."""

Rows = NDArray[np.int64]
"""Which image of a stream each frame shows, (frames,); no image after a later one."""


def counts(times: Times, rows: Rows, gaps: Sequence[Span] = ()) -> dict[str, int]:
    """Counts of a stream's images, of frames that repeat one, and of images in no frame.

    Frames within gaps, which are left out, are not counted.
    """
    shown = int(np.count_nonzero(np.diff(rows))) + (len(rows) > 0)
    held = sum(stop - start for start, stop in gaps)
    repeated, dropped = len(rows) - held - shown, len(times) - shown
    return {"messages": len(times), "repeated": repeated, "dropped": dropped}


def step_of(times: Times) -> float:
    """Median time between images, in seconds; NaN of fewer than two."""
    return float(np.median(np.diff(times)) / NANOSECONDS) if len(times) > 1 else float("nan")


def known_times(streams: Sequence[ImageStream], fps: float) -> list[Times]:
    """When each stream's images were taken; from 0 at an even rate where that is not known."""
    return [
        s.times if len(s.times) else times_of(np.arange(s.count), fps, 0).astype(np.uint64)
        for s in streams
    ]


def rate_of(streams: Sequence[ImageStream]) -> float:
    """Images a second of the first stream that has times.

    Raises:
        UsageError: none has, or they tell no rate that is taken.
    """
    timed = next((s for s in streams if len(s.times)), streams[0])
    step, table = step_of(timed.times), isinstance(timed, TableNumbers)
    count = "say what its times count, as --set input.time=COLUMN:s (or ms, us, ns)"
    if not step > 0:
        what = f"{timed.path}: {timed.topic}" if len(timed.times) else timed.path
        remedy = ", or name the column of its times with --set input.time=COLUMN" if table else ""
        if table and len(timed.times):
            what = f"{timed.path}: most of its rows are of the time of the row before, which"
            remedy = f", or {count}"
        raise UsageError(f"{what} tells no rate: set one with --rate{remedy}")
    if table and 1 / step > RECORDED_FPS[1]:
        raise UsageError(
            f"{timed.path}: {1 / step:.6g} rows a second are more than the {RECORDED_FPS[1]:.0f} "
            f"that are taken: {count}, or set a rate with --rate"
        )
    return float(f"{1 / step:.6g}")


def overlap(streams: Sequence[Times]) -> tuple[int, int]:
    """The first and the last time at which every stream has images; the first may be the later."""
    return max(int(times[0]) for times in streams), min(int(times[-1]) for times in streams)


def of_other_rate(times: Times, fps: float) -> bool:
    """Whether a stream has a rate that differs from another by more than a hundredth."""
    step = step_of(times)
    return step > 0 and abs(step * fps - 1) > UNEVEN


def unlike(first: Times, times: Times) -> str:
    """Why the i-th images of two streams do not belong together, in words; "" if they do.

    They may be apart by half a step of the first stream.
    """
    if len(times) != len(first):
        return f"{len(first)} and {len(times)} images"
    apart = np.abs(times.astype(np.int64) - first.astype(np.int64)).max()
    return "images at different times" if apart > NANOSECONDS * step_of(first) / 2 else ""


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
        raise UsageError(
            f"--rate {fps:g} makes {ticks:.0f} frames: choose a lower one, or a part of the log "
            "with --start and --end"
        )
    clock = times_of(np.arange(int(ticks)), fps, start).astype(np.uint64)
    return [np.searchsorted(times, clock, side="right") - 1 for times in streams]


def pauses(times: Times) -> Rows:
    """The images before which a stream paused for more than `GAP_STEPS` of its steps, (n,)."""
    step = step_of(times) * NANOSECONDS
    return np.flatnonzero(np.diff(times) > GAP_STEPS * step) + 1 if step > 0 else np.empty(0, int)


def missing(times: Times) -> int:
    """How many images a stream lacks between its first and last that its rate would have had."""
    return int(_lacks(times).sum())


def _lacks(times: Times) -> NDArray[np.float64]:
    """How many images are missing before each one but the first, (n - 1,)."""
    step = step_of(times) * NANOSECONDS
    if not step > 0:
        return np.zeros(max(len(times) - 1, 0))
    return np.maximum(np.round(np.diff(times) / step) - 1, 0)


def retimed(times: Times, rows: Rows, fps: float) -> str:
    """A warning if frames taken by number are not at the times of their images.

    Args:
        times: of the images, nanoseconds.
        rows: which of them each frame shows, each at least once; see `by_index`.
        fps: frames a second.

    Returns:
        "" where each frame is of its image's time, but for jitter, and, where no image is
        missing, for a rate that is known to a hundredth.
    """
    frame = np.flatnonzero(np.diff(rows, prepend=-1))
    since = (times - times[0]) / NANOSECONDS
    lacks = _lacks(times)
    lacks[pauses(times) - 1] = 0
    lost = int(lacks.sum())
    allowed = _JITTER / fps + (0 if lost else UNEVEN) * since
    if (np.abs(since - frame / fps) <= allowed).all():
        return ""
    lasts, become = since[-1] + 1 / fps, len(rows) / fps
    return f"its rate uneven ({lost} missing): {lasts:.6g} s of it become {become:.6g} s of frames"


def by_index(streams: Sequence[Times], fps: float, *, gaps: bool) -> tuple[Rows, list[Span]]:
    """Show the i-th image of every stream together, up to the end of the shortest.

    Args:
        streams: the times of each.
        fps: frames a second.
        gaps: show the last image longer where the first stream, and so all, pause.

    Returns:
        Which image of each stream each frame shows, and the frames of gaps.

    Raises:
        UsageError: that makes more frames than anybody can want.
    """
    first, count = streams[0], min(map(len, streams))
    begins = [int(i) for i in pauses(first) if i < count] if gaps else []
    ticks = np.ones(count, np.int64)
    for i in begins:
        ticks[i] = max(round(int(first[i] - first[i - 1]) * fps / NANOSECONDS), 2)
    frame = np.cumsum(ticks) - ticks[0]
    found = [(int(frame[i - 1]) + 1, int(frame[i])) for i in begins]
    if count and frame[-1] > MAX_FRAMES:
        said = f"it has {gaps_in_words(found, fps)}, {frame[-1] + 1} frames in all"
        raise UsageError(f"{said}: choose a part without, with --start or --end")
    return np.searchsorted(frame, np.arange(frame[-1] + 1), side="right") - 1, found


def gaps_by_time(times: Times, start: int, frames: int, fps: float) -> list[Span]:
    """The frames in which a stream that is aligned by time pauses.

    Args:
        times: of its images, nanoseconds.
        start: time of frame 0.
        frames: how many there are.
        fps: frames a second.
    """
    clock = times_of(np.arange(frames), fps, start).astype(np.uint64)
    step = step_of(times) * NANOSECONDS
    found = []
    for i in pauses(times):
        begins = int(np.searchsorted(clock, int(times[i - 1]) + int(step / 2), side="right"))
        ends = int(np.searchsorted(clock, times[i], side="left"))
        if begins < ends:
            found.append((begins, ends))
    return found


def gaps_in_words(gaps: Sequence[Span], fps: float) -> str:
    """How many gaps there are, how long the longest is, and when it begins."""
    start, stop = max(gaps, key=lambda gap: gap[1] - gap[0])
    many = "a gap" if len(gaps) == 1 else f"{len(gaps)} gaps, the longest"
    return f"{many} of {(stop - start) / fps:.3g} s after {(start - 1) / fps:.6g} s"
