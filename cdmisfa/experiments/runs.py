"""One run: a source, a learner, and the folder that keeps what happened.

RUN/run.mcap signals, RUN/modules.npz frozen modules, RUN/run.json manifest and result,
RUN/run.rrd the view. The loop itself is in `loop`.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cdmisfa.agents.learners import open_learner
from cdmisfa.core.blocks import (
    Block,
    FrameSource,
    SeekableSource,
    SourceSpec,
    description,
)
from cdmisfa.core.config import as_table
from cdmisfa.core.errors import LogExhaustedError, UsageError
from cdmisfa.core.learning import ARITHMETIC, Keyframe, Learner, Sink, arithmetic_of
from cdmisfa.core.modules import Module
from cdmisfa.core.signals import SCHEMA_VERSION, BlockSignals
from cdmisfa.experiments.documents import machine, write_json
from cdmisfa.experiments.loop import Digest, learn
from cdmisfa.experiments.resume import (
    COMMAND,
    FORK,
    SET_ASIDE,
    Fork,
    Keyframes,
    ancestry_of,
    bring_back,
    go_back,
    set_aside,
    stated_whole,
    take_over,
)
from cdmisfa.experiments.sources import versions_used
from recorder.log.files import (
    folder_here,
    held,
    logs_in,
    make_folder,
    partial_path,
    refuse_existing,
    refuse_special,
)

if TYPE_CHECKING:
    from replay.runs.writer import RunWriter


@dataclass(frozen=True, slots=True)
class RunResult:
    """What a run came to; `as_json` is the command line's contract.

    Attributes:
        run: its folder, if it has one.
        source: what it learned from, described.
        modules: what was learned, in order.
        summary: what else the learner says of itself.
        ended: why, a key of `ENDINGS`.
    """

    run: str | None
    source: Mapping[str, Any]
    streams: tuple[str, ...]
    seed: int
    iterations: int
    frames: int
    signals_sha256: str
    modules: tuple[Module, ...]
    summary: Mapping[str, Any]
    ended: str

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
            "modules": [module_table(module) for module in self.modules],
            **self.summary,
            "ended": self.ended,
        }


class RunExhaustedError(LogExhaustedError):
    """The recording of a run ended before the run did; `result` is what it came to."""

    result: RunResult


def module_table(module: Module) -> dict[str, Any]:
    """What a result says about a module, as JSON values."""
    return {
        "index": module.index,
        "stream": module.stream,
        "stream_index": module.stream_index,
        "iteration": module.iteration,
        "policy": module.policy.tolist(),
        "eta": module.eta.tolist(),
    }


def run(
    source: FrameSource,
    config: Any,
    folder: str | Path | None = None,
    *,
    seed: int = 0,
    max_iterations: int | None = None,
    max_modules: int | None = None,
    sections: Mapping[str, Any] | None = None,
    force: bool = False,
    rerun: bool = True,
    sinks: Sequence[Sink] = (),
    stop: Callable[[], bool] = lambda: False,
    resume: bool = False,
    keyframes: int | None = None,
    fsync_every: float | None = None,
    live: bool = False,
    announce: Callable[[str], None] | None = None,
    command: Mapping[str, Any] | None = None,
    fork: Fork | None = None,
    hashing: Callable[[int, int], None] = lambda done, size: None,
) -> RunResult:
    """Learn from a source until nothing is left to learn, and log every signal.

    Args:
        source: live or recorded; left open.
        config: of the learner, as its entry in `LEARNERS` says.
        folder: of the run, or None to log nothing.
        seed: seed of the policy and of the abstractions' first weights.
        max_iterations: end after so many.
        max_modules: end after so many modules; by default as the learner says.
        sections: further configuration tables (`scene`, `record`) for the manifest.
        force: replace an existing run.
        rerun: also build the Rerun view.
        sinks: told of everything, after the log.
        stop: asked before every iteration; true ends the run cleanly.
        resume: resume the run in `folder` where it was stopped, in whatever way; its
            signals become those of a run that was never stopped.
        keyframes: iterations between keyframes, see `Keyframes`.
        fsync_every: seconds after which the disk has the log, so that a power cut takes no more;
            None leaves it to the operating system until the run is finished.
        live: also show the run in Rerun while it learns, to viewers on this machine.
        announce: called with the address of the live view.
        command: how the run is begun, kept with it; see `resume.command_of`.
        fork: go on from another run, whose iterations before are this one's, too.
        hashing: told of bytes of the source that were hashed, and of how many, while that is
            waited for: at the end, for what the run states of its source.

    Raises:
        UsageError: `folder` exists and `force` is not set; or `resume` is, and `folder` holds no
            run or one with another configuration or source, or the source cannot go back.
        RunExhaustedError: a recording ended first; what was learned is saved.
    """
    folder = None if folder is None else folder_here(folder)
    learner = open_learner(config, source.spec, seed)
    digest = Digest()
    tables = {**(sections or {}), "learner": as_table(config)}
    described = description(source, at_once=not (resume and stated_whole(folder)), told=hashing)
    versions = versions_used(config, source, described)
    manifest: dict[str, Any] = {
        "config": tables,
        "seed": seed,
        "source": described,
        ARITHMETIC: arithmetic_of(learner),
    }
    begun: dict[str, Any] = {} if command is None else {COMMAND: dict(command)}
    ancestry = fork.ancestry if fork is not None else ancestry_of(folder) if resume else None
    if ancestry is not None:
        begun[FORK] = dict(ancestry)
    told: list[Sink] = [digest]
    exhausted: LogExhaustedError | None = None
    if resume and not isinstance(source, SeekableSource):
        raise UsageError(
            f"{described['kind']} cannot go back to where the run was "
            "stopped: resume from its recording, or begin another run"
        )

    stood: Keyframe | None = None

    def going_back(found: Path) -> None:
        nonlocal stood
        stood = go_back(found, learner, source, None if ancestry is None else ancestry["at"])

    with contextlib.ExitStack() as opened:
        log = shown = None
        if folder is not None:
            log = opened.enter_context(
                _run_log(
                    folder,
                    source.spec,
                    {**manifest, **begun},
                    force=force,
                    resume=going_back if resume else None,
                    goes_on=fork is None and isinstance(source, SeekableSource),
                    fsync_every=fsync_every,
                )
            )
            opened.enter_context(_telling_of_interrupts(folder, source, view=rerun))
            told += [
                _Unfinished(log, learner),
                Keyframes(log, source, learner, versions, keyframes),
            ]
        elif resume:
            raise UsageError("which run to resume? name its folder")
        if live:
            from replay.viewer.live import LiveView

            shown = LiveView(
                source.spec, {**manifest, **begun}, learner.tau, len(learner.phi), run=folder
            )
            told.append(opened.enter_context(shown))
            if announce is not None:
                announce(shown.address)
        if log is not None and resume:
            bring_back(log, stood, digest, versions)
            stood = None  # it is as large as what the learner holds
        elif log is not None and fork is not None:
            take_over(log, learner, source, digest, fork)
        if log is not None and shown is not None and (resume or fork):
            shown.earlier(log.path.parent)
        try:
            ended = learn(
                source,
                learner,
                (*told, *sinks),
                stop=stop,
                max_iterations=max_iterations,
                max_modules=max_modules,
            )
        except LogExhaustedError as error:
            ended, exhausted = "log_exhausted", error
        result = RunResult(
            run=str(folder) if folder is not None else None,
            source=description(source, told=hashing),
            streams=source.spec.streams,
            seed=seed,
            iterations=learner.iteration,
            frames=learner.iteration * learner.tau,
            signals_sha256=digest.hexdigest(),
            modules=tuple(learner.modules),
            summary=learner.summary(),
            ended=ended,
        )
        if folder is not None and log is not None:
            begun |= {ARITHMETIC: manifest[ARITHMETIC], "versions": versions}
            _write_run(folder, result, tables, begun, log, rerun=rerun)
    if exhausted is not None:
        kept = f"; {len(learner.modules)} modules of {learner.iteration} iterations are in {folder}"
        over = RunExhaustedError(f"{exhausted}{kept if folder is not None else ''}")
        over.result = result
        raise over from exhausted
    return result


class _Unfinished(Sink):
    """A run's log that stays open when learning ends, for what is written after it."""

    def __init__(self, log: RunWriter, learner: Learner) -> None:
        self._log, self._learner = log, learner

    def block(self, block: Block, signals: BlockSignals, learner: Learner) -> None:
        """See `Sink`."""
        self._log.block(block, signals, learner)

    def event(self, t: int, iteration: int, text: str, level: str = "INFO") -> None:
        """See `Sink`."""
        self._log.event(t, iteration, text, level)

    def finish(self) -> None:
        """Write the last weights, and hand over what was written."""
        self._log.weights(self._learner)
        self._log.flush()


