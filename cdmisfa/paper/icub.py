"""The vision-enabled iCub: two modules from pixels, and nothing from what cannot be learned."""

from __future__ import annotations

import contextlib
import json
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa.agents.learners import open_learner
from cdmisfa.core.blocks import Block, FrameSource
from cdmisfa.core.config import LearnerConfig, build, load_preset
from cdmisfa.core.errors import LogExhaustedError
from cdmisfa.core.learning import Learner, Sink
from cdmisfa.core.signals import BlockSignals
from cdmisfa.experiments.documents import write_json
from cdmisfa.experiments.loop import learn
from cdmisfa.experiments.statistics import correlation
from cdmisfa.paper import panels
from cdmisfa.paper.reproduce import (
    Claim,
    Findings,
    Line,
    Output,
    Request,
    Settings,
    Trial,
    groups,
    learned,
)
from replay.recordings.source import RecordedSource

TITLE = "Curiosity-driven, vision-enabled iCub"

OPTIMAL = ((0, "011"), (2, "110"))
"""Stream and policy of both modules, as the paper gives them."""

ITERATIONS = 1400
"""The second module is saved near 1160; the rest shows that no third one is."""

SHOWN = 200
"""Frames before a module is frozen whose output is drawn (paper)."""

OBJECTS = ("object1_y", "object3_y")
"""What each module should encode."""

LIVE = "live"
"""In place of a recording: render what each trial looks at."""


LEARNERS = (("2.0", 0.1), ("1.0", 0.1), ("1.0", 0.6))
"""Algorithm and 1.0's threshold of the clustering error: that of decision 0014, and a looser one.

As 1.0's labels serve the head's positions.
"""


def learner_config(**keys: Any) -> LearnerConfig:
    """The iCub preset with some keys set."""
    return build(LearnerConfig, "learner", load_preset("icub")["learner"], keys)


def plan(request: Request) -> list[dict[str, Any]]:
    """10 seeds of each learner, on one recording; it is made where none is given."""
    live = str(request.recording) == LIVE
    path = LIVE if live else str(recording_of(request))
    source = {"recording": path, "identity": None if live else identity(path)}
    return [
        {**source, "algorithm": algorithm, "roc_error": roc_error, "seed": seed}
        for algorithm, roc_error in LEARNERS
        for seed in range(request.count(10, 2))
    ]


def recording_of(request: Request) -> Path:
    """The recording that was given, or one made in the folder of the results."""
    if request.recording is not None:
        return request.recording
    folder = request.folder.parent / "icub-recording"
    finished = folder / "finished.json"
    if not finished.exists():
        from recorder.recording import record_scene

        views = record_scene(
            "icub",
            folder,
            frames=ITERATIONS * learner_config().tau,
            jobs=request.jobs,
            resume=folder.exists(),
        )
        write_json(finished, {"views": [view.as_json() for view in views]})
    return folder


def identity(path: str) -> dict[str, Any]:
    """What a recording is, wherever it lies."""
    with contextlib.closing(RecordedSource(path)) as source:
        return dict(json.loads(json.dumps(source.describe(), default=str)))


def open_world(settings: Settings) -> FrameSource:
    """The recording, or a live scene of the trial's own seed."""
    if settings["recording"] == LIVE:
        from recorder.world.icub.config import IcubConfig
        from recorder.world.scenes import open_scene

        return open_scene("icub", IcubConfig(seed=settings["seed"]))
    return RecordedSource(settings["recording"])


def run(settings: Settings) -> Output:
    """One trial: 1400 iterations, or as many as the recording has."""
    config = learner_config(algorithm=settings["algorithm"], roc_error=settings["roc_error"])
    with contextlib.closing(open_world(settings)) as source:
        return watch(source, config, settings["seed"], ITERATIONS)


