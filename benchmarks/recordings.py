"""Recordings to measure with: the sample log, and pictures as a camera gives them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.blocks import Block, SourceSpec
from recorder.config import RecordConfig
from recorder.log.viewfacts import Identity
from recorder.log.viewlog import ViewLog

SAMPLE = Path(__file__).parent.parent / "sample_logs" / "icub"


def noisy_pictures(n: int) -> NDArray[np.uint8]:
    """Pictures of slow waves with some noise, (n, 48, 128), which shrink to about a fifth."""
    rng = np.random.default_rng(3)
    y, x = np.mgrid[0:48, 0:128]
    frames = np.empty((n, 48, 128), np.uint8)
    for t in range(n):
        wave = 128 + 90 * np.sin(x / 17 + t / 40) * np.cos(y / 11 - t / 70)
        noise = rng.random((48, 128)) < 0.08
        frames[t] = wave // 8 * 8 + noise * 4
    return frames


def write_pictures(folder: Path, n: int) -> Path:
    """Record n noisy pictures in a folder; the file."""
    spec = SourceSpec(("left",), (48, 128), "uint8", ("x", "y"), 50.0, 10**18)
    log = ViewLog(folder, "left", Identity("noisy", 0, spec, {}), RecordConfig())
    log.write(Block(0, 0, noisy_pictures(n), np.zeros((n, 2))))
    log.file.finish()
    return log.file.path
