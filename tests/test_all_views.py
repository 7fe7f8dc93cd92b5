"""The view of a run shows what it did not watch, where its recording is still there."""

from __future__ import annotations

import numpy as np
import pytest
from view_data import View, scalars

from cdmisfa.core.config import LearnerConfig
from cdmisfa.core.errors import UsageError
from cdmisfa.experiments.session import run
from recorder.recording import record_scene
from recorder.world.oscillatory import OscillatoryConfig
from replay.recordings.source import RecordedSource
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
