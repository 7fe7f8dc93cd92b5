"""Building blocks of layouts: panels of layouts.toml, plots, state timelines, images, tabs."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Literal

import rerun as rr
import rerun.blueprint as rrb

from cdmisfa.core.errors import UsageError
from replay.view.writer import FRAME, ITERATION, Interval

Views = list[rrb.View | rrb.Container]

# Frames of a plot up to the time cursor: few enough that single frames are visible.
RECENT = 300

# Blocks of a state timeline up to the time cursor: few enough that single blocks are visible.
RECENT_BLOCKS = 50

# Share of a time axis that is added beyond its end, so that the legend covers no data.
ROOM = 0.14

# Share of a time axis that the labels of a plot's y axis take; state timelines have no such labels
# and begin later by this share, so that both are aligned.
MARGIN = 0.018

CURSOR = rr.TimeRangeBoundary.cursor_relative

# Duration in which the viewer plays a run of any length, in seconds.
PLAY_SECONDS = 60


@dataclass(frozen=True, slots=True)
class Panel:
    """A panel of a tab.

    Attributes:
        title: title, with the number of the module as {i} and facts of the run; see `RunLayout`.
        entities: entities that the panel draws. Curves that the run does not have are omitted; so
            is the panel if the first of them is missing.
        kind: curves ("lines") or state timelines ("states") of the whole run, or of the frames or
            blocks up to the time cursor ("recent", "recent states"); the last frame of each stream,
            the input, the weights, or the summary.
        height: relative height; state timelines have a fixed height per row.
        beside: place the panel to the right of the previous one.
        state_rows: number of state timelines, not counting `per_stream`.
        per_stream: add one state timeline for each stream.
        low: least value of the y axis.
        high: greatest value of the y axis.
        fit: fit the y axis to all values, from `low` on if that is given.
        legend: show a legend if there are several curves.
        each_module: repeat the panel for each module.
        when: show the panel only if novelty is measured by bands or by clusters, or if there are
            several outputs.
    """

    title: str
    entities: tuple[str, ...] = ()
    kind: Literal[
        "lines", "recent", "states", "recent states", "streams", "input", "weights", "summary"
    ] = "lines"
    height: float = 130
    beside: bool = False
    state_rows: int = 0
    per_stream: bool = False
    low: float | None = None
    high: float | None = None
    fit: bool = False
    legend: bool = True
    each_module: bool = False
    when: Literal["", "bands", "clusters", "outputs"] = ""


@dataclass(frozen=True, slots=True)
class Tab:
    """A tab: a column of panels, and a narrower column to its left."""

    name: str
    panels: tuple[Panel, ...]
    left: tuple[Panel, ...] = ()


@cache
def tabs_of(learner: Literal["paper", "progress"]) -> tuple[Tab, ...]:
    """Return the tabs of a learner's runs."""
    tables = tomllib.loads(Path(__file__).with_suffix(".toml").read_text("utf-8"))
    return tuple(
        Tab(
            tab["name"],
            tuple(Panel(**panel) for panel in tab["panels"]),
            tuple(Panel(**panel) for panel in tab.get("left", ())),
        )
        for tab in tables[learner]
    )


def blueprint(
    *tabs: rrb.Container | rrb.View,
    name: str,
    timeline: str = FRAME,
    length: int = 0,
    tab: str | None = None,
) -> rrb.Blueprint:
    """Return a layout of tabs above a time bar, without the viewer's side panels.

    The time cursor starts at the end, where every result is visible.

    Args:
        tabs: the tabs from left to right.
        name: name of the layout.
        timeline: timeline of the time bar.
        length: length of the timeline, which is played in `PLAY_SECONDS`; 0 if unknown.
        tab: name of the open tab; by default the first.

    Raises:
        UsageError: the tab does not exist.
    """
    names = [str(part.name) for part in tabs]
    if tab is not None and tab.lower() not in map(str.lower, names):
        raise UsageError(f"no tab {tab!r} in this view: choose one of {', '.join(names)}")
    opened = 0 if tab is None else [part.lower() for part in names].index(tab.lower())
    speed = max(round(length / PLAY_SECONDS), 1) if length else None
    return rrb.Blueprint(
        rrb.Tabs(*tabs, active_tab=opened, name=name),
        rrb.TimePanel(timeline=timeline, state="collapsed", play_state="following", fps=speed),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="hidden"),
        auto_views=False,
        auto_layout=False,
    )


