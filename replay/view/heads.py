"""The head's poses in 3D: where it looks for each view, and where it looked in a run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from cdmisfa.core.blocks import HeadPose
from replay.palette import colour, packed_all, pale
from replay.recordings.poses import yaw_of
from replay.runs.run import Outline
from replay.view.columns import line_column, time_columns
from replay.view.labels import label, part

POSES = "head/poses"
WATCHING = "head/poses/watching"
YAW = "head/yaw"

REACH = 0.25
"""Length of the arrow along a gaze, in metres."""


def write_heads(
    recording: rr.RecordingStream, names: Sequence[str], poses: Mapping[str, HeadPose]
) -> bool:
    """Show in 3D where the head looks for each view: an arrow along its gaze.

    Poses are in the robot's root frame: x to the back, y to the right, z up.

    Returns:
        Whether there is a pose for every view; otherwise nothing is shown.
    """
    if not set(poses) >= set(names):
        return False
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
    return True


def write_gaze(
    recording: rr.RecordingStream, outline: Outline, poses: Mapping[str, HeadPose]
) -> None:
    """Show where a run turned the head: `/head/yaw` in degrees, and an arrow in 3D."""
    spec, blocks = outline.header.spec, outline.blocks
    watched = [poses[name] for name in spec.streams]
    yaws = np.array([yaw_of(pose) for pose in watched])
    names = ["head turned to the left [degrees]"]
    column = line_column(recording, spec, YAW, names, [pale(0)], steps=True)
    column.add(blocks.starts, blocks.iterations, yaws[blocks.streams][:, None])
    turns = np.flatnonzero(np.diff(blocks.streams, prepend=-1))
    if len(turns):
        turned = rr.Transform3D.columns(
            translation=[watched[s].position for s in blocks.streams[turns]],
            quaternion=[watched[s].quaternion for s in blocks.streams[turns]],
        )
        times = time_columns(spec, blocks.starts[turns], blocks.iterations[turns])
        recording.send_columns(WATCHING, times, turned)
    column.flush()
    white = packed_all([(255, 255, 255)])
    arrow = rr.Arrows3D(vectors=[[-1.4 * REACH, 0, 0]], radii=[0.003], colors=white)
    recording.log(WATCHING, arrow, static=True)


def gaze(name: str) -> rrb.Spatial3DView:
    """The head's poses, in the robot's root frame, seen from above and behind."""
    return rrb.Spatial3DView(
        origin=f"/{POSES}",
        name=name,
        line_grid=rrb.LineGrid3D(visible=False),
        eye_controls=rrb.EyeControls3D(
            position=(0.45, 0.0, 0.75), look_target=(-0.12, 0.0, 0.24), eye_up=(0.0, 0.0, 1.0)
        ),
    )
