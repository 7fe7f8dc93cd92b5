"""A module knows what becomes of a raw picture: pictures are taken as the source gave them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from camera_files import RAW, raw
from conftest import Cdmisfa
from folders import external
from message_files import write_mcap

from cdmisfa import Module, Recipe, Run, make_frame
from recorder.images.options import Depth, Fit
from replay.runs.modules import load_modules

RNG = np.random.default_rng(5)


def of_type(dtype: str, *shape: int) -> Any:
    if dtype == "f4":
        return RNG.uniform(0.1, 6, (9, *shape)).astype("<f4")
    return RNG.integers(0, np.iinfo(dtype).max, (9, *shape), dtype)


def logged(path: Path, pictures: Any, encoding: str) -> Path:
    """A log of pictures, 25 a second."""
    messages = ((i * 40_000_000, raw(p, encoding)) for i, p in enumerate(pictures, start=1))
    return write_mcap(path, RAW, {"/cam": messages})


def module_of(recipe: Recipe | None, shape: tuple[int, ...]) -> Module:
    size = int(np.prod(shape))
    phi, mean, zero = np.random.default_rng(1).normal(size=(2, size)), np.zeros(size), np.zeros(2)
    scale = 1.0 if len(shape) == 1 else 1 / 255
    about: Any = {"expansion": "none", "scale": scale, "frame_shape": shape, "recipe": recipe}
    return Module(1, "a", 0, 9, phi, mean, zero, zero, zero, np.zeros(1, int), **about)


KINDS: dict[str, tuple[str, tuple[int, ...], bool, Depth | None]] = {
    "mono8": ("u1", (30, 41), False, None),
    "mono16": ("u2", (30, 41), False, None),
    "rgb8": ("u1", (30, 41, 3), False, None),
    "rgba8": ("u1", (30, 41, 4), True, None),
    "bayer_rggb8": ("u1", (60, 82), False, None),
    "bayer_gbrg16": ("u2", (60, 82), True, None),
    "16UC1": ("u2", (30, 41), False, (0.3, 5.0)),
    "32FC1": ("f4", (30, 41), False, (0.3, 5.0)),
}


@pytest.mark.parametrize("encoding", KINDS)
@pytest.mark.parametrize("fit", ["crop", "pad", "stretch"])
def test_a_raw_picture_becomes_the_frame_that_the_log_shows(
    encoding: str, fit: Fit, tmp_path: Path
) -> None:
    dtype, shape, color, depth = KINDS[encoding]
    pictures = of_type(dtype, *shape)
    log = logged(tmp_path / "a.mcap", pictures, encoding)
    source = external(log, size=(8, 16), fit=fit, color=color, range=depth)
    frames = source.take(0, len(pictures)).frames
    recipe = Recipe.of(source.describe(), frames.shape[1:])
    assert (recipe.fit, recipe.color, recipe.range) == (fit, color, depth)
    if encoding.startswith("bayer"):
        recipe = Recipe(recipe.shape, fit, color, pixels=source.pixels(0))
    module = module_of(recipe, frames.shape[1:])
    for given in (pictures, list(pictures)):
        np.testing.assert_array_equal(module.transform(given), module.transform(frames))
    np.testing.assert_array_equal(make_frame(pictures[0], recipe), frames[0])
    if dtype == "u1":
        np.testing.assert_array_equal(make_frame(pictures[0].astype(int), recipe), frames[0])


def test_a_run_and_its_modules_say_the_recipe(cdmisfa: Cdmisfa, tmp_path: Path) -> None:
    textures = RNG.uniform(-30, 30, (6, 12, 16, 3))
    waves = np.sin(np.arange(1000)[:, None] / (60 / np.arange(1, 7) ** 2))
    pictures = (128 + np.tensordot(waves, textures, 1)).clip(0, 255).astype(np.uint8)
    log, out = logged(tmp_path / "a.mcap", pictures, "bgr8"), tmp_path / "run"
    easy = ("delta=1", "eta_dot_window=3", "min_variance=0", "warm_up=0", "tau=20", "novel_share=0")
    settings = [word for key in easy for word in ("--set", f"learner.{key}")]
    options = (
        "--size",
        "8x8",
        "--set",
        "input.fit=stretch",
        "--algorithm",
        "2.0",
        "--max-modules",
        "1",
    )
    done = cdmisfa("learn", log, "-o", out, *options, *settings, "--no-rerun", "--json")
    assert done.code == 0, done.err
    said = {"shape": [8, 8], "fit": "stretch", "color": False, "range": None, "fields": []}
    stated = json.loads((out / "run.json").read_text())["result"]["modules"]
    assert [module["recipe"] for module in stated] == [
        {**said, "pixels": "", "raw": [12, 16]}
    ] * len(stated)
    module = Run(out).modules[0]
    assert module.recipe == load_modules(out)[0].recipe == Recipe((8, 8), "stretch", raw=(12, 16))
    frames = external(log, size=(8, 8), fit="stretch").take(0, 50).frames
    y = module.transform(pictures[:50, :, :, ::-1])  # red first
    np.testing.assert_array_equal(y, module.transform(frames))
    larger = pictures[:5].repeat(2, 1).repeat(2, 2)
    assert module.transform([*pictures[:5], *larger]).shape == (10, len(y[0]))


def test_numbers_of_any_type_are_taken_and_kept_in_their_range() -> None:
    module = module_of(Recipe((2,), range=(-1.0, 1.0)), (2,))
    given = [[3, -5], [1, 0]]
    np.testing.assert_array_equal(module.transform(np.array(given, float)), module.transform(given))
    np.testing.assert_array_equal(module.transform(given), module.transform([[1.0, -1.0], [1, 0]]))
    assert module.transform(np.zeros((0, 2), int)).shape == (0, 2)
