"""One run: a source, a learner, and the folder that keeps what happened.

RUN/run.mcap signals, RUN/modules.npz frozen modules, RUN/run.json manifest and result,
RUN/run.rrd the view. The loop knows nothing of where blocks come from.
"""

from __future__ import annotations

import contextlib
import functools
import json
import os
import platform
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Any

from cdmisfa.agents.agent import think
from cdmisfa.agents.learner import CuriousLearner
from cdmisfa.core.blocks import FrameSource, SeekableSource
from cdmisfa.core.compiled import needs_compiling
from cdmisfa.core.config import LearnerConfig, as_table
from cdmisfa.core.errors import CdmisfaError, LogExhaustedError, UsageError
from cdmisfa.core.modules import Module
from cdmisfa.core.signals import SCHEMA_VERSION, SignalsHash
from cdmisfa.experiments.checkpoint import (
    COMMAND,
    SET_ASIDE,
    Checkpoint,
    checkpoints,
    newest_covered,
    restore,
    save_checkpoint,
    set_aside,
)
from cdmisfa.experiments.endings import ENDINGS, ending
from cdmisfa.features.incsfa import strict
from recorder.log.folder import held

PACKAGES = ("cdmisfa", "numpy", "numba", "mcap", "protobuf", "rerun-sdk", "pybullet", "icub-models")


@dataclass(frozen=True, slots=True)
class Progress:
    """Where a run stands: iterations and frames so far, modules learned, epsilon."""

    iteration: int
    frames: int
    modules: int
    epsilon: float
    max_iterations: int | None


@dataclass(frozen=True, slots=True)
class RunResult:
    """What a run came to; `as_json` is the command line's contract."""

    run: str | None
    source: Mapping[str, Any]
    streams: tuple[str, ...]
    seed: int
    iterations: int
    frames: int
    signals_sha256: str
    modules: tuple[Module, ...]
    final_policy: tuple[int, ...]
    epsilon: float
    ended: str
    truth: tuple[str, ...] = field(default=())

    def as_json(self) -> dict[str, Any]:
        """The result as `learn --json` prints it."""
        return {
            "schema": 1,
            "run": self.run,
            "source": dict(self.source),
            "seed": self.seed,
            "iterations": self.iterations,
            "frames": self.frames,
            "signals_sha256": self.signals_sha256,
            "modules": [module_table(module, self.streams) for module in self.modules],
            "final_policy": list(self.final_policy),
            "epsilon": self.epsilon,
            "ended": self.ended,
        }


class RunExhaustedError(LogExhaustedError):
    """The recording of a run ended before the run did; `result` is what it came to."""

    result: RunResult


def module_table(module: Module, streams: Sequence[str]) -> dict[str, Any]:
    """What a result says about a module, as JSON values."""
    return {
        "index": module.index,
        "stream": streams[module.stream],
        "stream_index": module.stream,
        "iteration": module.iteration,
        "policy": module.policy.tolist(),
        "eta": module.eta.tolist(),
    }


