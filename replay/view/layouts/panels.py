"""The parts that the layouts of all runs share, made for a person."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import rerun.blueprint as rrb
from numpy.typing import NDArray

from cdmisfa.core.signals import SIGNALS
from replay.runs.log import PHI_EVERY
from replay.runs.run import Outline
from replay.view.columns import FRAME, ITERATION, TIMELINE_SIGNALS
from replay.view.heads import gaze
from replay.view.labels import label, part
from replay.view.lanes import ATTENDS, MOSTLY
from replay.view.layouts.plots import Span, blueprint, lines, near, near_axis, time_axis

MOST_MODULES = 6
"""Modules that stand on one page."""

NEAR = 300
"""Frames of a window in which the inside of a block can be seen, up to the time cursor."""

MOST_STREAMS = 16
"""Streams with lines and lanes of their own: the most watched ones."""

MANY = 6
"""With more streams than this the share of each is small, and drawn larger."""

SHOWS = {
    "/decision/R_stay/**": "R",
    "/decision/advantage/**": "Q",
    "/abstraction/delta": "eta_dot",
    "/abstraction/saved": "eta_dot",
    "/abstraction/log_eta_dot": "eta_dot",
    "/abstraction/log_xi": "xi",
}
"""Signal that an entity is made of, where its name does not say so."""

NEAR_BLOCKS = 50
"""Blocks of the windows of lanes."""


class Panels:
    """The panels of a run; they adapt to its streams and modules, and to what its log tells.

    Args:
        outline: the run in short.
        all_views: what was not watched is there too.
        head: where the head was turned is there too.
        tab: name of the tab that is open; by default the first.
    """

    def __init__(
        self,
        outline: Outline,
        *,
        all_views: bool = False,
        head: bool = False,
        tab: str | None = None,
    ) -> None:
        self.outline = outline
        self.spec = outline.header.spec
        self._all_views = all_views
        self._head = head
        self._tab = tab
        self._axis = time_axis(outline.end) if outline.end else None
        self._lanes_axis = time_axis(outline.end, lanes=True) if outline.end else None

    def tabs(self, *own: rrb.Container) -> rrb.Blueprint:
        """The layout of a run: tabs of its own, and those of every run."""
        views = [self._views()] if self._all_views else []
        tabs: list[rrb.Container | rrb.View] = [*own, self._modules(), *views, self._table()]
        return blueprint(*tabs, name="Run", length=self.outline.end, tab=self._tab)

    def lines(
        self,
        name: str,
        contents: Sequence[str],
        span: Span | None = None,
        *,
        legend: bool = True,
    ) -> list[rrb.View]:
        """Curves over time, of those contents that the run tells; no view where it tells none."""
        told = [entity for entity in contents if self._is_told(entity)]
        if not told:
            return []
        return [lines(name, told, self._axis, span, legend=legend and self._several(told))]

    def near(self, name: str, contents: Sequence[str]) -> list[rrb.View]:
        """The same of the last frames before the cursor, where the inside of blocks is seen."""
        told, title = [e for e in contents if self._is_told(e)], f"{name}: the last {NEAR} frames"
        if not told:
            return []
        axis = near_axis(NEAR)
        return [lines(title, told, axis, legend=self._several(told), within=near(NEAR))]

    def lanes(self, name: str, *contents: str) -> rrb.View:
        """What was the case when."""
        return rrb.StateTimelineView(
            origin="/", contents=list(contents), name=name, time_view=self._lanes_axis
        )

    def near_lanes(self, name: str, *contents: str) -> rrb.View:
        """The same of the last blocks before the cursor, each of which has its bar."""
        return rrb.StateTimelineView(
            origin="/",
            contents=list(contents),
            name=f"{name}: the last {NEAR_BLOCKS} blocks",
            time_view=near_axis(NEAR_BLOCKS * max(self.outline.tau, 1), room=False),
        )

    def values(self, *names: str) -> NDArray[np.float64]:
        """Values of signals that the outline keeps, one after the other, (n,)."""
        return np.concatenate([self.outline.lines[name] for name in names])

    def _is_told(self, entity: str) -> bool:
        if entity.endswith("/saved") and self.outline.iterations and not self.outline.saved:
            return False
        return (name := _signal(entity)) not in SIGNALS or name in self.outline.told

    def _several(self, contents: Sequence[str]) -> bool:
        """Whether these entities are more than one curve."""
        if len(contents) > 1 or contents[:1] == ["/decision/attention"]:
            return True
        if contents[0].endswith("**"):
            return len(self.spec.streams) > 1
        if contents[:1] == ["/world/truth"]:
            return len(self.spec.truth) > 1
        signal = SIGNALS.get(_signal(contents[0]))
        return signal is None or ("J" in signal.dims and self.outline.outputs > 1)

    def _modules(self) -> rrb.Container:
        """Every module; many stand on pages."""
        count = max(self.outline.modules, len(self.outline.saved))
        rows = [self._module(i) for i in range(1, count + 1)]
        truth = self.near("What the world knows", ["/world/truth"]) if self.spec.truth else []
        learned = events("Events")
        if count <= MOST_MODULES:
            return rrb.Vertical(*rows, *truth, learned, name="Modules")
        pages = [
            rrb.Vertical(*page, name=f"{start + 1} to {start + len(page)}")
            for start in range(0, count, MOST_MODULES)
            if (page := rows[start : start + MOST_MODULES])
        ]
        return rrb.Tabs(*pages, rrb.Vertical(*truth, learned, name="Events"), name="Modules")

    def _module(self, i: int) -> rrb.Container:
        """A module's weights and output; of one that was saved last of all, until its save."""
        saves = [save for save in self.outline.saved if save.module == i]
        stream = f" ({label(self.spec.streams[saves[0].stream])})" if saves else ""
        weights = self.weights(f"/modules/{i}/weights", f"Weights of module {i}{stream}")
        said = f"Output of module {i}{stream}"
        if i <= self.outline.modules:
            entity = [f"/signals/y_frozen/{i}"]
            output = [*self.lines(f"{said} on what was watched", entity), *self.near(said, entity)]
        else:
            end = saves[0].t + self.outline.tau
            axis, legend = time_axis(end, end - NEAR), self.outline.outputs > 1
            title = f"{said}: the last {NEAR} frames until it was saved"
            output = [lines(title, ["/signals/y"], axis, legend=legend)]
        shares = [2, 3, 2] if len(output) > 1 else [2, 5]
        return rrb.Horizontal(weights, *output, column_shares=shares[: 1 + len(output)])

    def _views(self) -> rrb.Container:
        names = self.spec.streams
        places = [(label(name), f"/views/{part(names, s)}") for s, name in enumerate(names)]
        if self.spec.images:
            pictures = [rrb.Spatial2DView(origin=place, name=name) for name, place in places]
            watched = self.lanes("What it mostly watches", f"/{MOSTLY}/{ATTENDS}")
            grid = rrb.Grid(*pictures, grid_columns=min(len(pictures), 3))
            title = "Where the head is turned [degrees to the left]"
            turned = self.lines(title, ["/head/yaw"], legend=False)
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
            looks_for or self.weights("/abstraction/phi", f"What it looks for: {self.of_phi()}"),
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

    def of_phi(self) -> str:
        """What a view of weights is called, and what its colours mean."""
        return "weights φ (blue below 0, red above)" if self.spec.images else "weights φ"

    def now(self) -> rrb.Container:
        """Input, output and weights."""
        output = self.near("Output y", ["/signals/y"])
        kept = f", every {PHI_EVERY} blocks" if self.outline.iterations else ""
        colours = " (blue < 0 < red)" if self.spec.images else ""
        return rrb.Vertical(
            self.watched("Input x"),
            *output,
            self.weights("/abstraction/phi", f"Weights φ{kept}{colours}"),
            row_shares=[3, 2, 3] if output else [3, 3],
        )

    def watched(self, name: str) -> rrb.View | rrb.Container:
        """What the learner was shown: an image with the name of its stream, or the last values."""
        if self.spec.images:
            height, width = self.spec.frame_shape
            below = 0.2 * height  # for the name
            return rrb.Spatial2DView(
                origin="/world/watched",
                name=name,
                visual_bounds=rrb.VisualBounds2D(x_range=(0, width), y_range=(0, height + below)),
            )
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


def events(name: str) -> rrb.View:
    """What happened, in words, with the iteration."""
    return rrb.TextLogView(
        origin="/events",
        name=name,
        columns=rrb.archetypes.TextLogColumns(
            timeline_columns=[ITERATION], text_log_columns=["body"]
        ),
    )


def _signal(entity: str) -> str:
    """Name of the signal that an entity shows."""
    return SHOWS.get(entity) or entity.removeprefix("/signals/").partition("/")[0]


def _values(entity: str) -> Any:
    """The column of an entity's numbers, without those of its style."""
    return rrb.components.ComponentColumnSelector(entity_path=entity, component="Scalars:scalars")
