"""A recording as rows of a Rerun recording: every view at every frame, and the truth."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from replay.columns import Clock, Column, ImageColumn
from replay.config import ViewConfig
from replay.labels import label, part
from replay.layout import blueprint, lines, whole
from replay.recorded import RecordedSource

BLOCK = 500
"""Frames that are read at once."""


def write_recording(recording: rr.RecordingStream, path: Path, config: ViewConfig) -> None:
    """Write a recording's views and ground truth, and the layout for them.

    Args:
        recording: where they go.
        path: the recording's folder, or a file of one view.
        config: every how many frames images are shown; values are all shown.

    Raises:
        UsageError: there is no such recording.
        LogDamagedError: it cannot be read.
    """
    source = RecordedSource(path)
    try:
        first, count, spec = source.t, source.frames, source.spec
        views = [f"views/{part(spec.streams, s)}" for s in range(len(spec.streams))]
        clock, images = Clock(spec), len(spec.frame_shape) == 2
        columns = [_column(recording, clock, view, spec.frame_shape, config) for view in views]
        truth = Column(recording, clock, "world/truth", config.rows)
        recording.log(
            "world/truth", rr.SeriesLines(names=[label(name) for name in spec.truth]), static=True
        )
        for t in range(first, first + count, BLOCK):
            frames = np.arange(t, min(t + BLOCK, first + count))
            keep = frames % config.every == 0 if images else np.ones(len(frames), dtype=bool)
            for stream, column in enumerate(columns):
                source.seek(t)
                block = source.take(stream, len(frames))
                column.add(frames[keep], None, block.frames[keep])
            if spec.truth:
                truth.add(frames, None, block.truth)
        for column in [*columns, truth]:
            column.flush()
        for warning in source.warnings:
            recording.set_time("frame", sequence=first)
            recording.log("events", rr.TextLog(label(warning), level="WARN"))
    finally:
        source.close()
    properties: dict[str, Any] = {
        "frames": count,
        "streams": label(", ".join(spec.streams)),
        "fps": spec.fps,
    }
    recording.send_property("recording", rr.AnyValues(**properties))
    recording.send_blueprint(_layout(spec.streams, views, bool(spec.truth), images, first + count))


def _column(
    recording: rr.RecordingStream,
    clock: Clock,
    path: str,
    shape: tuple[int, ...],
    config: ViewConfig,
) -> Column:
    if len(shape) == 2:
        column = ImageColumn(recording, clock, path, config.rows)
        column.declare(*shape)
        return column
    names = [f"x{i + 1}" for i in range(int(np.prod(shape)))]
    recording.log(path, rr.SeriesLines(names=names), static=True)
    return Column(recording, clock, path, config.rows)


def _layout(
    names: tuple[str, ...], views: list[str], truth: bool, images: bool, frames: int
) -> rrb.Blueprint:
    axis = whole(frames)
    shown = [
        rrb.Spatial2DView(origin=f"/{view}", name=label(name))
        if images
        else lines(label(name), [f"/{view}"], axis)
        for name, view in zip(names, views, strict=True)
    ]
    known = [lines("What the world knows", ["/world/truth"], axis)] if truth else []
    grid = rrb.Grid(*shown, grid_columns=min(len(shown), 3)) if images else rrb.Vertical(*shown)
    return blueprint(rrb.Vertical(grid, *known, name="Views"), name="Recording")
