"""The oscillatory streams: the paper's formulas, and the contract of a source."""

from __future__ import annotations

import math

import numpy as np
import pytest
from contracts.sources import SourceContract

from cdmisfa.core.blocks import FrameSource
from cdmisfa.core.clock import START_NS
from cdmisfa.core.errors import UsageError
from recorder.world.oscillatory import PERIOD, OscillatorySource


class TestOscillatory(SourceContract):
    long = 700

    def open(self) -> FrameSource:
        return OscillatorySource()


class TestOscillatoryThatEnds(SourceContract):
    ends = True

    def open(self) -> FrameSource:
        return OscillatorySource(("x1", "zero"), length=50)


def test_the_papers_formulas() -> None:
    source = OscillatorySource()
    th = 2 * np.pi * np.arange(PERIOD) / 500
    fast = [np.cos(44 * th), np.cos(27 * th), np.cos(12 * th)]
    expected = [
        [np.sin(4 * th - np.pi / 4) - fast[0] ** 2, fast[0]],
        [np.sin(3 * th) + fast[1] ** 2, fast[1]],
        [fast[2], np.cos(2 * th) + fast[2] ** 2],
    ]
    for stream, columns in enumerate(expected):
        source.seek(0)
        np.testing.assert_allclose(
            source.take(stream, PERIOD).frames, np.stack(columns, 1), rtol=0, atol=1e-14
        )


def test_the_truth_is_theta() -> None:
    source = OscillatorySource()
    source.seek(499)
    np.testing.assert_array_equal(source.take(0, 2).truth[:, 0], [2 * np.pi * 499 / 500, 0.0])


def test_streams_repeat_to_the_bit() -> None:
    source = OscillatorySource(("x2",))
    first = source.take(0, PERIOD).frames
    source.seek(1_000_000 * PERIOD)
    np.testing.assert_array_equal(source.take(0, PERIOD).frames, first)


def test_log_time_starts_where_it_is_told() -> None:
    assert OscillatorySource().spec.time_ns(50) == START_NS + 1_000_000_000
    assert OscillatorySource(fps=10.0, start_ns=5).spec.time_ns(1) == 100_000_005


@pytest.mark.parametrize("fps", [0.0, -50.0, math.nan, math.inf, 1e-300, 2e9])
def test_a_clock_that_does_not_run_is_refused(fps: float) -> None:
    with pytest.raises(UsageError, match="frames a second has no clock: give it an fps in"):
        OscillatorySource(fps=fps)


def test_the_zero_stream_shows_nothing() -> None:
    assert not OscillatorySource(("zero",)).take(0, 600).frames.any()


def test_an_abrupt_swap_takes_the_signal_but_not_the_clock() -> None:
    source, other = OscillatorySource(), OscillatorySource(("x3",))
    before = source.take(0, 130).frames.copy()
    source.replace(0, "x3")
    other.seek(130)
    np.testing.assert_array_equal(source.take(0, 50).frames, other.take(0, 50).frames)
    np.testing.assert_array_equal(before[:50], OscillatorySource().take(0, 50).frames)
    assert source.describe()["streams"] == ["x3", "x2", "x3"]


def test_unknown_streams_are_named_with_the_known_ones() -> None:
    with pytest.raises(UsageError, match="'x9': there are x1, x2, x3, zero"):
        OscillatorySource(("x1", "x9"))
