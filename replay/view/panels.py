"""Builds the layout of a run: the tables of its learner's tabs, its world, modules and signals."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import rerun.blueprint as rrb

from cdmisfa.core.signals import SIGNALS
from replay.runs.log import PHI_EVERY
from replay.runs.run import Outline
from replay.view.columns import FRAME, ITERATION, TIMELINE_SIGNALS, power_of_ten
from replay.view.labels import label, part
from replay.view.lanes import ATTENDS, MOSTLY
from replay.view.layouts import (
    Lesson,
    Panel,
    Range,
    Span,
    Tab,
    WorldTab,
    blueprint,
    heights,
    holding,
    lines,
    near,
    near_axis,
    tabs_of,
    time_axis,
)
from replay.view.run import HARDLY_WATCHED
from replay.view.scene import gaze_view, scene_view
from replay.view.world import WALL

MOST_MODULES = 6
"""Modules that stand on one page."""

NEAR = 300
"""Frames of a window in which the inside of a block can be seen, up to the time cursor."""

NEAR_BLOCKS = 50
"""Blocks of the windows of lanes."""

MANY = 6
"""With more streams than this the share of each is small, and drawn larger."""

TWO_COLUMNS = 4
"""Modules from which on what they learned stands in two columns."""

MOST_WEIGHTS = 3
"""Modules whose weights stand beside one another."""

SHOWS = {
    "/decision/R_stay/**": "R",
    "/decision/advantage/**": "Q",
    "/abstraction/delta": "eta_dot",
    "/abstraction/saved": "eta_dot",
    "/abstraction/log_eta_dot": "eta_dot",
    "/abstraction/log_xi": "xi",
}
"""Signal that an entity is made of, where its name does not say so."""

Views = list[rrb.View | rrb.Container]


def run_layout(
    outline: Outline,
    world: WorldTab,
    *,
    all_views: bool = False,
    head: bool = False,
    tab: str | None = None,
) -> rrb.Blueprint:
    """The layout of a run, ready to be sent.

    Args:
        outline: the run in short.
        world: what the first tab shows of the world.
        all_views: what was not watched is there too.
        head: where the head was turned is there too.
        tab: name of the tab that is open; by default the first.

    Raises:
        UsageError: there is no such tab.
    """
    panels = Panels(outline)
    own = tabs_of("progress" if outline.header.by_progress else "paper")
    tabs = [panels.world(world), *map(panels.tab, own), panels.modules()]
    tabs += [panels.all_views(head=head)] if all_views else []
    return blueprint(*tabs, panels.table(), name="Run", length=outline.end, tab=tab)


class Panels:
    """The panels of a run; they adapt to its streams and modules, and to the signals it has.

    Titles may name `clustering`, the threshold of CD-MISFA 1.0, and `promised`, why there may be
    no line.

    Args:
        outline: the run in short.
    """

    def __init__(self, outline: Outline) -> None:
        self._outline, self._header = outline, outline.header
        self._spec, self._lines = outline.header.spec, outline.lines
        self._axis = time_axis(outline.end) if outline.end else None
        self._lanes_axis = time_axis(outline.end, lanes=True) if outline.end else None
        interest = outline.lines["interest"]
        promised = "no line where it was hardly watched"
        if outline.iterations and not (interest < HARDLY_WATCHED).any():
            promised = "no line yet: none was watched long enough"
        self._facts = {"clustering": self._clustering(), "promised": promised}

    def _clustering(self) -> float | None:
        """The clustering error below which CD-MISFA 1.0 saves and knows; None of 2.0."""
        value = self._header.setting("learner", "roc_error")
        is_old = self._header.setting("learner", "algorithm") == "1.0"
        return float(value) if is_old and isinstance(value, int | float) else None

    def _is_wanted(self, panel: Panel) -> bool:
        clusters = self._facts["clustering"] is not None
        several = self._outline.outputs > 1
        return {"bands": not clusters, "clusters": clusters, "outputs": several, "": True}[
            panel.when
        ]

    def tab(self, tab: Tab) -> rrb.Container:
        """A tab of a table."""
        rows = [(view, panel) for panel in tab.panels for view in self._views(panel)]
        shares = [self._height(panel) for _, panel in rows]
        column = rrb.Vertical(*(view for view, _ in rows), row_shares=shares, name=tab.name)
        if tab.left:
            left = self._sees() if tab.left == "sees" else self._now()
            return rrb.Horizontal(left, column, column_shares=[2, 5], name=tab.name)
        if tab.table and "R" in self._outline.told:
            title = "R and Q, every 10 iterations"
            table = rrb.TextDocumentView(origin="/decision/table", name=title)
            return rrb.Horizontal(column, table, column_shares=[5, 2], name=tab.name)
        return column

    def _height(self, panel: Panel) -> float:
        if panel.kind == "lines":
            return panel.height
        return heights(panel.lanes + (len(self._spec.streams) if panel.per_stream else 0))

    def _views(self, panel: Panel) -> list[rrb.View]:
        if not self._is_wanted(panel):
            return []
        if panel.kind != "lines":
            return [self._lanes(panel.title, panel.entities, near_cursor=panel.kind != "lanes")]
        few = not panel.few or len(self._spec.streams) <= MANY
        span = panel.span if few else None
        span = self._range(panel.range) if panel.range else span
        count = min(self._outline.modules, MOST_MODULES) if panel.each_module else 1
        found = []
        for i in range(1, count + 1):
            title = panel.title.format(i=i, **self._facts)
            entities = [entity.format(i=i) for entity in panel.entities]
            found += self._curves(title, entities, span, legend=panel.legend)
        return found

    def _range(self, span: Range) -> Span | None:
        parts = [self._lines[name] for name in span.signals]
        if span.tested:
            parts = [np.where(np.isnan(self._lines["tested"]), np.nan, values) for values in parts]
        values = np.concatenate(parts)
        if span.watched:
            values = values[values < HARDLY_WATCHED]
        settled = (self._header.settled or (None,))[0]
        threshold = {"delta": self._header.delta, "settled": settled}.get(span.also)
        also = [math.log10(threshold)] if threshold else []
        return holding(power_of_ten(values) if span.powers else values, span.low, also=also)

    def _curves(
        self, name: str, contents: Sequence[str], span: Span | None = None, *, legend: bool = True
    ) -> list[rrb.View]:
        """Curves over time, of those contents that the run has; no view where it has none."""
        told = [entity for entity in contents if self._is_told(entity)]
        if not told:
            return []
        return [lines(name, told, self._axis, span, legend=legend and self._several(told))]

    def _near(self, name: str, contents: Sequence[str]) -> list[rrb.View]:
        """The same of the last frames before the cursor, where the inside of blocks is seen."""
        told, title = [e for e in contents if self._is_told(e)], f"{name}: the last {NEAR} frames"
        if not told:
            return []
        axis, legend = near_axis(NEAR), self._several(told)
        return [lines(title, told, axis, legend=legend, within=near(NEAR))]

    def _lanes(self, name: str, contents: Sequence[str], *, near_cursor: bool = False) -> rrb.View:
        """States over time, or those of the last blocks before the cursor, each with its bar."""
        axis = self._lanes_axis
        if near_cursor:
            axis = near_axis(NEAR_BLOCKS * max(self._outline.tau, 1), room=False)
            name = f"{name}: the last {NEAR_BLOCKS} blocks"
        return rrb.StateTimelineView(origin="/", contents=[*contents], name=name, time_view=axis)

    def _is_told(self, entity: str) -> bool:
        if entity.endswith("/saved") and self._outline.iterations and not self._outline.saved:
            return False
        return (name := _signal(entity)) not in SIGNALS or name in self._outline.told

    def _several(self, contents: Sequence[str]) -> bool:
        """Whether these entities are more than one curve."""
        first = contents[0]
        if len(contents) > 1 or first == "/decision/attention":
            return True
        if first.endswith("**"):
            return len(self._spec.streams) > 1
        if first == "/world/truth":
            return len(self._spec.truth) > 1
        signal = SIGNALS.get(_signal(first))
        return signal is None or ("J" in signal.dims and self._outline.outputs > 1)

    def world(self, world: WorldTab) -> rrb.Container:
        """The first tab: the world, what the learner sees and learned of it, and what happened."""
        shown: Views = [scene_view()] if world.scene else []
        if world.wall is not None:
            across, down = world.wall
            bounds = rrb.VisualBounds2D(x_range=across, y_range=down)
            name = "What each stream showed last; the watched one is framed"
            shown.append(rrb.Spatial2DView(origin=f"/{WALL}", name=name, visual_bounds=bounds))
        sees = self._watched("What it sees now")
        summary = rrb.TextDocumentView(origin="/summary", name="What came of it")
        beside: Views = [*([sees] if shown else []), summary, _events("What happened when")]
        above = rrb.Horizontal(
            rrb.Vertical(*shown) if shown else sees,
            rrb.Vertical(*beside, row_shares=[2, 3, 2][-len(beside) :]),
            column_shares=[5, 3],
        )
        rows = self._lessons(world.lessons)
        shares = [max(5, 2 * len(rows)), *(2 for _ in rows)]
        return rrb.Vertical(above, *rows, row_shares=shares, name="World")

    def _lessons(self, lessons: Sequence[Lesson]) -> Views:
        """A panel for each module: its output over what it follows."""
        views: Views = []
        for lesson in lessons:
            span = holding(np.array(lesson.span), margin=0.1)
            title, axis = f"{lesson.title}: the last {NEAR} frames", near_axis(NEAR)
            views.append(lines(title, [*lesson.entities], axis, span, within=near(NEAR)))
        if len(views) < TWO_COLUMNS:
            return views
        return [rrb.Horizontal(*views[i : i + 2]) for i in range(0, len(views), 2)]

    def modules(self) -> rrb.Container:
        """Every module; many stand on pages."""
        count = max(self._outline.modules, len(self._outline.saved))
        rows = [self._module(i) for i in range(1, count + 1)]
        truth = self._near("What the world knows", ["/world/truth"]) if self._spec.truth else []
        if count <= MOST_MODULES:
            return rrb.Vertical(*rows, *truth, _events("Events"), name="Modules")
        pages = []
        for start in range(0, count, MOST_MODULES):
            page = rows[start : start + MOST_MODULES]
            pages.append(rrb.Vertical(*page, name=f"{start + 1} to {start + len(page)}"))
        events = rrb.Vertical(*truth, _events("Events"), name="Events")
        return rrb.Tabs(*pages, events, name="Modules")

    def _module(self, i: int) -> rrb.Container:
        """A module's weights and output; of one that was saved last of all, until its save."""
        saves = [save for save in self._outline.saved if save.module == i]
        stream = f" ({label(self._spec.streams[saves[0].stream])})" if saves else ""
        weights = self._weights(f"/modules/{i}/weights", f"Weights of module {i}{stream}")
        said = f"Output of module {i}{stream}"
        if i <= self._outline.modules:
            entity = [f"/signals/y_frozen/{i}"]
            output = [
                *self._curves(f"{said} on what was watched", entity),
                *self._near(said, entity),
            ]
        else:
            end = saves[0].t + self._outline.tau
            axis, legend = time_axis(end, end - NEAR), self._outline.outputs > 1
            title = f"{said}: the last {NEAR} frames until it was saved"
            output = [lines(title, ["/signals/y"], axis, legend=legend)]
        shares = [2, 3, 2] if len(output) > 1 else [2, 5]
        return rrb.Horizontal(weights, *output, column_shares=shares[: 1 + len(output)])

    def all_views(self, *, head: bool) -> rrb.Container:
        """All streams, watched or not."""
        names = self._spec.streams
        places = [(label(name), f"/views/{part(names, s)}") for s, name in enumerate(names)]
        if not self._spec.images:
            curves = [view for name, place in places for view in self._curves(name, [place])]
            return rrb.Vertical(*curves, name="All views")
        pictures = [rrb.Spatial2DView(origin=place, name=name) for name, place in places]
        rows: Views = [
            rrb.Grid(*pictures, grid_columns=min(len(pictures), 3)),
            self._lanes("What it mostly watches", [f"/{MOSTLY}/{ATTENDS}"]),
        ]
        if head:
            title = "Where the head is turned [degrees to the left]"
            turned = self._curves(title, ["/head/yaw"], legend=False)
            rows.append(rrb.Horizontal(*turned, gaze_view("Where it looks"), column_shares=[2, 1]))
        return rrb.Vertical(*rows, row_shares=[3, 1, 2][: len(rows)], name="All views")

    def _sees(self) -> rrb.Container:
        """Input of the learner, summary of the run, and weights.

        The weights are those of now, or of the first modules of the progress learner.
        """
        colours = " (blue below 0, red above)" if self._spec.images else ""
        now = self._weights("/abstraction/phi", f"What it looks for: weights φ{colours}")
        streams = self._spec.streams
        saved = [
            self._weights(
                f"/modules/{s.module}/weights", f"φ {s.module}: {label(streams[s.stream])}"
            )
            for s in (self._outline.saved[:MOST_WEIGHTS] if self._header.by_progress else ())
        ]
        return rrb.Vertical(
            self._watched("What it sees"),
            rrb.TextDocumentView(origin="/summary", name="What happened"),
            rrb.Horizontal(*saved) if saved else now,
            row_shares=[3, 6, 3],
        )

    def _now(self) -> rrb.Container:
        """Input, output and weights."""
        output = self._near("Output y", ["/signals/y"])
        kept = f", every {PHI_EVERY} blocks" if self._outline.iterations else ""
        colours = " (blue < 0 < red)" if self._spec.images else ""
        weights = self._weights("/abstraction/phi", f"Weights φ{kept}{colours}")
        shares = [3, 2, 3] if output else [3, 3]
        return rrb.Vertical(self._watched("Input x"), *output, weights, row_shares=shares)

    def _watched(self, name: str) -> rrb.View | rrb.Container:
        """Input of the learner: an image with the name of its stream, or the last values."""
        if self._spec.images:
            height, width = self._spec.frame_shape
            # A fifth of it below for the name.
            bounds = rrb.VisualBounds2D(x_range=(0, width), y_range=(0, height + 0.2 * height))
            return rrb.Spatial2DView(origin="/world/watched", name=name, visual_bounds=bounds)
        axis = near_axis(NEAR, room=False)
        values = rrb.TimeSeriesView(
            origin="/world/watched",
            name=f"{name}: the last {NEAR} frames",
            plot_legend=rrb.PlotLegend(rrb.Corner2D.LeftTop, visible=True),
            time_ranges=near(NEAR),
            axis_x=axis,
        )
        whose = rrb.StateTimelineView(
            origin="/", contents=[f"/{ATTENDS}"], name="Of which stream", time_view=axis
        )
        return rrb.Vertical(values, whose, row_shares=[3, 2])

    def _weights(self, path: str, name: str) -> rrb.View:
        if self._spec.images:
            return rrb.Spatial2DView(origin=path, name=name)
        return rrb.BarChartView(origin=path, name=name, plot_legend=rrb.PlotLegend(visible=False))

    def table(self) -> rrb.View:
        """Every signal that the run has, in the record's order, a row for each iteration."""
        entities: list[str] = []
        for signal in SIGNALS.values():
            if signal.name not in TIMELINE_SIGNALS and signal.show != "heat":
                modules = range(1, self._outline.modules + 1)
                parts = [f"/{i}" for i in modules] if signal.dims.startswith("M") else [""]
                entities += [f"/signals/{signal.name}{part}" for part in parts]
        entities = [entity for entity in entities if self._is_told(entity)]
        return rrb.DataframeView(
            origin="/",
            contents=["/signals/**"],
            name="Table",
            query=rrb.archetypes.DataframeQuery(
                timeline=ITERATION,
                apply_latest_at=True,
                select=[FRAME, *map(_numbers, entities)],
                entity_order=entities,
            ),
        )


def _events(name: str) -> rrb.View:
    """Events in words, with their iterations."""
    columns = rrb.archetypes.TextLogColumns(timeline_columns=[ITERATION], text_log_columns=["body"])
    return rrb.TextLogView(origin="/events", name=name, columns=columns)


def _signal(entity: str) -> str:
    """Name of the signal that an entity shows."""
    return SHOWS.get(entity) or entity.removeprefix("/signals/").partition("/")[0]


def _numbers(entity: str) -> Any:
    """The column of an entity's numbers, without those of its style."""
    return rrb.components.ComponentColumnSelector(entity_path=entity, component="Scalars:scalars")
