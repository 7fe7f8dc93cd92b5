"""A recording as rows of a Rerun recording: every view at every frame, and the truth."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from cdmisfa.core.blocks import SourceSpec
from cdmisfa.core.errors import UsageError
from replay.camera_logs.options import CameraOptions
from replay.inputs import Logged, open_to_look
from replay.recordings.poses import head_poses
from replay.recordings.source import RecordedSource
from replay.runs.columns import Blocks
from replay.runs.run import Outline, stated_source, states_whole
from replay.view.columns import FRAME, frames_column, line_column
from replay.view.heads import gaze, write_gaze, write_heads
from replay.view.labels import label, part
from replay.view.layouts.first import tab_of_recording
from replay.view.layouts.plots import blueprint, lines, time_axis
from replay.view.world.known import world_of_recording
from replay.view.world.scene import SceneView

BLOCK = 500
"""Frames that are read at once."""


def write_recording(
    recording: rr.RecordingStream,
    paths: Sequence[Path],
    every: int,
    tab: str | None = None,
    cameras: CameraOptions | None = None,
) -> None:
    """Write a recording's views and ground truth, and the layout for them.

    Args:
        recording: where they go.
        paths: the recording's folder, or files of its views; or camera logs of others.
        every: show images of every this many frames; values are all shown.
        tab: name of the tab that is open.
        cameras: which streams of camera logs; by default all of images.

    Raises:
        UsageError: there is no such recording or tab.
        LogDamagedError: it cannot be read.
    """
    with contextlib.closing(open_to_look(paths, cameras)) as source:
        first, count, spec = source.t, source.frames, source.spec
        ours = isinstance(source, RecordedSource)
        scenery = world_of_recording(paths[0]) if ours else None
        scene = None if scenery is None else SceneView(recording, spec, scenery)
        notes = [*source.warnings]
        if scene is not None and (missing := scene.stand()) is not None:
            notes.append(missing)
        write_views(recording, source, count, every, scene=scene)
        for note in notes:
            recording.set_time(FRAME, sequence=first)
            recording.log("events", rr.TextLog(label(note), level="WARN"))
    properties: dict[str, Any] = {
        "frames": count,
        "streams": label(", ".join(spec.streams)),
        "fps": spec.fps,
    }
    recording.send_property("recording", rr.AnyValues(**properties))
    poses = {name: pose for p in paths for name, pose in head_poses(p).items()} if ours else {}
    head = write_heads(recording, spec.streams, poses)
    layout = recording_layout(spec, first + count, head=head, scene=scene is not None, tab=tab)
    recording.send_blueprint(layout)


def write_views(
    recording: rr.RecordingStream,
    source: Logged,
    count: int,
    every: int,
    blocks: Blocks | None = None,
    scene: SceneView | None = None,
) -> None:
    """Write every view of a recording, and what the world knows, from the source's t on.

    Args:
        recording: where they go.
        source: the recording.
        count: how many frames.
        every: show images of every this many frames.
        blocks: of a run, for its views; its truth is there already.
        scene: where what the world knows is shown, too.
    """
    first, spec = source.t, source.spec
    columns = [frames_column(recording, spec, view) for view in view_entities(spec)]
    truth = None
    if spec.truth and blocks is None:
        truth = line_column(recording, spec, "world/truth", spec.truth, every_frame=True)
    for t in range(first, first + count, BLOCK):
        stop = min(t + BLOCK, first + count)
        for stream, column in enumerate(columns):
            for low, high in source.spans(stream, t, stop):
                source.seek(low)
                block = source.take(stream, high - low)
                frames = np.arange(low, high)
                keep = frames % (every if spec.images else 1) == 0
                iterations = None if blocks is None else blocks.iteration(frames[keep])
                column.add(frames[keep], iterations, block.frames[keep])
                if truth is not None and stream == 0:
                    truth.add(frames, None, block.truth)
                if scene is not None and stream == 0:
                    scene.move(frames[keep], block.truth[keep])
    for column in [*columns, *([truth] if truth is not None else [])]:
        column.flush()
    if scene is not None:
        scene.flush()


def write_unwatched(
    recording: rr.RecordingStream, path: Path, log: Path, outline: Outline, every: int
) -> bool:
    """Write all views of the recording that a run learned from, also while not watched.

    Where the recording has head poses, they say where the head was turned.

    Returns:
        Whether there is a head.

    Raises:
        UsageError: the run learned from another recording, or from a live scene.
        LogDamagedError: it cannot be read.
    """
    learned_from = stated_source(log)
    with contextlib.closing(RecordedSource(path, loop=True)) as source:
        whole = states_whole(learned_from)
        described = source.describe() if whole else source.describe_at_once()
        if _hashes(described) != _hashes(learned_from) or not _hashes(learned_from):
            raise UsageError(
                f"{path} is not the recording that this run learned from: the SHA-256 of its "
                "files are others"
            )
        write_views(recording, source, outline.end - source.t, every, outline.blocks)
    poses = head_poses(path)
    if not write_heads(recording, outline.names(), poses):
        return False
    write_gaze(recording, outline, poses)
    return True


def _hashes(described: Any) -> list[str]:
    """What tells the files of views from others: the SHA-256 of all of each, or of its sample."""
    views = described.get("views", ()) if isinstance(described, Mapping) else ()
    found = (view.get("sha256", view.get("sample_sha256")) for view in views)
    return [str(known) for known in found if known is not None]


def view_entities(spec: SourceSpec) -> list[str]:
    """The entity of each view."""
    return [f"views/{part(spec.streams, s)}" for s in range(len(spec.streams))]


def recording_layout(
    spec: SourceSpec,
    frames: int,
    *,
    head: bool = False,
    scene: bool = False,
    tab: str | None = None,
) -> rrb.Blueprint:
    """The tabs of a recording: its world, where there is one, its views, and what is known.

    Args:
        spec: of its source.
        frames: where it ends.
        head: where the head looks is there.
        scene: so is the world in 3D.
        tab: name of the one that is open.
    """
    axis = time_axis(frames)
    shown = [
        rrb.Spatial2DView(origin=f"/{view}", name=label(name))
        if spec.images
        else lines(label(name), [f"/{view}"], axis)
        for name, view in zip(spec.streams, view_entities(spec), strict=True)
    ]
    grid = (
        rrb.Grid(*shown, grid_columns=min(len(shown), 3)) if spec.images else rrb.Vertical(*shown)
    )
    known = [lines("What the world knows", ["/world/truth"], axis)] if spec.truth else []
    looks = [gaze("Where the head looks")] if head else []
    beside = [*known, *looks]
    below = [rrb.Horizontal(*beside, column_shares=[3, 1][: len(beside)])] if beside else []
    world = [tab_of_recording(spec, view_entities(spec))] if scene else []
    views = rrb.Vertical(grid, *below, name="Views")
    return blueprint(*world, views, name="Recording", length=frames, tab=tab)