def learn(
    source: FrameSource,
    config: LearnerConfig,
    out: Path | None = None,
    *,
    seed: int = 0,
    max_iterations: int | None = None,
    max_modules: int | None = None,
    sections: Mapping[str, Any] | None = None,
    force: bool = False,
    rerun: bool = True,
    progress: Callable[[Progress], None] | None = None,
    stop: Callable[[], bool] = lambda: False,
    resume: bool = False,
    checkpoint_every: int = 200,
    live: bool = False,
    announce: Callable[[str], None] | None = None,
    command: Mapping[str, Any] | None = None,
) -> RunResult:
    """Learn from a source until nothing is left to learn, and log every signal.

    Args:
        source: live or recorded; left open.
        config: the learner's configuration.
        out: folder of the run, or None to log nothing.
        seed: seed of the policy and of the abstractions' first weights.
        max_iterations: end after so many.
        max_modules: end after so many modules; by default as many as there are streams.
        sections: further configuration tables (`scene`, `record`) for the manifest.
        force: replace an existing run.
        rerun: also build the Rerun view.
        progress: called after every iteration.
        stop: asked after every iteration; true ends the run cleanly.
        resume: go on with the run in `out` where it was stopped, in whatever way; its
            signals become those of a run that was never stopped.
        checkpoint_every: iterations between checkpoints; 0 writes one at the end only.
        live: also show the run in Rerun while it learns, to viewers on this machine.
        announce: called with the address of the live view.
        command: how the run is begun, kept with it; see `cdmisfa.experiments.again`.

    Raises:
        UsageError: `out` exists and `force` is not set; or `resume` is, and `out` holds no
            run or one with another configuration or source.
        RunExhaustedError: a recording ended first; what was learned is saved.
    """
    learner = CuriousLearner(config, source.spec, seed)
    limit = max_modules if max_modules is not None else len(source.spec.streams)
    digest = SignalsHash()
    tables = {**(sections or {}), "learner": as_table(config)}
    exhausted: LogExhaustedError | None = None
    with (
        _run_log(out, source, tables, seed, force, resume, command) as log,
        _live_view(live, announce, config, source, tables, seed) as shown,
    ):
        if log is not None and resume:
            _go_on(log, learner, source, digest)
            if shown is not None:
                shown.earlier(log.path.parent)
        _say_if_compiling()
        while True:
            ended = ending(learner, limit, max_iterations) or ("interrupted" if stop() else "")
            if ended:
                break
            try:
                block = source.take(learner.stream, learner.tau)
            except LogExhaustedError as error:
                if stop():  # while it waited for frames to be recorded
                    ended = "interrupted"
                else:
                    ended, exhausted = "log_exhausted", error
                break
            learned = len(learner.modules)
            signals = learner.step(block)
            digest.add(signals)
            for sink in (log, shown):
                if sink is None:
                    continue
                sink.block(block, signals, learner)
                if len(learner.modules) > learned:
                    sink.event(block.t, signals.iteration, _saved_text(learner, source))
            if log is not None and checkpoint_every and learner.iteration % checkpoint_every == 0:
                _save_checkpoint(log, learner, source)
            if progress is not None:
                progress(
                    Progress(
                        learner.iteration,
                        learner.iteration * learner.tau,
                        len(learner.modules),
                        learner.epsilon,
                        max_iterations,
                    )
                )
        for sink in (log, shown):
            if sink is not None:
                sink.event(source.t, max(learner.iteration - 1, 0), f"ended: {ENDINGS[ended]}")
        if log is not None:
            _save_checkpoint(log, learner, source)
            log.finish()
        result = RunResult(
            run=str(out) if out is not None else None,
            source=source.describe(),
            streams=source.spec.streams,
            seed=seed,
            iterations=learner.iteration,
            frames=learner.iteration * learner.tau,
            signals_sha256=digest.hexdigest(),
            modules=tuple(learner.modules),
            final_policy=tuple(learner.policy.tolist()),
            epsilon=learner.epsilon,
            ended=ended,
            truth=source.spec.truth,
        )
        if out is not None:
            _write_run(out, result, tables, rerun, command)
    if exhausted is not None:
        kept = f"; {len(learner.modules)} modules of {learner.iteration} iterations are in {out}"
        message = f"{exhausted}{kept if out is not None else ''}"
        over = RunExhaustedError(message)
        over.result = result
        raise over from exhausted
    return result


def _saved_text(learner: CuriousLearner, source: FrameSource) -> str:
    module = learner.modules[-1]
    return (
        f"module {module.index} saved on stream {source.spec.streams[module.stream]}, "
        f"policy {module.policy.tolist()}"
    )


@contextlib.contextmanager
def _run_log(
    out: Path | None,
    source: FrameSource,
    tables: Mapping[str, Any],
    seed: int,
    force: bool,
    resume: bool,
    command: Mapping[str, Any] | None,
) -> Iterator[Any]:
    """The run's log, to be finished inside, and its folder held; None for no folder.

    On failure a log that is not finished is left as a readable prefix.
    """
    if out is None:
        if resume:
            raise UsageError("which run to go on with? name its folder")
        yield None
        return
    from replay.runs.writer import RunWriter

    manifest = {"config": tables, "seed": seed, "source": dict(source.describe())}
    if command is not None:
        manifest[COMMAND] = dict(command)
    if not resume:
        if out.exists() and not force and (not out.is_dir() or any(out.iterdir())):
            raise UsageError(f"{out} exists: choose another folder, or say --force to replace it")
        try:
            out.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise _no_folder(out, error) from error
    with held(out):
        stale = [out / name for name in ("run.json", "modules.npz", "run.rrd")]
        if resume:
            set_aside(out, source.spec, manifest)
        else:
            stale += [out / "run.mcap", out / SET_ASIDE, *checkpoints(out)]
        try:
            for path in stale:
                path.unlink(missing_ok=True)
        except OSError as error:
            raise _no_folder(out, error) from error
        log = RunWriter(out / "run.mcap", source.spec, manifest, force=force or resume)
        try:
            yield log
        except BaseException:
            log.abandon()
            raise


