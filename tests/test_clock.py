"""The clock: one formula, for one frame or many, that can be turned round."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, example, given
from hypothesis import strategies as st

from cdmisfa.core.clock import NANOSECONDS, START_NS, nearest_frames, time_of, times_of

RATES = st.one_of(
    st.sampled_from([29.97, 30_000 / 1001, 23.976, 59.94, 25.0, 50.0, 1e-3, 1e6, 1e9]),
    st.floats(1e-6, NANOSECONDS),
    st.integers(1, NANOSECONDS),
)
FRAMES = st.integers(0, 2**33 - 1)
STARTS = st.sampled_from([0, 1, START_NS, 2**62])


@given(t=FRAMES, fps=RATES, start=STARTS)
@example(t=15_015, fps=29.97, start=START_NS)
@example(t=2**33 - 1, fps=30, start=0)
@example(t=2**33 - 1, fps=1e9, start=2**62)
def test_one_frame_and_many_have_the_same_times_and_lead_back(
    t: int, fps: float, start: int
) -> None:
    assume(t * NANOSECONDS / fps < 2**62)
    frames = np.array([t, t // 2, 0])
    times = times_of(frames, fps, start)
    assert times.dtype == np.int64
    assert times.tolist() == [time_of(int(frame), fps, start) for frame in frames]
    if fps <= 1e8 or fps == NANOSECONDS:  # between, rounding to nanoseconds is half a frame
        assert nearest_frames(times, fps, start).tolist() == frames.tolist()


@pytest.mark.parametrize("fps", [29.97, 30_000 / 1001, 50, 50.0])
def test_every_frame_of_two_hours(fps: float) -> None:
    frames = np.arange(216_000)
    times = times_of(frames, fps, START_NS)
    assert times.tolist() == [time_of(t, fps, START_NS) for t in range(216_000)]
    np.testing.assert_array_equal(nearest_frames(times, fps, START_NS), frames)


def test_times_of_the_wall_clock_do_not_overflow() -> None:
    """A whole number as the rate must not be multiplied as one."""
    assert nearest_frames(np.array([START_NS]), 30, 0).tolist() == [43_548_192_000]
