"""Modules know what their input was: they transform frames as the learner did."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cdmisfa.agents.learner import CuriousLearner
from cdmisfa.core.blocks import Block, SourceSpec
from cdmisfa.core.config import LearnerConfig
from cdmisfa.core.errors import LogDamagedError, UsageError
from cdmisfa.core.learning import Keyframe, LearnerState
from cdmisfa.modules import Module
from replay.runs.keyframes import decode_keyframe, encode_keyframe
from replay.runs.modules import load_modules, save_modules

EASY = {"delta": 1.0, "eta_dot_window": 3, "min_variance": 0.0, "warm_up": 0, "tau": 20}
"""Saves what it has after a few blocks."""


def learned(dtype: str, expansion: str, shape: tuple[int, ...] = (2, 3)) -> tuple[Any, Any]:
    """A learner's first module, and its output on the block after it, with the block's frames."""
    rng = np.random.default_rng(0)
    config = LearnerConfig(expansion=expansion, components=2, **EASY)
    learner = CuriousLearner(config, SourceSpec(("a",), shape, dtype), 1)
    k = 0
    while True:
        walk = np.cumsum(rng.standard_normal((20, *shape)), axis=0)
        frames = walk if dtype == "float64" else (walk * 9 + 120).clip(0, 255).astype(np.uint8)
        signals = learner.step(Block(0, 20 * k, frames, np.empty((20, 0))))
        if len(signals.y_frozen):
            return learner, (signals.y_frozen[0], frames)
        k += 1


@pytest.mark.parametrize("dtype", ["uint8", "float64"])
@pytest.mark.parametrize("expansion", ["none", "quadratic"])
def test_a_module_transforms_as_the_learner_did(dtype: str, expansion: str, tmp_path: Path) -> None:
    learner, (y, frames) = learned(dtype, expansion)
    module = learner.modules[0]
    assert module.expansion == expansion
    assert module.scale == (1 / 255 if dtype == "uint8" else 1.0)
    save_modules(tmp_path / "modules.npz", learner.modules)
    (loaded, *_) = load_modules(tmp_path)
    for same in (module, loaded):
        np.testing.assert_array_equal(same.transform(frames), y)
        np.testing.assert_array_equal(same.transform(frames.reshape(20, -1)), y)
        assert same.frame_shape == (2, 3)
    assert (loaded.expansion, loaded.scale) == (module.expansion, module.scale)
    assert type(loaded.expansion) is str


def with_width(width: int, **values: Any) -> Module:
    phi, mean, zero, policy = np.ones((1, width)), np.zeros(width), np.zeros(1), np.zeros(1, int)
    return Module(1, "a", 0, 9, phi, mean, zero, zero, zero, policy, **values)


@pytest.mark.parametrize("shape", [(5, 3, 2), (5, 2, 3, 1), (5, 1, 6), (5, 2), (5,), (2, 3)])
def test_frames_have_the_shape_that_the_module_learned_from(shape: tuple[int, ...]) -> None:
    module = with_width(6, expansion="none", frame_shape=(2, 3))
    with pytest.raises(UsageError, match=r": give uint8 pixels .* \(n, 2, 3\)"):
        module.transform(np.zeros(shape))
    assert module.transform(np.zeros((5, 6))).shape == (5, 1)  # as rows
    assert module.transform(np.zeros((0, 2, 3))).shape == (0, 1)


def test_the_expansion_decides_the_width_and_only_pixels_and_values_are_taken() -> None:
    """Two values expand to five weights; five values that nobody expanded have five, too."""
    module = with_width(5, expansion="none")
    assert module.transform(np.zeros((3, 5))).shape == (3, 1)
    for frames in (np.zeros((3, 2)), *(np.ones((3, 5)).astype(k) for k in ("int8", "bool", "U1"))):
        with pytest.raises(UsageError, match=r": give uint8 pixels or float values"):
            module.transform(frames)


def test_modules_come_back_in_order_and_to_the_bit(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    modules = [
        replace(with_width(5), index=i, stream_index=i % 2, phi=rng.standard_normal((1, 5)))
        for i in range(1, 12)
    ]
    save_modules(tmp_path / "modules.npz", modules)
    back = load_modules(tmp_path)
    assert [(m.index, m.stream_index, m.iteration) for m in back] == [
        (i, i % 2, 9) for i in range(1, 12)
    ]
    for ours, theirs in zip(modules, back, strict=True):
        assert ours.phi.tobytes() == theirs.phi.tobytes()


@pytest.mark.parametrize("data", [b"", b"PK\x03\x04 no zip", b"\x93NUMPY"])
def test_a_file_of_something_else_is_refused_in_words(data: bytes, tmp_path: Path) -> None:
    (tmp_path / "modules.npz").write_bytes(data)
    with pytest.raises(LogDamagedError, match=r"modules\.npz"):
        load_modules(tmp_path)
    with pytest.raises(UsageError, match="does not exist"):
        load_modules(tmp_path / "elsewhere")


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *(("stream_index", np.array(value)) for value in (-1, 0.0, "a", [0, 0])),
        *(("phi", value) for value in (np.full((1, 6), np.nan), np.zeros((0, 6)), np.ones((1, 5)))),
        *(("mean", value) for value in (np.full(6, np.inf), np.zeros((6, 1)), np.zeros(7))),
        *(("scale", np.array(value)) for value in (np.nan, [1.0, 1.0])),
        *(("frame_shape", np.array(value)) for value in ([-2, -3], [0, 6], [2, 2], 6, [np.inf])),
        *(("policy", value) for value in (np.array(0), np.zeros((1, 1)))),
        *(("iteration", np.array(-1)), ("slow", np.zeros(2)), ("eta", np.zeros(0))),
        *(("counts", np.zeros((1, 1))), ("phi", np.array([b"a"])), ("recipe", np.array("[1]"))),
    ],
)
def test_a_module_is_refused_if_a_value_does_not_fit(
    name: str, value: np.ndarray[Any, Any], tmp_path: Path
) -> None:
    module = with_width(6, frame_shape=(2, 3))
    save_modules(tmp_path / "modules.npz", [module])
    arrays = dict(np.load(tmp_path / "modules.npz"))
    assert load_modules(tmp_path)[0].frame_shape == (2, 3)
    np.savez(tmp_path / "modules.npz", **{**arrays, f"module1_{name}": value})
    with pytest.raises(LogDamagedError, match=r"modules\.npz is not a file of modules"):
        load_modules(tmp_path)
    if name in ("phi", "mean", "policy") and value.dtype.kind == "f":
        state = LearnerState({}, (replace(module, **{name: value}),), {})
        with pytest.raises(LogDamagedError, match="not a keyframe"):
            decode_keyframe(encode_keyframe(Keyframe(1, 1, state, {})))


@pytest.mark.parametrize(
    ("outputs", "columns"),
    [(None, [0, 1, 2]), (0, [0]), (-1, [2]), (slice(2), [0, 1]), ([2, 0], [2, 0]), ((1,), [1])],
)
def test_outputs_are_chosen(outputs: Any, columns: list[int]) -> None:
    module = replace(with_width(4), phi=np.random.default_rng(0).normal(size=(3, 4)))
    frames = np.random.default_rng(1).normal(size=(6, 4))
    y = module.transform(frames)
    np.testing.assert_allclose(module.transform(frames, outputs=outputs), y[:, columns])
    with pytest.raises(IndexError):
        module.transform(frames, outputs=3)
