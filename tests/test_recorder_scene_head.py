"""The head of the iCub scene: its joints, its turns, which cost frames, and one that roams."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools

import numpy as np
import pytest

from cdmisfa.core.config import LearnerConfig, section_table
from cdmisfa.core.errors import UsageError
from cdmisfa.experiments.resume import check_run
from cdmisfa.experiments.session import run_session
from recorder.config import RecordConfig
from recorder.log.scenery import scenery_of, turned
from recorder.recording import record_scene
from recorder.world.icub.config import EyesConfig, IcubConfig
from recorder.world.icub.head import LOOK_FRAMES, Roaming
from replay.open_sources import open_recording
from replay.runs.run import read_outline

YAW = (45.0, 0.0, -45.0)


def test_a_roaming_head_dwells_on_views_and_turns_between_them_the_same_at_every_cut():
    angles = Roaming(YAW, 7.5, 3).angles(0, 3000)
    parts = [Roaming(YAW, 7.5, 3).angles(t, n) for t, n in ((1000, 2000), (0, 1), (1, 999))]
    assert [*parts[1], *parts[2], *parts[0]] == angles
    assert Roaming(YAW, 7.5, 4).angles(0, 3000) != angles
    assert set(YAW) <= set(angles)
    assert np.abs(np.diff(angles)).max() < 15
    runs = [(yaw, len(list(same))) for yaw, same in itertools.groupby(angles)]
    dwells = [n for yaw, n in runs if yaw in YAW]
    assert min(dwells[:-1]) >= LOOK_FRAMES - 12
    assert len({yaw for yaw, _ in runs}) < 40  # of few angles, each drawn once


def test_a_bent_neck_is_that_of_the_simulator():
    pytest.importorskip("pybullet")
    from recorder.world.icub.source import IcubSource

    scene = IcubConfig(eyes=EyesConfig(pitch=-20.0))
    with contextlib.closing(IcubSource(scene, RecordConfig())) as source:
        poses = source.head_poses
    for pose, gaze in zip(poses, scenery_of(section_table(scene)).gazes, strict=True):
        np.testing.assert_allclose(pose.position, gaze.head.position, atol=2e-6)
        np.testing.assert_allclose(pose.quaternion, gaze.head.quaternion, atol=1e-12)
        assert turned(pose.quaternion, (-1.0, 0.0, 0.0))[2] < 0  # it looks down
    level = IcubConfig(eyes=EyesConfig(pitch=-89.0))
    with pytest.raises(UsageError, match=r"scene\.eyes\.pitch has -89"):
        IcubSource(level, RecordConfig())


SMALL = IcubConfig(
    seed=1,
    eyes=EyesConfig(views=("left", "right"), yaw=(30.0, -30.0), width=16, height=12),
    transit=6.0,
)
COST = 10
LEARNER = LearnerConfig(tau=8, components=3)


@pytest.fixture(scope="module")
def scene():
    pytest.importorskip("pybullet")
    from recorder.world.icub.source import IcubSource

    with contextlib.closing(IcubSource(SMALL, RecordConfig())) as source:
        yield source


def test_a_switch_costs_the_same_frames_live_and_from_the_log(scene, tmp_path):
    recording = tmp_path / "recording"
    record_scene("icub", recording, SMALL, frames=500)
    scene.seek(0)
    live = run_session(scene, LEARNER, tmp_path / "live", max_iterations=25, rerun=False)
    with contextlib.closing(open_recording(recording)) as source:
        logged = run_session(source, LEARNER, tmp_path / "log", max_iterations=25, rerun=False)
    assert live.signals_sha256 == logged.signals_sha256
    blocks = read_outline(tmp_path / "log" / "run.mcap").blocks
    lost = np.diff(blocks.starts) - LEARNER.tau
    switched = np.diff(blocks.streams) != 0
    assert 3 < switched.sum() < 21
    np.testing.assert_array_equal(lost, COST * switched)
    with contextlib.closing(open_recording(recording)) as source:
        assert check_run(tmp_path / "log", (str(recording),), start=11).holds
        for stop in (7, 25):  # stopped, and resumed
            again = run_session(
                source,
                LEARNER,
                tmp_path / "again",
                max_iterations=stop,
                rerun=False,
                keyframes=1,
                resume=stop > 7,
            )
        assert again.signals_sha256 == live.signals_sha256


def test_a_roaming_view_shows_what_the_others_do_while_it_dwells_there():
    pytest.importorskip("pybullet")
    from recorder.world.icub.source import IcubSource

    roaming = dataclasses.replace(SMALL, roam=True)
    with contextlib.closing(IcubSource(roaming, RecordConfig())) as source:
        assert source.spec.streams == ("left", "right", "roam")
        source.seek(200)
        roam = source.take(2, 130)
        seen = []
        for stream in (0, 1):
            source.seek(200)
            seen.append(source.take(stream, 130))
        source.seek(290)
        again = source.take(2, 7)
    np.testing.assert_array_equal(again.frames, roam.frames[90:97])
    yaw = roam.truth[:, source.spec.truth.index("head_yaw")]
    np.testing.assert_array_equal(seen[0].truth, roam.truth)
    for block, where in zip(seen, SMALL.eyes.yaw, strict=True):
        there = yaw == where
        assert there.any()
        np.testing.assert_array_equal(block.frames[there], roam.frames[there])
    assert ((yaw > -30) & (yaw < 30)).any()
    with pytest.raises(UsageError, match="name each view once"):
        dataclasses.replace(roaming, eyes=EyesConfig(views=("roam",), yaw=(0.0,)))
