"""The viewer's layout, made for a person: what it sees, what it feels, what it decides."""

from __future__ import annotations

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
HEAT = rrb.TensorScalarMapping(colormap="viridis")
FIT = rrb.components.ViewFit.Fill

MOST_STREAMS = 16
"""Streams with lines and lanes of their own: the most watched ones."""

MANY = 6
"""With more streams than this the share of each is small, and drawn larger."""

LANE = 35
"""Height of a lane, beside plots of 100 to 200."""

MOST_LANES = 9
"""Lanes that get their full height; more are scrolled."""

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


class RunLayout:
    """The layout of a run; it adapts to its streams and modules.

    Args:
        outline: the run in short.
        all_views: what was not watched is there too.
        head: where the head was turned is there too.
    """

    def __init__(self, outline: Outline, *, all_views: bool = False, head: bool = False) -> None:
        self._outline = outline
        self._all_views = all_views
        self._head = head
        self._spec = outline.header.spec
        self._axis = time_axis(outline.frames) if outline.frames else None
        self._images = self._spec.images

    def blueprint(self) -> rrb.Blueprint:
        """The layout, ready to be sent."""
        table = rrb.DataframeView(
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
        return blueprint(
            self._overview(),
            self._abstraction(),
            self._gate(),
            self._decision(),
            self._modules(),
            *([self._views()] if self._all_views else []),
            table,
            name="Run",
        )

    def _entities(self) -> list[str]:
        """Entities of the table's columns: the signals in the record's order."""
        modules = range(1, max(self._outline.modules, 1) + 1)
        found: list[str] = []
        for signal in SIGNALS.values():
            if signal.name not in TIMELINE_SIGNALS and signal.show != "heat":
                parts = [f"/{i}" for i in modules] if signal.dims.startswith("M") else [""]
                found += [f"/signals/{signal.name}{part}" for part in parts]
        return found

    def _overview(self) -> rrb.Container:
        sees = rrb.Vertical(
            self._watched("What it sees"),
            rrb.TextDocumentView(origin="/summary", name="What happened"),
            self._weights("/abstraction/phi", "What it looks for: weights φ"),
            row_shares=[3, 6, 3],
        )
        story = rrb.Vertical(
            self._lanes(
                "What it does, and decides: the policy in each stream", "/lanes/**", "/policy/**"
            ),
            self._lines(
                "Where it looks: share of the last 50 blocks",
                ["/decision/attention"],
                (0.0, 1.05) if len(self._spec.streams) <= MANY else None,
            ),
            self._feels(),
            self._lines("What it expects: reward R for staying", ["/decision/R_stay/**"]),
            row_shares=[_heights(5 + len(self._spec.streams)), 125, 190, 125],
        )
        return rrb.Horizontal(sees, story, column_shares=[2, 5], name="Overview")

    def _feels(self) -> rrb.View:
        """What comes down until a module is saved."""
        threshold = self._clusters_below()
        if threshold is None:
            return self._convergence(
                "What it feels: η̇ below δ, nearly all blocks novel: a module is saved"
            )
        return self._lines(
            f"What it feels: a module is saved when the clustering error's mean is below "
            f"{threshold:g}",
            ["/signals/roc_error_inst", "/signals/roc_error"],
        )

    def _abstraction(self) -> rrb.Container:
        span = self._outline.span
        curves = rrb.Vertical(
            self._lines("Output y", ["/signals/y"]),
            self._lines("Slowness η [1/frame]", ["/signals/eta"], span("eta", low=0.0)),
            self._convergence("Change of slowness η̇, and δ"),
            self._lines("Change of weights ξ", ["/signals/xi"], span("xi", low=0.0)),
            self._lines("Recent variance of the output", ["/signals/variance"]),
        )
        now = rrb.Vertical(
            self._watched("Input x"),
            self._weights("/abstraction/phi", "Weights φ"),
            row_shares=[2, 3],
        )
        return rrb.Horizontal(now, curves, column_shares=[2, 5], name="Abstraction")

    def _gate(self) -> rrb.Container:
        verdict = self._lanes("Verdict", "/lanes/1_stream", "/lanes/2_learning", "/lanes/3_gate")
        threshold = self._clusters_below()
        if threshold is not None:
            return rrb.Vertical(verdict, *self._clusters(threshold), name="Gate")
        bands = [
            self._lines(
                f"Slowness in the block by module {i}: known within the band of 2 SD",
                [f"/signals/eta_inst_frozen/{i}", f"/gate/band/{i}"],
            )
            for i in range(1, min(self._outline.modules, MOST_MODULES) + 1)
        ]
        own = self._lines(
            "Slowness in the block by the abstraction, its mean and SD",
            ["/signals/eta_inst", "/signals/gate_mean", "/signals/gate_sd"],
        )
        return rrb.Vertical(verdict, *bands, own, self._share(), name="Gate")

    def _clusters_below(self) -> float | None:
        """The clustering error below which CD-MISFA 1.0 saves and knows; None of 2.0."""
        value = self._outline.header.setting("learner", "roc_error")
        is_old = self._outline.header.setting("learner", "algorithm") == "1.0"
        return float(value) if is_old and isinstance(value, int | float) else None

    def _clusters(self, threshold: float) -> list[rrb.View]:
        """The gate of CD-MISFA 1.0: clusters instead of bands of slowness."""
        modules = [
            self._lines(
                f"Clustering error by module {i}: known below {threshold:g}",
                [f"/signals/roc_error_frozen/{i}"],
            )
            for i in range(1, min(self._outline.modules, MOST_MODULES) + 1)
        ]
        own = self._lines(
            f"Clustering error of the block, and its mean: saved below {threshold:g}",
            ["/signals/roc_error_inst", "/signals/roc_error"],
        )
        return [*modules, own, self._share()]

    def _share(self) -> rrb.View:
        return self._lines("Share of novel blocks", ["/signals/share"], (0.0, 1.05))

    def _decision(self) -> rrb.Container:
        rewards = ["curiosity", "expert", "reward"]
        curves = rrb.Vertical(
            self._lanes(
                "Policy in each stream, and what was done",
                "/policy/**",
                "/lanes/4_action",
                "/lanes/5_chosen_by",
            ),
            self._lines("Reward R for staying", ["/decision/R_stay/**"]),
            self._lines("Value Q of staying minus switching", ["/decision/advantage/**"]),
            self._lines(
                "Rewards",
                [f"/signals/{name}" for name in rewards],
                self._outline.span(*rewards),
            ),
            self._lines("Exploration ε", ["/signals/epsilon"], (0.0, 1.25)),
            row_shares=[_heights(2 + len(self._spec.streams)), 130, 130, 130, 100],
        )
        heat = rrb.Vertical(
            _reward(0, "R for staying: from stream (down) to stream (across)"),
            _reward(1, "R for switching: from stream (down) to stream (across)"),
            rrb.TensorView(
                origin="/decision/Q_beside_mean",
                name="Q less its mean: stream (down), stay and switch (across)",
                scalar_mapping=HEAT,
                view_fit=FIT,
            ),
        )
        return rrb.Horizontal(curves, heat, column_shares=[5, 2], name="Decision")

    def _modules(self) -> rrb.Container:
        rows = [
            rrb.Horizontal(
                self._weights(f"/modules/{i}/weights", f"Weights of module {i}"),
                self._lines(
                    f"Output of module {i} on what was watched", [f"/signals/y_frozen/{i}"]
                ),
                column_shares=[2, 5],
            )
            for i in range(1, min(self._outline.modules, MOST_MODULES) + 1)
        ]
        truth = [self._lines("What the world knows", ["/world/truth"])] if self._spec.truth else []
        learned = rrb.TextLogView(
            origin="/events",
            name="Events",
            columns=rrb.archetypes.TextLogColumns(
                timeline_columns=[FRAME, ITERATION], text_log_columns=["loglevel", "body"]
            ),
        )
        return rrb.Vertical(*rows, *truth, learned, name="Modules")

    def _views(self) -> rrb.Container:
        names = self._spec.streams
        places = [(label(name), f"/views/{part(names, s)}") for s, name in enumerate(names)]
        if self._images:
            pictures = [rrb.Spatial2DView(origin=place, name=name) for name, place in places]
            watched = self._lanes("What it watches", "/lanes/1_stream")
            grid = rrb.Grid(*pictures, grid_columns=min(len(pictures), 3))
            turned = self._lines("Where the head is turned", ["/head/yaw"])
            looks = rrb.Horizontal(turned, gaze("Where it looks"), column_shares=[2, 1])
            head = [looks] if self._head else []
            shares = [3, 1, *(2 for _ in head)]
            return rrb.Vertical(grid, watched, *head, row_shares=shares, name="All views")
        curves = [self._lines(name, [place]) for name, place in places]
        return rrb.Vertical(*curves, name="All views")

    def _watched(self, name: str) -> rrb.View:
        if self._images:
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

    def _weights(self, path: str, name: str) -> rrb.View:
        if self._images:
            return rrb.Spatial2DView(origin=path, name=name)
        return rrb.BarChartView(origin=path, name=name, plot_legend=rrb.PlotLegend(visible=False))

    def _convergence(self, name: str) -> rrb.View:
        """Eta-dot with delta well above the floor, and the saves."""
        span, delta = self._outline.span("eta_dot", low=0.0), self._outline.header.delta
        if span is not None and delta is not None:
            span = 0.0, min(max(span[1], 2.5 * delta), 8 * delta)
        return self._lines(
            name, ["/signals/eta_dot", "/abstraction/delta", "/abstraction/saved"], span
        )

    def _lanes(self, name: str, *contents: str) -> rrb.View:
        return rrb.StateTimelineView(
            origin="/", contents=list(contents), name=name, time_view=self._axis
        )

    def _lines(self, name: str, contents: list[str], span: Span | None = None) -> rrb.View:
        return lines(name, contents, self._axis, span)


def _values(entity: str) -> Any:
    """The column of an entity's numbers, without those of its style."""
    return rrb.components.ComponentColumnSelector(entity_path=entity, component="Scalars:scalars")


def _heights(lanes: int) -> int:
    """Height of a panel of lanes, with its title and axis."""
    return 60 + LANE * min(lanes, MOST_LANES)


def _reward(action: int, name: str) -> rrb.View:
    selection = rrb.TensorSliceSelection(
        width=2,
        height=0,
        indices=[rr.TensorDimensionIndexSelection(dimension=1, index=action)],
    )
    return rrb.TensorView(
        origin="/signals/R",
        name=name,
        scalar_mapping=HEAT,
        slice_selection=selection,
        view_fit=FIT,
    )
