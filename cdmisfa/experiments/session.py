"""A run in progress: start it, resume it or fork it, learn, and write its folder.

Files: RUN/run.mcap with the signals, RUN/modules.npz with the modules, RUN/run.json with manifest
and result, RUN/run.rrd with the view. `loop` has the loop, `run_folder` the folder.
"""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, Self

from cdmisfa.agents.learners import open_learner
from cdmisfa.core.blocks import FrameSource, SeekableSource, description
from cdmisfa.core.config import section_table
from cdmisfa.core.errors import LogDamagedError, UsageError
from cdmisfa.core.learning import ARITHMETIC, Keyframe, Learner, Sink, arithmetic_of
from cdmisfa.core.outcomes import INTERRUPTED
from cdmisfa.experiments.documents import versions
from cdmisfa.experiments.holdout import evaluate
from cdmisfa.experiments.loop import Digest, Keyframes, learn_blocks
from cdmisfa.experiments.resume import Recomputation, fork_span, reconfigured, restore
from cdmisfa.experiments.run_folder import (
    COMMAND,
    FORK,
    SET_ASIDE,
    RunResult,
    command_of,
    log_to_resume,
    opened_log,
    read_command,
    with_recipes,
    write_results,
)
from recorder.log.files import local_folder, partial_path
from recorder.mcap.reader import LogReader
from replay.runs.compare import differences
from replay.runs.folders import RUN_FILE, run_log
from replay.runs.keyframes import read_keyframe
from replay.runs.log import read_header
from replay.runs.provenance import comparable, has_whole_hashes, stated_source
from replay.runs.writer import RunWriter

# Facts that may differ when a run is resumed: the first passes over a log are the same, however
# many follow.
OF_PASSES = ("source.passes", "spec.length")

# Called with the number of bytes of the source that were hashed, and the total.
Hashing = Callable[[int, int], None]


