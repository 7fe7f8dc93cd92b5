"""An expansion of the user, added without editing a file."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import Cdmisfa
from numpy.typing import NDArray
from test_trial import QUICK, assert_equal, step_by_step

from cdmisfa.core.expansion import EXPANSIONS, Expansion
from cdmisfa.experiments.trial import run_oscillatory_trial
from replay.runs.modules import load_modules

STREAMS = ("x1", "x2", "x3")
MANY_INPUTS = 200
"""From so many on IncSFA learns on the Gram matrix."""


def cubic(frames: NDArray[Any]) -> NDArray[np.float64]:
    """All inputs, their products of two, and each one's cube."""
    x = frames * (1 / 255 if frames.dtype == np.uint8 else 1.0)
    i, j = np.triu_indices(x.shape[1])
    return np.hstack([x, x[:, i] * x[:, j], x**3])


def many(frames: NDArray[Any]) -> NDArray[np.float64]:
    """So many inputs that IncSFA takes its other kernel."""
    return np.hstack([np.cos(k * frames) / (1 + k) for k in range(MANY_INPUTS // 2 + 1)])


@pytest.fixture(autouse=True)
def _added(monkeypatch: pytest.MonkeyPatch) -> None:
    sizes = (lambda n: 2 * n + n * (n + 1) // 2), (lambda n: n * (MANY_INPUTS // 2 + 1))
    monkeypatch.setitem(EXPANSIONS, "cubic", Expansion(sizes[0], cubic))
    monkeypatch.setitem(EXPANSIONS, "many", Expansion(sizes[1], many))


@pytest.mark.parametrize(("expansion", "least"), [("cubic", 1), ("many", 0)])
def test_a_whole_trial_is_the_learner_with_an_expansion_of_ones_own(
    expansion: str, least: int
) -> None:
    config = dataclasses.replace(QUICK, expansion=expansion, delta=0.005)
    trial = run_oscillatory_trial(config, seed=5, curves=True, max_iterations=600)
    assert len(trial.modules) >= least
    assert all(m.expansion == expansion for m in trial.modules)
    assert_equal(trial, *step_by_step(config, STREAMS, 5, trial.iterations))


def test_its_modules_transform_frames(cdmisfa: Cdmisfa, tmp_path: Path) -> None:
    done = cdmisfa(
        *("learn", "oscillatory", "--set", "learner.expansion=cubic", "--no-rerun"),
        *("--set", "learner.delta=1", "--set", "learner.eta_dot_window=5"),
        *("--max-modules", "1", "-o", str(tmp_path / "run")),
    )
    assert done.code == 0, done.err
    (module,) = load_modules(tmp_path / "run")
    x = np.random.default_rng(0).random((7, 2))
    expected = (cubic(x) - module.mean) @ module.phi.T
    np.testing.assert_allclose(module.transform(x), expected, rtol=1e-12)
