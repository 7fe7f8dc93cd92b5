"""The clock of a log: which row of each stream every frame shows, by times alone."""

from __future__ import annotations

from itertools import accumulate
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cdmisfa.core.arrays import IntArray
from cdmisfa.core.clock import NANOSECONDS, time_of
from cdmisfa.core.errors import LogDamagedError, UsageError
from replay.logs.clock import by_time, counts, overlap, step_of
from replay.logs.stream import LAST_NS, LogStream

START = 1_700_000_000 * NANOSECONDS

GAPS = st.lists(st.integers(0, 10**9), min_size=1, max_size=30)


def times(*gaps: int) -> IntArray:
    return np.array(list(accumulate(gaps, initial=START)), np.int64)


def test_times_in_whole_milliseconds_have_the_rate_of_all_steps() -> None:
    stamps = np.round(np.arange(3001) * 1000 / 30).astype(np.int64) * 10**6
    lost = np.delete(stamps, slice(50, 3000, 50))
    assert [round(step_of(each) * 30, 4) for each in (stamps, lost)] == [1, 1]


@given(GAPS, GAPS, st.floats(0.5, 100))
def test_every_frame_shows_the_last_image_at_or_before_it(
    left: list[int], right: list[int], fps: float
) -> None:
    streams = [times(*left), times(*right)]
    start, stop = overlap(streams)
    for stream, rows in zip(streams, by_time(streams, fps).rows, strict=True):
        clock = [time_of(t, fps, start) for t in range(len(rows))]
        assert clock[0] == start
        assert -1 <= stop - clock[-1] < NANOSECONDS / fps + 1
        for at, row in zip(clock, rows, strict=True):
            assert stream[row] <= at
            assert row + 1 == len(stream) or stream[row + 1] > at
        shown = len(set(rows))
        result = counts(len(stream), rows)
        assert (result["repeated"], result["dropped"]) == (len(clock) - shown, len(stream) - shown)


def test_no_rate_makes_frames_without_end() -> None:
    with pytest.raises(UsageError, match="choose a lower --rate"):
        by_time([times(10**18)], 1e6)


@pytest.mark.parametrize("wrong", [[-1, 5], [5, LAST_NS], [0, -(2**62)]])
def test_times_beyond_any_clock_are_damage(wrong: list[int]) -> None:
    about = {"path": Path("left.db3"), "topic": "it", "count": 2}
    with pytest.raises(LogDamagedError, match=r"left\.db3: it has times before 1970 or after 2116"):
        LogStream(**about, times=np.array(wrong))
    assert LogStream(**about, times=np.array([0, LAST_NS - 1])).count == 2
