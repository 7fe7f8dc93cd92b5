"""A run: a source, a learner, and the folder that stores what happened.

RUN/run.mcap signals, RUN/modules.npz frozen modules, RUN/run.json manifest and result,
RUN/run.rrd the view. The loop itself is in `loop`, the folder in `run_folder`.
"""

from __future__ import annotations

import contextlib
import dataclasses
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
from cdmisfa.experiments.documents import versions
from cdmisfa.experiments.holdout import judged
from cdmisfa.experiments.loop import INTERRUPTED, Digest, Keyframes, learn_blocks
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
from recorder.log.files import folder_here, partial_path
from recorder.mcap.reader import LogReader
from replay.runs.compare import differences
from replay.runs.folders import RUN_FILE, run_log
from replay.runs.keyframes import read_keyframe
from replay.runs.log import read_header
from replay.runs.provenance import comparable, has_whole_hashes, stated_source
from replay.runs.writer import RunWriter

# Called with the bytes of the source that were hashed and with all, while a run waits for that.
Hashing = Callable[[int, int], None]


class Session:
    """A run that is started, resumed or forked; `learn` then learns to its end.

    Attributes:
        source: the source of the run; left open.
        learner: the learner.
        folder: the run's folder, or None where nothing is stored.
        manifest: what its log states at its beginning.
        before: the log whose first iterations it copies: its own earlier one, or its parent's.
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
            source: live or recorded.
            config: the learner's configuration, of the class that its entry names.
            folder: the run's folder, or None to store nothing.
            seed: the seed of the policy and of the abstractions' first weights.
            max_iterations: end after this many.
            max_modules: end after this many modules; by default as the learner says.
            sections: further configuration tables (`scene`, `record`) for the manifest.
            command: how the run is started, stored with it; see `command_of`.
            force: replace an existing run.
            resume: put learner and source to the newest keyframe of the run in the folder; the
                signals equal those of an uninterrupted run.
            hashing: see `Hashing`.

        Raises:
            UsageError: to resume: the source cannot go back; there is no run, or one of another
                configuration or source.
            LogDamagedError: to resume: the log cannot be read.
        """
        self.source = source
        self.learner: Learner = open_learner(config, source.spec, seed)
        self.folder = None if folder is None else folder_here(folder)
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
                f"{self.manifest['source']['kind']} cannot go back to where the run was stopped: "
                "resume from its recording, or start another run"
            )
        self.before = log = log_to_resume(folder)
        try:
            header = read_header(log)
        except (LogDamagedError, UsageError):
            if log != partial_path(folder / RUN_FILE):
                raise
            return  # killed before the log stated anything: start again
        if has_whole_hashes(stated_source(log)):
            self.manifest["source"] = description(source, progress=self.hashing)
        if header.forked_at is not None:
            self.manifest[FORK] = header.manifest[FORK]
        as_json = json.loads(json.dumps(self.manifest))  # lists for tuples, as the log has them
        source_then, source_now = comparable(stated_source(log), as_json["source"])
        spec_then, spec_now = map(dataclasses.asdict, (header.spec, self.source.spec))
        then = {**header.manifest, "source": source_then, "spec": spec_then, COMMAND: None}
        now = {**as_json, "source": source_now, "spec": spec_now, COMMAND: None}
        found = {key.removeprefix("config."): values for key, *values in differences(then, now)}
        if found:
            # another learner has other keys, so its name explains all of them
            key = "learner.algorithm" if "learner.algorithm" in found else next(iter(found))
            raise UsageError(
                f"{folder} was made with {key} = {found[key][0]}, not {found[key][1]}: resume "
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

        Its log begins with the parent's first iterations as they are.

        Args:
            parent: the run, its folder or its log.
            at: iterations that are copied of it.
            folder: the fork's folder.
            settings: `learner.key=value` words, but for the keys in `resume.FIXED`.
            seed: the seed of the random choices from there on; the world stays the parent's.
            source: words that name its source, where the run does not state it.
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
        with Recomputation.after(log, at, source) as stopped:
            manifest, spec = stopped.header.manifest, stopped.source.spec
            span = fork_span(stopped.learner, manifest, settings, seed)
            sections = {k: part for k, part in manifest["config"].items() if k != "learner"}
            words, options = tuple(source), dict[str, Any]()
            with contextlib.suppress(UsageError):  # the run does not state its command
                named, options = read_command(log.parent)
                words = words or named
            world = sections.get("scene", {}).get("seed")
            kept = () if world is None else (f"scene.seed={world}",)
            settings = (*options.get("settings", ()), *kept, *settings)
            options |= {"settings": settings, "seed": span.seed, **(limits or {})}
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
            session.learner = reconfigured(stopped.learner, span, spec)
            session.manifest[FORK] = {
                "parent": os.path.relpath(log.parent, folder),
                "at": at,
                "changed": span.changed,
                "before": {k: manifest[k] for k in ("config", "seed", FORK) if k in manifest},
            }
            session.before = log
            state = session.learner.state
            session.keyframe = Keyframe(at, stopped.t, state, session._versions)
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
        """Learn until nothing is left to learn, and log every signal.

        Args:
            sinks: called with everything, after the log; one that raises ends the run.
            stop: called before every iteration; true ends the run cleanly, without a view, and
                without reading all of a long source for its hash.
            keyframes: iterations between keyframes, see `Keyframes`.
            rerun: also build the Rerun view.
            live: also serve the run to Rerun's viewers while it learns; called with the address,
                and entered while the run is served.

        Raises:
            UsageError: the folder is not empty and is not to be replaced, or is in use.
            LogExhaustedError: the source has not enough frames for a single block.
        """
        digest, log = Digest(), None
        all_sinks: list[Sink] = [digest]
        if self._resumed and self.before is not None and self.keyframe is not None:
            # Damage must be found before anything of the earlier run is replaced.
            end = self.source.spec.time_ns(self.keyframe.t)
            with LogReader(self.before) as earlier:
                for _, table in earlier.tables():
                    if len(table.log_time) and table.log_time[0] >= end:
                        break
        with contextlib.ExitStack() as opened:
            if self.folder is not None:
                how = {"force": self._force, "resumed": self._resumed}
                log = opened.enter_context(
                    opened_log(self.folder, self.source, self.manifest, **how)
                )
                state = Keyframes(log, self.source, self.learner, self._versions, keyframes)
                all_sinks += [log, state]
            if live is not None:
                from replay.view.live import LiveView

                tau, outputs = self.learner.tau, len(self.learner.phi)
                view = LiveView(self.source.spec, self.manifest, tau, outputs, run=self.folder)
                all_sinks.append(opened.enter_context(view))
                opened.enter_context(live(view.address))
            if log is not None and self.before is not None:
                self._copy_log(log, self.before, digest)
                if live is not None:
                    view.earlier(log.path.parent)
            all_sinks += sinks
            ended = learn_blocks(self.source, self.learner, all_sinks, stop=stop, **self._limits)
            result = self._result(ended, digest.hexdigest(), stop)
            if log is not None:
                manifest = {**self.manifest, "versions": self._versions}
                view_too = rerun and result.ended != INTERRUPTED
                write_results(log, result, manifest, view=view_too)
        return result

    def _result(self, ended: str, sha256: str, stop: Callable[[], bool]) -> RunResult:
        learner, summary, held_out = self.learner, self.learner.summary(), dict[str, Any]()
        if ended != INTERRUPTED:
            components = self.manifest["config"]["learner"].get("components", 1)
            judgement = judged(self.source, learner.modules, components, stop)
            ended, held_out = (INTERRUPTED, {}) if judgement is None else (ended, judgement)
        # After an interrupt nothing is read that is as long as the source.
        described = description(self.source, at_once=ended == INTERRUPTED, progress=self.hashing)
        streams, undecided = self.source.spec.streams, tuple[str, ...]()
        if not learner.over:
            learned = {streams[module.stream_index] for module in learner.modules}
            undecided = tuple(name for name in streams if name not in learned)
            if "streams" in summary:
                states = {one["stream"]: one["state"] for one in summary["streams"]}
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
        )

    def _copy_log(self, log: RunWriter, before: Path, digest: Digest) -> None:
        """Copy the iterations up to the keyframe from the earlier log; hash their signals."""
        if self._resumed:
            before = log.path.parent / SET_ASIDE
        keyframe, self.keyframe = self.keyframe, None  # as large as the learner's memory
        if keyframe is not None:
            at, fork = keyframe.iteration, self.manifest.get(FORK, {})
            for signals in log.copy_log(before, at):
                digest.add(signals)
            if self._resumed:
                log.event(keyframe.t, max(at - 1, 0), f"resumed at iteration {at}")
            else:
                text = [f"fork of {fork['parent']} after {at} iterations"]
                for name, (value_before, now) in fork["changed"].items():
                    text.append(f"{name} is {now}, was {value_before}")
                log.event(keyframe.t, max(at - 1, 0), "; ".join(text))
                log.keyframe(keyframe, again=True)
        log.sync()
        if self._resumed:
            before.unlink()


def run(
    source: FrameSource, config: Any, folder: str | Path | None = None, **how: Any
) -> RunResult:
    """Start a run, or resume the one in `folder`, and learn to its end.

    For the arguments see `Session` and `Session.learn`.
    """
    names = Session.learn.__kwdefaults__ or {}
    learning = {name: how.pop(name) for name in names if name in how}
    return Session(source, config, folder, **how).learn(**learning)
