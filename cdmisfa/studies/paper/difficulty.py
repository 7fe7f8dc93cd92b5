"""How difficult each stream is for IncSFA alone, by the frames it needs."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.arrays import FloatArray
from cdmisfa.core.config import LearnerConfig
from cdmisfa.core.errors import UsageError
from cdmisfa.experiments.results import correlation, stays_above
from cdmisfa.features.incsfa import IncrementalFeature
from cdmisfa.features.sfa import batch_sfa, leading_directions, slowness
from cdmisfa.studies import pages
from cdmisfa.studies.paper import icub
from cdmisfa.studies.paper.experiment import (
    Experiment,
    Findings,
    Output,
    Request,
    Settings,
    Trial,
    groups,
)
from cdmisfa.studies.paper.oscillatory import expanded_period, paper_config
from replay.recordings.source import RecordedSource

THRESHOLD = 0.95
"""Direction cosine with batch SFA above which a stream counts as learned.

Measured where the input is white: there it is the correlation of the outputs.
"""

WHITE_NOISE = math.sqrt(2) / (2 * math.pi)
"""Slowness of white noise: E(ydot^2) = 2 Var(y)."""

LEARNABLE = 2 / 3 * WHITE_NOISE
"""Slowness below which, on held-out frames, a stream is learnable."""

FRAMES = {"oscillatory": 10_000, "icub": 12_000}
"""Frames IncSFA gets."""

STEP = 20
"""Frames between two looks at the direction."""

TEST = 1000
"""Held-out frames on which directions are compared."""

TRAINING = 4000
"""Frames of a view that batch SFA learns from; as many others test it."""


@dataclass(frozen=True, slots=True)
class Task:
    """A stream to learn, with the answer.

    Attributes:
        frames: (n, I) what IncSFA gets.
        config: its constants.
        test: (n, I) held-out frames.
        answer: (n,) batch SFA's slowest output on them.
        eta: its slowness.
    """

    frames: NDArray[Any]
    config: LearnerConfig
    test: FloatArray
    answer: FloatArray
    eta: float


class Difficulty(Experiment):
    """The order of the frames needed, and which streams cannot be learned."""

    title = "Learning difficulty"
    trials = (20, 12)

    def conditions(self, request: Request) -> list[Settings]:
        """Each stream; the iCub's views, too, where there is a recording."""
        scenes: list[Settings] = [{"scene": "oscillatory", "recording": None, "identity": None}]
        recording, made = request.recording, icub.made_recording(request)
        if recording is None and made.exists() and not request.quick:
            recording = made.parent
        if recording is not None:
            path = str(recording)
            take_view(path, 0, 1)
            described = icub.describe_recording(path)
            scenes.append({"scene": "icub", "recording": path, "identity": described})
        return [{**scene, "stream": stream} for scene in scenes for stream in range(3)]

    def run(self, settings: Settings) -> Output:
        """Frames until IncSFA's slowest output stays in the direction of batch SFA's."""
        task = _task(settings["scene"], settings["stream"], settings["recording"])
        rng = np.random.default_rng(np.random.SeedSequence(settings["seed"]))
        sfa = IncrementalFeature(task.config, task.frames.shape[1], rng)
        cosines = []
        for start in range(0, len(task.frames) - STEP + 1, STEP):
            sfa.update(task.frames[start : start + STEP])
            cosines.append(correlation(task.test @ sfa.phi[0], task.answer))
        first = stays_above(cosines, THRESHOLD)
        row = {
            "eta_held_out": task.eta,
            "learnable": task.eta < LEARNABLE,
            "frames": (first + 1) * STEP if first >= 0 else None,
            "cosine": float(np.median(cosines[-50:])),
        }
        return row, {"cosine": np.array(cosines, dtype=np.float32)}

    def evaluate(self, trials: Sequence[Trial], found: Findings) -> None:
        """Order of the frames needed, and which streams cannot be learned."""
        medians: dict[tuple[str, int], float] = {}
        names = {"oscillatory": "stream x{}", "icub": "iCub view {}"}
        for (scene, stream), group in groups(trials, "scene", "stream").items():
            name = names[scene].format(stream + 1)
            eta = [t.row["eta_held_out"] for t in group]
            held_out = f"{name}: slowness of batch SFA on held-out frames"
            found.measured(held_out, eta, digits=4)
            if all(t.row["learnable"] for t in group):
                needed = [math.inf if (f := t.row["frames"]) is None else f for t in group]
                medians[scene, stream] = float(np.median(needed))
                found.measured(f"{name}: frames until learned", needed, digits=0)
        order = [medians.get(("oscillatory", s), math.inf) for s in range(3)]
        easier = order[0] < order[1] < order[2] < math.inf
        in_words = " < ".join(f"{v:.0f}" for v in order) + " frames (medians)"
        found.claim("x1 is easier than x2, and x2 than x3", easier, in_words)
        if any(t.settings["scene"] == "icub" for t in trials):
            one, three = (medians.get(("icub", view), math.inf) for view in (0, 2))
            in_words = f"{one:.0f} and {three:.0f} frames (medians)"
            found.claim("view 1 is easier than view 3", one < three, in_words)
            limit = f"slowness below {LEARNABLE:.3f} on held-out frames would be"
            found.claim("view 2 is not learnable", ("icub", 1) not in medians, limit)
        found.notes.append(
            f"White noise has slowness {WHITE_NOISE:.4f}. Only learnable streams have frames; a "
            "trial that does not stay above a direction cosine of .95 is not in n, and never in "
            "the median. The paper's own measure, the curiosity function of earlier work, it does "
            "not define; the rewards that its agent goes by are told with the experiments above."
        )

    def draw(self, trials: Sequence[Trial], folder: Path) -> list[Path]:
        """Direction cosine over frames, a colour a stream."""
        scenes = groups(trials, "scene")
        figure, axes = pages.new_figure(1, len(scenes))
        for panel, ((scene,), alone), letter in zip(axes[0], scenes.items(), "ab", strict=False):
            for (stream,), group in groups(alone, "stream").items():
                mean, sd = pages.mean_sd(pages.stack([t.arrays["cosine"] for t in group]))
                at, colour = (np.arange(len(mean)) + 1) * STEP, pages.COLOURS[stream]
                pages.draw_band(panel, at, mean, sd, colour, limits=(0, 1))
                panel.plot(at, mean, color=colour, linewidth=1, label=pages.STREAM_NAMES[stream])
            panel.axhline(THRESHOLD, color="grey", linestyle=":", linewidth=0.8)
            panel.set_xscale("log")
            pages.explain_above(panel)
            pages.letter_panel(panel, letter, f"frames ({scene})", "|cos| with batch SFA")
        return pages.save_figure(figure, folder, "difficulty")


