"""Plots of reports: round ticks, and curves that keep extremes and gaps."""

from __future__ import annotations

import re

import numpy as np

from replay.report.drawing import Axis, Plot


def test_a_curve_keeps_its_extremes_and_its_gaps() -> None:
    t = np.arange(50_000, dtype=float)
    values = np.sin(t / 40)
    values[777], values[30_000] = 9.0, -9.0
    values[20_000:21_000] = np.nan
    values[21_001] = np.nan  # one value alone
    plot = Plot("a curve", Axis(0, 50_000, 1000), Axis(-9, 9, 90, upward=True))
    plot.curve("plain", t, values)
    (path,) = plot.shapes
    points = [tuple(map(float, p.split())) for p in re.findall(r"[\d.]+ [\d.]+", path)]
    assert len(points) < 2200
    assert {0.0, 90.0} <= {y for _, y in points}
    assert (path.count("M"), path.count("h0")) == (3, 1)
    assert not [x for x, _ in points if 400.5 < x < 419.5]
    assert np.all(np.diff([x for x, _ in points]) >= 0)