class Session:
    """A run that is started, resumed or forked; `learn` then runs it to its end.

    Attributes:
        source: the source of the run; it stays open.
        learner: the learner.
        folder: folder of the run, or None if nothing is stored.
        manifest: the manifest at the beginning of the log.
        before: the log whose first iterations are copied: the run's earlier log, or the parent's.
        keyframe: the state after these iterations; None at the beginning.
        hashing: see `Hashing`.
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
        resume: bool = False,
        hashing: Hashing = lambda done, size: None,
    ) -> None:
        """Prepare to start or resume a run; nothing is written before `learn`.

        Args:
            source: a live or recorded source.
            config: configuration of the learner, of the class that the learner names.
            folder: folder of the run, or None to store nothing.
            seed: seed of the policy and of the initial weights.
            max_iterations: largest number of iterations.
            max_modules: largest number of modules; None: the learner's default.
            sections: further configuration tables (`scene`, `record`) for the manifest.
            command: the command that started the run, stored with it; see `command_of`.
            force: True to replace an existing run.
            resume: True to continue the run in the folder from its newest keyframe; the signals
                equal those of an uninterrupted run.
            hashing: see `Hashing`.

        Raises:
            UsageError: for `resume`: the source cannot go back, or the run does not exist or has
                another configuration or source.
            LogDamagedError: for `resume`: the log cannot be read.
        """
        self.source = source
        self.learner: Learner = open_learner(config, source.spec, seed)
        self.folder = None if folder is None else local_folder(folder)
        self.before: Path | None = None
        self.keyframe: Keyframe | None = None
        self._limits = {"max_iterations": max_iterations, "max_modules": max_modules}
        self._force, self._resumed, self.hashing = force, resume, hashing
        self._versions = versions()
        self.manifest: dict[str, Any] = {
            "config": {**(sections or {}), "learner": section_table(config)},
            "seed": seed,
            "source": description(source, at_once=True),
            ARITHMETIC: arithmetic_of(self.learner),
        }
        if command is not None:
            self.manifest[COMMAND] = dict(command)
        if resume and self.folder is not None:
            self._resume(self.folder)

    def _resume(self, folder: Path) -> None:
        source = self.source
        if not isinstance(source, SeekableSource):
            raise UsageError(
                f"{self.manifest['source']['kind']} cannot go back to where the run stopped: "
                "resume from a recording of it, or start another run"
            )
        self.before = log = log_to_resume(folder)
        try:
            header = read_header(log)
        except (LogDamagedError, UsageError):
            if log != partial_path(folder / RUN_FILE):
                raise
            return  # the run was killed before its log had a header: start again
        if has_whole_hashes(stated_source(log)):
            self.manifest["source"] = description(source, progress=self.hashing)
        if header.forked_at is not None:
            self.manifest[FORK] = header.manifest[FORK]
        as_json = json.loads(json.dumps(self.manifest))  # lists instead of tuples, as in the log
        source_then, source_now = comparable(stated_source(log), as_json["source"])
        spec_then, spec_now = (spec.as_json() for spec in (header.spec, source.spec))
        then = {**header.manifest, "source": source_then, "spec": spec_then, COMMAND: None}
        now = {**as_json, "source": source_now, "spec": spec_now, COMMAND: None}
        entries = (entry for entry in differences(then, now) if entry[0] not in OF_PASSES)
        changed = {key.removeprefix("config."): values for key, *values in entries}
        if changed:
            # Another learner has other keys, so its name is the reason for all differences.
            key = "learner.algorithm" if "learner.algorithm" in changed else next(iter(changed))
            raise UsageError(
                f"{folder} was made with {key} = {changed[key][0]}, not {changed[key][1]}: resume "
                "with the same settings, or choose another folder"
            )
        keyframe = read_keyframe(log)
        if (0 if keyframe is None else keyframe.iteration) < (header.forked_at or 0):
            raise UsageError(f"{folder} was cut before its fork: fork again with --force")
        if keyframe is not None:
            restore(self.learner, keyframe, source.spec)
            source.seek(keyframe.t)
            self.keyframe = keyframe

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
        """Prepare to continue a run from an iteration with other settings, in another folder.

        The log of the fork begins with the parent's first iterations, unchanged.

        Args:
            parent: the run, its folder or its log.
            at: number of iterations that are copied from it.
            folder: folder of the fork.
            settings: `learner.key=value` words, except for the keys in `resume.FIXED`.
            seed: seed of the random choices from there on; the world stays that of the parent.
            source: words that name the source, if the run does not.
            limits: `max_iterations` and `max_modules`; None: those of the parent.
            force: True to replace an existing run.

        Yields:
            The session; its source is open until the context ends.

        Raises:
            UsageError: the run, the iteration or the source does not exist, or a setting cannot
                change.
        """
        log, folder = run_log(Path(parent)), local_folder(folder)
        if os.path.realpath(log.parent) == os.path.realpath(folder):
            raise UsageError(f"{folder} is the folder of the run itself: choose another one")
        with Recomputation.after(log, at, source) as parent_run:
            manifest, spec = parent_run.header.manifest, parent_run.source.spec
            span = fork_span(parent_run.learner, manifest, settings, seed)
            sections = {k: part for k, part in manifest["config"].items() if k != "learner"}
            words, options = tuple(source), dict[str, Any]()
            with contextlib.suppress(UsageError):  # the run does not state its command
                stated, options = read_command(log.parent)
                words = words or stated
            world = sections.get("scene", {}).get("seed")
            scene = () if world is None else (f"scene.seed={world}",)
            settings = (*options.get("settings", ()), *scene, *settings)
            options |= {"settings": settings, "seed": span.seed, **(limits or {})}
            session = cls(
                parent_run.source,
                span.config,
                folder,
                seed=span.seed,
                max_iterations=options.get("max_iterations"),
                max_modules=options.get("max_modules"),
                sections=sections,
                command=command_of(words, options, folder) if words else None,
                force=force,
            )
            session.learner = reconfigured(parent_run.learner, span, spec)
            session.manifest[FORK] = {
                "parent": os.path.relpath(log.parent, folder),
                "at": at,
                "changed": span.changed,
                "before": {k: manifest[k] for k in ("config", "seed", FORK) if k in manifest},
            }
            session.before = log
            state = session.learner.state
            session.keyframe = Keyframe(at, parent_run.t, state, session._versions)
            yield session

    def learn(
        self,
        *,
        sinks: Sequence[Sink] = (),
        stop: Callable[[], bool] = lambda: False,
        keyframes: int | None = None,
        rerun: bool = True,
        live: Callable[[str], AbstractContextManager[None]] | None = None,
    ) -> RunResult:
        """Learn until the run ends, and log every signal.

        Args:
            sinks: receive every iteration and event, after the log; an exception of one ends the
                run.
            stop: called before every iteration; True ends the run without a view, and without
                reading all of a long source for its hash.
            keyframes: iterations between keyframes, see `Keyframes`.
            rerun: True to build the Rerun view too.
            live: serves the run to Rerun viewers while it learns: a context manager that is called
                with the address.

        Raises:
            UsageError: the folder is in use, or it is not empty and not to be replaced.
            LogExhaustedError: the source is shorter than one block.
        """
        digest, log = Digest(), None
        all_sinks: list[Sink] = [digest]
        if self._resumed and self.before is not None and self.keyframe is not None:
            # Read the old log first: damage must be found before anything of the run is replaced.
            end = self.source.spec.time_ns(self.keyframe.t)
            with LogReader(self.before) as earlier:
                for _, table in earlier.tables():
                    if len(table.log_time) and table.log_time[0] >= end:
                        break
        with contextlib.ExitStack() as stack:
            if self.folder is not None:
                options = {"force": self._force, "resumed": self._resumed}
                opened = opened_log(self.folder, self.source, self.manifest, **options)
                log = stack.enter_context(opened)
                state = Keyframes(log, self.source, self.learner, self._versions, keyframes)
                all_sinks += [log, state]
            if live is not None:
                from replay.view.live import LiveView

                tau, outputs = self.learner.tau, len(self.learner.phi)
                view = LiveView(self.source.spec, self.manifest, tau, outputs, run=self.folder)
                all_sinks.append(stack.enter_context(view))
                stack.enter_context(live(view.address))
            if log is not None and self.before is not None:
                self._copy_log(log, self.before, digest)
                if live is not None:
                    view.earlier(log.path.parent)
            all_sinks += sinks
            ended = learn_blocks(self.source, self.learner, all_sinks, stop=stop, **self._limits)
            result = self._result(ended, digest.hexdigest(), stop)
            if log is not None:
                manifest = {**self.manifest, "versions": self._versions}
                write_results(log, result, manifest, view=rerun and result.ended != INTERRUPTED)
        return result

    def _result(self, ended: str, sha256: str, stop: Callable[[], bool]) -> RunResult:
        learner, summary, held_out = self.learner, self.learner.summary(), dict[str, Any]()
        if ended != INTERRUPTED:
            components = self.manifest["config"]["learner"].get("components", 1)
            evaluation = evaluate(self.source, learner.modules, components, stop)
            ended, held_out = (INTERRUPTED, {}) if evaluation is None else (ended, evaluation)
        # After an interrupt, do not spend time that grows with the length of the source.
        described = description(self.source, at_once=ended == INTERRUPTED, progress=self.hashing)
        streams, undecided = self.source.spec.streams, tuple[str, ...]()
        if not learner.over:
            learned = {streams[module.stream_index] for module in learner.modules}
            undecided = tuple(name for name in streams if name not in learned)
            if "streams" in summary:
                states = {row["stream"]: row["state"] for row in summary["streams"]}
                undecided = tuple(name for name, state in states.items() if state == "learning")
        return RunResult(
            run=str(self.folder) if self.folder is not None else None,
            source=described,
            seed=self.manifest["seed"],
            iterations=learner.iteration,
            frames=learner.iteration * learner.tau,
            signals_sha256=sha256,
            modules=with_recipes(learner.modules, self.source, described),
            summary=summary,
            held_out=held_out,
            ended=ended,
            undecided=undecided,
            passes=getattr(self.source, "passes_begun", None),
        )

    def _copy_log(self, log: RunWriter, before: Path, digest: Digest) -> None:
        """Copy the iterations before the keyframe from the earlier log, and hash their signals."""
        if self._resumed:
            before = log.path.parent / SET_ASIDE
        keyframe, self.keyframe = self.keyframe, None  # frees as much memory as the learner has
        if keyframe is not None:
            at, fork = keyframe.iteration, self.manifest.get(FORK, {})
            for signals in log.copy_log(before, at):
                digest.add(signals)
            if self._resumed:
                log.event(keyframe.t, max(at - 1, 0), f"resumed at iteration {at}")
            else:
                text = [f"fork of {fork['parent']} after {at} iterations"]
                text += [f"{k} is {now}, was {was}" for k, (was, now) in fork["changed"].items()]
                log.event(keyframe.t, max(at - 1, 0), "; ".join(text))
                log.keyframe(keyframe, again=True)
        log.sync()
        if self._resumed:
            before.unlink()


def run_session(
    source: FrameSource, config: Any, folder: str | Path | None = None, **options: Any
) -> RunResult:
    """Start a run, or resume the one in `folder`, and learn to its end.

    Args:
        source: see `Session`.
        config: see `Session`.
        folder: see `Session`.
        options: further arguments of `Session` and of `Session.learn`.
    """
    names = Session.learn.__kwdefaults__ or {}
    learning = {name: options.pop(name) for name in names if name in options}
    return Session(source, config, folder, **options).learn(**learning)