@lru_cache(maxsize=1)
def _task(scene: str, stream: int, recording: str | None) -> Task:
    config = paper_config(scene)
    if recording is None:
        period = expanded_period(stream)
        frames = np.concatenate([period] * (FRAMES[scene] // len(period)))
        # The stream repeats: other frames would hold nothing new.
        training = held_out = frames[: 4 * len(period)]
    else:
        frames = take_view(recording, stream, FRAMES[scene])
        training, held_out = frames[:TRAINING], frames[TRAINING : 2 * TRAINING]
    oracle = slowest_weights(training, config.components)
    answer = held_out / _unit(held_out) @ oracle
    test = held_out[:TEST] / _unit(held_out)
    return Task(frames, config, test, answer[:TEST], float(slowness(answer[:, None])[0]))


def take_view(recording: str, stream: int, count: int) -> NDArray[Any]:
    """The first frames of a view, flat.

    Raises:
        UsageError: the recording has too few to learn from and to test.
    """
    with contextlib.closing(RecordedSource(recording)) as source:
        if source.frames <= TRAINING:
            raise UsageError(
                f"{recording} holds {source.frames} frames of a view: how hard its views are to "
                f"learn takes more than {TRAINING}: record them, or leave --recording out"
            )
        count = min(count, source.frames)
        return source.take(stream, count).frames.reshape(count, -1)


def slowest_weights(frames: NDArray[Any], components: int) -> FloatArray:
    """Weights of the slowest feature within the leading principal components, by batch SFA.

    Args:
        frames: (n, I).
        components: how many.

    Returns:
        (I,).
    """
    x = frames / _unit(frames)
    x = x - x.mean(axis=0)
    leading = leading_directions(x, components)
    return np.asarray(leading @ batch_sfa(x @ leading, 1)[0])


def _unit(frames: NDArray[Any]) -> float:
    return 255.0 if frames.dtype == np.uint8 else 1.0
