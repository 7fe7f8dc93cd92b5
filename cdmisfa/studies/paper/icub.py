"""The vision-enabled iCub: two modules from pixels, and nothing from what cannot be learned."""

from __future__ import annotations

import contextlib
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa.agents.learners import open_learner
from cdmisfa.core.blocks import Block, FrameSource
from cdmisfa.core.config import LearnerConfig
from cdmisfa.core.learning import Learner, Sink
from cdmisfa.core.signals import BlockSignals
from cdmisfa.experiments.documents import plain, write_json
from cdmisfa.experiments.loop import learn_blocks
from cdmisfa.experiments.results import correlation
from cdmisfa.studies import pages
from cdmisfa.studies.paper.experiment import (
    Experiment,
    Findings,
    Output,
    Request,
    Settings,
    Trial,
    groups,
    learned_order,
    module_row,
)
from cdmisfa.studies.paper.oscillatory import paper_config
from replay.recordings.source import RecordedSource

OPTIMAL = ((0, "011"), (2, "110"))
"""Stream and policy of both modules, as the paper gives them."""

ITERATIONS = 1400
"""The second module is saved near 1160; the rest shows that no third one is."""

DRAWN = 200
"""Frames before a module is frozen whose output is drawn (paper)."""

OBJECTS = ("object1_y", "object3_y")
"""What each module should encode."""

LEARNERS = (("2.0", 0.1), ("1.0", 0.1), ("1.0", 0.6))
"""Algorithm and 1.0's threshold of the clustering error: that of decision 0014, and a looser one.

As 1.0's labels serve the head's positions.
"""


class Icub(Experiment):
    """2.0 learns object 1, then object 3, and no third module; 1.0 does not."""

    title = "Curiosity-driven, vision-enabled iCub"
    trials = (10, 2)

    def conditions(self, request: Request) -> list[Settings]:
        """Each learner, on one recording; it is made where none is given."""
        path = str(request.recording or make_recording(request))
        source = {"recording": path, "identity": describe_recording(path)}
        return [{**source, "algorithm": a, "roc_error": error} for a, error in LEARNERS]

    def run(self, settings: Settings) -> Output:
        """One trial: 1400 iterations, or as many as the recording has."""
        keys = {key: settings[key] for key in ("algorithm", "roc_error")}
        with contextlib.closing(RecordedSource(settings["recording"])) as source:
            return learn_curves(source, paper_config("icub", **keys), settings["seed"], ITERATIONS)

    def evaluate(self, trials: Sequence[Trial], found: Findings) -> None:
        """Object 1, then object 3, with the optimal policies, and no third module; by 2.0 only."""
        new, old, loose = (groups(trials, "algorithm", "roc_error")[which] for which in LEARNERS)
        n, good = len(new), _in_order(new)
        ended = sum(len(t.row["streams"]) == 2 for t in new)
        both, ten = "trials with both modules and policies optimal", "10 of 10 (text)"
        found.share(both, ten, good, n)
        found.share("trials without a third module", ten, ended, n)
        found.measured("iterations in all", [t.row["iterations"] for t in new], digits=0)
        for i, name in enumerate(OBJECTS):
            module = f"module {i + 1}"
            follows = f"correlation of {module} with {name}"
            found.of_module(f"{module} saved at iteration", new, "saved_at", i, digits=0)
            found.of_module(follows, new, "correlation", i, "encodes it (figure)")
        for (_, threshold), group in zip(LEARNERS[1:], (old, loose), strict=True):
            at = f"1.0, threshold {threshold:g}"
            modules = [len(t.row["streams"]) for t in group]
            found.measured(f"{at}: modules learned", modules, digits=1)
            found.share(f"{at}: {both}", "not applicable (text)", _in_order(group), len(group))
            for i, name in enumerate(OBJECTS):
                follows = f"{at}: correlation of module {i + 1} with {name}"
                found.of_module(follows, group, "correlation", i)
        found.claim_all("object 1 with [0,1,1], then object 3 with [1,1,0]", good, n)
        found.claim_all("no third module is learned", ended, n)
        found.claim_all("1.0 does not learn both", len(old) - _in_order(old), len(old))
        found.notes.append(
            "1.0 is given the head's positions as labels. Correlations are over the last "
            f"{DRAWN} frames before a module was saved."
        )

    def draw(self, trials: Sequence[Trial], folder: Path) -> list[Path]:
        """Value function, policy, eta-dot; the modules' outputs over time and the objects."""
        trials = [t for t in trials if t.settings["algorithm"] == "2.0"]
        figure, axes = pages.new_figure(1, 3)
        Q, policy, eta_dot = ([t.arrays[k] for t in trials] for k in ("Q", "policy", "eta_dot"))
        pages.draw_value_gains(axes[0, 0], Q, "c")
        pages.draw_policies(axes[0, 1], policy, "d", "share of trials that stay")
        pages.draw_eta_dot(axes[0, 2], eta_dot, paper_config("icub").delta, "e")
        paths = pages.save_figure(figure, folder, "icub")
        outputs, axes = pages.new_figure(2, 2, sharey=True)
        for i, name in enumerate(OBJECTS):
            one = next((t for t in trials if f"truth{i + 1}" in t.arrays), None)
            if one is None:
                continue
            y, truth = one.arrays[f"y{i + 1}"], one.arrays[f"truth{i + 1}"]
            axes[i, 0].plot(y, color=pages.COLOURS[0], linewidth=0.8)
            pages.letter_panel(axes[i, 0], "ac"[i], "frame", f"output y of module {i + 1}")
            axes[i, 1].plot(truth, y, ".", color=pages.COLOURS[0], markersize=3)
            x = np.linspace(truth.min(), truth.max(), 100)
            degree = min(3, len(np.unique(np.round(truth, 6))) - 1)
            if degree > 0:
                axes[i, 1].plot(x, np.polynomial.Polynomial.fit(truth, y, degree)(x), color="black")
            pages.letter_panel(axes[i, 1], "bd"[i], f"{name}, m", "")
            axes[i, 1].locator_params(axis="x", nbins=5)
        return paths + pages.save_figure(outputs, folder, "icub-outputs")


