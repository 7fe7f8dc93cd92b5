"""Recordings of the iCub scene hold its world in messages that others read."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from foxglove_schemas_protobuf import CameraCalibration_pb2, FrameTransforms_pb2, SceneUpdate_pb2
from rerun.chunk import McapReader

from cdmisfa.core.config import as_table
from recorder.log.scenery import scenery_of, times, turned
from recorder.recording import record_scene
from recorder.world.icub.config import IcubConfig
from replay.mcap.reader import LogReader
from replay.recordings.source import RecordedSource

SAMPLE = Path(__file__).parents[1] / "sample_logs" / "icub"
FRAMES = 120


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """The first frames of the sample recording, recorded again."""
    folder = tmp_path_factory.mktemp("scene") / "r"
    record_scene("icub", folder, IcubConfig(seed=0), frames=FRAMES)
    return folder


def messages(file, topic):
    with LogReader(file) as reader:
        return [(m.log_time, bytes(m.data)) for m in reader.messages({topic})]


@pytest.mark.parametrize("view", ["left", "center", "right"])
def test_frames_and_truth_are_the_bytes_that_they_were_before_there_was_a_world(recorded, view):
    for topic in (f"/view/{view}", "/truth", "/head_pose"):
        new = messages(recorded / f"{view}.mcap", topic)
        assert new == messages(SAMPLE / f"{view}.mcap", topic)[: len(new)]
        assert len(new) == (FRAMES if topic != "/head_pose" else 3)


def test_a_learner_gets_the_same_from_both(recorded):
    new, old = RecordedSource(recorded), RecordedSource(SAMPLE)
    for stream in range(3):
        for source in (new, old):
            source.seek(0)
        one, other = new.take(stream, FRAMES), old.take(stream, FRAMES)
        np.testing.assert_array_equal(one.frames, other.frames)
        np.testing.assert_array_equal(one.truth, other.truth)
    new.close()
    old.close()


def test_objects_are_where_the_truth_says(recorded):
    source = RecordedSource(recorded)
    truth = source.take(0, FRAMES).truth
    source.close()
    things = [scenery_of(as_table(IcubConfig())).table, *scenery_of(as_table(IcubConfig())).objects]
    for t, (_, data) in enumerate(messages(recorded / "right.mcap", "/scene")):
        entities = SceneUpdate_pb2.SceneUpdate.FromString(data).entities
        assert [e.id for e in entities] == ["table", "box", "cylinder", "ball"]
        assert {e.frame_id for e in entities} == {"root"}
        for i, (thing, entity) in enumerate(zip(things, entities, strict=True)):
            (shape,) = [*entity.cubes, *entity.cylinders, *entity.spheres]
            assert (shape.size.x, shape.size.y, shape.size.z) == thing.size
            place = shape.pose.position
            if i:
                x, y = truth[t, 2 * i - 2 : 2 * i]
                assert (place.x, place.y, place.z) == (x, -y, thing.place[2])
            else:
                assert (place.x, place.y, place.z) == thing.place


@pytest.mark.parametrize("view", ["left", "right"])
def test_transforms_lead_from_the_root_to_each_eye(recorded, view):
    gaze = scenery_of(as_table(IcubConfig())).gaze(view)
    ((_, data), *_) = messages(recorded / f"{view}.mcap", "/tf")
    chain = {
        t.child_frame_id: t for t in FrameTransforms_pb2.FrameTransforms.FromString(data).transforms
    }
    for side, eye in zip(("left_eye", "right_eye"), gaze.eyes, strict=True):
        place, turn, frame = np.zeros(3), (0.0, 0.0, 0.0, 1.0), f"{view}/{side}"
        while frame != "root":
            step = chain[frame]
            q = step.rotation
            own = (q.x, q.y, q.z, q.w)
            move = np.array([step.translation.x, step.translation.y, step.translation.z])
            place, turn = turned(own, place) + move, times(own, turn)
            frame = step.parent_frame_id
        np.testing.assert_allclose(place, eye.place, atol=1e-12)
        np.testing.assert_allclose(turn, eye.turn, atol=1e-12)
        ((_, data), *_) = messages(recorded / f"{view}.mcap", f"/calibration/{view}/{side}")
        camera = CameraCalibration_pb2.CameraCalibration.FromString(data)
        assert camera.frame_id == f"{view}/{side}"
        assert list(camera.K) == [eye.focal, 0, 32, 0, eye.focal, 24, 0, 0, 1]


def test_rerun_reads_cameras_and_frames_without_us(recorded):
    read = {}
    for chunk in McapReader(str(recorded / "left.mcap")).stream():
        names = chunk.to_record_batch().schema.names
        read.setdefault(chunk.entity_path, set()).update(names)
    assert "Pinhole:image_from_camera" in read["/calibration/left/left_eye"]
    assert {"Transform3D:quaternion", "Transform3D:child_frame"} <= read["/tf"]
    assert "/scene" in read
