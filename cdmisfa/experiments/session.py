"""A run: a source, a learner, and the folder that keeps what happened.

RUN/run.mcap signals, RUN/modules.npz frozen modules, RUN/run.json manifest and result,
RUN/run.rrd the view. The loop itself is in `loop`.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from cdmisfa.agents.learners import open_learner
from cdmisfa.core.blocks import (
    FrameSource,
    SeekableSource,
    description,
)
from cdmisfa.core.config import as_table
from cdmisfa.core.errors import LogExhaustedError, LogWriteError, UsageError
from cdmisfa.core.learning import ARITHMETIC, Keyframe, Learner, Sink, arithmetic_of
from cdmisfa.experiments.command import (
    COMMAND,
    SET_ASIDE,
    command_of,
    log_to_resume,
    source_of,
)
from cdmisfa.experiments.loop import Digest, Keyframes, learn
from cdmisfa.experiments.recompute import Recomputation, check_run
from cdmisfa.experiments.resume import (
    FORK,
    Fork,
    copy_parent_log,
    has_header,
    plan_fork,
    refuse_difference,
    replay_log,
    restore_from,
    stated_before,
)
from cdmisfa.experiments.run_folder import (
    OpenLog,
    RunExhaustedError,
    RunResult,
    opened_log,
    write_results,
)
from cdmisfa.experiments.sources import versions_used
from recorder.log.files import folder_here, partial_path
from replay.runs.folders import RUN_FILE, run_log
from replay.runs.run import states_whole

if TYPE_CHECKING:
    from replay.viewer.live import LiveView


class Session:
    """A run that is begun, resumed or forked, and then goes on with `learn`.

    Attributes:
        source: what it learns from.
        learner: what learns; of a run that is resumed or forked, in its state from `learn` on.
        folder: of the run, or None where nothing is kept.
        manifest: what its log states at its beginning.
    """

    def __init__(
        self,
        source: FrameSource,
        config: Any,
        folder: str | Path | None = None,
        *,
        seed: int = 0,
        max_iterations: int | None = None,
        max_modules: int | None = None,
        sections: Mapping[str, Any] | None = None,
        command: Mapping[str, Any] | None = None,
        force: bool = False,
        described: Mapping[str, Any] | None = None,
    ) -> None:
        """Prepare to begin a run; nothing is written before `learn`.

        Args:
            source: live or recorded; left open.
            config: of the learner, as its entry in `LEARNERS` says.
            folder: of the run, or None to keep nothing.
            seed: of the policy and of the abstractions' first weights.
            max_iterations: end after so many.
            max_modules: end after so many modules; by default as the learner says.
            sections: further configuration tables (`scene`, `record`) for the manifest.
            command: how the run is begun, kept with it; see `command_of`.
            force: replace an existing run.
            described: what the source says of itself, where that was asked already.
        """
        self.source = source
        self.learner: Learner = open_learner(config, source.spec, seed)
        self.folder = None if folder is None else folder_here(folder)
        self._limits = {"max_iterations": max_iterations, "max_modules": max_modules}
        self._force = force
        described = described or description(source, at_once=True)
        self._versions = versions_used(config, source, described)
        self.manifest: dict[str, Any] = {
            "config": {**(sections or {}), "learner": as_table(config)},
            "seed": seed,
            "source": described,
            ARITHMETIC: arithmetic_of(self.learner),
        }
        if command is not None:
            self.manifest[COMMAND] = dict(command)
        self._resumed = False
        self._keyframe: Keyframe | None = None
        self._fork: Fork | None = None

    @classmethod
    def resume(
        cls,
        source: FrameSource,
        config: Any,
        folder: str | Path | None,
        *,
        hashing: Callable[[int, int], None] = lambda done, size: None,
        **how: Any,
    ) -> Self:
        """Prepare to resume a run where it was stopped, in whatever way.

        Its signals become those of a run that was never stopped. Whether it was begun with the
        same source, configuration and seed is checked by `learn`.

        Args:
            source: what it learned from.
            config: the learner's.
            folder: of the run.
            hashing: told of bytes of the source that were hashed, and of how many.
            how: further arguments, as of a new run.

        Raises:
            UsageError: the source cannot go back, or no folder is named.
        """
        if folder is None:
            raise UsageError("which run to resume? name its folder")
        stated, ancestry = stated_before(folder_here(folder))
        described = description(source, at_once=not states_whole(stated), told=hashing)
        if not isinstance(source, SeekableSource):
            raise UsageError(
                f"{described['kind']} cannot go back to where the run was "
                "stopped: resume from its recording, or begin another run"
            )
        session = cls(source, config, folder, described=described, **how)
        session._resumed = True
        if ancestry is not None:
            session.manifest[FORK] = dict(ancestry)
        return session

    @classmethod
    @contextlib.contextmanager
    def fork(
        cls,
        parent: Path,
        at: int,
        folder: Path,
        *,
        settings: Sequence[str] = (),
        seed: int | None = None,
        source: Sequence[str] = (),
        limits: Mapping[str, int] | None = None,
        force: bool = False,
    ) -> Iterator[Self]:
        """Prepare to continue a run from some iteration with other settings, in another folder.

        Its log begins with the parent's first iterations as they are.

        Args:
            parent: the run, its folder or its log.
            at: iterations kept of it.
            folder: of the fork.
            settings: `learner.key=value` words; keys that what was learned depends on stay.
            seed: of the random choices from there on; the world stays the parent's.
            source: words that name its source, where it is not what the run says.
            limits: `max_iterations` and `max_modules`, by default the parent's.
            force: replace an existing run.

        Yields:
            The session; its source is open meanwhile.

        Raises:
            UsageError: there is no such run, iteration or source, or a setting that cannot change.
        """
        folder = folder_here(folder)
        log = run_log(Path(parent))
        if os.path.realpath(log.parent) == os.path.realpath(folder):
            raise UsageError(f"{folder} is the run itself: choose another folder")
        with Recomputation(log, 0, source) as beginning:
            then, now = beginning.arithmetic
        if then != now:
            raise UsageError(
                f"{log} was learned with arithmetic {then}, this version computes with {now}: "
                "learn it anew, and fork that"
            )
        with cls.at(log, at, source) as stopped:
            fork = plan_fork(stopped, folder, settings, seed, source)
        options = {**fork.options, **(limits or {})}
        with contextlib.closing(source_of(log.parent, source)) as frames:
            session = cls(
                frames,
                fork.config,
                folder,
                seed=fork.seed,
                max_iterations=options.get("max_iterations"),
                max_modules=options.get("max_modules"),
                sections=fork.sections,
                command=command_of(fork.words, options, folder) if fork.words else None,
                force=force,
            )
            session.manifest[FORK] = fork.ancestry
            session._fork = fork
            yield session

    at = staticmethod(Recomputation.after)
    check = staticmethod(check_run)

    def learn(
        self,
        *,
        sinks: Sequence[Sink] = (),
        stop: Callable[[], bool] = lambda: False,
        keyframes: int | None = None,
        fsync_every: float | None = None,
        rerun: bool = True,
        live: bool = False,
        announce: Callable[[str], None] = lambda address: None,
        hashing: Callable[[int, int], None] = lambda done, size: None,
    ) -> RunResult:
        """Learn until nothing is left to learn, and log every signal.

        Args:
            sinks: told of everything, after the log.
            stop: asked before every iteration; true ends the run cleanly.
            keyframes: iterations between keyframes, see `Keyframes`.
            fsync_every: seconds after which the disk has the log, so that a power cut takes no
                more; None leaves it to the operating system until the run is finished.
            rerun: also build the Rerun view.
            live: also show the run in Rerun while it learns, to viewers on this machine.
            announce: called with the address of the live view.
            hashing: told of bytes of the source that were hashed, and of how many, while that is
                waited for: at the end, for what the run states of its source.

        Raises:
            UsageError: the folder exists and is neither replaced nor resumed; or there is no run
                to resume, or one of another configuration or source.
            RunExhaustedError: a recording ended first; what was learned is saved.
        """
        digest, log = Digest(), None
        told: list[Sink] = [digest]
        with contextlib.ExitStack() as opened:
            if self.folder is not None:
                log = opened.enter_context(
                    opened_log(
                        self.folder,
                        self.source,
                        self.manifest,
                        force=self._force,
                        resume=self._set_aside if self._resumed else None,
                        fsync_every=fsync_every,
                        view=rerun,
                    )
                )
                told.append(OpenLog(log, self.learner))
                told.append(Keyframes(log, self.source, self.learner, self._versions, keyframes))
            if live:
                shown = opened.enter_context(self._live_view())
                told.append(shown)
                announce(shown.address)
            if log is not None and (self._resumed or self._fork is not None):
                if self._fork is not None:
                    copy_parent_log(
                        log, self.learner, self.source, digest, self._fork, self._versions
                    )
                else:
                    replay_log(log, self._keyframe, digest, self._versions)
                self._keyframe = self._fork = None  # as large as what the learner holds
                if live:
                    shown.earlier(log.path.parent)
            told += sinks
            exhausted: LogExhaustedError | None = None
            try:
                ended = learn(self.source, self.learner, told, stop=stop, **self._limits)
            except LogExhaustedError as error:
                ended, exhausted = "log_exhausted", error
            result = self._result(digest, ended, hashing)
            if log is not None:
                versions = {"versions": self._versions}
                write_results(log, result, {**self.manifest, **versions}, view=rerun)
        if exhausted is not None:
            kept = f"{len(result.modules)} modules of {result.iterations} iterations"
            saved = "" if self.folder is None else f"; {kept} are in {self.folder}"
            over = RunExhaustedError(f"{exhausted}{saved}")
            over.result = result
            raise over from exhausted
        return result

    def _set_aside(self, folder: Path) -> None:
        """Move the log of a run that is resumed out of the way, after checking that it may."""
        found = log_to_resume(folder)
        if found == partial_path(folder / RUN_FILE) and not has_header(found):
            return  # it was killed before it had said anything
        refuse_difference(folder, found, self.source.spec, self.manifest)
        forked_at = self.manifest[FORK]["at"] if FORK in self.manifest else None
        self._keyframe = restore_from(found, self.learner, self.source, forked_at)
        try:
            os.replace(found, folder / SET_ASIDE)
        except OSError as error:
            raise LogWriteError(f"{found} cannot be set aside: {error.strerror}") from error

    def _live_view(self) -> LiveView:
        from replay.viewer.live import LiveView

        learner = self.learner
        return LiveView(
            self.source.spec, self.manifest, learner.tau, len(learner.phi), run=self.folder
        )

    def _result(self, digest: Digest, ended: str, hashing: Callable[[int, int], None]) -> RunResult:
        learner = self.learner
        return RunResult(
            run=str(self.folder) if self.folder is not None else None,
            source=description(self.source, told=hashing),
            streams=self.source.spec.streams,
            seed=self.manifest["seed"],
            iterations=learner.iteration,
            frames=learner.iteration * learner.tau,
            signals_sha256=digest.hexdigest(),
            modules=tuple(learner.modules),
            summary=learner.summary(),
            ended=ended,
        )


def run(
    source: FrameSource,
    config: Any,
    folder: str | Path | None = None,
    *,
    seed: int = 0,
    max_iterations: int | None = None,
    max_modules: int | None = None,
    sections: Mapping[str, Any] | None = None,
    command: Mapping[str, Any] | None = None,
    force: bool = False,
    resume: bool = False,
    **how: Any,
) -> RunResult:
    """Learn from a source: begin a run, or resume one, and learn to its end.

    Arguments are those of `Session`, `Session.resume` and, as `how`, `Session.learn`.

    Raises:
        UsageError: as there.
        RunExhaustedError: a recording ended first; what was learned is saved.
    """
    told: dict[str, Any] = {
        "seed": seed,
        "max_iterations": max_iterations,
        "max_modules": max_modules,
        "sections": sections,
        "command": command,
    }
    if resume:
        hashing = {key: how[key] for key in ("hashing",) if key in how}
        session = Session.resume(source, config, folder, **told, **hashing)
    else:
        session = Session(source, config, folder, **told, force=force)
    return session.learn(**how)
