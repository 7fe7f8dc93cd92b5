"""The story of the progress learner: what becomes of each stream, and where that is learned."""

from __future__ import annotations

import rerun.blueprint as rrb

from replay.view.labels import label
from replay.view.layouts.panels import Panels, heights, stacked

MOST_WEIGHTS = 3
"""Modules whose weights stand beside one another."""

HARDLY_WATCHED = 1000.0
"""Interest from which on a stream promises most because it was hardly watched."""

FALL = 10
"""Times the threshold of a change that its panel shows."""

UNTESTED = 3.0
"""Learning error that stands for none, before anything was tested."""


def progress_layout(panels: Panels) -> rrb.Blueprint:
    """The tabs of a run of the progress learner."""
    return panels.tabs(_overview(panels), _candidate(panels))


def _overview(panels: Panels) -> rrb.Container:
    lanes = panels.lanes(
        "What it watches, and what became of each stream", "/lanes/1_stream", "/streams/state/**"
    )
    error = panels.lines(
        "How well it knows each stream: learning error, where it was watched",
        ["/streams/learning_error/**", "/streams/threshold", "/streams/saved"],
        panels.outline.span("learning_error", low=0.0, below=UNTESTED),
    )
    interest = panels.lines(
        "What each stream promises: interest; above the panel where it was hardly watched",
        ["/streams/interest/**"],
        panels.outline.span("interest", low=0.0, below=HARDLY_WATCHED),
    )
    story = stacked(
        ([lanes], heights(1 + len(panels.spec.streams))),
        (error, 190),
        (_slowness(panels), 150),
        (panels.looks(), 110),
        (interest, 110),
    )
    sees = panels.sees(_looks_for(panels))
    return rrb.Horizontal(sees, story, column_shares=[2, 5], name="Overview")


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
        "Slowness on new frames (bright) and on those it learned from (dim) [1/frame]",
        ["/streams/fitted/**", "/streams/tested/**"],
        panels.outline.span("tested", "fitted", low=0.0),
    )


def _candidate(panels: Panels) -> rrb.Container:
    """What is being learned of the streams."""
    outline = panels.outline
    change, settled = outline.span("change", low=0.0), outline.header.settled
    if change is not None and settled is not None:
        change = 0.0, min(max(change[1], 2.5 * settled[0]), FALL * settled[0])
    others = panels.lines("Slowness of each output on new frames [1/frame]", ["/signals/eta"])
    curves = stacked(
        ([panels.lanes("What it watches", "/lanes/1_stream")], heights(1)),
        (panels.lines("Output y on new frames", ["/signals/y"]), 130),
        (_slowness(panels), 130),
        (others if outline.outputs > 1 else [], 130),
        (
            panels.lines(
                "Change of the output with a block: settled below the line",
                ["/streams/change/**", "/streams/settled"],
                change,
            ),
            130,
        ),
        (panels.lines("Variance of the output on new frames", ["/signals/variance"]), 130),
    )
    return rrb.Horizontal(
        panels.now("Weights φ of its candidate; white: it has none"),
        curves,
        column_shares=[2, 5],
        name="Candidate",
    )
