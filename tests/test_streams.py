"""The oscillatory streams: the paper's formulas, and the contract of a source."""

from __future__ import annotations

import numpy as np
from contracts.sources import SourceContract

from cdmisfa.core.blocks import FrameSource
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


def test_streams_repeat_to_the_bit() -> None:
    source = OscillatorySource(("x2",))
    first = source.take(0, PERIOD).frames
    source.seek(1_000_000 * PERIOD)
    np.testing.assert_array_equal(source.take(0, PERIOD).frames, first)


def test_an_abrupt_swap_takes_the_signal_but_not_the_clock() -> None:
    source, other = OscillatorySource(), OscillatorySource(("x3",))
    before = source.take(0, 130).frames.copy()
    source.replace(0, "x3")
    other.seek(130)
    np.testing.assert_array_equal(source.take(0, 50).frames, other.take(0, 50).frames)
    np.testing.assert_array_equal(before[:50], OscillatorySource().take(0, 50).frames)
    assert source.describe()["streams"] == ["x3", "x2", "x3"]
