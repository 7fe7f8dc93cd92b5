"""Builds the layout of a run: the tables of its learner's tabs, its world, modules and signals."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import rerun.blueprint as rrb

from cdmisfa.core.signals import SIGNALS
from replay.runs.log import PHI_EVERY
from replay.runs.run import Outline
from replay.view.columns import FRAME, ITERATION, TIMELINE_SIGNALS, power_of_ten
from replay.view.labels import label
from replay.view.lanes import ATTENDS
from replay.view.layouts import (
    CROSSED,
    Panel,
    Range,
    Span,
    Tab,
    Views,
    WorldTab,
    beside,
    blueprint,
    events,
    holding,
    lines,
    near,
    near_axis,
    shares,
    tabs_of,
    time_axis,
    wall,
)
from replay.view.modules import sheet_size
from replay.view.run import HARDLY_WATCHED, lines_of
from replay.view.scene import scene_view
from replay.view.world import WALL, bounds

PAGES, MOST_MODULES = 12, 6
"""Modules that have a page each; of more, those that stand on one page."""

ACROSS = 3
"""Modules that stand beside one another in the gate."""

NEAR = 300
"""Frames of a window in which the inside of a block can be seen, up to the time cursor."""

NEAR_BLOCKS = 50
"""Blocks of the windows of lanes."""

MANY = 6
"""With more streams than this the share of each is small, and drawn larger."""

SHOWS = {
    "/decision/R_stay/**": "R",
    "/decision/advantage/**": "Q",
    "/abstraction/delta": "eta_dot",
    "/abstraction/min_variance": "variance",
    "/gate/novel_share": "share",
    "/gate/clustering": "roc_error",
    "/abstraction/saved": "eta_dot",
    "/abstraction/log_eta_dot": "eta_dot",
    "/abstraction/log_xi": "xi",
}
"""Signal that an entity is made of, where its name does not say so."""


def run_layout(
    outline: Outline,
    world: WorldTab,
    *,
    sheets: int = 0,
    tab: str | None = None,
) -> rrb.Blueprint:
    """The layout of a run, ready to be sent.

    Where there is a world, or something is known of it, it comes first.

    Args:
        outline: the run in short.
        world: what is shown of the world.
        sheets: modules whose pictures of least to greatest output are there.
        tab: name of the tab that is open; by default the first.

    Raises:
        UsageError: there is no such tab.
    """
    panels = Panels(outline, world)
    own = tabs_of("progress" if outline.header.by_progress else "paper")
    tabs = [panels.world()] if world.scene or world.lessons else []
    tabs += [*map(panels.tab, own), panels.modules(sheets)]
    return blueprint(*tabs, panels.table(), name="Run", length=outline.end, tab=tab)


class Panels:
    """The panels of a run; they adapt to its streams and modules, and to the signals it has.

    Titles may name thresholds of CD-MISFA, and `promised`, why there may be no line.

    Args:
        outline: the run in short.
        world: what is shown of the world.
    """

    def __init__(self, outline: Outline, world: WorldTab) -> None:
        self._world = world
        self._outline, self._header = outline, outline.header
        self._spec, self._lines = outline.header.spec, outline.lines
        self._axis = time_axis(outline.end) if outline.end else None
        self._lanes_axis = time_axis(outline.end, lanes=True) if outline.end else None
        interest = outline.lines["interest"]
        promised = "no line where it was hardly watched"
        if outline.iterations and not (interest < HARDLY_WATCHED).any():
            promised = "no line yet: none was watched long enough"
        keys = ("roc_error", "delta", "novel_share", "min_variance")
        facts = {key: f"{self._header.number(key) or 0.0:g}" for key in keys}
        self._facts = {**facts, "promised": promised}

    def _is_wanted(self, panel: Panel) -> bool:
        clusters = self._header.clusters
        several = self._outline.outputs > 1
        return {"bands": not clusters, "clusters": clusters, "outputs": several, "": True}[
            panel.when
        ]

    def tab(self, tab: Tab) -> rrb.Container:
        """A tab of a table."""
        rows: list[tuple[Panel, Views]] = []
        for panel in tab.panels:
            if views := Views(self._views(panel)):
                if panel.beside and rows:
                    rows[-1][1].extend(views)
                else:
                    rows += [(panel, views[i : i + ACROSS]) for i in range(0, len(views), ACROSS)]
        heights = shares([self._count(p) for p, _ in rows], [p.height for p, _ in rows])
        column = rrb.Vertical(
            *(beside(views) for _, views in rows), row_shares=heights, name=tab.name
        )
        if tab.left:
            left = self._sees() if tab.left == "sees" else self._now()
            return rrb.Horizontal(left, column, column_shares=[2, 5], name=tab.name)
        if tab.table and "R" in self._outline.told:
            title = "R and Q, every 10 iterations"
            table = rrb.TextDocumentView(origin="/decision/table", name=title)
            return rrb.Horizontal(column, table, column_shares=[5, 2], name=tab.name)
        return column

    def _count(self, panel: Panel) -> int:
        """Lanes of a panel."""
        return panel.lanes + (len(self._spec.streams) if panel.per_stream else 0)

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
        also = [value for path, _, value in lines_of(self._header) if path == span.also]
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
        if entity in CROSSED and entity.lstrip("/") not in (
            at for at, *_ in lines_of(self._header)
        ):
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

    def world(self) -> rrb.Container:
        """The world, what the learner sees and learned of it, and what happened."""
        summary = rrb.TextDocumentView(origin="/summary", name="What came of it")
        told = rrb.Tabs(summary, events("What happened when"))
        if self._world.scene:
            right = rrb.Vertical(self._watched("What it sees now"), told, row_shares=[2, 4])
            above = rrb.Horizontal(scene_view(), right, column_shares=[5, 3])
        else:
            above = rrb.Horizontal(self._pictures(), told, column_shares=[5, 3])
        lessons = self._lessons()
        return rrb.Vertical(above, *lessons, row_shares=[5, *(2 for _ in lessons)], name="World")

    def _lessons(self) -> Views:
        """A panel for each module, two beside one another: its output over what it follows."""
        views: Views = []
        for lesson in self._world.lessons:
            span = holding(np.array(lesson.span), margin=0.1)
            title, how = f"{lesson.title}, the last {NEAR} frames", {"within": near(NEAR)}
            entities, axis = [*lesson.entities], near_axis(NEAR, room=False)
            views.append(lines(title, entities, axis, span, legend=False, **how))
        return [beside(views[i : i + 2]) for i in range(0, len(views), 2)]

    def modules(self, sheets: int) -> rrb.Container:
        """Every module on a page of its own; many stand on pages together."""
        count = max(self._outline.modules, len(self._outline.saved))
        truth = self._near("What the world knows", ["/world/truth"]) if self._spec.truth else []
        told: Views = [*truth, events("Events")]
        if not count:
            return rrb.Vertical(*told, name="Modules")
        pages: Views = [rrb.Vertical(*told, name="Events")]
        for start in reversed(range(1, count + 1, MOST_MODULES if count > PAGES else 1)):
            page = range(start, min(start + MOST_MODULES, count + 1))
            rows = (rrb.Horizontal(self._weights_of(i), self._output(i)) for i in page)
            many = rrb.Vertical(*rows, name=f"{page[0]} to {page[-1]}")
            pages.insert(0, many if count > PAGES else self._module(start, sheet=start <= sheets))
        return rrb.Tabs(*pages, name="Modules")

    def _module(self, i: int, *, sheet: bool) -> rrb.Container:
        """A module's page: weights, frames, and its output, also around its save."""
        left, output, name = Views([self._weights_of(i)]), Views([self._output(i)]), f"Module {i}"
        if sheet:
            title = "Frames of least, middle and greatest output 1, and its values"
            width, height = sheet_size(*self._spec.frame_shape)
            left.append(wall(f"/modules/{i}/sheet", title, bounds(3, height, width, columns=1)))
        for save in (save for save in self._outline.saved if save.module == i):
            name += f": {label(self._spec.streams[save.stream])}"
            blocks, saved = self._outline.blocks, save.t + self._outline.tau
            later = blocks.starts[(blocks.streams == save.stream) & (blocks.starts >= saved)]
            ends = {"until it was saved": saved}
            if len(later):
                ends["of its stream"] = int(later[-1]) + self._outline.tau
            windows: Views = [
                self._output(i, f"The last {NEAR} frames {words}", time_axis(end, end - NEAR))
                for words, end in ends.items()
            ]
            output.append(beside(windows))
        columns = (rrb.Vertical(*views) for views in (left, output))
        return rrb.Horizontal(*columns, column_shares=[3, 4], name=name)

    def _weights_of(self, i: int) -> rrb.View:
        colours = " (blue below 0, orange above), each by its largest" if self._spec.images else ""
        return self._weights(f"/modules/{i}/weights", f"Weights of module {i}{colours}")

    def _output(
        self, i: int, title: str = "", axis: rrb.archetypes.TimeAxis | None = None
    ) -> rrb.View:
        """A module's output where its own stream was watched."""
        title = title or f"Output of module {i} wherever its own stream was watched"
        entities = [f"/modules/{i}/output", f"/modules/{i}/saved"]
        return lines(title, entities, axis or self._axis)

    def _pictures(self) -> rrb.View | rrb.Container:
        """What each stream showed last, or of numbers what is watched now."""
        if self._world.wall is None:
            return self._watched("What it sees")
        return wall(f"/{WALL}", "What each stream showed last", self._world.wall)

    def _sees(self) -> rrb.Container:
        """Input of the learner, what came of it, and weights; of many candidates they are apart."""
        shown: Views = [self._pictures(), rrb.TextDocumentView(origin="/summary", name="Summary")]
        if not self._header.by_progress:
            colours = " (blue below 0, orange above)" if self._spec.images else ""
            shown.append(self._weights("/abstraction/phi", f"Weights φ{colours}"))
        return rrb.Vertical(*shown, row_shares=[3, 4, 2][: len(shown)])

    def _now(self) -> rrb.Container:
        """Input, output and weights."""
        output = self._near("Output y", ["/signals/y"])
        kept = f", every {PHI_EVERY} blocks" if self._outline.iterations else ""
        colours = " (blue < 0 < red)" if self._spec.images else ""
        whose = " of this stream" if self._header.by_progress else ""
        weights = self._weights("/abstraction/phi", f"Weights φ{whose}{kept}{colours}")
        shares = [3, 2, 3] if output else [3, 3]
        return rrb.Vertical(self._watched("Input x"), *output, weights, row_shares=shares)

    def _watched(self, name: str) -> rrb.View | rrb.Container:
        """Input of the learner: an image with the name of its stream, or the last values."""
        if self._spec.images:
            height, width = self._spec.frame_shape
            # A fifth of it below for the name.
            return wall("/world/watched", name, ((0, width), (0, height + 0.2 * height)))
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
        if self._spec.images and self._outline.outputs > 1:
            return wall(path, name, bounds(self._outline.outputs, *self._spec.frame_shape))
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


def _signal(entity: str) -> str:
    """Name of the signal that an entity shows."""
    return SHOWS.get(entity) or entity.removeprefix("/signals/").partition("/")[0]


def _numbers(entity: str) -> Any:
    """The column of an entity's numbers, without those of its style."""
    return rrb.components.ComponentColumnSelector(entity_path=entity, component="Scalars:scalars")
