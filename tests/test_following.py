"""A module's output on the frames of its stream, and the quantity of the world it follows."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from run_data import IMAGE, VECTOR, module_of, write_run

from replay.module_outputs import SAMPLE_FRAMES, ModuleOutputs, Subsample
from replay.runs.log import read_batches
from replay.truth_fits import truth_fits


def best_fit(names, y, *truth):
    return next(iter(truth_fits(names, np.column_stack(truth), y)), None)


def test_an_output_finds_the_truth_it_follows():
    rng = np.random.default_rng(0)
    truth = rng.standard_normal((500, 3))
    y = -2 * truth[:, 1] + 0.01 * rng.standard_normal(500)
    result = best_fit(("a", "b", "c", "constant"), y, truth, np.ones(500))
    assert (result.column, result.function) == (1, "b")
    assert result.r > 0.99
    np.testing.assert_allclose(result(truth[:, 1]), -2 * truth[:, 1], atol=0.01)
    assert best_fit(("constant",), y, np.ones(500)) is None


@pytest.mark.parametrize(
    ("function", "said"),
    [
        (lambda x: 2 - x, "angle"),
        (lambda x: (x - 3) ** 2, "a parabola of angle"),
        (lambda x: np.sin(x - 1), "sin(angle + c)"),
        (lambda x: 3 * np.sin(4 * x - np.pi / 4) + 1, "sin(4 angle + c)"),
    ],
)
def test_the_simplest_function_of_a_truth_is_named(function, said):
    """The oscillatory streams' slow features are sines of a phase, which itself they follow not."""
    phase = 2 * np.pi * np.arange(1000) / 500 % (2 * np.pi)
    noise = 0.05 * np.random.default_rng(0).standard_normal(1000)
    result = best_fit(("angle",), function(phase) + noise, phase)
    assert result.function == said
    assert result.r > 0.99
    np.testing.assert_allclose(result(phase), function(phase), atol=0.05)


def heard(run: Path, module, spec) -> tuple[ModuleOutputs, np.ndarray, np.ndarray]:
    own, t, y = ModuleOutputs(module, spec), [], []
    for batch in read_batches(run):
        for frames, _, outputs in own.take(batch):
            t += frames.tolist()
            y += outputs[:, 0].tolist()
    return own, np.array(t), np.array(y)


@pytest.mark.parametrize("spec", [IMAGE, VECTOR])
def test_outputs_are_those_on_every_logged_frame_of_the_stream(tmp_path: Path, spec) -> None:
    records = write_run(tmp_path / "run.mcap", spec, 60)
    rng = np.random.default_rng(3)
    module = module_of(1, 30, rng.standard_normal((1, int(np.prod(spec.frame_shape)))), stream=1)
    own, t, y = heard(tmp_path / "run.mcap", module, spec)
    blocks = [r.t for r in records if r.stream == 1]
    step = 10 if spec.images else 1
    assert t.tolist() == [f for start in blocks for f in range(start, start + 40, step)]
    assert own.count == len(t)

    watched = [part for b in read_batches(tmp_path / "run.mcap") for part in b.watched]
    every = dict(zip(np.concatenate([f for f, _ in watched]).tolist(),
                     np.concatenate([v for _, v in watched]), strict=True))  # fmt: skip
    frames = np.array([every[i] for i in t.tolist()])
    np.testing.assert_array_equal(y, module.transform(frames)[:, 0])
    np.testing.assert_allclose(own.mean, frames.mean(axis=0))
    np.testing.assert_allclose(own.deviation, frames.std(axis=0), atol=1e-9)
    scaled = module.phi[0].reshape(spec.frame_shape) * own.deviation * module.scale
    np.testing.assert_allclose(own.saliency(), scaled)

    sheet = own.sheet()
    assert (sheet["least"][0].y, sheet["greatest"][-1].y) == (y.min(), y.max())
    picks = [pick for part in sheet.values() for pick in part]
    assert len({pick.t for pick in picks}) == len(picks)
    for part in sheet.values():
        assert 0 < len(part) <= SAMPLE_FRAMES
        assert [pick.y for pick in part] == sorted(pick.y for pick in part)
    for pick in picks:
        assert pick.y == y[t.tolist().index(pick.t)]
        np.testing.assert_array_equal(pick.frame, every[pick.t])


def test_of_a_periodic_stream_the_least_and_the_greatest_are_apart() -> None:
    module = module_of(1, 30, np.ones((1, int(np.prod(VECTOR.frame_shape)))), stream=1)
    y, blocks = np.tile(np.r_[0.0:40.0, -40.0:0.0, -40.0:0.0], 5), np.repeat(np.arange(15), 40)
    for sign, expected in ((1, [[-40.0], [-1.0, 39.0]]), (-1, [[-39.0, 1.0], [40.0]])):
        own = ModuleOutputs(module, VECTOR)
        own._add(blocks, np.arange(600), np.zeros((600, module.mean.size)), sign * y)
        sheet = own.sheet()
        assert [[pick.y for pick in sheet[name]] for name in ("least", "greatest")] == expected


@given(st.lists(st.integers(0, 400)), st.integers(2, 90))
def test_rows_kept_do_not_depend_on_how_they_came(sizes: list[int], most: int) -> None:
    parts, one = Subsample(most), Subsample(most)
    numbers = np.arange(sum(sizes))
    one.add(numbers, -numbers)
    for part in np.split(numbers, np.cumsum(sizes))[:-1]:
        parts.add(part, -part)
    remaining = parts.columns[0].tolist() if sizes else []
    assert remaining == one.columns[0].tolist() == (-one.columns[1]).tolist()
    assert len(remaining) == one.count if one.step == 1 else most // 4 <= len(remaining) <= most
    if len(remaining) > 1:
        assert max(np.diff([*remaining, len(numbers)])) <= 3 * one.step
