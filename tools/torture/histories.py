"""Histories: record, split, kill, resume, force, follow, learn and verify in any order.

The rule: the signals of a run are the signals of the files that it names, or there is an error.
A `History` does one step after the other in a folder and checks the rule after each; whatever is
read must be what one world shows from its first frame on. Kills are real: a forked child kills
itself before a call that writes.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import os
import signal
import traceback
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

from cdmisfa.core.blocks import Block, ClockedSource, FrameSource, SourceSpec, freeze
from cdmisfa.core.config import LearnerConfig
from cdmisfa.core.errors import CdmisfaError, LogExhaustedError
from cdmisfa.core.learning import Learner, Sink
from cdmisfa.core.signals import BlockSignals, SignalsHash
from cdmisfa.experiments.run_folder import RunResult
from cdmisfa.experiments.session import run
from recorder.config import Split
from recorder.recording import record
from recorder.world.oscillatory import OscillatoryConfig
from recorder.world.scenes import open_scene
from replay.integrity.verify import check_log
from replay.recordings.followed import FollowedSource
from replay.recordings.source import RecordedSource
from replay.runs.log import read_columns, read_header

from .calls import Call, watched
from .outcomes import MIXED, RIGHT, WRONG, Defect, Job, Limits, Outcome

LIMITS = Limits(seconds=120, share=20, enough=10_000)
TAU = 20
MOST = 240
"""Frames of the longest recording."""
CONFIG = LearnerConfig(tau=TAU, delta=1.0, eta_dot_window=2, min_variance=0.0, warm_up=0)
PER_CASE = 20


class Unseeded(ClockedSource):
    """Streams of random values that say nothing of their seed, as cameras do."""

    def __init__(self, seed: int) -> None:
        self._spec = SourceSpec(("a", "b"), (2,), "float64")
        self._frames = np.random.default_rng(seed).normal(size=(2, MOST, 2)).cumsum(axis=1)

    def take(self, stream: int, n: int) -> Block:
        """See `FrameSource`."""
        frames = self._frames[stream, self._t : self._t + n].copy()
        if len(frames) < n:
            raise LogExhaustedError("no more frames")
        self._t += n
        return Block(stream, self._t - n, freeze(frames), freeze(np.empty((n, 0))))

    def describe(self) -> dict[str, str]:
        """See `FrameSource`."""
        return {"kind": "unseeded"}


World = tuple[str, int]
WORLDS: tuple[World, ...] = (("seeded", 0), ("seeded", 1), ("unseeded", 0), ("unseeded", 1))


def opened(world: World) -> FrameSource:
    """What a world shows."""
    kind, seed = world
    if kind == "unseeded":
        return Unseeded(seed)
    return open_scene("oscillatory", OscillatoryConfig(seed=seed))


class _Steps(Sink):
    def __init__(self) -> None:
        self.hash = SignalsHash()
        self.after = [self.hash.hexdigest()]

    def block(self, block: Block, signals: BlockSignals, learner: Learner) -> None:
        self.hash.add(signals)
        self.after.append(self.hash.hexdigest())


@functools.cache
def signals_of(world: World) -> tuple[str, ...]:
    """The hash of what is learned of a world, after each iteration."""
    steps = _Steps()
    with contextlib.closing(opened(world)) as source:
        run(source, CONFIG, max_iterations=MOST // TAU, max_modules=99, sinks=(steps,))
    return tuple(steps.after)


@functools.cache
def frames_of(world: World) -> dict[str, bytes]:
    """The bytes of each stream's frames, by its name."""
    with contextlib.closing(opened(world)) as source:
        blocks = source.take_all(MOST)
        return {source.spec.streams[block.stream]: block.frames.tobytes() for block in blocks}


def check(kind: str, right: bool, said: str) -> None:
    """What must be so."""
    if not right:
        raise Defect(kind, "histories", said)


