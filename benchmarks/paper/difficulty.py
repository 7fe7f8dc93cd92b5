"""How difficult each stream is for IncSFA alone, by the frames it needs."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from benchmarks.paper import Table, study
from cdmisfa.core.arrays import FloatArray
from cdmisfa.core.expansion import quadratic
from cdmisfa.experiments.results import correlation
from cdmisfa.features.following import batch_outputs
from cdmisfa.features.incsfa import IncrementalFeature
from cdmisfa.features.sfa import slowness
from cdmisfa.studies.paper.experiment import Settings, Trial, groups, mean_text, paper_config
from cdmisfa.studies.paper.oscillatory import STREAMS
from recorder.world.oscillatory import one_period
from replay.open_sources import open_recording

THRESHOLD = 0.95
"""Direction cosine with batch SFA above which a stream counts as learned.

Measured where the input is white: there it is the correlation of the outputs.
"""

LEARNABLE = 2 / 3 * math.sqrt(2) / (2 * math.pi)
"""Slowness below which, on held-out frames, a stream is learnable: two thirds of white noise's."""

FRAMES = {"oscillatory": 10_000, "icub": 12_000}
"""Frames IncSFA gets."""

STEP = 20
"""Frames between two looks at the direction."""

TEST = 1000
"""Held-out frames on which directions are compared."""

TRAINING = 4000
"""Frames of a view that batch SFA learns from; as many others test it."""

CONDITIONS = [{"scene": scene, "stream": stream} for scene in FRAMES for stream in range(3)]


def run(settings: Settings) -> dict[str, Any]:
    """Count frames until IncSFA's slowest output stays in the direction of batch SFA's."""
    scene, config = settings["scene"], paper_config(settings["scene"])
    if scene == "oscillatory":
        period = quadratic(one_period(STREAMS[settings["stream"]]))
        frames = np.concatenate([period] * (FRAMES[scene] // len(period)))
        # The stream repeats: other frames would hold nothing new.
        training = held_out = frames[: 4 * len(period)]
    else:
        with contextlib.closing(open_recording(settings["recording"])) as source:
            seen = source.take(settings["stream"], FRAMES[scene]).frames
        frames = seen.reshape(len(seen), -1) / 255.0
        training, held_out = frames[:TRAINING], frames[TRAINING : 2 * TRAINING]
    answer = held_out @ slowest_weights(training, config.components)
    rng = np.random.default_rng(np.random.SeedSequence(settings["seed"]))
    sfa = IncrementalFeature(config, frames.shape[1], rng)
    needed = 0
    for end in range(STEP, len(frames) + 1, STEP):
        sfa.update(frames[end - STEP : end])
        if not correlation(held_out[:TEST] @ sfa.phi[0], answer[:TEST]) > THRESHOLD:
            needed = end + STEP
    eta = float(slowness(answer[:, None])[0])
    return {"eta": eta, "frames": needed if needed <= len(frames) else None}


def slowest_weights(frames: FloatArray, components: int) -> FloatArray:
    """Return weights of batch SFA's slowest feature within the leading principal components."""
    return batch_outputs([(frames, False)], len(frames), components, outputs=1).phi[0]


def tables(trials: Sequence[Trial]) -> list[Table]:
    """Tabulate slowness and frames; a trial without frames did not stay above `THRESHOLD`."""
    rows = []
    for (scene, stream), group in groups(trials, "scene", "stream").items():
        eta = float(np.mean([t.row["eta"] for t in group]))
        needed = [t.row["frames"] or math.inf for t in group]
        row = [scene, stream + 1, f"{eta:.4f}", "yes" if eta < LEARNABLE else "no"]
        learned = sum(map(math.isfinite, needed))
        rows.append([*row, learned, f"{np.median(needed):.0f}", mean_text(needed, 0)])
    head = (
        "scene",
        "stream",
        "slowness of batch SFA, held out",
        "learnable",
        "trials that learned",
    )
    return [((*head, "frames until learned, median", "mean"), rows)]


if __name__ == "__main__":
    study("difficulty", CONDITIONS, run, tables, trials=20)