def curve_view(
    name: str,
    entities: Sequence[str],
    end: int = 0,
    *,
    start: int = 0,
    recent: int = 0,
    span: Interval | None = None,
    legend: bool = True,
) -> rrb.TimeSeriesView:
    """Return a plot of curves over time.

    Args:
        name: title of the plot.
        entities: entities of the curves.
        end: last frame on the time axis, without the space for the legend; 0 if the axis grows.
        start: first frame on the time axis.
        recent: draw only this many frames up to the time cursor; 0 draws all.
        span: range of the y axis; None leaves it to the viewer.
        legend: show a legend.
    """
    corner = rrb.Corner2D.RightTop if end or recent else rrb.Corner2D.LeftTop
    axis, time_ranges = None, None
    if recent:
        axis = _axis(-recent, round(ROOM * recent), CURSOR)
        time_ranges = [rr.VisibleTimeRange(FRAME, start=CURSOR(seq=-recent), end=CURSOR(seq=0))]
    elif end:
        axis = _axis(start, end + round(ROOM * max(end - start, 1)))
    return rrb.TimeSeriesView(
        origin="/",
        contents=[*entities],
        name=f"{name}, last {recent} frames" if recent else name,
        axis_x=axis,
        axis_y=None if span is None else rrb.ScalarAxis(range=span),
        plot_legend=rrb.PlotLegend(corner, visible=legend),
        time_ranges=time_ranges,
    )


def state_rows(
    name: str, entities: Sequence[str], end: int = 0, *, recent: int = 0, room: bool = True
) -> rrb.View:
    """Return state timelines, aligned with plots of the same time axis; see `curve_view`."""
    axis = None
    if recent:
        axis = _axis(-recent, round(ROOM * recent) if room else 0, CURSOR)
    elif end:
        axis = _axis(-round(MARGIN * (1 + ROOM) * end), end + round(ROOM * end))
    return rrb.StateTimelineView(origin="/", contents=[*entities], name=name, time_view=axis)


def _axis(
    start: int, end: int, boundary: Callable[..., Any] = rr.TimeRangeBoundary.absolute
) -> rrb.archetypes.TimeAxis:
    visible = rr.TimeRange(start=boundary(seq=start), end=boundary(seq=end))
    return rrb.archetypes.TimeAxis(view_range=visible)


def images(origin: str, name: str, bounds: tuple[Interval, Interval] | None = None) -> rrb.View:
    """Return a view of images; with `bounds`, of the part within ranges of x and y."""
    across, down = bounds or (None, None)
    visible = rrb.VisualBounds2D(x_range=across, y_range=down) if across and down else None
    return rrb.Spatial2DView(origin=origin, name=name, visual_bounds=visible)


def scene() -> rrb.View:
    """Return the 3D view of the world, seen from in front of the robot."""
    name, hidden = "World and attended view", rrb.LineGrid3D(visible=False)
    eye = rrb.EyeControls3D(
        position=(-1.5, -0.85, 0.72), look_target=(-0.38, 0.0, 0.0), eye_up=(0.0, 0.0, 1.0)
    )
    return rrb.Spatial3DView(origin="/scene", name=name, line_grid=hidden, eye_controls=eye)


def beside(views: Views) -> rrb.View | rrb.Container:
    """Return views side by side."""
    return views[0] if len(views) == 1 else rrb.Horizontal(*views)


def events(name: str) -> rrb.View:
    """Return the list of events with their iterations."""
    columns = rrb.archetypes.TextLogColumns(timeline_columns=[ITERATION], text_log_columns=["body"])
    return rrb.TextLogView(origin="/events", name=name, columns=columns)
