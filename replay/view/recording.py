"""A recording as rows of a Rerun recording: every view at every frame, and the truth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from cdmisfa.core.blocks import HeadPose
from cdmisfa.core.errors import UsageError
from replay.palette import colour, packed_all
from replay.recordings.poses import head_poses, yaw_of
from replay.recordings.source import RecordedSource
from replay.runs.outline import Outline
from replay.runs.stretches import read_columns
from replay.view.columns import Clock, Column, ImageColumn
from replay.view.config import ViewConfig
from replay.view.labels import label, part
from replay.view.layout import blueprint, gaze, lines, whole

POSES = "head/poses"
WATCHING = "head/poses/watching"

REACH = 0.25
"""Length of the arrow along a gaze, in metres."""

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
        views = write_views(recording, source, count, config)
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
    images = len(spec.frame_shape) == 2
    poses = head_poses(path)
    if head := set(poses) >= set(spec.streams):
        write_heads(recording, spec.streams, poses)
    panels = Panels(truth=bool(spec.truth), images=images, head=head)
    recording.send_blueprint(_layout(spec.streams, views, panels, first + count))


def write_views(
    recording: rr.RecordingStream,
    source: RecordedSource,
    count: int,
    config: ViewConfig,
    tau: int | None = None,
) -> list[str]:
    """Write every view of a recording, and what the world knows, from the source's t on.

    Args:
        recording: where they go.
        source: the recording.
        count: how many frames.
        config: every how many frames images are shown.
        tau: frames of an iteration, for the views of a run, whose truth is there already.

    Returns:
        The entity of each view.
    """
    first, spec = source.t, source.spec
    views = [f"views/{part(spec.streams, s)}" for s in range(len(spec.streams))]
    clock, images = Clock(spec), len(spec.frame_shape) == 2
    columns = [_column(recording, clock, view, spec.frame_shape, config) for view in views]
    truth = Column(recording, clock, "world/truth", config.rows)
    if spec.truth and tau is None:
        names = [label(name) for name in spec.truth]
        shades = packed_all([colour(i) for i in range(len(names))])
        recording.log("world/truth", rr.SeriesLines(names=names, colors=shades), static=True)
    for t in range(first, first + count, BLOCK):
        frames = np.arange(t, min(t + BLOCK, first + count))
        keep = frames % config.every == 0 if images else np.ones(len(frames), dtype=bool)
        for stream, column in enumerate(columns):
            source.seek(t)
            block = source.take(stream, len(frames))
            column.add(
                frames[keep], None if tau is None else frames[keep] // tau, block.frames[keep]
            )
        if spec.truth and tau is None:
            truth.add(frames, None, block.truth)
    for column in [*columns, truth]:
        column.flush()
    return views


def write_unwatched(
    recording: rr.RecordingStream, log: Path, path: Path, outline: Outline, config: ViewConfig
) -> bool:
    """Write all views of the recording that a run learned from, also while not watched.

    Where the recording has head poses, `/head/yaw` says where the head was turned, and
    `/head/poses` shows it.

    Returns:
        Whether there is a head.

    Raises:
        UsageError: the run learned from another recording, or from a live scene.
        LogDamagedError: it cannot be read.
    """
    learned_from = outline.header.manifest.get("source")
    source = RecordedSource(path, loop=True)
    try:
        if _hashes(source.describe()) != _hashes(learned_from) or not _hashes(learned_from):
            raise UsageError(
                f"{path} is not the recording that this run learned from: the SHA-256 of its "
                "files are others"
            )
        write_views(recording, source, outline.frames, config, max(outline.tau, 1))
    finally:
        source.close()
    poses = head_poses(path)
    names = outline.names()
    if set(poses) < set(names):
        return False
    write_heads(recording, names, poses)
    name = rr.SeriesLines(names=["head turned to the left [degrees]"])
    recording.log("head/yaw", name, static=True)
    clock = Clock(outline.header.spec)
    column = Column(recording, clock, "head/yaw", config.rows)
    watching = -1
    for columns in read_columns(log, outline.header):
        yaws = np.array([yaw_of(poses[name]) for name in names])[columns["stream"]]
        column.add(columns.frames, columns.iterations, yaws[:, None])
        streams = columns["stream"].astype(np.int64)
        turns = np.flatnonzero(np.diff(streams, prepend=watching))
        times = clock.columns(columns.frames[turns], columns.iterations[turns])
        watched = [poses[names[s]] for s in streams[turns]]
        if watched:
            turned = rr.Transform3D.columns(
                translation=[pose.position for pose in watched],
                quaternion=[pose.quaternion for pose in watched],
            )
            recording.send_columns(WATCHING, times, turned)
        watching = int(streams[-1])
    column.flush()
    white = packed_all([(255, 255, 255)])
    arrow = rr.Arrows3D(vectors=[[-1.4 * REACH, 0, 0]], radii=[0.003], colors=white)
    recording.log(WATCHING, arrow, static=True)
    return True


def write_heads(
    recording: rr.RecordingStream, names: Sequence[str], poses: Mapping[str, HeadPose]
) -> None:
    """Show in 3D where the head looks for each view: an arrow along its gaze.

    Poses are in the robot's root frame: x to the back, y to the right, z up.
    """
    recording.log(POSES, rr.ViewCoordinates.BRU, static=True)
    for s, name in enumerate(names):
        place, pose = f"{POSES}/{part(names, s)}", poses[name]
        turn = rr.Quaternion(xyzw=pose.quaternion)
        recording.log(
            place, rr.Transform3D(translation=pose.position, quaternion=turn), static=True
        )
        arrow = rr.Arrows3D(
            vectors=[[-REACH, 0, 0]],
            radii=[0.005],
            colors=packed_all([colour(s)]),
            labels=[label(name)],
        )
        recording.log(place, arrow, static=True)


def _hashes(described: Any) -> list[str]:
    views = described.get("views", ()) if isinstance(described, Mapping) else ()
    return [str(view["sha256"]) for view in views if "sha256" in view]


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
    shades = packed_all([colour(i) for i in range(len(names))])
    recording.log(path, rr.SeriesLines(names=names, colors=shades), static=True)
    return Column(recording, clock, path, config.rows)


@dataclass(frozen=True, slots=True)
class Panels:
    """What there is to be shown of a recording beside its views."""

    truth: bool
    images: bool
    head: bool


def _layout(names: tuple[str, ...], views: list[str], panels: Panels, frames: int) -> rrb.Blueprint:
    axis = whole(frames)
    shown = [
        rrb.Spatial2DView(origin=f"/{view}", name=label(name))
        if panels.images
        else lines(label(name), [f"/{view}"], axis)
        for name, view in zip(names, views, strict=True)
    ]
    known = [lines("What the world knows", ["/world/truth"], axis)] if panels.truth else []
    head = [gaze("Where the head looks")] if panels.head else []
    below = [rrb.Horizontal(*known, *head, column_shares=[3, 1][: len([*known, *head])])]
    columns = min(len(shown), 3)
    grid = rrb.Grid(*shown, grid_columns=columns) if panels.images else rrb.Vertical(*shown)
    return blueprint(
        rrb.Vertical(grid, *(below if known or head else []), name="Views"), name="Recording"
    )