class History:
    """What happens to a recording and a run of it.

    Attributes:
        steps: what was done, in words.
        errors: how many steps ended with an error.
    """

    def __init__(self, folder: Path) -> None:
        self.recording, self.run = folder / "recording", folder / "run"
        self.steps: list[str] = []
        self.errors = 0
        self._world: World | None = None
        self._made: tuple[int, str | None] | None = None
        self._whole = {self.recording: False, self.run: False}
        self._follower: FollowedSource | None = None
        self._followed: set[World] = set()

    # Steps

    def record(
        self, world: World, frames: int, split: str | None, *, force: bool, die: int | None = None
    ) -> None:
        """Record a world, perhaps over what is there, perhaps killed."""
        self._say(f"record {world} {frames} {split} force={force} die={die}")
        self._write(world, frames, split, die, force=force)

    def resume(self, die: int | None = None) -> None:
        """Go on with what was begun last."""
        if self._world is None or self._world[0] == "unseeded" or self._made is None:
            return  # whoever shows other frames under one name is told to begin anew
        self._say(f"resume die={die}")
        self._write(self._world, *self._made, die, resume=True)

    def learn(self, iterations: int, *, how: str, follow: bool, die: int | None = None) -> None:
        """Learn from what is there.

        Args:
            iterations: to end after.
            how: "new", "force" or "resume".
            follow: as `learn --follow`.
            die: before which call of those that write; None lives.
        """
        self._say(f"learn {iterations} {how} follow={follow} die={die}")
        found: list[RunResult] = []

        def work() -> None:
            with contextlib.closing(self._opened(follow=follow)) as source:
                words = {"force": how == "force", "resume": how == "resume", "rerun": False}
                limits = {"max_iterations": iterations, "max_modules": 99}
                found.append(run(source, CONFIG, self.run, keyframes=3, **limits, **words))

        self._do(work, die, self.run)
        for result in found:
            self._check_result(result)
        self.check_run()

    def follow(self, frames: int) -> None:
        """Take more frames with a follower that lives on."""
        self._say(f"follow {frames}")
        if self._follower is None:
            with self._errors():
                self._follower = FollowedSource(self.recording, timeout=0.0)
                self._followed = set(WORLDS)
        if (follower := self._follower) is None:
            return
        start, stream = follower.t, follower.t // TAU % len(follower.spec.streams)
        name = follower.spec.streams[stream]
        try:
            block = follower.take(stream, frames)
        except LogExhaustedError:
            return
        except CdmisfaError:
            self.errors += 1
            self.leave()
            return
        self._followed = {w for w in self._followed if _shows(w, name, start, block.frames)}
        check(MIXED, bool(self._followed), "what was followed is no world's")

    def leave(self) -> None:
        """End following."""
        self._say("leave")
        if self._follower is not None:
            self._follower.close()
            self._follower = None

    def verify(self) -> None:
        """Look at both folders as verify does, and read the recording."""
        self._say("verify")
        for folder in (self.recording, self.run):
            with self._errors():
                found = check_log(folder)
                check(WRONG, found.ok or not self._whole[folder], f"{found.problems}")
        self.check_recording()

    # Rules

    def check_recording(self) -> None:
        """What is there of a recording is what one world shows from its first frame on."""
        with self._errors(), RecordedSource(self.recording) as source:
            worlds, first, most = set(WORLDS), source.first_frame, source.frames
            for stream, name in enumerate(source.spec.streams):
                source.seek(first)
                frames = source.take(stream, most).frames
                worlds = {w for w in worlds if _shows(w, name, first, frames)}
            check(MIXED, bool(worlds), "the recording shows no world")

    def check_run(self) -> None:
        """The log of a run holds the signals of one world."""
        if not self.run.is_dir():
            return
        with self._errors():
            header = read_header(self.run)
            found, first = SignalsHash(), 0
            for columns in read_columns(self.run, header):
                for signals in columns.records():
                    first = first if found.count else signals.t
                    found.add(signals)
            if first == 0:
                self._check_signals(header.spec.streams, found.hexdigest(), found.count)

    def _check_signals(self, streams: tuple[str, ...], digest: str, count: int) -> set[World]:
        if not any(streams == tuple(frames_of(world)) for world in WORLDS):
            return set()  # of a recording that lost a view when it was to be overwritten
        worlds = {w for w in WORLDS if signals_of(w)[count] == digest}
        check(MIXED, bool(worlds), f"the run's {count} iterations are no world's")
        return worlds

    def _check_result(self, result: RunResult) -> None:
        if result.source.get("first_frame", 0):
            return
        worlds = self._check_signals(result.streams, result.signals_sha256, result.iterations)
        log = check_log(self.run)
        check(WRONG, log.ok, f"{log.problems}")
        named: Any = result.source.get("views", ())
        if result.iterations and named and all(map(self._is_there, named)):
            with RecordedSource(self.recording) as source:
                shown, name = source.take(0, TAU), source.spec.streams[0]
            right = any(_shows(world, name, shown.t, shown.frames) for world in worlds)
            check(MIXED, right or not worlds, "its files show another world")

    def _is_there(self, view: dict[str, Any]) -> bool:
        if "sha256" not in view:
            return False
        path = self.recording / view["file"]
        data = path.read_bytes()[: view.get("bytes")] if path.is_file() else b""
        return hashlib.sha256(data).hexdigest() == view["sha256"]

    # Inside

    def _say(self, step: str) -> None:
        self.steps.append(step)

    @contextlib.contextmanager
    def _errors(self) -> Iterator[None]:
        try:
            yield
        except CdmisfaError as error:
            check(WRONG, "\n" not in str(error), f"more than a line: {error}")
            self.errors += 1

    def _opened(self, *, follow: bool) -> Any:
        if follow:
            return FollowedSource(self.recording, timeout=0.0)
        return RecordedSource(self.recording)

    def _write(
        self, world: World, frames: int, split: str | None, die: int | None, **how: bool
    ) -> None:
        def work() -> None:
            with contextlib.closing(opened(world)) as source:
                parts = None if split is None else Split.parse(split)
                record(source, self.recording, frames=frames, split=parts, **how)  # type: ignore[arg-type]

        before = {path.name for path in self.recording.glob("*")}
        if self._do(work, die, self.recording) or how.get("force") or not before:
            self._world, self._made = world, (frames, split)
        self.check_recording()

    def _do(self, work: Callable[[], None], die: int | None, folder: Path) -> bool:
        """Do it here, or in a child that is killed before a call that writes.

        Returns:
            Whether it was no error.
        """
        if die is None:
            errors = self.errors
            with self._errors():
                work()
            self._whole[folder] |= errors == self.errors
            return errors == self.errors
        self._whole[folder] = False
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # of forks beside threads
            child = os.fork()
        if child == 0:
            self._doomed(work, die)
        _, status = os.waitpid(child, 0)
        ended = os.WIFSIGNALED(status) or os.waitstatus_to_exitcode(status) in (0, 2)
        check(WRONG, ended, f"a child ended with {status}")
        return os.WIFSIGNALED(status) or status == 0

    def _doomed(self, work: Callable[[], None], die: int) -> None:
        left = die

        def before(call: Call) -> None:
            nonlocal left
            left -= 1
            if left < 0:
                os.kill(os.getpid(), signal.SIGKILL)

        code = 3
        try:
            with watched(self.recording.parent, before):
                work()
            code = 0
        except CdmisfaError:
            code = 2
        except BaseException:
            traceback.print_exc()
        finally:
            os._exit(code)