@contextlib.contextmanager
def _live_view(
    live: bool,
    announce: Callable[[str], None] | None,
    config: LearnerConfig,
    source: FrameSource,
    tables: Mapping[str, Any],
    seed: int,
) -> Iterator[Any]:
    """The view that shows the run while it learns, or None."""
    if not live:
        yield None
        return
    from replay.viewer.live import LiveView

    manifest = {"config": tables, "seed": seed, "source": dict(source.describe())}
    with LiveView(source.spec, manifest, config.tau, config.outputs) as shown:
        if announce is not None:
            announce(shown.address)
        yield shown


def _no_folder(out: Path, error: OSError) -> UsageError:
    reason = error.strerror or error
    return UsageError(f"{out} cannot be a run's folder ({reason}): choose another")


def _go_on(log: Any, learner: CuriousLearner, source: FrameSource, digest: SignalsHash) -> None:
    """Bring log, learner, source and digest to where the run's newest checkpoint stands."""
    from replay.runs.log import count_iterations

    run = log.path.parent
    before = run / SET_ASIDE
    if not before.exists():
        return
    checkpoint = newest_covered(run, count_iterations(before))
    if checkpoint is not None:
        restore(learner, checkpoint)
        for signals in log.take_over(before, checkpoint.iteration):
            digest.add(signals)
        if not isinstance(source, SeekableSource):
            raise UsageError("this source cannot go back: resume from its recording")
        source.seek(checkpoint.t)
        last = max(checkpoint.iteration - 1, 0)
        log.event(source.t, last, f"resumed at iteration {checkpoint.iteration}")
        changed = [
            f"{name} is {now}, was {checkpoint.versions.get(name)}"
            for name, now in versions().items()
            if checkpoint.versions.get(name) != now
        ]
        if changed:
            log.event(source.t, last, "; ".join(changed), "WARNING")
        log.flush()
    before.unlink()


def _save_checkpoint(log: Any, learner: CuriousLearner, source: FrameSource) -> None:
    log.flush()
    save_checkpoint(
        log.path.parent, Checkpoint(learner.iteration, source.t, learner.state, versions())
    )


def _say_if_compiling() -> None:
    """Explain the wait to whoever is looking, when numba has nothing on disk yet."""
    if not sys.stderr.isatty():
        return
    functions: list[Callable[..., Any]] = [think, strict.update]
    if scan := sys.modules.get("replay.recordings.kernels"):  # of a source that reads recordings
        functions += [scan.scan, scan.gather]
    if any(needs_compiling(function) for function in functions):
        print("compiling the learner, this first time only (some 10 to 30 s)", file=sys.stderr)


def _write_run(
    out: Path,
    result: RunResult,
    tables: Mapping[str, Any],
    rerun: bool,
    command: Mapping[str, Any] | None,
) -> None:
    from replay.runs.modules import save_modules

    save_modules(out / "modules.npz", result.modules)
    document = {
        "schema": 1,
        "signals_schema": SCHEMA_VERSION,
        "config": tables,
        "seed": result.seed,
        "source": dict(result.source),
        "streams": list(result.streams),
        "versions": versions(),
        "platform": {"system": platform.system(), "machine": platform.machine()},
        "result": result.as_json(),
    }
    if command is not None:
        document[COMMAND] = dict(command)
    write_json(out / "run.json", document)
    if rerun:
        from replay.view.build import build_view

        build_view(out, out / "run.rrd")


@functools.cache
def versions() -> dict[str, str]:
    """Versions of Python and of the packages a result may depend on."""
    found = {"python": platform.python_version()}
    for name in PACKAGES:
        with contextlib.suppress(metadata.PackageNotFoundError):
            found[name] = metadata.version(name)
    return found


def write_json(path: Path, document: Mapping[str, Any]) -> None:
    """Write a JSON document so that the file is never seen half written.

    Raises:
        CdmisfaError: the file cannot be written.
    """
    text = json.dumps(document, indent=2) + "\n"
    partial = path.with_name(path.name + ".partial")
    try:
        with open(partial, "w", encoding="utf-8") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        os.replace(partial, path)
    except OSError as error:
        raise CdmisfaError(f"{path} cannot be written: {error.strerror or error}") from error
