"""The demonstration: record the iCub scene, learn from the log, check, and show."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from cdmisfa.core.blocks import Block, SeekableSource
from cdmisfa.core.errors import NotReproducedError
from cdmisfa.core.learning import Learner, Sink
from cdmisfa.core.modules import Module
from cdmisfa.core.signals import ACTIONS, BlockSignals
from cdmisfa.experiments.run_folder import RunResult
from cdmisfa.experiments.session import run
from cdmisfa.experiments.sources import Configuration, configure, open_source
from cdmisfa.experiments.statistics import correlation

SCENE = "icub"
MODULES = 2
"""Views whose object has something slow about it: the one in the centre is pure noise."""

CHECKED_ITERATIONS = 200
"""Length of the stretch on which live and recorded signals are compared."""

SCORED_FRAMES = 4000
"""Frames on which a module's output is compared with the object's true position."""


class StageProgress(Protocol):
    """What a stage of the demonstration reports to."""

    def update(self, done: float, total: float | None = None, note: str = "") -> None:
        """So much is done."""

    def say(self, line: str) -> None:
        """Show a line that stays."""


Stage = Callable[[str, str], AbstractContextManager[StageProgress]]
"""Opens a stage by its title and the unit that it counts."""


@dataclass(frozen=True, slots=True)
class DemoModule:
    """A module, and what in the world its output follows.

    Attributes:
        module: index, from 1.
        view: name of the view it was learned on.
        policy: "stay" or "switch" for each view.
        iteration: at which it was saved.
        follows: name of the true quantity that its first output follows best.
        correlation: of the two, without sign.
    """

    module: int
    view: str
    policy: tuple[str, ...]
    iteration: int
    follows: str
    correlation: float


@dataclass(frozen=True, slots=True)
class Report:
    """What the demonstration showed."""

    recording: Path
    run: Path
    figures: tuple[Path, ...]
    iterations: int
    live_equals_recorded: bool
    modules: tuple[DemoModule, ...]

    def as_json(self) -> dict[str, Any]:
        """The report as `demo --json` prints it."""
        return {"schema": 1, **asdict(self)}


def demo(out: Path, *, seed: int, frames: int, jobs: int, stage: Stage) -> Report:
    """Record the scene, learn from the recording, compare with live, draw figures.

    Args:
        out: folder that gets `recordings/demo-icub` and `runs/demo-icub`; replaced.
        seed: of world and learner.
        frames: of the recording; the learner starts it again at its end.
        jobs: processes that render.
        stage: opens each stage's report of progress.

    Raises:
        CdmisfaError: there is no simulator, or files cannot be written.
        NotReproducedError: live and recorded signals differ.
    """
    from recorder.recording import record_scene
    from replay.export.figures import draw_figures

    configuration = configure(SCENE, seed=seed)
    recording, folder = out / "recordings" / "demo-icub", out / "runs" / "demo-icub"
    with stage(f"1/4 recording three views, {frames} frames each", "frames") as bar:
        record_scene(
            SCENE,
            recording,
            configuration.scene,
            configuration.record,
            frames=frames,
            jobs=jobs,
            force=True,
            progress=lambda done: bar.update(done, frames),
        )
    with stage("2/4 learning from the recording", "blocks") as bar:
        result = _learn([recording], configuration, folder, seed, bar, max_modules=MODULES)
    with stage("3/4 checking live against recorded", "blocks") as bar:
        _check(recording, configuration, seed, min(CHECKED_ITERATIONS, frames // 40), bar)
    with stage("4/4 drawing figures", "modules") as bar, _opened([recording], seed) as source:
        learned = tuple(_score(module, source) for module in result.modules)
        figures = tuple(draw_figures(folder, None, force=True))
    return Report(recording, folder, figures, result.iterations, True, learned)


class ProgressSink(Sink):
    """Says how far a run is."""

    def __init__(self, bar: StageProgress, max_iterations: int | None) -> None:
        self._bar, self._max_iterations = bar, max_iterations

    def block(self, block: Block, signals: BlockSignals, learner: Learner) -> None:
        """See `Sink`."""
        if learner.iteration % 10 == 0:
            note = f"{len(learner.modules)} saved, ε {signals.epsilon:.2f}"
            self._bar.update(learner.iteration, self._max_iterations, note)


def _learn(
    words: list[str | Path],
    configuration: Configuration,
    out: Path | None,
    seed: int,
    bar: StageProgress,
    max_iterations: int | None = None,
    max_modules: int | None = None,
) -> RunResult:
    with _opened(words, seed) as source:
        return run(
            source,
            configuration.learner,
            out,
            seed=seed,
            sections=configuration.tables(),
            force=True,
            sinks=(ProgressSink(bar, max_iterations),),
            max_iterations=max_iterations,
            max_modules=max_modules,
        )


def _opened(words: list[str | Path], seed: int) -> AbstractContextManager[SeekableSource]:
    return contextlib.closing(open_source(words, seed=seed, loop=True)[0])


def _check(
    recording: Path, configuration: Configuration, seed: int, iterations: int, bar: StageProgress
) -> None:
    live, recorded = (
        _learn([word], configuration, None, seed, bar, max_iterations=iterations).signals_sha256
        for word in (SCENE, recording)
    )
    if live != recorded:
        raise NotReproducedError(
            f"live and recorded signals differ within {iterations} iterations of seed {seed}: "
            "see `cdmisfa doctor`"
        )
    bar.say(f"live and recorded signals of {iterations} iterations are the same, bit for bit")


def _score(module: Module, source: SeekableSource) -> DemoModule:
    """Find the true quantity that a module's first output on its own view follows best."""
    source.seek(0)
    block = source.take(module.stream_index, SCORED_FRAMES)
    y = module.transform(block.frames)[:, 0]
    r = [correlation(y, column) for column in block.truth.T]
    best = int(np.argmax(r))
    return DemoModule(
        module.index,
        module.stream,
        tuple(ACTIONS[action] for action in module.policy),
        module.iteration,
        source.spec.truth[best],
        r[best],
    )
