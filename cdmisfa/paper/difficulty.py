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

from cdmisfa.core.config import LearnerConfig
from cdmisfa.core.errors import UsageError
from cdmisfa.experiments.statistics import correlation, stays_above
from cdmisfa.features.incsfa import IncSFA
from cdmisfa.features.sfa import batch_sfa, leading_directions, slowness
from cdmisfa.paper import icub, oscillatory, panels
from cdmisfa.paper.reproduce import Claim, Findings, Line, Output, Request, Settings, Trial, groups
from replay.recordings.source import RecordedSource

TITLE = "Learning difficulty"

THRESHOLD = 0.95
"""Direction cosine with batch SFA above which a stream counts as learned.

Measured where the input is white: there it is the correlation of the outputs.
"""

WHITE_NOISE = math.sqrt(2) / (2 * math.pi)
"""Slowness of white noise: E(ydot^2) = 2 Var(y)."""

LEARNABLE = 2 / 3
"""Share of white noise's slowness below which, on held-out frames, a stream is learnable."""

FRAMES = {"oscillatory": 10_000, "icub": 12_000}
"""Frames IncSFA gets."""

STEP = 20
"""Frames between two looks at the direction."""

TEST = 1000
"""Held-out frames on which directions are compared."""

TRAINING = 4000
"""Frames of a view that batch SFA learns from; as many others test it."""


def plan(request: Request) -> list[dict[str, Any]]:
    """20 seeds of each stream; the iCub's views where there is a recording."""
    n = request.count(20, 12)
    scenes: list[tuple[str, str | None, Any]] = [("oscillatory", None, None)]
    if (found := _recording(request)) is not None:
        scenes.append(("icub", str(found), icub.identity(str(found))))
    return [
        {"scene": scene, "stream": stream, "recording": recording, "identity": who, "seed": seed}
        for scene, recording, who in scenes
        for stream in range(3)
        for seed in range(n)
    ]


def _recording(request: Request) -> Path | None:
    """The recording given, or the one that the experiment `icub` made."""
    if request.recording is not None and str(request.recording) != icub.LIVE:
        return request.recording
    made = request.folder.parent / "icub-recording"
    return made if (made / "finished.json").exists() and not request.quick else None


def run(settings: Settings) -> Output:
    """Learn one stream alone and compare with batch SFA as it goes."""
    task = _task(settings["scene"], settings["stream"], settings["recording"])
    return compare(task, settings["seed"])


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
    test: NDArray[np.float64]
    answer: NDArray[np.float64]
    eta: float


