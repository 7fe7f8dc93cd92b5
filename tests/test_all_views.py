"""The view of a run shows what it did not watch, where its recording is still there."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from run_data import read_signals
from view_data import View, scalars

from cdmisfa.core.config import LearnerConfig
from cdmisfa.core.errors import UsageError
from cdmisfa.experiments.session import run
from recorder.recording import record_scene
from recorder.world.oscillatory import OscillatoryConfig
from replay.recordings.source import RecordedSource, head_poses, yaw_of
from replay.view.build import build_view


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A recording, and a run that went twice around it."""
    place = tmp_path_factory.mktemp("made")
    record_scene("oscillatory", place / "rec", OscillatoryConfig(), frames=500)
    source = RecordedSource(place / "rec", loop=True)
    run(source, LearnerConfig(), place / "run", max_iterations=8, rerun=False)
    source.close()
    return place


def test_every_view_is_there_at_every_frame(made, tmp_path):
    build_view(made / "run", tmp_path / "v.rrd", all_views=made / "rec")
    source = RecordedSource(made / "rec")
    expected = source.take(1, 500).frames
    source.close()
    rows = View(tmp_path / "v.rrd").rows["/views/2_x2"]
    assert rows["frame"] == list(range(800))
    assert rows["iteration"] == [t // 100 for t in range(800)]
    np.testing.assert_array_equal(scalars(rows), expected[np.arange(800) % 500])


def test_another_recording_is_refused(made, tmp_path):
    record_scene("oscillatory", tmp_path / "other", OscillatoryConfig(), frames=501)
    with pytest.raises(UsageError, match="not the recording"):
        build_view(made / "run", tmp_path / "v.rrd", all_views=tmp_path / "other")
    assert not (tmp_path / "v.rrd").exists()
    with pytest.raises(UsageError, match="anyway"):
        build_view(made / "rec", tmp_path / "v.rrd", all_views=made / "rec")


def test_a_recording_that_was_moved_is_still_the_same(made, tmp_path, cdmisfa):
    shutil.copytree(made / "rec", tmp_path / "moved")
    words = ("--all-views", tmp_path / "moved", "--save", tmp_path / "v.rrd")
    assert cdmisfa("view", made / "run", *words).code == 0


def test_the_head_turns_to_what_is_watched(tmp_path):
    """In the sample recording the head looks at the left, the centre and the right in turn."""
    sample = Path(__file__).parents[1] / "sample_logs" / "icub"
    yaws = {name: yaw_of(pose) for name, pose in head_poses(sample).items()}
    assert yaws["left"] > yaws["center"] > yaws["right"]
    source = RecordedSource(sample)
    config = LearnerConfig(expansion="none", components=5)
    run(source, config, tmp_path / "run", max_iterations=6, rerun=False)
    source.close()
    build_view(tmp_path / "run", tmp_path / "v.rrd", all_views=sample)
    rows = View(tmp_path / "v.rrd").rows
    head, gaze = rows["/head/yaw"], rows["/head/poses/watching"]
    shown = dict(zip(head["iteration"], scalars(head)[:, 0].tolist(), strict=True))
    turns = [turn for (turn,) in gaze["Transform3D:quaternion"]]
    gazes = dict(zip(gaze["iteration"], turns, strict=True))
    names = ("left", "center", "right")
    expected = {s.iteration: yaws[names[s.stream]] for s in read_signals(tmp_path / "run")}
    assert shown == expected
    for iteration, yaw in expected.items():
        *_, z, w = gazes[max(k for k in gazes if k <= iteration)]
        assert np.degrees(2 * np.arctan2(z, w)) == pytest.approx(yaw, abs=1e-4)
    assert set(gazes) <= {0} | {k for k in expected if expected[k] != expected.get(k - 1)}
