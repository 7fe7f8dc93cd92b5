"""What was learned can be used without the learner, and in scikit-learn."""

from __future__ import annotations

import numpy as np
import pytest
from run_data import read_signals, rows_of

from cdmisfa.core.config import LearnerConfig
from cdmisfa.experiments import session
from cdmisfa.modules import Module
from recorder.world.oscillatory import OscillatorySource
from replay.runs.modules import SlowFeatures


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run that saved a module of expanded frames, and went on."""
    out = tmp_path_factory.mktemp("run")
    session.run(OscillatorySource(), LearnerConfig(), out, max_iterations=600, rerun=False)
    return out


def test_outputs_are_those_the_run_recorded(run):
    features = SlowFeatures.load(run)
    assert len(features) >= 1
    records = list(read_signals(run))
    recorded = [s.y_frozen[0] for s in records if len(s.y_frozen)]
    frames = np.split(rows_of(run, "watched"), len(records))[-len(recorded) :]
    assert len(recorded) > 5
    for y, block in zip(recorded, frames, strict=True):
        np.testing.assert_array_equal(features[0].transform(block), y)


def image_module():
    rng = np.random.default_rng(0)
    phi, mean, zero = rng.standard_normal((2, 12)), rng.random(12), np.zeros(2)
    return Module(1, "a", 0, 5, phi, mean, zero, zero, zero, np.zeros(3, dtype=np.int64))


def test_it_is_a_step_of_a_pipeline():
    pytest.importorskip("sklearn.frozen")
    from sklearn.base import clone
    from sklearn.frozen import FrozenEstimator
    from sklearn.linear_model import LinearRegression
    from sklearn.pipeline import make_pipeline

    features = SlowFeatures(image_module())
    x = np.random.default_rng(2).random((100, 12))
    target = features.transform(x) @ [2.0, -1.0] + 3.0
    pipeline = make_pipeline(FrozenEstimator(features), LinearRegression()).fit(x, target)
    np.testing.assert_allclose(pipeline.predict(x), target, atol=1e-9)
    np.testing.assert_array_equal(make_pipeline(features).transform(x), features.transform(x))
    assert clone(FrozenEstimator(features)).estimator is features
