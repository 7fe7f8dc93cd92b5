"""The parts that the layouts of all runs share, made for a person."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import rerun as rr
import rerun.blueprint as rrb

from cdmisfa.core.signals import SIGNALS
from replay.runs.outline import Outline
from replay.view.columns import FRAME, ITERATION, TIMELINE_SIGNALS
from replay.view.heads import gaze
from replay.view.labels import label, part

MOST_MODULES = 6
"""Modules that get rows of their own."""

LEGEND = rrb.PlotLegend(visible=True, corner=rrb.Corner2D.RightTop)

MOST_STREAMS = 16
"""Streams with lines and lanes of their own: the most watched ones."""

MANY = 6
"""With more streams than this the share of each is small, and drawn larger."""

LANE = 35
"""Height of a lane, beside plots of 100 to 200."""

MOST_LANES = 9
"""Lanes that get their full height; more are scrolled."""

SHOWS = {
    "/decision/R_stay/**": "R",
    "/decision/advantage/**": "Q",
    "/abstraction/delta": "eta_dot",
    "/abstraction/saved": "eta_dot",
}
"""Signal that an entity is made of, where its name does not say so."""

Span = tuple[float, float]


def blueprint(*tabs: rrb.Container | rrb.View, name: str, timeline: str = FRAME) -> rrb.Blueprint:
    """Tabs with one plain time bar below and no panels around.

    The cursor starts at the end, where what was learned is on show.
    """
    return rrb.Blueprint(
        rrb.Tabs(*tabs, active_tab=0, name=name),
        rrb.TimePanel(timeline=timeline, state="collapsed", play_state="following"),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="hidden"),
        auto_views=False,
        auto_layout=False,
    )


def time_axis(end: int) -> rrb.archetypes.TimeAxis:
    """A time axis that shows [0, end]."""
    return rrb.archetypes.TimeAxis(
        view_range=rr.TimeRange(
            start=rr.TimeRangeBoundary.absolute(seq=0),
            end=rr.TimeRangeBoundary.absolute(seq=max(end, 1)),
        )
    )


def lines(
    name: str, contents: list[str], axis: rrb.archetypes.TimeAxis | None, span: Span | None = None
) -> rrb.TimeSeriesView:
    """Curves over time, all in view from the start; without an axis, as they come."""
    return rrb.TimeSeriesView(
        origin="/",
        contents=contents,
        name=name,
        axis_x=axis,
        axis_y=rrb.ScalarAxis(range=span) if span is not None else None,
        plot_legend=LEGEND,
    )


def stacked(*rows: tuple[Sequence[rrb.View], float]) -> rrb.Container:
    """Views below one another with the height of each; a row without a view takes no room."""
    views = [(view, height) for row, height in rows for view in row]
    return rrb.Vertical(*(v for v, _ in views), row_shares=[height for _, height in views])


def heights(lanes: int) -> int:
    """Height of a panel of lanes, with its title and axis."""
    return 60 + LANE * min(lanes, MOST_LANES)


class Panels:
    """The panels of a run; they adapt to its streams and modules, and to what its log tells.

    Args:
        outline: the run in short.
        all_views: what was not watched is there too.
        head: where the head was turned is there too.
    """

    def __init__(self, outline: Outline, *, all_views: bool = False, head: bool = False) -> None:
        self.outline = outline
        self.spec = outline.header.spec
        self._all_views = all_views
        self._head = head
        self._axis = time_axis(outline.frames) if outline.frames else None

    def tabs(self, *own: rrb.Container) -> rrb.Blueprint:
        """The layout of a run: tabs of its own, and those of every run."""
        views = [self._views()] if self._all_views else []
        return blueprint(*own, self._modules(), *views, self._table(), name="Run")

    def lines(self, name: str, contents: Sequence[str], span: Span | None = None) -> list[rrb.View]:
        """Curves over time, of those contents that the run tells; no view where it tells none."""
        told = [entity for entity in contents if self._is_told(entity)]
        return [lines(name, told, self._axis, span)] if told else []

    def lanes(self, name: str, *contents: str) -> rrb.View:
        """What was the case when."""
        return rrb.StateTimelineView(
            origin="/", contents=list(contents), name=name, time_view=self._axis
        )

    def _is_told(self, entity: str) -> bool:
        if entity.endswith("/saved") and self.outline.iterations and not self.outline.saved:
            return False
        signal = SHOWS.get(entity) or entity.removeprefix("/signals/").partition("/")[0]
        return signal not in SIGNALS or signal in self.outline.told

    def _modules(self) -> rrb.Container:
        frozen = range(1, min(max(self.outline.modules, len(self.outline.saved)), MOST_MODULES) + 1)
        rows = [self._module(i) for i in frozen]
        truth = self.lines("What the world knows", ["/world/truth"]) if self.spec.truth else []
        learned = rrb.TextLogView(
            origin="/events",
            name="Events",
            columns=rrb.archetypes.TextLogColumns(
                timeline_columns=[FRAME, ITERATION], text_log_columns=["loglevel", "body"]
            ),
        )
        return rrb.Vertical(*rows, *truth, learned, name="Modules")

    def _module(self, i: int) -> rrb.Container:
        """A module's weights; one that was saved last of all never spoke."""
        spoke = i <= self.outline.modules
        said = f"Output of module {i} on what was watched"
        output = self.lines(said, [f"/signals/y_frozen/{i}"]) if spoke else []
        weights = self.weights(f"/modules/{i}/weights", f"Weights of module {i}")
        return rrb.Horizontal(weights, *output, column_shares=[2, 5][: 1 + len(output)])

    def _views(self) -> rrb.Container:
        names = self.spec.streams
        places = [(label(name), f"/views/{part(names, s)}") for s, name in enumerate(names)]
        if self.spec.images:
            pictures = [rrb.Spatial2DView(origin=place, name=name) for name, place in places]
            watched = self.lanes("What it watches", "/lanes/1_stream")
            grid = rrb.Grid(*pictures, grid_columns=min(len(pictures), 3))
            turned = self.lines("Where the head is turned", ["/head/yaw"])
            looks = rrb.Horizontal(*turned, gaze("Where it looks"), column_shares=[2, 1])
            head = [looks] if self._head else []
            shares = [3, 1, *(2 for _ in head)]
            return rrb.Vertical(grid, watched, *head, row_shares=shares, name="All views")
        curves = [view for name, place in places for view in self.lines(name, [place])]
        return rrb.Vertical(*curves, name="All views")

    def sees(self, looks_for: rrb.View | rrb.Container | None = None) -> rrb.Container:
        """What the learner sees, what came of the run, and weights, by default those of now."""
        return rrb.Vertical(
            self.watched("What it sees"),
            rrb.TextDocumentView(origin="/summary", name="What happened"),
            looks_for or self.weights("/abstraction/phi", "What it looks for: weights φ"),
            row_shares=[3, 6, 3],
        )

    def looks(self) -> list[rrb.View]:
        """How much it watched each stream of late."""
        few = len(self.spec.streams) <= MANY
        return self.lines(
            "Where it looks: share of the last 50 blocks",
            ["/decision/attention"],
            (0.0, 1.05) if few else None,
        )

    def now(self, weights: str = "Weights φ") -> rrb.Container:
        """Input and weights."""
        return rrb.Vertical(
            self.watched("Input x"),
            self.weights("/abstraction/phi", weights),
            row_shares=[2, 3],
        )

    def watched(self, name: str) -> rrb.View:
        """What the learner was shown: an image, or the last values."""
        if self.spec.images:
            return rrb.Spatial2DView(origin="/world/watched", name=name)
        near = rr.VisibleTimeRange(
            FRAME,
            start=rr.TimeRangeBoundary.cursor_relative(seq=-500),
            end=rr.TimeRangeBoundary.cursor_relative(),
        )
        axis = rrb.archetypes.TimeAxis(
            view_range=rr.TimeRange(
                start=rr.TimeRangeBoundary.cursor_relative(seq=-500),
                end=rr.TimeRangeBoundary.cursor_relative(),
            )
        )
        return rrb.TimeSeriesView(
            origin="/world/watched",
            name=f"{name}: the last 500 frames",
            plot_legend=LEGEND,
            time_ranges=[near],
            axis_x=axis,
        )

    def weights(self, path: str, name: str) -> rrb.View:
        """Weights of an entity."""
        if self.spec.images:
            return rrb.Spatial2DView(origin=path, name=name)
        return rrb.BarChartView(origin=path, name=name, plot_legend=rrb.PlotLegend(visible=False))

    def _table(self) -> rrb.View:
        """Every signal that the run tells, a row for each iteration."""
        return rrb.DataframeView(
            origin="/",
            contents=["/signals/**"],
            name="Table",
            query=rrb.archetypes.DataframeQuery(
                timeline=ITERATION,
                apply_latest_at=True,
                select=[FRAME, *(_values(entity) for entity in self._entities())],
                entity_order=self._entities(),
            ),
        )

    def _entities(self) -> list[str]:
        """Entities of the table's columns: the signals in the record's order."""
        modules = range(1, self.outline.modules + 1)
        found: list[str] = []
        for signal in SIGNALS.values():
            if signal.name not in TIMELINE_SIGNALS and signal.show != "heat":
                parts = [f"/{i}" for i in modules] if signal.dims.startswith("M") else [""]
                found += [f"/signals/{signal.name}{part}" for part in parts]
        return [entity for entity in found if self._is_told(entity)]


def _values(entity: str) -> Any:
    """The column of an entity's numbers, without those of its style."""
    return rrb.components.ComponentColumnSelector(entity_path=entity, component="Scalars:scalars")
