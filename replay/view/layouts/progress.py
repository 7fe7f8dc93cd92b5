"""The story of the progress learner: what becomes of each stream, and where that is learned."""

from __future__ import annotations

import math

import numpy as np
import rerun.blueprint as rrb
from numpy.typing import NDArray

from replay.view.columns import power_of_ten
from replay.view.labels import label
from replay.view.lanes import ATTENDS, MOSTLY
from replay.view.layouts.panels import Panels
from replay.view.layouts.plots import heights, holding, stacked
from replay.view.run import HARDLY_WATCHED

MOST_WEIGHTS = 3
"""Modules whose weights stand beside one another."""


def progress_layout(panels: Panels) -> list[rrb.Container]:
    """The tabs of a run of the progress learner."""
    return [_overview(panels), _candidate(panels)]


def _overview(panels: Panels) -> rrb.Container:
    streams = len(panels.spec.streams)
    lanes = panels.lanes(
        "What it mostly attends to, and what became of each stream", f"/{MOSTLY}/**", "/state/**"
    )
    error = panels.lines(
        "How well it knows each stream: learning error, where it was watched",
        ["/streams/learning_error/**", "/streams/threshold", "/streams/saved"],
        holding(tested_only(panels, "learning_error"), low=0.0),
    )
    promises = panels.lines(
        f"What each stream promises: interest; {_promised(panels)}",
        ["/streams/interest/**"],
        holding(_watched_enough(panels), low=0.0),
    )
    story = stacked(
        ([lanes], heights(1 + streams)),
        (error, 190),
        (_slowness(panels), 150),
        (panels.looks(), 110),
        (promises, 110),
    )
    sees = panels.sees(_looks_for(panels))
    return rrb.Horizontal(sees, story, column_shares=[2, 5], name="Overview")


def _watched_enough(panels: Panels) -> NDArray[np.float64]:
    """Interest, where that is no number for a stream that was hardly watched."""
    interest = panels.values("interest")
    return interest[interest < HARDLY_WATCHED]


def _promised(panels: Panels) -> str:
    """Why there may be no line."""
    if panels.outline.iterations and not len(_watched_enough(panels)):
        return "no line yet: none was watched long enough"
    return "no line where it was hardly watched"


def tested_only(panels: Panels, name: str) -> NDArray[np.float64]:
    """A signal's values, (n,), where the candidate was tested: those that are drawn."""
    return np.where(np.isnan(panels.values("tested")), np.nan, panels.values(name))


def _looks_for(panels: Panels) -> rrb.Container | None:
    """Weights of the first modules; of a run that has none there are those of now."""
    views = [
        panels.weights(
            f"/modules/{save.module}/weights",
            f"φ {save.module}: {label(panels.spec.streams[save.stream])}",
        )
        for save in panels.outline.saved[:MOST_WEIGHTS]
    ]
    return rrb.Horizontal(*views) if views else None


def _slowness(panels: Panels) -> list[rrb.View]:
    return panels.lines(
        "Slowness on new frames (bright) and on those it learned from (dim), by stream [1/frame]",
        ["/streams/fitted/**", "/streams/tested/**"],
        holding(
            np.concatenate([tested_only(panels, name) for name in ("tested", "fitted")]), low=0.0
        ),
        legend=False,
    )


def _candidate(panels: Panels) -> rrb.Container:
    """What is being learned of the streams."""
    outline = panels.outline
    settled = outline.header.settled
    also = [math.log10(settled[0])] if settled else []
    change = holding(power_of_ten(tested_only(panels, "change")), also=also)
    others = panels.lines("Slowness of each output on new frames [1/frame]", ["/signals/eta"])
    curves = stacked(
        ([panels.lanes("What it mostly attends to", f"/{MOSTLY}/{ATTENDS}")], heights(1)),
        (panels.lines("Output y on new frames, from least to most", ["/signals/y"]), 130),
        (_slowness(panels), 130),
        (others if outline.outputs > 1 else [], 130),
        (
            panels.lines(
                "Change of the output with a block, as powers of ten: settled below the line",
                ["/streams/log_change/**", "/streams/settled"],
                change,
            ),
            130,
        ),
        (panels.lines("Variance of the output on new frames", ["/signals/variance"]), 130),
    )
    return rrb.Horizontal(panels.now(), curves, column_shares=[2, 5], name="Candidate")