class Curves(Sink):
    """Keeps what the figures show: some signals, and each module's last outputs.

    Attributes:
        arrays: by name; of module i its outputs are yi, the truth of its object truthi.
        encoded: of each module the correlation with its object.
    """

    def __init__(self, tau: int, truth: Sequence[str]) -> None:
        self.arrays: dict[str, NDArray[Any]] = {}
        self.encoded: list[float] = []
        self._truth = truth
        self._curves: dict[str, list[NDArray[Any]]] = {"eta_dot": [], "Q": [], "policy": []}
        self._recent: deque[tuple[NDArray[Any], NDArray[Any]]] = deque(maxlen=-(-SHOWN // tau))

    def block(self, block: Block, signals: BlockSignals, learner: Learner) -> None:
        """See `Sink`."""
        for name, values in self._curves.items():
            values.append(np.asarray(getattr(signals, name), dtype=np.float32))
        if signals.novel:
            self._recent.append((signals.y[:, 0], block.truth))
        if signals.saved:
            number = len(learner.modules)
            y, truth = (np.concatenate(r)[-SHOWN:] for r in zip(*self._recent, strict=True))
            self.arrays[f"y{number}"] = y
            if number <= len(OBJECTS) and OBJECTS[number - 1] in self._truth:
                column = truth[:, self._truth.index(OBJECTS[number - 1])]
                self.arrays[f"truth{number}"] = column
                self.encoded.append(correlation(y, column))
            self._recent.clear()

    def finish(self) -> None:
        """See `Sink`."""
        self.arrays |= {name: np.stack(values) for name, values in self._curves.items()}


def watch(source: FrameSource, config: LearnerConfig, seed: int, iterations: int) -> Output:
    """Learn from a source, and keep the curves and each module's last outputs."""
    learner = open_learner(config, source.spec, seed)
    curves = Curves(learner.tau, source.spec.truth)
    with contextlib.suppress(LogExhaustedError):
        learn(source, learner, (curves,), max_iterations=iterations, max_modules=iterations)
    row = {
        **learned(learner.modules),
        "correlation": curves.encoded,
        "iterations": learner.iteration,
    }
    return row, curves.arrays


def evaluate(trials: Sequence[Trial]) -> Findings:
    """Object 1, then object 3, with the optimal policies, and no third module; by 2.0 only."""
    new, old, loose = (groups(trials, "algorithm", "roc_error")[which] for which in LEARNERS)
    n, good = len(new), _in_order(new)
    ended = sum(len(t.row["streams"]) == 2 for t in new)
    lines = [
        Line.share("trials with both modules and policies optimal", "10 of 10 (text)", good, n),
        Line.share("trials without a third module", "10 of 10 (text)", ended, n),
        Line.measured("iterations in all", [t.row["iterations"] for t in new], digits=0),
    ]
    for i, name in enumerate(OBJECTS):
        module = f"module {i + 1}"
        follows = f"correlation of {module} with {name}"
        lines += [
            Line.of_module(f"{module} saved at iteration", new, "saved_at", i, digits=0),
            Line.of_module(follows, new, "correlation", i, "encodes it (figure)"),
        ]
    for (_, threshold), group in zip(LEARNERS[1:], (old, loose), strict=True):
        at = f"1.0, threshold {threshold:g}"
        modules = [len(t.row["streams"]) for t in group]
        both = f"{at}: trials with both modules and policies optimal"
        lines += [
            Line.measured(f"{at}: modules learned", modules, digits=1),
            Line.share(both, "not applicable (text)", _in_order(group), len(group)),
        ]
        for i, name in enumerate(OBJECTS):
            follows = f"{at}: correlation of module {i + 1} with {name}"
            lines.append(Line.of_module(follows, group, "correlation", i))
    claims = [
        Claim.of_all("object 1 with [0,1,1], then object 3 with [1,1,0]", good, n),
        Claim.of_all("no third module is learned", ended, n),
        Claim.of_all("1.0 does not learn both", len(old) - _in_order(old), len(old)),
    ]
    note = (
        "1.0 is given the head's positions as labels. Correlations are over the last "
        f"{SHOWN} frames before a module was saved."
    )
    return Findings(lines, claims, [note])


def _in_order(trials: Sequence[Trial]) -> int:
    """How many trials began with both modules as they should be."""
    found = [tuple(zip(t.row["streams"], t.row["policies"], strict=True)) for t in trials]
    return sum(f[:2] == OPTIMAL for f in found)


def draw(trials: Sequence[Trial], folder: Path) -> list[Path]:
    """Value function, policy, eta-dot; the modules' outputs over time and against the objects."""
    trials = [t for t in trials if t.settings["algorithm"] == "2.0"]
    drawn, axes = panels.figure(1, 3)
    panels.values(axes[0, 0], trials, "c")
    panels.policies(axes[0, 1], trials, "d", "policy, mean and SD")
    panels.eta_dot(axes[0, 2], trials, learner_config().delta, "e")
    paths = panels.save(drawn, folder, "icub")
    outputs, axes = panels.figure(2, 2)
    for i, name in enumerate(OBJECTS):
        one = next((t for t in trials if f"truth{i + 1}" in t.arrays), None)
        if one is None:
            continue
        y, truth = one.arrays[f"y{i + 1}"], one.arrays[f"truth{i + 1}"]
        axes[i, 0].plot(y, color=panels.COLOURS[0], linewidth=0.8)
        panels.label(axes[i, 0], f"f{2 * i + 1}", "frame", f"y, module {i + 1}")
        axes[i, 1].plot(truth, y, ".", color=panels.COLOURS[0], markersize=3)
        x = np.linspace(truth.min(), truth.max(), 100)
        degree = min(3, len(np.unique(np.round(truth, 6))) - 1)
        if degree > 0:
            axes[i, 1].plot(x, np.polynomial.Polynomial.fit(truth, y, degree)(x), color="red")
        panels.label(axes[i, 1], f"f{2 * i + 2}", f"{name}, m", f"y, module {i + 1}")
        axes[i, 1].locator_params(axis="x", nbins=5)
    return paths + panels.save(outputs, folder, "icub-outputs")
