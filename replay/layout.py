"""The viewer's layout, made for a person: what it sees, what it feels, what it decides."""

from __future__ import annotations

import rerun as rr
import rerun.blueprint as rrb

from replay.config import ViewConfig
from replay.outline import Outline

LEGEND = rrb.PlotLegend(visible=True, corner=rrb.Corner2D.RightTop)


def run_layout(outline: Outline, config: ViewConfig) -> rrb.Blueprint:
    """The layout of a run; it adapts to its streams and modules."""
    return rrb.Blueprint(
        rrb.Tabs(
            _overview(outline),
            _abstraction(outline),
            _gate(outline),
            _decision(outline),
            _modules(outline),
            rrb.DataframeView(
                origin="/",
                contents=["/signals/**"],
                name="Table",
                query=rrb.archetypes.DataframeQuery(timeline="iteration", apply_latest_at=True),
            ),
            active_tab=0,
            name="Run",
        ),
        rrb.TimePanel(timeline="frame", state="collapsed", play_state="paused"),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="collapsed"),
        auto_views=False,
        auto_layout=False,
    )


def _overview(outline: Outline) -> rrb.Container:
    sees = rrb.Vertical(
        _watched(outline),
        rrb.TextDocumentView(origin="/summary", name="What happened"),
        row_shares=[2, 3],
    )
    story = rrb.Vertical(
        rrb.StateTimelineView(origin="/lanes", name="What it does"),
        _line(
            "What it feels: change of slowness η̇ - a module is saved below δ",
            ["/signals/eta_dot", "/abstraction/delta", "/abstraction/saved"],
            _above_zero(outline),
        ),
        _line("What it expects: reward R for staying, by stream", ["/decision/R_stay/**"]),
        rrb.StateTimelineView(origin="/policy", name="What it decides: policy by stream"),
        row_shares=[5, 4, 4, 3],
    )
    return rrb.Horizontal(sees, story, column_shares=[2, 5], name="Overview")


def _abstraction(outline: Outline) -> rrb.Container:
    weights = "/abstraction/phi"
    return rrb.Horizontal(
        rrb.Vertical(_watched(outline), _weights(outline, weights, "Weights φ")),
        rrb.Vertical(
            _line("Output y", ["/signals/y"]),
            _line("Slowness η [1/frame]", ["/signals/eta"], outline.span("eta", low=0.0)),
            _line(
                "Change of slowness η̇, and δ",
                ["/signals/eta_dot", "/abstraction/delta", "/abstraction/saved"],
                _above_zero(outline),
            ),
            _line("Change of weights ξ", ["/signals/xi"], outline.span("xi", low=0.0)),
            _line("Recent variance of the output", ["/signals/variance"]),
        ),
        column_shares=[2, 5],
        name="Abstraction",
    )


def _gate(outline: Outline) -> rrb.Container:
    bands = [
        _line(
            f"Slowness in the block by module {i}, and its band of 2 SD",
            [f"/signals/eta_inst_frozen/{i}", f"/gate/band/{i}"],
        )
        for i in range(1, min(outline.modules, 6) + 1)
    ]
    own = [
        _line(
            "Slowness in the block by the abstraction",
            ["/signals/eta_inst", "/signals/gate_mean", "/signals/gate_sd"],
        ),
        _line("Share of novel blocks", ["/signals/share"], (0.0, 1.05)),
    ]
    lanes = rrb.StateTimelineView(
        origin="/lanes",
        contents=["$origin/1_stream", "$origin/2_learning", "$origin/3_gate"],
        name="Verdict",
    )
    return rrb.Vertical(lanes, *bands, *own, name="Gate")


def _decision(outline: Outline) -> rrb.Container:
    return rrb.Horizontal(
        rrb.Vertical(
            rrb.StateTimelineView(origin="/policy", name="Policy by stream"),
            _line("Reward R for staying", ["/decision/R_stay/**"]),
            _line("Value of staying minus switching", ["/decision/advantage/**"]),
            _line(
                "Rewards",
                ["/signals/curiosity", "/signals/expert", "/signals/reward"],
                outline.span("reward", "curiosity", "expert"),
            ),
            _line("Exploration ε", ["/signals/epsilon"], (0.0, 1.25)),
        ),
        rrb.Vertical(
            _heat("/signals/R", "R for staying: stream to next stream", stay=True),
            _heat("/signals/R", "R for switching: stream to next stream", stay=False),
            rrb.TensorView(
                origin="/signals/Q",
                name="Q: stream by action (stay, switch)",
                scalar_mapping=rrb.TensorScalarMapping(colormap="viridis"),
            ),
        ),
        column_shares=[3, 2],
        name="Decision",
    )


def _modules(outline: Outline) -> rrb.Container:
    rows = [
        rrb.Horizontal(
            _weights(
                outline, f"/modules/{save.module}/weights", f"Weights of module {save.module}"
            ),
            _line(f"Output of module {save.module}", [f"/signals/y_frozen/{save.module}"]),
            column_shares=[2, 5],
        )
        for save in outline.saved[:6]
    ]
    truth = [_line("Truth", ["/world/truth"])] if outline.header.spec.truth else []
    return rrb.Vertical(*rows, *truth, name="Modules")


def _watched(outline: Outline) -> rrb.View:
    if len(outline.header.spec.frame_shape) == 2:
        return rrb.Spatial2DView(origin="/world/watched", name="What it sees")
    return rrb.TimeSeriesView(
        origin="/world/watched",
        name="What it sees: the last 500 frames",
        plot_legend=LEGEND,
        time_ranges=[
            rr.VisibleTimeRange(
                "frame",
                start=rr.TimeRangeBoundary.cursor_relative(seq=-500),
                end=rr.TimeRangeBoundary.cursor_relative(),
            )
        ],
    )


def _weights(outline: Outline, path: str, name: str) -> rrb.View:
    if len(outline.header.spec.frame_shape) == 2:
        return rrb.Spatial2DView(origin=path, name=name)
    return rrb.BarChartView(origin=path, name=name)


def _heat(path: str, name: str, *, stay: bool) -> rrb.View:
    return rrb.TensorView(
        origin=path,
        name=name,
        scalar_mapping=rrb.TensorScalarMapping(colormap="viridis"),
        slice_selection=rrb.TensorSliceSelection(
            width=2,
            height=0,
            indices=[rr.TensorDimensionIndexSelection(dimension=1, index=0 if stay else 1)],
        ),
    )


def _line(
    name: str, contents: list[str], span: tuple[float, float] | None = None
) -> rrb.TimeSeriesView:
    axis = rrb.ScalarAxis(range=span) if span is not None else None
    return rrb.TimeSeriesView(
        origin="/", contents=contents, name=name, axis_y=axis, plot_legend=LEGEND
    )


def _above_zero(outline: Outline) -> tuple[float, float] | None:
    """A range for eta-dot in which delta is well above the floor."""
    span = outline.span("eta_dot", low=0.0)
    if span is None or outline.delta is None:
        return span
    return 0.0, min(max(span[1], 2.5 * outline.delta), 12 * outline.delta)
