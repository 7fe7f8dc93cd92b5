"""Frames are checked where they come in: C never reads beyond what it was given."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cdmisfa.core.config import LearnerConfig
from cdmisfa.core.errors import UsageError
from cdmisfa.core.expansion import expand, quadratic
from cdmisfa.features.incsfa import IncrementalFeature
from cdmisfa.features.outputs import project
from cdmisfa.kernels import lib

SMALL, LARGE = 5, lib.MANY_INPUTS + 50
CONFIG = LearnerConfig(components=3)
TYPES = ("float64", "uint8", "float32", "int8", "bool", "int64", "complex128", ">f8", "U3", "O")


def abstraction(size: int) -> IncrementalFeature:
    return IncrementalFeature(CONFIG, size, np.random.default_rng(0))


@st.composite
def anything(draw: st.DrawFn) -> np.ndarray:
    """Arrays of most shapes, types and orders, many of them frames of SMALL or LARGE values."""
    inner = draw(st.sampled_from([(SMALL,), (LARGE,), (SMALL, 1), (1,), (2,), (3,), (0,), ()]))
    shape = (draw(st.integers(0, 4)), *inner)
    array = np.random.default_rng(0).integers(0, 2, shape).astype(draw(st.sampled_from(TYPES)))
    match draw(st.integers(0, 4)):
        case 0:
            return np.asfortranarray(array)
        case 1 if array.ndim > 1:
            return np.repeat(array, 2, axis=1)[:, ::2]
        case 2:
            return array[::-1]
        case 3:
            array.flags.writeable = False
    return array


@given(anything(), st.sampled_from([SMALL, LARGE]), st.booleans())
@settings(deadline=None, max_examples=400)
def test_frames_are_learned_from_or_refused(frames: np.ndarray, size: int, gap: bool) -> None:
    fits = frames.ndim == 2 and frames.shape[1] == size and frames.dtype in (np.uint8, np.float64)
    fits = fits and frames.dtype.isnative
    sfa = abstraction(size)
    calls = [lambda: sfa.update(frames, gap), lambda: project(sfa.phi, np.zeros(1), frames)]
    for call in calls:
        if fits:
            assert len(call()) == len(frames)
        else:
            with pytest.raises(UsageError, match=r"^frames are .*: give "):
                call()


@given(anything())
@settings(deadline=None, max_examples=200)
def test_frames_are_expanded_or_refused(frames: np.ndarray) -> None:
    if frames.ndim == 2 and frames.dtype in (np.uint8, np.float64) and frames.dtype.isnative:
        before = frames.copy()
        unit = 1 / 255 if frames.dtype == np.uint8 else 1.0
        i, j = np.triu_indices(frames.shape[1])
        x = frames * unit
        np.testing.assert_array_equal(quadratic(frames), np.hstack([x, x[:, i] * x[:, j]]))
        np.testing.assert_array_equal(frames, before)
    else:
        for kind in ("none", "quadratic"):
            with pytest.raises(UsageError, match=r"^frames are .*: give "):
                expand(kind, frames)


def test_the_order_of_frames_in_memory_does_not_matter() -> None:
    frames = np.random.default_rng(1).random((60, SMALL))
    wide = np.zeros((60, 2 * SMALL))
    wide[:, ::2] = frames
    raw = np.zeros(frames.nbytes + 1, np.uint8)
    unaligned = raw[1:].view(np.float64).reshape(frames.shape)
    unaligned[...] = frames
    expected = abstraction(SMALL).update(frames).tobytes()
    for same in (np.asfortranarray(frames), wide[:, ::2], unaligned, frames.tolist()):
        assert abstraction(SMALL).update(same).tobytes() == expected  # type: ignore[arg-type]
