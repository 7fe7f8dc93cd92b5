"""The story of CD-MISFA 2.0 and 1.0: what it sees, what it feels, what it decides."""

from __future__ import annotations

import rerun as rr
import rerun.blueprint as rrb

from replay.runs.outline import Outline
from replay.view.layouts.panels import MOST_MODULES, Panels, heights, stacked

HEAT = rrb.TensorScalarMapping(colormap="viridis")
FIT = rrb.components.ViewFit.Fill


def paper_layout(panels: Panels) -> rrb.Blueprint:
    """The tabs of a run of CD-MISFA."""
    return panels.tabs(_overview(panels), _abstraction(panels), _gate(panels), _decision(panels))


def feels(panels: Panels) -> list[rrb.View]:
    """What comes down until a module is saved."""
    threshold = _clusters_below(panels.outline)
    if threshold is None:
        return _convergence(
            panels, "What it feels: η̇ below δ, blocks novel and of one stream: a module is saved"
        )
    return panels.lines(
        f"What it feels: a module is saved when the clustering error's mean is below {threshold:g}",
        ["/signals/roc_error_inst", "/signals/roc_error"],
    )


def _overview(panels: Panels) -> rrb.Container:
    lanes = panels.lanes(
        "What it does, and decides: the policy in each stream", "/lanes/**", "/policy/**"
    )
    expects = panels.lines("What it expects: reward R for staying", ["/decision/R_stay/**"])
    story = stacked(
        ([lanes], heights(5 + len(panels.spec.streams))),
        (panels.looks(), 125),
        (feels(panels), 190),
        (expects, 125),
    )
    return rrb.Horizontal(panels.sees(), story, column_shares=[2, 5], name="Overview")


def _abstraction(panels: Panels) -> rrb.Container:
    span = panels.outline.span
    curves = rrb.Vertical(
        *panels.lines("Output y", ["/signals/y"]),
        *panels.lines("Slowness η [1/frame]", ["/signals/eta"], span("eta", low=0.0)),
        *_convergence(panels, "Change of slowness η̇, and δ"),
        *panels.lines("Change of weights ξ", ["/signals/xi"], span("xi", low=0.0)),
        *panels.lines("Recent variance of the output", ["/signals/variance"]),
    )
    return rrb.Horizontal(panels.now(), curves, column_shares=[2, 5], name="Abstraction")


def _gate(panels: Panels) -> rrb.Container:
    verdict = panels.lanes("Verdict", "/lanes/1_stream", "/lanes/2_learning", "/lanes/3_gate")
    threshold = _clusters_below(panels.outline)
    judged = _bands(panels) if threshold is None else _clusters(panels, threshold)
    share = panels.lines("Share of novel blocks", ["/signals/share"], (0.0, 1.05))
    return rrb.Vertical(verdict, *judged, *share, name="Gate")


def _bands(panels: Panels) -> list[rrb.View]:
    """The gate of CD-MISFA 2.0: bands of slowness."""
    found: list[rrb.View] = []
    for i in _modules(panels.outline):
        found += panels.lines(
            f"Slowness in the block by module {i}: known within the band of 2 SD",
            [f"/signals/eta_inst_frozen/{i}", f"/gate/band/{i}"],
        )
    return found + panels.lines(
        "Slowness in the block by the abstraction, its mean and SD",
        ["/signals/eta_inst", "/signals/gate_mean", "/signals/gate_sd"],
    )


def _clusters(panels: Panels, threshold: float) -> list[rrb.View]:
    """The gate of CD-MISFA 1.0: clusters instead of bands of slowness."""
    found: list[rrb.View] = []
    for i in _modules(panels.outline):
        found += panels.lines(
            f"Clustering error by module {i}: known below {threshold:g}",
            [f"/signals/roc_error_frozen/{i}"],
        )
    return found + panels.lines(
        f"Clustering error of the block, and its mean: saved below {threshold:g}",
        ["/signals/roc_error_inst", "/signals/roc_error"],
    )


def _modules(outline: Outline) -> range:
    return range(1, min(outline.modules, MOST_MODULES) + 1)


def _clusters_below(outline: Outline) -> float | None:
    """The clustering error below which CD-MISFA 1.0 saves and knows; None of 2.0."""
    value = outline.header.setting("learner", "roc_error")
    is_old = outline.header.setting("learner", "algorithm") == "1.0"
    return float(value) if is_old and isinstance(value, int | float) else None


def _decision(panels: Panels) -> rrb.Container:
    rewards = ["curiosity", "expert", "reward"]
    lanes = panels.lanes(
        "Policy in each stream, and what was done",
        "/policy/**",
        "/lanes/4_action",
        "/lanes/5_chosen_by",
    )
    curves = stacked(
        ([lanes], heights(2 + len(panels.spec.streams))),
        (panels.lines("Reward R for staying", ["/decision/R_stay/**"]), 130),
        (panels.lines("Value Q of staying minus switching", ["/decision/advantage/**"]), 130),
        (
            panels.lines(
                "Rewards", [f"/signals/{name}" for name in rewards], panels.outline.span(*rewards)
            ),
            130,
        ),
        (panels.lines("Exploration ε", ["/signals/epsilon"], (0.0, 1.25)), 100),
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


def _convergence(panels: Panels, name: str) -> list[rrb.View]:
    """Eta-dot with delta well above the floor, and the saves."""
    outline = panels.outline
    span, delta = outline.span("eta_dot", low=0.0), outline.header.delta
    if span is not None and delta is not None:
        span = 0.0, min(max(span[1], 2.5 * delta), 8 * delta)
    return panels.lines(
        name, ["/signals/eta_dot", "/abstraction/delta", "/abstraction/saved"], span
    )


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
