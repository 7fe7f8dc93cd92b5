"""Parts of layouts: the tables of layouts.toml, plots and lanes, and the frame around all tabs."""

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
from replay.view.rows import FRAME, ITERATION, Span

Views = list[rrb.View | rrb.Container]

# Frames of a window in which the inside of a block can be seen, up to the time cursor.
NEAR = 300

# Blocks of the windows of lanes.
NEAR_BLOCKS = 50

# Part of a time axis, beyond its end, that is left to the legend, which so covers no data.
ROOM = 0.14

# Part of a time axis that the numbers of a plot take; lanes have none, and begin as much later.
MARGIN = 0.018

CURSOR = rr.TimeRangeBoundary.cursor_relative

# Time in which a run is played.
PLAY_SECONDS = 60


@dataclass(frozen=True, slots=True)
class Panel:
    """A view in a column of views.

    Attributes:
        title: with the number of the module as {i}, and facts of the run, see `RunLayout`.
        entities: that it draws; curves that the run does not have are left out, and the panel
            where the first of them is.
        kind: curves, or lanes; of all of the run, or of the last frames or blocks; or of the time
            cursor the last frame of each stream, the input, the weights, or the summary.
        height: of all but lanes, which have what they need.
        beside: it is on the right of the one before.
        lanes: how many there are; `per_stream` besides one for each stream.
        low: least value of the axis.
        high: greatest value of the axis.
        fit: the axis holds every value, from `low` on if that is given.
        legend: there may be one.
        each_module: there is one for each module.
        when: the run has it where its gate has bands or clusters, or with several outputs.
    """

    title: str
    entities: tuple[str, ...] = ()
    kind: Literal[
        "lines", "near", "lanes", "near lanes", "streams", "input", "weights", "summary"
    ] = "lines"
    height: float = 130
    beside: bool = False
    lanes: int = 0
    per_stream: bool = False
    low: float | None = None
    high: float | None = None
    fit: bool = False
    legend: bool = True
    each_module: bool = False
    when: Literal["", "bands", "clusters", "outputs"] = ""


@dataclass(frozen=True, slots=True)
class Tab:
    """Panels below one another, with others on their left."""

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
    """Return tabs with one plain time bar below and no panels around.

    The cursor starts at the end, where all that was learned is shown.

    Args:
        tabs: one beside the other.
        name: of all.
        timeline: of the time bar.
        length: of the timeline, which is played in a minute; 0: not known.
        tab: name of the one that is open; by default the first.

    Raises:
        UsageError: there is no such tab.
    """
    names = [str(part.name) for part in tabs]
    if tab is not None and tab.lower() not in map(str.lower, names):
        raise UsageError(f"there is no tab {tab!r}: there are {', '.join(names)}")
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
    near: int = 0,
    span: Span | None = None,
    legend: bool = True,
) -> rrb.TimeSeriesView:
    """Return curves over time.

    Args:
        name: the title.
        entities: that are drawn.
        end: of the time axis, which has room for a legend beyond; 0: it grows with the values.
        start: of the time axis.
        near: only this many frames up to the time cursor are drawn.
        span: of the values.
        legend: whether there is one.
    """
    corner = rrb.Corner2D.RightTop if end or near else rrb.Corner2D.LeftTop
    axis, recent = None, None
    if near:
        axis = _axis(-near, round(ROOM * near), CURSOR)
        recent = [rr.VisibleTimeRange(FRAME, start=CURSOR(seq=-near), end=CURSOR(seq=0))]
    elif end:
        axis = _axis(start, end + round(ROOM * max(end - start, 1)))
    return rrb.TimeSeriesView(
        origin="/",
        contents=[*entities],
        name=f"{name}, last {near} frames" if near else name,
        axis_x=axis,
        axis_y=None if span is None else rrb.ScalarAxis(range=span),
        plot_legend=rrb.PlotLegend(corner, visible=legend),
        time_ranges=recent,
    )


def lanes(
    name: str, entities: Sequence[str], end: int = 0, *, near: int = 0, room: bool = True
) -> rrb.View:
    """Return states over time, in line with plots of the same time; see `curve_view`."""
    axis = None
    if near:
        axis = _axis(-near, round(ROOM * near) if room else 0, CURSOR)
    elif end:
        axis = _axis(-round(MARGIN * (1 + ROOM) * end), end + round(ROOM * end))
    return rrb.StateTimelineView(origin="/", contents=[*entities], name=name, time_view=axis)


def _axis(
    start: int, end: int, boundary: Callable[..., Any] = rr.TimeRangeBoundary.absolute
) -> rrb.archetypes.TimeAxis:
    visible = rr.TimeRange(start=boundary(seq=start), end=boundary(seq=end))
    return rrb.archetypes.TimeAxis(view_range=visible)


def images(origin: str, name: str, bounds: tuple[Span, Span] | None = None) -> rrb.View:
    """Return an image, or those of several images that lie within some ranges of x and y."""
    across, down = bounds or (None, None)
    visible = rrb.VisualBounds2D(x_range=across, y_range=down) if across and down else None
    return rrb.Spatial2DView(origin=origin, name=name, visual_bounds=visible)


def scene() -> rrb.View:
    """Return the world in 3D, seen from in front of the robot."""
    name, hidden = "World and attended view", rrb.LineGrid3D(visible=False)
    eye = rrb.EyeControls3D(
        position=(-1.5, -0.85, 0.72), look_target=(-0.38, 0.0, 0.0), eye_up=(0.0, 0.0, 1.0)
    )
    return rrb.Spatial3DView(origin="/scene", name=name, line_grid=hidden, eye_controls=eye)


def beside(views: Views) -> rrb.View | rrb.Container:
    """Return views beside one another."""
    return views[0] if len(views) == 1 else rrb.Horizontal(*views)


def events(name: str) -> rrb.View:
    """Return events in words, with their iterations."""
    columns = rrb.archetypes.TextLogColumns(timeline_columns=[ITERATION], text_log_columns=["body"])
    return rrb.TextLogView(origin="/events", name=name, columns=columns)