@lru_cache(maxsize=1)
def _task(scene: str, stream: int, recording: str | None) -> Task:
    if recording is None:
        config = oscillatory.learner_config()
        period = oscillatory.expanded_period(stream)
        frames = np.concatenate([period] * (FRAMES[scene] // len(period)))
        # The stream repeats: other frames would hold nothing new.
        training = held_out = frames[: 4 * len(period)]
    else:
        config = icub.learner_config()
        frames = _view(recording, stream, FRAMES[scene])
        if len(frames) <= TRAINING:
            raise UsageError(
                f"{recording} holds {len(frames)} frames of a view: how hard its views are to "
                f"learn takes more than {TRAINING}: record them, or leave --recording out"
            )
        training, held_out = frames[:TRAINING], frames[TRAINING : 2 * TRAINING]
    oracle = slowest(training, config.components)
    answer = held_out / _unit(held_out) @ oracle
    test = held_out[:TEST] / _unit(held_out)
    return Task(frames, config, test, answer[:TEST], float(slowness(answer[:, None])[0]))


def _view(recording: str, stream: int, count: int) -> NDArray[Any]:
    """The first frames of a view, flat."""
    with contextlib.closing(RecordedSource(recording)) as source:
        count = min(count, source.frames)
        return source.take(stream, count).frames.reshape(count, -1)


def compare(task: Task, seed: int) -> Output:
    """Frames until IncSFA's slowest output stays in the direction of batch SFA's."""
    rng = np.random.default_rng(np.random.SeedSequence(seed))
    sfa = IncSFA(task.config, task.frames.shape[1], rng)
    cosines = []
    for start in range(0, len(task.frames) - STEP + 1, STEP):
        sfa.update(task.frames[start : start + STEP])
        cosines.append(correlation(task.test @ sfa.phi[0], task.answer))
    first = stays_above(cosines, THRESHOLD)
    row = {
        "eta_held_out": task.eta,
        "learnable": task.eta < LEARNABLE * WHITE_NOISE,
        "frames": (first + 1) * STEP if first >= 0 else None,
        "cosine": float(np.median(cosines[-50:])),
    }
    return row, {"cosine": np.array(cosines, dtype=np.float32)}


def slowest(frames: NDArray[Any], components: int) -> NDArray[np.float64]:
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


def evaluate(trials: Sequence[Trial]) -> Findings:
    """Order of the frames needed, and which streams cannot be learned."""
    lines: list[Line] = []
    medians: dict[tuple[str, int], float] = {}
    learnable: dict[tuple[str, int], bool] = {}
    names = {"oscillatory": "stream x{}", "icub": "iCub view {}"}
    for (scene, stream), group in groups(trials, "scene", "stream").items():
        name = names[scene].format(stream + 1)
        learnable[scene, stream] = all(t.row["learnable"] for t in group)
        eta = [t.row["eta_held_out"] for t in group]
        held_out = f"{name}: slowness of batch SFA on held-out frames"
        lines.append(Line.measured(held_out, eta, digits=4))
        if learnable[scene, stream]:
            needed = [math.inf if (f := t.row["frames"]) is None else f for t in group]
            medians[scene, stream] = float(np.median(needed))
            lines.append(Line.measured(f"{name}: frames until learned", needed, digits=0))
    order = [medians.get(("oscillatory", s), math.inf) for s in range(3)]
    claims = [
        Claim(
            "x1 is easier than x2, and x2 than x3",
            order[0] < order[1] < order[2] < math.inf,
            " < ".join(f"{v:.0f}" for v in order) + " frames (medians)",
        )
    ]
    if any(scene == "icub" for scene, _ in learnable):
        one, three = medians.get(("icub", 0), math.inf), medians.get(("icub", 2), math.inf)
        claims += [
            Claim(
                "view 1 is easier than view 3",
                one < three,
                f"{one:.0f} and {three:.0f} frames (medians)",
            ),
            Claim(
                "view 2 is not learnable",
                not learnable["icub", 1],
                f"slowness below {LEARNABLE * WHITE_NOISE:.3f} on held-out frames would be",
            ),
        ]
    notes = [
        f"White noise has slowness {WHITE_NOISE:.4f}. Only learnable streams have frames; a trial "
        "that does not stay above a direction cosine of .95 is not in n, and never in the median."
    ]
    return Findings(lines, claims, notes)


def draw(trials: Sequence[Trial], folder: Path) -> list[Path]:
    """Direction cosine over frames, a colour a stream."""
    scenes = list(dict.fromkeys(t.settings["scene"] for t in trials))
    drawn, axes = panels.figure(1, len(scenes))
    for panel, scene, letter in zip(axes[0], scenes, "ab", strict=False):
        alone = [trial for trial in trials if trial.settings["scene"] == scene]
        for (stream,), group in groups(alone, "stream").items():
            mean, sd = panels.mean_sd(panels.stack([t.arrays["cosine"] for t in group]))
            at, colour = (np.arange(len(mean)) + 1) * STEP, panels.COLOURS[stream]
            panels.band(panel, mean, sd, stream, x=at, within=(0, 1))
            panel.plot(at, mean, color=colour, linewidth=1, label=panels.STREAM_NAMES[stream])
        panel.axhline(THRESHOLD, color="grey", linestyle=":", linewidth=0.8)
        panel.set_xscale("log")
        panel.legend(fontsize=6)
        panels.label(panel, letter, f"frames ({scene})", "|cos| with batch SFA")
    return panels.save(drawn, folder, "difficulty")
