"""A run of one stream with modules to apply, and logs for them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from camera_files import pictures, write_images
from conftest import Cdmisfa
from run_data import module_of

from cdmisfa import Recipe
from cdmisfa.modules import Module
from replay.runs.modules import save_modules

TAU = 20
SIZE = (6, 8)


def make_run(cdmisfa: Cdmisfa, folder: Path) -> Path:
    """A run of one stream with two modules of three outputs, of frames 8x6."""
    out = folder / "run"
    log = camera(folder / "learned.mcap", 100, 9)
    quick = ("--set", f"learner.tau={TAU}", "--max-iterations", 3, "--no-rerun", "-o", out)
    done = cdmisfa("learn", log, "--size", "8x6", *quick)
    assert done.code == 0, done.err
    save_modules(out / "modules.npz", [learned(i) for i in (1, 2)])
    return out


def learned(index: int, shape: tuple[int, ...] = SIZE) -> Module:
    phi = np.random.default_rng(index).normal(size=(3, int(np.prod(shape))))
    made = module_of(index, index, phi)
    about: Any = {"eta": np.full(3, 0.02), "band_sd": np.full(3, np.nan)}
    about |= {"band_mean": about["eta"]}
    recipe = Recipe(shape, raw=(12, 16) if shape == SIZE else ())
    return replace(made, **about, recipe=recipe, frame_shape=shape, expansion="none", scale=1 / 255)


def camera(path: Path, count: int, seed: int = 0, gap: int = 0) -> Path:
    """A log of pictures 16x12, 50 a second; `gap` seconds are missing in its middle."""
    late = [1000 * gap * (i >= count // 2) for i in range(count)]
    images = [(1000 + 20 * i + late[i], image) for i, image in enumerate(pictures(count, seed))]
    return write_images(path, {"/cam": images})