def made_recording(request: Request) -> Path:
    """Where the recording is that `make_recording` makes, once it is finished."""
    return request.folder.parent / "icub-recording" / "finished.json"


def make_recording(request: Request) -> Path:
    """A recording in the folder of the results, made unless it is there."""
    finished = made_recording(request)
    folder = finished.parent
    if not finished.exists():
        from recorder.recording import record_scene

        frames = ITERATIONS * paper_config("icub").tau
        resume = folder.exists()
        views = record_scene("icub", folder, frames=frames, jobs=request.jobs, resume=resume)
        write_json(finished, {"views": [view.as_json() for view in views]})
    return folder


def describe_recording(path: str) -> dict[str, Any]:
    """What a recording is, wherever it lies."""
    with contextlib.closing(RecordedSource(path)) as source:
        described: dict[str, Any] = plain(source.describe())
    return described


def _in_order(trials: Sequence[Trial]) -> int:
    """How many trials began with both modules as they should be."""
    return sum(learned_order(t.row)[:2] == OPTIMAL for t in trials)


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
        self._recent: deque[tuple[NDArray[Any], NDArray[Any]]] = deque(maxlen=-(-DRAWN // tau))

    def block(self, block: Block, signals: BlockSignals, learner: Learner) -> None:
        """See `Sink`."""
        for name, values in self._curves.items():
            values.append(np.asarray(getattr(signals, name), dtype=np.float32))
        if signals.novel:
            self._recent.append((signals.y[:, 0], block.truth))
        if signals.saved:
            number = len(learner.modules)
            y, truth = (np.concatenate(r)[-DRAWN:] for r in zip(*self._recent, strict=True))
            self.arrays[f"y{number}"] = y
            if number <= len(OBJECTS) and OBJECTS[number - 1] in self._truth:
                column = truth[:, self._truth.index(OBJECTS[number - 1])]
                self.arrays[f"truth{number}"] = column
                self.encoded.append(correlation(y, column))
            self._recent.clear()

    def finish(self) -> None:
        """See `Sink`."""
        self.arrays |= {name: np.stack(values) for name, values in self._curves.items()}


def learn_curves(source: FrameSource, config: LearnerConfig, seed: int, iterations: int) -> Output:
    """Learn from a source: a trial's row, and the curves and each module's last outputs."""
    learner = open_learner(config, source.spec, seed)
    curves = Curves(learner.tau, source.spec.truth)
    learn_blocks(source, learner, (curves,), max_iterations=iterations, max_modules=iterations)
    encoded, done = curves.encoded, learner.iteration
    row = {**module_row(learner.modules), "correlation": encoded, "iterations": done}
    return row, curves.arrays
