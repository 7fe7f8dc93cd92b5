"""Recordings of the iCub scene hold its world in messages that others read."""

from __future__ import annotations

from pathlib import Path

import foxglove.messages
import numpy as np
import pytest
from foxglove_schemas_protobuf import CameraCalibration_pb2, FrameTransforms_pb2, SceneUpdate_pb2
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from google.protobuf.json_format import MessageToDict
from mcap.reader import make_reader

from cdmisfa.core.config import section_table
from recorder.log.scenery import scenery_of, times, turned
from recorder.mcap.reader import LogReader
from recorder.recording import record_scene
from recorder.world.icub.config import IcubConfig
from replay.open_sources import open_recording

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


def test_objects_are_where_the_truth_says(recorded):
    with open_recording(recorded) as source:
        truth = source.take(0, FRAMES).truth
    scenery = scenery_of(section_table(IcubConfig()))
    reported = messages(recorded / "right.mcap", "/scene")
    assert len(reported) == FRAMES
    for t, (_, data) in enumerate(reported):
        entities = SceneUpdate_pb2.SceneUpdate.FromString(data).entities
        assert [e.id for e in entities] == ["table", "box", "cylinder", "ball"]
        things = [scenery.table, *scenery.objects]
        for i, (thing, entity) in enumerate(zip(things, entities, strict=True)):
            (shape,) = [*entity.cubes, *entity.cylinders, *entity.spheres]
            assert (shape.size.x, shape.size.y, shape.size.z) == thing.size
            x, y = (truth[t, 2 * i - 2], -truth[t, 2 * i - 1]) if i else thing.place[:2]
            place = shape.pose.position
            assert (place.x, place.y, place.z) == (x, y, thing.place[2])
            assert entity.frame_id == "root"


@pytest.mark.parametrize("view", ["left", "right"])
def test_transforms_lead_from_the_root_to_each_eye(recorded, view):
    gaze = scenery_of(section_table(IcubConfig())).gaze(view)
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


def class_of(schema_name, descriptors):
    """A message's class from a schema alone, apart from every one that this process knows."""
    pool = descriptor_pool.DescriptorPool()
    for file in descriptor_pb2.FileDescriptorSet.FromString(descriptors).file:
        pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(schema_name))


@pytest.mark.parametrize(
    ("topic", "published"),
    [
        ("/view/left", foxglove.messages.RawImage),
        ("/calibration/left/left_eye", foxglove.messages.CameraCalibration),
        ("/tf", foxglove.messages.FrameTransforms),
        ("/scene", foxglove.messages.SceneUpdate),
    ],
)
def test_foxglove_s_own_reader_and_schemas_decode_every_message(recorded, topic, published):
    """By the schema of the channel, and by the one that Foxglove's SDK publishes, to the same."""
    schema = published.get_schema()
    newest, count = class_of(schema.name, schema.data), 0
    with (recorded / "left.mcap").open("rb") as file:
        for own, channel, message in make_reader(file).iter_messages([topic]):
            assert (own.name, own.encoding) == (schema.name, schema.encoding)
            assert channel.message_encoding == "protobuf"
            by_own = class_of(own.name, own.data).FromString(message.data)
            by_newest = newest.FromString(message.data)
            assert MessageToDict(by_own) == MessageToDict(by_newest) != {}
            for read in (by_own, by_newest):
                read.DiscardUnknownFields()
                assert read.SerializeToString(deterministic=True) == message.data
            count += 1
    assert count == (FRAMES if topic in ("/view/left", "/scene") else 3)
