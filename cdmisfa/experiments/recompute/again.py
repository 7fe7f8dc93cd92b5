"""A run's learner, put where it stood and learning again what it learned then."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from cdmisfa.agents.learners import LEARNERS, open_learner
from cdmisfa.core.blocks import SeekableSource, SourceSpec, description
from cdmisfa.core.config import build
from cdmisfa.core.errors import LogDamagedError, UsageError
from cdmisfa.core.learning import Learner, LearnerState
from cdmisfa.core.signals import BlockSignals
from cdmisfa.experiments.resume import CAMERAS, FORK, read_command, restore
from cdmisfa.experiments.sources import open_logs, open_source
from recorder.cameras.words import is_live
from recorder.world.scenes import SCENES
from replay.camera_logs.options import CameraOptions
from replay.runs.folders import run_log
from replay.runs.keyframes import read_keyframe
from replay.runs.log import RunHeader, read_header
from replay.runs.run import other_files, stated_source

SAME = ("streams", "frame_shape", "dtype", "fps", "start_ns")
"""What a source must have in common with the one that a run learned from."""


@dataclass(frozen=True, slots=True)
class Era:
    """What a run's learner was told from some iteration on: once, and anew at each fork."""

    start: int
    config: Any
    seed: int
    reseeded: bool


def eras_of(log: Path, manifest: Mapping[str, Any]) -> tuple[Era, ...]:
    """What a run was told, in order.

    Raises:
        LogDamagedError: its manifest does not say it.
    """
    try:
        table, seed, fork = manifest["config"]["learner"], manifest["seed"], manifest.get(FORK)
        config = build(LEARNERS[table["algorithm"]].configuration, "learner", table)
        if fork is None:
            return (Era(0, config, seed, reseeded=False),)
        before = eras_of(log, fork["before"])
        return (*before, Era(int(fork["at"]), config, seed, seed != before[-1].seed))
    except (LookupError, TypeError, ValueError, RecursionError) as error:
        raise LogDamagedError(f"{log} does not say how its learner was configured") from error


def told_anew(learner: Learner, era: Era, spec: SourceSpec) -> Learner:
    """A learner where another one stands, told something else from now on.

    Raises:
        ValueError: what was learned does not fit what is told.
    """
    new, state = open_learner(era.config, spec, era.seed), learner.state
    policy_rng = new.state.policy_rng if era.reseeded else state.policy_rng
    new.restore(LearnerState(state.arrays, state.modules, policy_rng))
    return new


class Again:
    """A run's learner at the newest keyframe at or before an iteration, to learn on from there.

    Args:
        run: the run's folder, or its log.
        iteration: iterations done.
        source: words that name its source, where it is not what the run says.

    Attributes:
        log: of the run.
        header: of the log.
        learner: as it stands.
        t: the source's next frame.

    Raises:
        UsageError: there is no such run.
        LogDamagedError: it cannot be read.
    """

    def __init__(self, run: Path, iteration: int, source: Sequence[str] = ()) -> None:
        self.log = run_log(Path(run))
        self.header: RunHeader = read_header(self.log)
        self._words = tuple(source)
        self._source: SeekableSource | None = None
        self._eras = eras_of(self.log, self.header.manifest)
        keyframe = read_keyframe(self.log, iteration)
        self._era = sum(e.start <= (keyframe.iteration if keyframe else 0) for e in self._eras) - 1
        era = self._eras[self._era]
        self.learner: Learner = open_learner(era.config, self.header.spec, era.seed)
        self.t = 0
        if keyframe is not None:
            restore(self.learner, keyframe)
            self.t = keyframe.t

    def steps(self, count: int) -> Iterator[BlockSignals]:
        """Learn so many blocks again.

        Raises:
            UsageError: the run's source is not there.
            LogExhaustedError: it ended.
        """
        for _ in range(count):
            if self._source is None:
                self._source = self._open()
                self._source.seek(self.t)
            block = self._source.take(self.learner.stream, self.learner.tau)
            signals = self.learner.step(block)
            self.t = self._source.t
            if self._era + 1 < len(self._eras):
                self._enter(self._eras[self._era + 1])
            yield signals

    def other_files(self) -> list[str]:
        """Names of the source's files that are not those it learned from.

        None are named of a source of other words, of one that was not needed, and of a recording
        that was still written.
        """
        if self._source is None or self._words or self._followed():
            return []
        return other_files(stated_source(self.log), description(self._source, at_once=True))

    def _followed(self) -> bool:
        return bool(read_command(self.log.parent)[1].get("follow"))

    def close(self) -> None:
        """Let go of the source."""
        if self._source is not None:
            self._source.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _enter(self, era: Era) -> None:
        if self.learner.iteration == era.start:
            try:
                self.learner = told_anew(self.learner, era, self.header.spec)
            except ValueError as error:
                raise LogDamagedError(f"{self.log}: its fork cannot be ({error})") from error
            self._era += 1

    def _open(self) -> SeekableSource:
        try:
            source = source_of(self.log.parent, self._words)
        except UsageError as error:
            raise UsageError(
                f"{error} (what it learned from is needed after {self.learner.iteration} "
                "iterations, where it stands in its log: name it with --source)"
            ) from error
        now, then = source.spec, self.header.spec
        if any(getattr(now, name) != getattr(then, name) for name in SAME):
            source.close()
            raise UsageError(
                f"{' '.join(self._words) or 'its source'} shows other streams than {self.log} was "
                "learned from: name its source with --source"
            )
        return source


def source_of(run: Path, words: Sequence[str] = ()) -> SeekableSource:
    """Open what a run learned from: as it says, or what other words name.

    Raises:
        UsageError: it does not say, or there is no such source.
    """
    named, begun = tuple[str, ...](), dict[str, Any]()
    try:
        named, begun = read_command(run)
    except UsageError:
        if not words:
            raise
    as_begun = not words or words[0] in SCENES
    settings = list(begun.get("settings", ()))
    if begun.get("algorithm"):
        settings.append(f"learner.algorithm={begun['algorithm']}")
    words = tuple(words) or named
    if is_live(words[0]):
        raise UsageError(f"{words[0]} was live: name what learn --record wrote of it")
    kept = () if not as_begun and _is_recording(words) else CAMERAS
    cameras = CameraOptions(**{name: begun[name] for name in kept if name in begun})
    if words[0] not in SCENES:
        loop, salvage = bool(begun.get("loop")), bool(begun.get("salvage"))
        return open_logs(words, loop=loop, salvage=salvage, cameras=cameras)
    source, _ = open_source(
        words,
        preset=begun.get("preset"),
        settings=settings,
        seed=begun.get("seed", 0),
        cameras=cameras,
    )
    return source


def _is_recording(words: Sequence[str]) -> bool:
    from replay.recordings.source import RecordedSource
    from replay.recordings.view_file import NoRecordingError
    from replay.storage.location import location

    try:
        RecordedSource([location(word) for word in words]).close()
    except NoRecordingError:
        return False
    return True
