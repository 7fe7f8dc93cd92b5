"""The story of CD-MISFA 2.0 and 1.0: what it sees, what it feels, what it decides."""

from __future__ import annotations

import math

import rerun.blueprint as rrb

from replay.runs.run import Outline
from replay.view.columns import power_of_ten
from replay.view.lanes import ATTENDS, DOES, EXPLORES, LEARNS, MOSTLY, NOVELTY
from replay.view.layouts.panels import MOST_MODULES, Panels
from replay.view.layouts.plots import heights, holding, stacked

POWERS_OF_TEN = "as powers of ten"

R_STAY = "/decision/R_stay/**"


def paper_layout(panels: Panels) -> list[rrb.Container]:
    """The tabs of a run of CD-MISFA."""
    return [_overview(panels), _abstraction(panels), _gate(panels), _decision(panels)]


def feels(panels: Panels) -> list[rrb.View]:
    """What comes down until a module is saved."""
    threshold = _clusters_below(panels.outline)
    if threshold is None:
        return _convergence(
            panels,
            "What it feels: η̇ [1/frame], saved below δ, where blocks are novel, of one stream",
        )
    return panels.lines(
        f"What it feels: a module is saved when the clustering error's mean is below {threshold:g}",
        ["/signals/roc_error_inst", "/signals/roc_error"],
    )


def _overview(panels: Panels) -> rrb.Container:
    streams = len(panels.spec.streams)
    lanes = panels.lanes(
        "What it learns, mostly attends to, what is novel, and the policy in each stream",
        f"/{LEARNS}",
        f"/{MOSTLY}/**",
        "/policy/**",
    )
    expects = panels.lines("What it expects: reward R for staying [1/1000]", [R_STAY])
    story = stacked(
        ([lanes], heights(3 + streams)), (panels.looks(), 125), (feels(panels), 190), (expects, 160)
    )
    return rrb.Horizontal(panels.sees(), story, column_shares=[2, 5], name="Overview")


def _abstraction(panels: Panels) -> rrb.Container:
    xi = holding(power_of_ten(panels.values("xi")))
    curves = rrb.Vertical(
        *panels.lines("Output y, from least to most", ["/signals/y"]),
        *panels.lines(
            "Slowness η [1/frame]", ["/signals/eta"], holding(panels.values("eta"), low=0.0)
        ),
        *_convergence(panels, "Change of slowness η̇ [1/frame], and δ"),
        *panels.lines(f"Change of weights ξ, {POWERS_OF_TEN}", ["/abstraction/log_xi"], xi),
        *panels.lines("Recent variance of the output", ["/signals/variance"]),
    )
    return rrb.Horizontal(panels.now(), curves, column_shares=[2, 5], name="Abstraction")


def _gate(panels: Panels) -> rrb.Container:
    verdict = panels.lanes("What it learns, and the verdict", f"/{LEARNS}", f"/{MOSTLY}/**")
    blocks = panels.near_lanes("Verdict on each block", f"/{ATTENDS}", f"/{NOVELTY}")
    threshold = _clusters_below(panels.outline)
    judged = _bands(panels) if threshold is None else _clusters(panels, threshold)
    share = panels.lines("Share of novel blocks", ["/signals/share"], (0.0, 1.05))
    return stacked(
        ([verdict], heights(3)), ([blocks], heights(2)), (judged, 150), (share, 110), name="Gate"
    )


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
    streams = len(panels.spec.streams)
    done = panels.near_lanes("What was done", f"/{ATTENDS}", f"/{DOES}", f"/{EXPLORES}")
    curves = stacked(
        ([panels.lanes("Policy in each stream", "/policy/**")], heights(streams)),
        ([done], heights(3)),
        (panels.lines("Reward R for staying [1/1000]", [R_STAY]), 130),
        (panels.lines("Q of staying minus switching [1/1000]", ["/decision/advantage/**"]), 130),
        (
            panels.lines(
                "Rewards, from least to most",
                [f"/signals/{name}" for name in rewards],
                holding(panels.values(*rewards)),
            ),
            130,
        ),
        (panels.lines("Exploration ε", ["/signals/epsilon"], (0.0, 1.25)), 100),
    )
    table = rrb.TextDocumentView(origin="/decision/table", name="R and Q, every 10 iterations")
    tables = [table] if "R" in panels.outline.told else []
    shares = [5, 2][: 1 + len(tables)]
    return rrb.Horizontal(curves, *tables, column_shares=shares, name="Decision")


def _convergence(panels: Panels, name: str) -> list[rrb.View]:
    """Eta-dot with delta, and the saves."""
    delta = panels.outline.header.delta
    also = [math.log10(delta)] if delta else []
    return panels.lines(
        f"{name}, {POWERS_OF_TEN}",
        ["/abstraction/log_eta_dot", "/abstraction/delta", "/abstraction/saved"],
        holding(power_of_ten(panels.values("eta_dot")), also=also),
    )
