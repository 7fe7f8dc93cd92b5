"""Parts of layouts: the tables of layouts.toml, plots and axes, the frame around all tabs."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from cdmisfa.core.arrays import FloatArray
from cdmisfa.core.errors import UsageError
from replay.view.columns import FRAME, ITERATION

Span = tuple[float, float]
"""Least and most value of an axis."""

Views = list[rrb.View | rrb.Container]

Bounds = tuple[Span, Span]
"""Ranges of x and y."""


ROOM = 0.14
"""Part of a time axis, beyond its end, that is left to the legend: so it covers no data."""

MARGIN = 0.018
"""Part of a time axis that the numbers of a plot take; lanes have none, and begin as much later."""

PLAY_SECONDS = 60
"""Time in which a run is played."""

ROW, LANE = 55, 40
"""Height of a panel of lanes without them, and of each, in points."""

MOST_LANES = 9
"""Lanes that get their full height; more are scrolled."""

HEIGHT, LEAST = 624, 60
"""Height of a tab on a screen of 1280 x 720, in points, and least one of a row of plots."""


CROSSED = (
    *("/abstraction/delta", "/abstraction/min_variance", "/gate/novel_share"),
    *("/gate/clustering", "/streams/settled", "/streams/threshold"),
)
"""Lines that are crossed where something is learned; a learner has some of them."""


@dataclass(frozen=True, slots=True)
class Range:
    """An axis that holds every value of some signals.

    Attributes:
        signals: their names.
        low: where it begins, whatever they are.
        powers: they are drawn as powers of ten.
        tested: of their values those where the candidate was tested are drawn.
        watched: of their values those of streams that were hardly watched are not drawn.
        also: the line that it holds too.
    """

    signals: tuple[str, ...]
    low: float | None = None
    powers: bool = False
    tested: bool = False
    watched: bool = False
    also: str = ""


@dataclass(frozen=True, slots=True)
class Panel:
    """A view in a column of views.

    Attributes:
        title: with facts of the run in braces, see `Panels`.
        entities: what it shows; curves that the run does not have are left out.
        kind: curves, or lanes; of all of the run, or of the last blocks.
        height: of curves, beside other panels; lanes have what they need.
        beside: it stands on the right of the one before.
        lanes: how many there are; `per_stream` besides one for each stream.
        span: of the values; `few` only where there are few streams.
        range: holds the values instead.
        legend: there may be one.
        each_module: there is one for each module, whose number is {i}.
        when: the run has it where its gate has bands or clusters, or with several outputs.
    """

    title: str
    entities: tuple[str, ...]
    kind: Literal["lines", "lanes", "near lanes"] = "lines"
    height: float = 130
    beside: bool = False
    lanes: int = 0
    per_stream: bool = False
    span: Span | None = None
    few: bool = False
    range: Range | None = None
    legend: bool = True
    each_module: bool = False
    when: Literal["", "bands", "clusters", "outputs"] = ""


@dataclass(frozen=True, slots=True)
class Tab:
    """Panels below one another, with what stands beside them.

    Attributes:
        left: what it sees and looks for, or input, output and weights.
        table: tables of R and Q stand on the right.
    """

    name: str
    panels: tuple[Panel, ...]
    left: Literal["", "sees", "now"] = ""
    table: bool = False


@dataclass(frozen=True, slots=True)
class Lesson:
    """Panel of what a module has learned.

    Attributes:
        title: of its panel.
        entities: of the panel: what is followed, and the output.
        span: the least and the most of both.
    """

    title: str
    entities: tuple[str, ...]
    span: Span


@dataclass(frozen=True, slots=True)
class WorldTab:
    """The world on the first tab.

    Attributes:
        scene: there is a world in 3D.
        wall: ranges of x and y of a wall of images, where there is one.
        lessons: what each module has learned.
    """

    scene: bool = False
    wall: Bounds | None = None
    lessons: Sequence[Lesson] = ()


@cache
def tabs_of(learner: Literal["paper", "progress"]) -> tuple[Tab, ...]:
    """The tabs of a learner's runs."""
    tables = tomllib.loads(Path(__file__).with_suffix(".toml").read_text("utf-8"))
    return tuple(
        Tab(**tab | {"panels": tuple(map(_panel, tab["panels"]))}) for tab in tables[learner]
    )


def _panel(table: dict[str, Any]) -> Panel:
    return Panel(**table | ({"range": Range(**table["range"])} if "range" in table else {}))


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
    """The frames that are drawn in such a window."""
    start = rr.TimeRangeBoundary.cursor_relative(seq=-frames)
    return [rr.VisibleTimeRange(FRAME, start=start, end=rr.TimeRangeBoundary.cursor_relative())]


def holding(
    values: FloatArray,
    low: float | None = None,
    *,
    also: Sequence[float] = (),
    margin: float = 0.05,
) -> Span | None:
    """A range that holds every one of these values that is a number.

    Args:
        values: of lines.
        low: where the range begins, whatever they are.
        also: what it shall hold besides.
        margin: share of the range that is added on either side.

    Returns:
        None where there are none: the viewer shows what comes.
    """
    finite = values[np.isfinite(values)]
    if not len(finite):
        return None
    least, most = float(min([*also, finite.min()])), float(max([*also, finite.max()]))
    least = least if low is None else low
    room = margin * (most - least) or 0.1 * abs(most) or 1.0
    return (least - room if low is None else least), most + room


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


def heights(lanes: int) -> int:
    """Height of a panel of lanes, with its title and axis."""
    return ROW + LANE * min(lanes, MOST_LANES)


def shares(lanes: Sequence[int], plots: Sequence[float]) -> list[float]:
    """Heights of the rows of a tab, so that a small screen shows each lane.

    Args:
        lanes: of each row, how many it has; 0: it has plots.
        plots: height of rows of plots, beside one another.
    """
    found = [float(heights(n)) if n else 0.0 for n in lanes]
    whole = sum(height for n, height in zip(lanes, plots, strict=True) if not n)
    left = max(HEIGHT - sum(found), LEAST * lanes.count(0))
    rows = zip(found, lanes, plots, strict=True)
    return [own if n else left * height / whole for own, n, height in rows]


def wall(origin: str, name: str, bounds: Bounds) -> rrb.View:
    """Pictures in 2D, of which those within some bounds are in view."""
    across, down = bounds
    shown = rrb.VisualBounds2D(x_range=across, y_range=down)
    return rrb.Spatial2DView(origin=origin, name=name, visual_bounds=shown)


def beside(views: Views) -> rrb.View | rrb.Container:
    """Views beside one another."""
    return views[0] if len(views) == 1 else rrb.Horizontal(*views)


def events(name: str) -> rrb.View:
    """Events in words, with their iterations."""
    columns = rrb.archetypes.TextLogColumns(timeline_columns=[ITERATION], text_log_columns=["body"])
    return rrb.TextLogView(origin="/events", name=name, columns=columns)
