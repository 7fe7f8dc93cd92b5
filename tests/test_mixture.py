"""Modules of slow features and principal components: known answers, files, and their cost."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from moving_pictures import MovingPictures
from numpy.typing import NDArray

from cdmisfa.agents.progress.config import ProgressConfig
from cdmisfa.agents.progress.learner import ProgressLearner
from cdmisfa.core.errors import LogDamagedError, UsageError
from cdmisfa.estimators import RecursiveSFA
from cdmisfa.features.recursive import RecursiveFeature
from cdmisfa.features.sfa import batch_sfa, slowness
from cdmisfa.modules import PRINCIPAL, SLOW, Module
from replay.runs.modules import load_modules, save_modules

FOREVER = 10**9


def waves(sources: int, inputs: int, n: int = 4000) -> NDArray[np.float64]:
    """Sources of falling strength and random speed, seen through orthogonal patterns."""
    rng = np.random.default_rng(sources)
    speeds = np.geomspace(0.01, 1.5, sources)[rng.permutation(sources)]
    x = np.sin(np.arange(n)[:, None] * speeds + rng.uniform(0, 6, sources))
    patterns = np.linalg.qr(rng.normal(size=(inputs, sources)))[0].T
    return x * np.geomspace(3, 0.3, sources) @ patterns + rng.normal(size=inputs)


def learned(frames: NDArray[Any], *sizes: int, wide: int = 0, principal: int = 0) -> Any:
    sfa = RecursiveFeature(frames.shape[1], *sizes, FOREVER, principal=principal, wide=wide)
    sfa.widen()
    for start in range(0, len(frames), 40):
        sfa.update(frames[start : start + 40])
    return sfa, (frames - sfa.mean) @ sfa.phi.T


def like(own: NDArray[np.float64], other: NDArray[np.float64]) -> NDArray[np.float64]:
    """Absolute correlation of each column with that of the other."""
    return np.array([abs(np.corrcoef(a, b)[0, 1]) for a, b in zip(own.T, other.T, strict=True)])


def test_principal_outputs_are_those_of_all_frames_in_one_batch() -> None:
    frames = waves(12, 30)
    x = frames - frames.mean(axis=0)
    components = np.linalg.svd(x, full_matrices=False)[0][:, :5]
    _, y = learned(frames, 8, 3, principal=5)
    assert (like(y[:, 3:], components) > 1 - 1e-9).all()
    assert y.var(axis=0) == pytest.approx(1)
    assert np.corrcoef(y[:, 3:].T) == pytest.approx(np.eye(5), abs=1e-6)


@pytest.mark.parametrize("wide", [0, 20])
def test_slow_outputs_are_those_of_batch_sfa(wide: int) -> None:
    frames = waves(6 if not wide else 20, 25)
    sfa, y = learned(frames, 6 if not wide else 8, 4, wide=wide, principal=2)
    x = frames - frames.mean(axis=0)
    if not wide:
        assert (like(y[:, :4], x @ batch_sfa(frames, 4).T) > 1 - 1e-6).all()
        return
    # The first is that of the 8 largest components; the others, of what it does not explain.
    leading = np.linalg.svd(x, full_matrices=False)[2][:8]
    first = x @ leading.T @ batch_sfa(x @ leading.T, 1)[0]
    assert like(y[:, :1], first[:, None]) > 1 - 1e-6
    rest = x - np.outer(first, first @ x) / (first @ first)
    others = rest @ batch_sfa(rest, 3, tolerance=1e-8).T
    assert (like(y[:, 1:4], others) > 1 - 1e-6).all()
    assert np.corrcoef(y[:, :4].T) == pytest.approx(np.eye(4), abs=1e-6)
    assert sfa.output_slowness == pytest.approx(slowness(y), rel=1e-4)


def test_widening_changes_the_other_outputs_only() -> None:
    frames = waves(20, 25)
    narrow, wide = (RecursiveFeature(25, 4, 3, principal=2, wide=w) for w in (0, 20))
    for k, start in enumerate(range(0, 4000, 40)):
        block = frames[start : start + 40]
        if k == 30:
            narrow.widen()
            wide.widen()
        before = wide.update(block)
        assert before == pytest.approx(narrow.update(block), abs=0.2, nan_ok=True)
    assert (narrow.is_wide, wide.is_wide) == (False, True)
    assert (len(narrow.state.variance), len(wide.state.variance)) == (8, 20)
    y, other = ((frames - sfa.mean) @ sfa.phi.T for sfa in (narrow, wide))
    assert like(y, other)[[0, 3, 4]] == pytest.approx(1, abs=1e-2)
    assert slowness(other)[1:3].max() < 0.1 * slowness(y)[1:3].max()


def test_sizes_that_do_not_fit_are_refused() -> None:
    with pytest.raises(UsageError, match="-1 principal outputs"):
        RecursiveFeature(20, 4, principal=-1)


def test_the_estimator_has_principal_components_after_its_slow_features() -> None:
    X = waves(12, 30)
    slow, mixed = RecursiveSFA(3).fit(X), RecursiveSFA(3, n_principal=4).fit(X)
    np.testing.assert_array_equal(mixed.components_[:3], slow.components_)
    y = mixed.transform(X)
    assert y[:, 3:].var(axis=0) == pytest.approx(1)
    assert mixed.slowness_ == pytest.approx(slowness(y), rel=1e-4)
    assert len(mixed.get_feature_names_out()) == 7
    best = np.linalg.lstsq(y, X - X.mean(axis=0), rcond=None)[0]
    assert mixed.inverse_transform(y) == pytest.approx(y @ best + X.mean(axis=0), abs=1e-6)
    for wrong in (-1, 13, True, 1.5):
        with pytest.raises(ValueError, match="n_principal is"):
            RecursiveSFA(3, n_whitened=12, n_principal=wrong).fit(X)


def test_only_streams_that_promise_pay_for_more_components() -> None:
    source = MovingPictures("swing", "noise", "constant")
    learner = ProgressLearner(ProgressConfig(components=8), source.spec, 0)
    stored = dict[str, set[int]]()
    while not learner.over:
        stream = source.spec.streams[learner.stream]
        learner.step(source.take(learner.stream, learner.tau))
        if (candidate := learner._candidates.get(source.spec.streams.index(stream))) is not None:
            stored.setdefault(stream, set()).add(len(candidate.sfa.state.variance))
    assert stored == {"swing": {16, 48}, "noise": {16}, "constant": {16}}
    (module,) = learner.modules
    assert module.kinds == 8 * (SLOW,) + 8 * (PRINCIPAL,)
    assert not module.slow[8:].any()
    assert module.labels[0] == "1 slow"
    assert module.labels[8:] == [f"{j} principal" for j in range(9, 17)]


def module_of(**values: Any) -> Module:
    bands, phi = np.ones(3), np.arange(12.0).reshape(3, 4)
    return Module(1, "a", 0, 9, phi, np.zeros(4), *3 * (bands,), np.zeros(1, int), **values)


def test_kinds_come_back_from_files_and_are_slow_in_older_ones(tmp_path: Path) -> None:
    path = tmp_path / "modules.npz"
    save_modules(path, [module_of(kinds=(SLOW, PRINCIPAL, PRINCIPAL))])
    assert load_modules(path)[0].kinds == (SLOW, PRINCIPAL, PRINCIPAL)
    with np.load(path) as file:
        older = {name: file[name] for name in file if name != "module1_kinds"}
        wrong = {**file, "module1_kinds": np.array(["slow", "odd", "slow"])}
    np.savez(path, **older)
    assert load_modules(path)[0].kinds == 3 * (SLOW,)
    np.savez(path, **wrong)
    with pytest.raises(LogDamagedError, match="odd"):
        load_modules(path)