@contextlib.contextmanager
def _telling_of_interrupts(run: Path, source: FrameSource, *, view: bool) -> Iterator[None]:
    """Let an interrupt say what is missing of a run that may have a view, and how to go on."""
    from replay.integrity.run_files import view_again
    from replay.runs.folders import RUN_FILE, VIEW_FILE

    try:
        yield
    except KeyboardInterrupt:
        if (run / RUN_FILE).is_file():
            but = "" if not view or (run / VIEW_FILE).is_file() else " but its view: "
            said = f"all of {run} is there{but and but + view_again(run)}"
        elif isinstance(source, SeekableSource):
            said = f"{run} is not finished: go on with --resume"
        else:
            said = f"{run} is not finished, and cameras cannot go back: cdmisfa info {run}"
        raise KeyboardInterrupt(said) from None


@contextlib.contextmanager
def _run_log(
    out: Path,
    spec: SourceSpec,
    manifest: Mapping[str, Any],
    *,
    force: bool,
    resume: Callable[[Path], None] | None,
    goes_on: bool,
    fsync_every: float | None,
) -> Iterator[RunWriter]:
    """The run's log, to be finished inside, and its folder held.

    One that is resumed is gone back with first, before anything of the folder is changed.

    On failure a log that is not finished is left as a readable prefix.
    """
    from replay.runs.folders import MODULES_FILE, RUN_FILE, RUN_JSON, VIEW_FILE
    from replay.runs.writer import RunWriter

    if resume is None:
        refuse_existing(out, force=force, goes_on=goes_on)
        try:
            make_folder(out)
        except OSError as error:
            raise _no_folder(out, error) from error
    with held(out):
        own = (RUN_FILE, partial_path(out / RUN_FILE).name, SET_ASIDE)
        if others := [path for path in logs_in(out) if path.name not in own]:
            raise UsageError(f"{others[0]} is of no run: choose another folder")
        stale = [out / name for name in (RUN_JSON, MODULES_FILE, VIEW_FILE)]
        stale += out.glob("checkpoint-*.npz")  # of runs from before keyframes
        if resume is not None:
            set_aside(out, spec, manifest, resume)
        else:  # the log first: of what is left by a kill nothing then looks like a run
            logs = (SET_ASIDE, RUN_FILE, partial_path(out / RUN_FILE).name)
            stale = [*(out / name for name in logs), *stale]
        try:
            refuse_special(*stale)
            for path in stale:
                path.unlink(missing_ok=True)
        except OSError as error:
            raise _no_folder(out, error) from error
        log = RunWriter(
            out / RUN_FILE,
            spec,
            manifest,
            force=force or resume is not None,
            fsync_every=fsync_every,
        )
        try:
            yield log
        except BaseException:
            log.abandon()
            raise


def _no_folder(out: Path, error: OSError) -> UsageError:
    reason = error.strerror or error
    return UsageError(f"{out} cannot be a run's folder ({reason}): choose another")


def _write_run(
    out: Path,
    result: RunResult,
    tables: Mapping[str, Any],
    begun: Mapping[str, Any],
    log: RunWriter,
    *,
    rerun: bool,
) -> None:
    from replay.runs.folders import MODULES_FILE, RUN_JSON, VIEW_FILE
    from replay.runs.modules import save_modules
    from replay.runs.run import final_record

    save_modules(out / MODULES_FILE, result.modules)
    document = {
        "schema": 1,
        "signals_schema": SCHEMA_VERSION,
        "config": tables,
        "seed": result.seed,
        "source": dict(result.source),
        "streams": list(result.streams),
        "platform": machine(),
        "result": result.as_json(),
        **begun,
    }
    write_json(out / RUN_JSON, document)
    log.finish(final_record(out, document, result.signals_sha256, view=rerun))
    if rerun:
        from replay.view.build import build_view

        build_view(out, out / VIEW_FILE)
