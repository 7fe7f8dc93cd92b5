"""The first tab: the world, what the learner sees and has learned of it, and what happened."""

from __future__ import annotations

from collections.abc import Sequence

import rerun.blueprint as rrb

from cdmisfa.core.blocks import SourceSpec
from replay.view.labels import label
from replay.view.layouts.panels import NEAR, Panels, events
from replay.view.layouts.plots import lines, near, near_axis
from replay.view.world.first import First
from replay.view.world.scene import SCENE
from replay.view.world.wall import WALL

NAME = "World"

TWO_COLUMNS = 4
"""Modules from which on they stand in two columns."""


def first_tab(panels: Panels, first: First) -> rrb.Container:
    """The first tab of a run's view.

    Args:
        panels: of the run.
        first: what there is to show.
    """
    happened = [
        rrb.TextDocumentView(origin="/summary", name="What came of it"),
        events("What happened when"),
    ]
    sees = panels.watched("What it sees now")
    world = [*([scene_view()] if first.scene else []), *_wall(first)]
    left = rrb.Vertical(*world) if world else sees
    beside = [sees, *happened] if world else happened
    right = rrb.Vertical(*beside, row_shares=[2, 3, 2][-len(beside) :])
    above = rrb.Horizontal(left, right, column_shares=[5, 3])
    rows = _learned(first)
    if not rows:
        return rrb.Vertical(above, name=NAME)
    height = 2 * len(rows)
    return rrb.Vertical(above, *rows, row_shares=[max(5, height), *(2 for _ in rows)], name=NAME)


def tab_of_recording(spec: SourceSpec, views: Sequence[str]) -> rrb.Container:
    """The first tab of a recording: its world, and what each view shows.

    Args:
        spec: of its source.
        views: the entity of each view.
    """
    pictures = [
        rrb.Spatial2DView(origin=f"/{view}", name=label(name))
        for name, view in zip(spec.streams, views, strict=True)
    ]
    return rrb.Horizontal(scene_view(), rrb.Vertical(*pictures), column_shares=[5, 2], name=NAME)


def scene_view() -> rrb.View:
    """The world in 3D, seen from in front of the robot."""
    return rrb.Spatial3DView(
        origin=f"/{SCENE}",
        name="The world, and where it looks",
        line_grid=rrb.LineGrid3D(visible=False),
        eye_controls=rrb.EyeControls3D(
            position=(-1.5, -0.85, 0.72), look_target=(-0.38, 0.0, 0.0), eye_up=(0.0, 0.0, 1.0)
        ),
    )


def _wall(first: First) -> list[rrb.View]:
    if first.wall is None:
        return []
    across, down = first.wall
    return [
        rrb.Spatial2DView(
            origin=f"/{WALL}",
            name="What each stream showed last; the watched one is framed",
            visual_bounds=rrb.VisualBounds2D(x_range=across, y_range=down),
        )
    ]


def _learned(first: First) -> list[rrb.View | rrb.Container]:
    """A panel for each module: its output over what it follows."""
    axis = near_axis(NEAR)
    shown: list[rrb.View | rrb.Container] = []
    for lesson in first.lessons:
        low, high = lesson.span
        margin = 0.1 * (high - low) or 1.0
        span = (low - margin, high + margin)
        shown.append(
            lines(
                f"{lesson.title}: the last {NEAR} frames",
                list(lesson.entities),
                axis,
                span,
                within=near(NEAR),
            )
        )
    if len(shown) < TWO_COLUMNS:
        return shown
    return [rrb.Horizontal(*shown[i : i + 2]) for i in range(0, len(shown), 2)]