def _shows(world: World, stream: str, start: int, frames: Any) -> bool:
    """Whether a world's stream shows these frames."""
    size, shown = frames[0].nbytes, frames_of(world).get(stream, b"")
    shows = shown[start * size : (start + len(frames)) * size] == frames.tobytes()
    return shows and size * MOST == len(shown)


def step(history: History, rng: Random) -> None:
    """Do something random."""
    die = rng.choice((None, rng.randrange(60)))
    world, frames = rng.choice(WORLDS), rng.randrange(20, MOST + 1, 10)
    match rng.choice(("record", "force", "resume", "resume", "learn", "learn", "follow", "verify")):
        case "record":
            history.record(world, frames, rng.choice((None, "1s", "3s")), force=False, die=die)
        case "force":
            history.record(world, frames, rng.choice((None, "1s", "3s")), force=True, die=die)
        case "resume":
            history.resume(die)
        case "learn":
            how, follow = rng.choice(("new", "force", "resume", "resume")), rng.random() < 0.6
            history.learn(rng.randrange(1, MOST // TAU), how=how, follow=follow, die=die)
        case "follow":
            for _ in range(rng.randrange(1, 4)):
                history.follow(rng.randrange(1, 90))
            if rng.random() < 0.1:
                history.leave()
        case "verify":
            history.verify()


def case(job: Job) -> Outcome:
    """Some histories of a dozen steps."""
    errors = 0
    for number in range(PER_CASE):
        history = History(job.folder / str(number))
        history.recording.parent.mkdir()
        try:
            for _ in range(job.rng.randrange(4, 16)):
                step(history, job.rng)
            history.verify()
        except Defect as found:
            told = "; ".join(history.steps)
            kind = found.outcome.kind
            raise Defect(kind, "histories", f"{number}: {found}: after {told}") from None
        finally:
            history.leave()
        errors += history.errors
    return Outcome(RIGHT, "histories", f"{errors} errors", PER_CASE)
