"""The clock of a log: the row of each stream for every frame, computed from the times of rows.

All functions are pure; times are int64 nanoseconds, not decreasing.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from cdmisfa.core.arrays import IntArray
from cdmisfa.core.clock import NANOSECONDS, times_of
from cdmisfa.core.errors import LogDamagedError, UsageError
from recorder.log.manifest import ViewMetadata
from replay.stored_source import Span, merged, outside

# Most frames of aligned streams: a lost or wrong timestamp could otherwise fill the memory.
MAX_FRAMES: Final = 2**31

# A pause of more than this many median steps is a gap; fewer would cut uneven cameras into pieces.
GAP_STEPS: Final = 10

# Rates that differ by less than this share count as equal: clocks of cameras drift.
UNEVEN: Final = 0.01

# Share of a frame by which the time of a row may deviate from that of its frame, as by jitter.
JITTER: Final = 0.75

# The row that each frame shows, (frames,), none after a later one.
RowOfFrame = range | IntArray


@dataclass(frozen=True, slots=True)
class FrameClock:
    """Frames of all streams on one clock.

    Attributes:
        start_ns: time of frame 0, nanoseconds.
        rows: the rows of each stream, from frame `first` on.
        gaps: the frames in which each stream has nothing new to show.
        first: number of the first frame.
    """

    start_ns: int
    rows: Sequence[RowOfFrame]
    gaps: Sequence[Sequence[Span]]
    first: int = 0


def by_time(streams: Sequence[IntArray], fps: float, *, nearest: bool = False) -> FrameClock:
    """Show in each frame the last row at or before its time, while every stream has rows.

    Args:
        streams: the times of each.
        fps: frames a second.
        nearest: show the nearest row, so that jitter of a camera repeats no image.

    Raises:
        UsageError: the streams do not overlap, or there are more than `MAX_FRAMES` frames.
    """
    start, stop = overlap(streams)
    if stop < start:
        raise UsageError("the streams do not overlap in time: choose one with --topic")
    ticks = (stop - start) * fps / NANOSECONDS + (1.5 if nearest else 1)
    _refuse_many(ticks)
    clock = times_of(np.arange(int(ticks)), fps, start)
    row_at = nearest_rows if nearest else last_rows
    rows = [row_at(times, clock) for times in streams]
    gaps: list[list[Span]] = []
    for times in streams:
        step, spans = step_of(times) * NANOSECONDS, list[Span]()
        for i in pauses(times):
            begins = int(np.searchsorted(clock, int(times[i - 1]) + int(step / 2), side="right"))
            ends = int(np.searchsorted(clock, times[i], side="left"))
            if begins < ends:
                spans.append((begins, ends))
        gaps.append(spans)
    return FrameClock(start, rows, gaps)


def last_rows(times: IntArray, clock: IntArray) -> IntArray:
    """Return the last row at or before each time of a clock."""
    return np.searchsorted(times, clock, side="right") - 1


def nearest_rows(times: IntArray, clock: IntArray) -> IntArray:
    """Return the row nearest to each time of a clock, the earlier one of two."""
    return np.searchsorted(times[:-1] + np.diff(times) // 2, clock)


def by_index(streams: Sequence[IntArray], fps: float, *, gaps: bool) -> FrameClock:
    """Show the i-th row of every stream together, up to the end of the shortest.

    Args:
        streams: the times of each.
        fps: frames a second.
        gaps: show the last row longer where the first stream, and so all, pause.

    Raises:
        UsageError: there are more than `MAX_FRAMES` frames.
    """
    first, count = streams[0], min(map(len, streams))
    begins = [int(i) for i in pauses(first) if i < count] if gaps else []
    if not begins:
        return FrameClock(int(first[0]), [range(count)] * len(streams), [[]] * len(streams))
    ticks = np.ones(count, np.int64)
    for i in begins:
        ticks[i] = max(round(int(first[i] - first[i - 1]) * fps / NANOSECONDS), 2)
    frame = np.cumsum(ticks) - ticks[0]
    spans = [(int(frame[i - 1]) + 1, int(frame[i])) for i in begins]
    _refuse_many(frame[-1])
    rows = np.searchsorted(frame, np.arange(frame[-1] + 1), side="right") - 1
    return FrameClock(int(first[0]), [rows] * len(streams), [spans] * len(streams))


def _refuse_many(frames: float) -> None:
    if frames > MAX_FRAMES:
        raise UsageError(
            f"{frames:.0f} frames are too many: choose a lower --rate, or a shorter part with "
            "--start and --end"
        )


def by_number(views: Iterable[Sequence[Span]], facts: ViewMetadata, name: str) -> FrameClock:
    """Show each frame of a recording at its number; rows are numbers of frames.

    Args:
        views: the frames that each stream has.
        facts: metadata of the recording; if it states gaps, missing frames of a stream are gaps,
            else they are skipped in all streams.
        name: name of the recording in errors.

    Raises:
        LogDamagedError: no frame is in every stream.
    """
    streams, first = [merged(covered) for covered in views], facts.first_frame
    common = streams[0]
    if facts.gaps:
        common = [(first, max((high for covered in streams for _, high in covered), default=first))]
    else:
        for covered in streams[1:]:
            common = intersection(common, covered)
    common = merged(common)
    if not common:
        raise LogDamagedError(f"{name}: no frame is readable in every view")
    begins, end = common[0][0], common[-1][1]
    parts = [np.arange(low, high) for low, high in common] if len(common) > 1 else []
    rows: RowOfFrame = np.concatenate(parts) if parts else range(begins, end)
    absent = [outside(covered, begins, end) if facts.gaps else [] for covered in streams]
    return FrameClock(facts.start_ns, [rows] * len(streams), absent, begins)


def intersection(one: Sequence[Span], two: Sequence[Span]) -> list[Span]:
    """Return the frames in both of two sorted lists of ranges [start, stop)."""
    result: list[Span] = []
    i = j = 0
    while i < len(one) and j < len(two):
        low, high = max(one[i][0], two[j][0]), min(one[i][1], two[j][1])
        if low < high:
            result.append((low, high))
        if one[i][1] < two[j][1]:
            i += 1
        else:
            j += 1
    return result


def overlap(streams: Sequence[IntArray]) -> tuple[int, int]:
    """Return the first and last time at which all streams have rows; the first may be later."""
    return max(int(times[0]) for times in streams), min(int(times[-1]) for times in streams)


def step_of(times: IntArray) -> float:
    """Return the typical time between rows, in seconds; NaN of fewer than two.

    It is the mean of the steps near their median, which times in whole milliseconds shift.
    """
    if len(times) < 2:
        return float("nan")
    steps = np.sort(np.diff(times))
    median = steps[(len(steps) - 1) // 2]
    return float(steps[np.abs(steps - median) <= median / 4].mean() / NANOSECONDS)


def unlike(first: IntArray, times: IntArray) -> str:
    """Return the reason why the i-th rows of two streams do not belong together; "" if they do.

    They may be apart by half a step of the first stream.
    """
    if len(times) != len(first):
        return f"{len(first)} and {len(times)} images"
    apart = np.abs(times - first).max()
    return "images at different times" if apart > NANOSECONDS * step_of(first) / 2 else ""


def pauses(times: IntArray) -> IntArray:
    """Return the rows before which a stream paused for more than `GAP_STEPS` of its steps."""
    step = step_of(times) * NANOSECONDS
    return np.flatnonzero(np.diff(times) > GAP_STEPS * step) + 1 if step > 0 else np.empty(0, int)


def missing(times: IntArray) -> IntArray:
    """Return how many rows are missing before each row but the first, (n - 1,)."""
    step = step_of(times) * NANOSECONDS
    if not step > 0:
        return np.zeros(max(len(times) - 1, 0), int)
    return np.maximum(np.round(np.diff(times) / step) - 1, 0).astype(int)


def retimed(times: IntArray, rows: RowOfFrame, fps: float) -> str:
    """Return a warning if frames by number are not at the times of their rows; else "".

    Jitter is allowed, and, where no row is missing, a rate that is known to a hundredth.

    Args:
        times: times of the rows in nanoseconds.
        rows: row that each frame shows; each row at least once.
        fps: frames a second.
    """
    row_of = np.asarray(rows)
    frame = np.concatenate([[0], np.flatnonzero(row_of[1:] != row_of[:-1]) + 1])
    since = (times - times[0]) / NANOSECONDS
    lacks = missing(times)
    lacks[pauses(times) - 1] = 0
    lost = int(lacks.sum())
    allowed = JITTER / fps + (0 if lost else UNEVEN) * since
    if (np.abs(since - frame / fps) <= allowed).all():
        return ""
    lasts, become = since[-1] + 1 / fps, len(rows) / fps
    return f"at an uneven rate ({lost} missing): {lasts:.6g} s become {become:.6g} s of frames"


def counts(count: int, rows: RowOfFrame, gaps: Sequence[Span] = ()) -> dict[str, int]:
    """Return counts of a stream's rows, of frames that repeat one, and of rows in no frame.

    Args:
        count: number of rows.
        rows: row that each frame shows.
        gaps: frames that are not counted.
    """
    visible = len(rows)
    if not isinstance(rows, range):
        visible = int(np.count_nonzero(rows[1:] != rows[:-1])) + 1
    in_gaps = sum(stop - start for start, stop in gaps)
    return {
        "messages": count,
        "repeated": len(rows) - in_gaps - visible,
        "dropped": count - visible,
    }


def gaps_in_words(gaps: Sequence[Span], fps: float) -> str:
    """Return how many gaps there are, how long the longest is, and when it begins."""
    start, stop = max(gaps, key=lambda gap: gap[1] - gap[0])
    many = "a gap" if len(gaps) == 1 else f"{len(gaps)} gaps, the longest"
    return f"{many} of {(stop - start) / fps:.3g} s after {(start - 1) / fps:.6g} s"
