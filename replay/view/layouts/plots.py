"""Plots and lanes over time, and the frame around all tabs: axes that hold the data, and align."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from cdmisfa.core.errors import UsageError
from replay.view.columns import FRAME

ROOM = 0.14
"""Part of a time axis, beyond its end, that is left to the legend: so it covers no data."""

MARGIN = 0.018
"""Part of a time axis that the numbers of a plot take; lanes have none, and begin as much later."""

PLAY_SECONDS = 60
"""What it takes to play a run."""

LANE = 35
"""Height of a lane, beside plots of 100 to 200."""

MOST_LANES = 9
"""Lanes that get their full height; more are scrolled."""

Span = tuple[float, float]


def blueprint(
    *tabs: rrb.Container | rrb.View,
    name: str,
    timeline: str = FRAME,
    length: int = 0,
    tab: str | None = None,
) -> rrb.Blueprint:
    """Tabs with one plain time bar below and no panels around.

    The cursor starts at the end, where what was learned is on show.

    Args:
        tabs: one beside the other.
        name: of all.
        timeline: of the time bar.
        length: of the timeline, which is played in a minute; 0: not known.
        tab: name of the one that is open; by default the first.

    Raises:
        UsageError: there is no such tab.
    """
    names = [str(found.name) for found in tabs]
    if tab is not None and tab.lower() not in map(str.lower, names):
        raise UsageError(f"there is no tab {tab!r}: there are {', '.join(names)}")
    opened = 0 if tab is None else [found.lower() for found in names].index(tab.lower())
    return rrb.Blueprint(
        rrb.Tabs(*tabs, active_tab=opened, name=name),
        rrb.TimePanel(
            timeline=timeline,
            state="collapsed",
            play_state="following",
            fps=max(round(length / PLAY_SECONDS), 1) if length else None,
        ),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="hidden"),
        auto_views=False,
        auto_layout=False,
    )


def time_axis(end: int, start: int = 0, *, lanes: bool = False) -> rrb.archetypes.TimeAxis:
    """A time axis that shows [start, end], and has room for a legend beyond.

    Args:
        end: where it ends.
        start: where it begins.
        lanes: it is one of lanes, and shall be in line with those of plots.
    """
    long = max(end - start, 1)
    before = round(MARGIN * (1 + ROOM) * long) if lanes else 0
    return rrb.archetypes.TimeAxis(
        view_range=rr.TimeRange(
            start=rr.TimeRangeBoundary.absolute(seq=start - before),
            end=rr.TimeRangeBoundary.absolute(seq=start + long + round(ROOM * long)),
        )
    )


def near_axis(frames: int, *, room: bool = True) -> rrb.archetypes.TimeAxis:
    """A time axis that shows so many frames up to the cursor."""
    return rrb.archetypes.TimeAxis(
        view_range=rr.TimeRange(
            start=rr.TimeRangeBoundary.cursor_relative(seq=-frames),
            end=rr.TimeRangeBoundary.cursor_relative(seq=round(ROOM * frames) if room else 0),
        )
    )


def near(frames: int) -> list[rr.VisibleTimeRange]:
    """What is drawn in such a window."""
    start = rr.TimeRangeBoundary.cursor_relative(seq=-frames)
    return [rr.VisibleTimeRange(FRAME, start=start, end=rr.TimeRangeBoundary.cursor_relative())]


def holding(
    values: NDArray[np.float64], low: float | None = None, *, also: Sequence[float] = ()
) -> Span | None:
    """A range that holds every one of these values that is a number.

    Args:
        values: of lines.
        low: where the range begins, whatever they are.
        also: what it shall hold besides.

    Returns:
        None where there are none: the viewer shows what comes.
    """
    finite = values[np.isfinite(values)]
    if not len(finite):
        return None
    least, most = float(min([*also, finite.min()])), float(max([*also, finite.max()]))
    least = least if low is None else low
    margin = 0.05 * (most - least) or 0.1 * abs(most) or 1.0
    return (least - margin if low is None else least), most + margin


def lines(
    name: str,
    contents: list[str],
    axis: rrb.archetypes.TimeAxis | None,
    span: Span | None = None,
    *,
    legend: bool = True,
    within: list[rr.VisibleTimeRange] | None = None,
) -> rrb.TimeSeriesView:
    """Curves over time, all in view from the start; without an axis, as they come.

    Args:
        name: the title.
        contents: entities.
        axis: of time.
        span: of the values.
        legend: there are several curves.
        within: what is drawn; by default everything.
    """
    corner = rrb.Corner2D.LeftTop if axis is None else rrb.Corner2D.RightTop
    return rrb.TimeSeriesView(
        origin="/",
        contents=contents,
        name=name,
        axis_x=axis,
        axis_y=rrb.ScalarAxis(range=span) if span is not None else None,
        plot_legend=rrb.PlotLegend(corner, visible=legend),
        time_ranges=within,
    )


def stacked(*rows: tuple[Sequence[rrb.View], float], name: str | None = None) -> rrb.Container:
    """Views below one another with the height of each; a row without a view takes no room."""
    views = [(view, height) for row, height in rows for view in row]
    shares = [height for _, height in views]
    return rrb.Vertical(*(v for v, _ in views), row_shares=shares, name=name)


def heights(lanes: int) -> int:
    """Height of a panel of lanes, with its title and axis."""
    return 60 + LANE * min(lanes, MOST_LANES)
