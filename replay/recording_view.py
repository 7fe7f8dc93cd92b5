"""A recording as rows of a Rerun recording: every view at every frame, and the truth."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from foxglove_schemas_protobuf import PoseInFrame_pb2
from google.protobuf import message

from cdmisfa.errors import LogDamagedError, UsageError
from recorder.messages import METADATA, POSE_TOPIC
from replay.columns import Clock, Column, ImageColumn
from replay.config import ViewConfig
from replay.files import log_files
from replay.labels import label, part
from replay.layout import blueprint, lines, whole
from replay.outline import Outline
from replay.palette import colour, packed_all
from replay.reader import LogReader
from replay.recorded import RecordedSource
from replay.runlog import read_signals

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
    recording.send_blueprint(_layout(spec.streams, views, bool(spec.truth), images, first + count))


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

    Where the recording has head poses, `/head/yaw` says where the head was turned.

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
    yaws = head_yaws(path)
    names = outline.names()
    if set(yaws) < set(names):
        return False
    name = rr.SeriesLines(names=["head turned to the left [degrees]"])
    recording.log("head/yaw", name, static=True)
    column = Column(recording, Clock(outline.header.spec), "head/yaw", config.rows)
    for signals in read_signals(log):
        yaw = np.array([[yaws[names[signals.stream]]]])
        column.add(np.array([signals.t]), signals.iteration, yaw)
    column.flush()
    return True


def head_yaws(path: Path) -> dict[str, float]:
    """How far the head is turned in each view of a recording, degrees to the left.

    Returns:
        By the view's name; without the views that do not say it.

    Raises:
        UsageError: there is no such recording.
        LogDamagedError: it cannot be read.
    """
    found: dict[str, float] = {}
    for file in log_files(path):
        with LogReader(file) as reader:
            facts = next((r.values for r in reader.metadata if r.name == METADATA), {})
            entry = next(reader.messages({POSE_TOPIC}), None)
        if entry is None or "view" not in facts:
            continue
        try:
            turn = PoseInFrame_pb2.PoseInFrame.FromString(entry.data).pose.orientation
        except message.DecodeError as error:
            raise LogDamagedError(f"{file} {POSE_TOPIC}: not a foxglove.PoseInFrame") from error
        found[facts["view"]] = math.degrees(2 * math.atan2(turn.z, turn.w))
    return found


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
