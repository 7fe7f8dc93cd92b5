"""Where the head was while a recording was made."""

from __future__ import annotations

import math
from pathlib import Path

from foxglove_schemas_protobuf import PoseInFrame_pb2
from google.protobuf import message

from cdmisfa.core.blocks import HeadPose
from cdmisfa.core.errors import LogDamagedError
from recorder.log.messages import POSE_TOPIC, RECORDING_METADATA
from recorder.mcap.reader import LogReader
from replay.storage.opening import log_files, open_store


def head_poses(path: Path) -> dict[str, HeadPose]:
    """Where the head is in each view of a recording.

    Returns:
        By the view's name; without the views that do not say it.

    Raises:
        UsageError: there is no such recording.
        LogDamagedError: it cannot be read.
    """
    found: dict[str, HeadPose] = {}
    for file in log_files(path):
        with LogReader(open_store(file)) as reader:
            facts = next((r.values for r in reader.metadata if r.name == RECORDING_METADATA), {})
            pose = first_pose(reader)
        if pose is not None and "view" in facts:
            found[facts["view"]] = pose
    return found


def first_pose(reader: LogReader) -> HeadPose | None:
    """Where the head is in a view's log, None where it does not say it.

    Raises:
        LogDamagedError: it cannot be read.
    """
    entry = next(reader.messages({POSE_TOPIC}), None)
    if entry is None:
        return None
    try:
        pose = PoseInFrame_pb2.PoseInFrame.FromString(entry.data).pose
    except message.DecodeError as error:
        raise LogDamagedError(f"{reader.path} {POSE_TOPIC}: not a foxglove.PoseInFrame") from error
    place, turn = pose.position, pose.orientation
    return HeadPose((place.x, place.y, place.z), (turn.x, turn.y, turn.z, turn.w))


def yaw_of(pose: HeadPose) -> float:
    """How far the head is turned, degrees to the left."""
    _, _, z, w = pose.quaternion
    return math.degrees(2 * math.atan2(z, w))
