"""A run: a source, a learner, and the folder that keeps what happened.

RUN/run.mcap signals, RUN/modules.npz frozen modules, RUN/run.json manifest and result,
RUN/run.rrd the view. The loop itself is in `loop`, the folder in `run_folder`.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, Self

from cdmisfa.agents.learners import open_learner
from cdmisfa.core.blocks import FrameSource, SeekableSource, description
from cdmisfa.core.config import section_table
from cdmisfa.core.errors import LogWriteError, UsageError
from cdmisfa.core.learning import ARITHMETIC, Keyframe, Learner, Sink, arithmetic_of
from cdmisfa.experiments.documents import versions
from cdmisfa.experiments.holdout import judged
from cdmisfa.experiments.loop import INTERRUPTED, BestEffort, Digest, Keyframes, learn_blocks
from cdmisfa.experiments.recompute import Recomputation, check_run
from cdmisfa.experiments.resume import (
    COMMAND,
    FORK,
    SET_ASIDE,
    changes,
    command_of,
    command_of_fork,
    continued,
    header_to_resume,
    refuse_difference,
    restore,
    restore_from,
)
from cdmisfa.experiments.run_folder import (
    OpenLog,
    RunResult,
    in_words,
    opened_log,
    undecided,
    with_recipes,
    write_results,
)
from recorder.log.files import folder_here
from replay.runs.folders import run_log
from replay.runs.provenance import has_whole_hashes, stated_source
from replay.runs.writer import RunWriter

Hashing = Callable[[int, int], None]
"""Told of bytes of the source that were hashed and of how many, while that is waited for."""


def _not_told(done: int, size: int) -> None:
    """Tell nobody."""


class Session:
    """A run that is begun, resumed or forked, and then goes on with `learn`.

    Attributes:
        source: what it learns from; left open.
        learner: what learns.
        folder: of the run, or None where nothing is kept.
        manifest: what its log states at its beginning.
        before: the log whose first iterations it keeps: its own of before, or its parent's.
        keyframe: where in that log it goes on; None at the beginning.
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
            source: live or recorded.
            config: of the learner, as its entry says.
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
        self.before: Path | None = None
        self.keyframe: Keyframe | None = None
        self._limits = {"max_iterations": max_iterations, "max_modules": max_modules}
        self._force, self._resumed = force, False
        described = described or description(source, at_once=True)
        self._versions = versions()
        self.manifest: dict[str, Any] = {
            "config": {**(sections or {}), "learner": section_table(config)},
            "seed": seed,
            "source": described,
            ARITHMETIC: arithmetic_of(self.learner),
        }
        if command is not None:
            self.manifest[COMMAND] = dict(command)

    @classmethod
    def resume(
        cls,
        source: FrameSource,
        config: Any,
        folder: str | Path | None,
        *,
        hashing: Hashing = _not_told,
        **how: Any,
    ) -> Self:
        """Prepare to resume a run where it was stopped, in whatever way.

        Learner and source are put to the newest keyframe of its log. Its signals become those of a
        run that was never stopped.

        Args:
            source: what it learned from.
            config: the learner's.
            folder: of the run.
            hashing: see `learn`.
            how: further arguments, as of a new run.

        Raises:
            UsageError: the source cannot go back; there is no run, or one of another
                configuration or source.
            LogDamagedError: the log cannot be read, or the source shows something else now.
        """
        if folder is None:
            raise UsageError("which run to resume? name its folder")
        if not isinstance(source, SeekableSource):
            raise UsageError(
                f"{description(source, at_once=True)['kind']} cannot go back to where the run was "
                "stopped: resume from its recording, or begin another run"
            )
        log, header = header_to_resume(folder_here(folder))
        whole = header is not None and has_whole_hashes(stated_source(log))
        described = description(source, at_once=not whole, told=hashing)
        session = cls(source, config, folder, described=described, **how)
        session._resumed = True
        if header is not None:
            forked_at = header.forked_at
            if forked_at is not None:
                session.manifest[FORK] = header.manifest[FORK]
            refuse_difference(log, header, source.spec, session.manifest)
            session.before = log
            session.keyframe = restore_from(log, session.learner, source, forked_at)
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
        log, folder = run_log(Path(parent)), folder_here(folder)
        if os.path.realpath(log.parent) == os.path.realpath(folder):
            raise UsageError(f"{folder} is the run itself: choose another folder")
        with cls.at(log, at, source) as stopped:
            manifest = stopped.header.manifest
            span, state = continued(stopped.header, stopped.learner, settings, seed)
            sections = {k: part for k, part in manifest["config"].items() if k != "learner"}
            words, options = command_of_fork(log.parent, source, sections, settings)
            options |= {"seed": span.seed, **(limits or {})}
            session = cls(
                stopped.source,
                span.config,
                folder,
                seed=span.seed,
                max_iterations=options.get("max_iterations"),
                max_modules=options.get("max_modules"),
                sections=sections,
                command=command_of(words, options, folder) if words else None,
                force=force,
            )
            session.manifest[FORK] = {
                "parent": os.path.relpath(log.parent, folder),
                "at": at,
                "changed": changes(manifest, span),
                "before": {k: manifest[k] for k in ("config", "seed", FORK) if k in manifest},
            }
            session.before = log
            spec = stopped.source.spec
            session.keyframe = Keyframe(at, stopped.t, state, session._versions)
            restore(session.learner, session.keyframe, spec)
            yield session

    at = staticmethod(Recomputation.after)
    check = staticmethod(check_run)

    def learn(
        self,
        *,
        sinks: Sequence[Sink] = (),
        stop: Callable[[], bool] = lambda: False,
        keyframes: int | None = None,
        rerun: bool = True,
        live: Callable[[str], AbstractContextManager[None]] | None = None,
        hashing: Hashing = _not_told,
    ) -> RunResult:
        """Learn until nothing is left to learn, and log every signal.

        Args:
            sinks: told of everything, after the log; one that fails is let go, and a warning and
                an event say so.
            stop: asked before every iteration; true ends the run cleanly, without a view, and a
                long source is known by a sample.
            keyframes: iterations between keyframes, see `Keyframes`.
            rerun: also build the Rerun view.
            live: also serve the run to Rerun's viewers while it learns; called with the address,
                and entered while the run is served.
            hashing: told of bytes of the source that were hashed, and of how many, while the run
                waits for what it states of its source at its end.

        Raises:
            UsageError: the folder is not empty and is not to be replaced, or is in use.
            LogExhaustedError: the source has not enough for a single block.
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
                        resumed=self._resumed,
                        aside=self.before if self._resumed else None,
                        view=rerun,
                    )
                )
                told.append(OpenLog(log, self.learner))
                told.append(Keyframes(log, self.source, self.learner, self._versions, keyframes))
            if live is not None:
                from replay.view.live import LiveView

                tau, outputs = self.learner.tau, len(self.learner.phi)
                view = LiveView(self.source.spec, self.manifest, tau, outputs, run=self.folder)
                told.append(opened.enter_context(view))
                opened.enter_context(live(view.address))
            if log is not None and self.before is not None:
                self._copy_log(log, digest)
                if live is not None:
                    view.earlier(log.path.parent)
            told += [BestEffort(sink, told) for sink in sinks]
            ended = learn_blocks(self.source, self.learner, told, stop=stop, **self._limits)
            ended, held_out = self._judged(ended, stop)
            stopped = ended == INTERRUPTED  # then nothing is read that is as long as the log
            described = description(self.source, at_once=stopped, told=hashing)
            result = self._result(described, digest.hexdigest(), ended=ended, held_out=held_out)
            if log is not None:
                stated = {**self.manifest, "versions": self._versions}
                write_results(log, result, stated, view=rerun and not stopped)
        return result

    def _judged(self, ended: str, stop: Callable[[], bool]) -> tuple[str, Mapping[str, Any] | None]:
        if ended == INTERRUPTED:
            return ended, None
        config = self.manifest["config"]["learner"]
        found = judged(self.source, self.learner.modules, config.get("components", 1), stop)
        return INTERRUPTED if found is None else ended, found

    def _result(self, described: Mapping[str, Any], sha256: str, **ending: Any) -> RunResult:
        learner, summary = self.learner, self.learner.summary()
        return RunResult(
            run=str(self.folder) if self.folder is not None else None,
            source=described,
            streams=self.source.spec.streams,
            seed=self.manifest["seed"],
            iterations=learner.iteration,
            frames=learner.iteration * learner.tau,
            signals_sha256=sha256,
            modules=with_recipes(learner.modules, self.source, described),
            summary=summary,
            **ending,
            undecided=() if learner.over else undecided(learner, self.source, summary),
        )

    def _copy_log(self, log: RunWriter, digest: Digest) -> None:
        """Write what is kept of the log before, its own or its parent's; hash its signals."""
        before = log.path.parent / SET_ASIDE if self._resumed else self.before
        assert before is not None
        keyframe, self.keyframe = self.keyframe, None  # as large as the learner's memory
        if keyframe is not None:
            at, t, fork = keyframe.iteration, keyframe.t, self.manifest.get(FORK, {})
            for signals in log.copy_log(before, at):
                digest.add(signals)
            if self._resumed:
                then, now = keyframe.versions, self._versions
                changed = {k: (then.get(k), v) for k, v in now.items() if then.get(k) != v}
                log.event(t, max(at - 1, 0), f"resumed at iteration {at}")
                if changed:
                    log.event(t, max(at - 1, 0), "; ".join(in_words(changed)), "WARNING")
            else:
                text = f"fork of {fork['parent']} after {at} iterations"
                log.event(t, max(at - 1, 0), "; ".join([text, *in_words(fork["changed"])]))
                log.keyframe(keyframe, again=True)
        log.sync()
        if self._resumed:
            try:
                before.unlink()
            except OSError as error:
                raise LogWriteError(f"{before} cannot be removed: {error.strerror}") from error


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
    """Begin a run, or resume the one in `folder`, and learn to its end.

    The arguments are those of `Session`, and as `how` those of `Session.learn`.
    """
    told: dict[str, Any] = {
        "seed": seed,
        "max_iterations": max_iterations,
        "max_modules": max_modules,
        "sections": sections,
        "command": command,
    }
    if resume:
        hashing = how.get("hashing", _not_told)
        session = Session.resume(source, config, folder, hashing=hashing, **told)
    else:
        session = Session(source, config, folder, force=force, **told)
    return session.learn(**how)
