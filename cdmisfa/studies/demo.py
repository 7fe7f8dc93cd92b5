"""The demo: record the iCub scene in a furnished room, learn from it, check, and write a report.

Without PyBullet it records the scene of oscillatory streams instead.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from contextlib import AbstractContextManager
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from cdmisfa.core.blocks import SeekableSource
from cdmisfa.core.errors import NotReproducedError
from cdmisfa.core.signals import ACTIONS
from cdmisfa.experiments.reports import write_report
from cdmisfa.experiments.run_folder import RunResult
from cdmisfa.experiments.session import run_session
from cdmisfa.experiments.sources import Layers, configure, open_source
from cdmisfa.modules import Module
from replay.truth_fits import truth_fits

SCENE, PRESET = "icub", "icub-real"

# Scene that needs no simulator.
FALLBACK_SCENE = "oscillatory"

# Iterations whose live and recorded signals are compared. They take a few seconds; signals that
# differ do so from the first block that differs on.
CHECKED_ITERATIONS = 200

# Frames on which the output of a module is compared with true positions: 80 s, in which each object
# crosses its range several times.
SCORED_FRAMES = 4000

# Opens a stage by its title and the unit that it counts; reports to a `cli.progress.Bar`.
Stage = Callable[[str, str], AbstractContextManager[Any]]


def demo(out: Path, *, seed: int, frames: int, jobs: int, stage: Stage) -> dict[str, Any]:
    """Record the scene, learn from the recording, compare with live, write the report.

    Args:
        out: folder in which `recordings/demo-icub` and `runs/demo-icub` are written or replaced.
        seed: seed of world and learner.
        frames: length of the recording, which the learner repeats.
        jobs: number of processes that render.
        stage: opens the progress display of a stage.

    Returns:
        The document of `demo --json`: files, and each module with the true position it follows.

    Raises:
        CdmisfaError: files cannot be written.
        NotReproducedError: live and recorded signals differ.
    """
    from recorder.recording import record_scene

    missing = [name for name in ("pybullet", "icub_models") if find_spec(name) is None]
    scene = FALLBACK_SCENE if missing else SCENE
    preset = None if missing else PRESET
    configuration = configure(scene, Layers.read(preset), seed)
    recording, folder = out / "recordings" / f"demo-{scene}", out / "runs" / f"demo-{scene}"

    def learn(bar: Any, word: str | Path, out: Path | None, most: int | None) -> RunResult:
        with _opened(word, preset, seed) as source:
            return run_session(
                source,
                configuration.learner,
                out,
                seed=seed,
                sections=configuration.tables(),
                force=True,
                sinks=(bar.sink(source.spec, most, events=out is not None),),
                max_iterations=most,
            )

    why = f" of {scene}, since {missing[0]} is not installed" if missing else ""
    with stage(f"1/4 recording three views{why}, {frames} frames each", "frames") as bar:
        record_scene(
            scene,
            recording,
            configuration.scene,
            configuration.record,
            frames=frames,
            jobs=jobs,
            force=True,
            progress=lambda done: bar.update(done, frames),
        )
    with stage("2/4 learning from the recording", "blocks") as bar:
        result = learn(bar, recording, folder, None)
    with stage("3/4 checking live against recorded", "blocks") as bar:
        most = min(CHECKED_ITERATIONS, frames // configuration.learner.tau)
        live, recorded = (learn(bar, w, None, most).signals_sha256 for w in (scene, recording))
        if live != recorded:
            raise NotReproducedError(
                f"live and recorded signals differ within {most} iterations of seed {seed}: "
                "see `cdmisfa doctor`"
            )
        bar.say(f"live and recorded signals of {most} iterations are the same, bit for bit")
    with stage("4/4 writing the report", "modules"), _opened(recording, preset, seed) as source:
        return {
            "schema": 1,
            "recording": recording,
            "run": folder,
            "report": write_report([folder]),
            "iterations": result.iterations,
            "live_equals_recorded": True,
            "modules": [followed_by(module, source) for module in result.modules],
        }


def _opened(
    word: str | Path, preset: str | None, seed: int
) -> AbstractContextManager[SeekableSource]:
    loops = isinstance(word, Path)  # a scene does not end, a recording does
    return contextlib.closing(open_source([word], preset=preset, seed=seed, loop=loops)[0])


def followed_by(module: Module, source: SeekableSource) -> dict[str, Any]:
    """Return a module with the true position that its first output on its view follows best."""
    source.seek(0)
    block = source.take(module.stream_index, SCORED_FRAMES)
    y = module.transform(block.frames)[:, 0]
    best = next(iter(truth_fits(source.spec.truth, block.truth, y)), None)
    return {
        "module": module.index,
        "view": module.stream,
        "policy": [ACTIONS[action] for action in module.policy],
        "iteration": module.iteration,
        "follows": best.function if best else "",
        "correlation": best.r if best else 0.0,
    }
