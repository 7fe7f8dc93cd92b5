"""Frozen modules at work: applied to a source, block by block, and what they come to there."""

from __future__ import annotations

import contextlib
import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from cdmisfa import kernels
from cdmisfa.agents.progress.candidate import log_ratio
from cdmisfa.agents.progress.judging import PRESENT, STRANGE
from cdmisfa.core.arrays import FloatArray
from cdmisfa.core.blocks import Block, FrameSource, SourceSpec, freeze
from cdmisfa.core.errors import LogDamagedError, LogExhaustedError, UsageError
from cdmisfa.core.options import option_name
from cdmisfa.experiments.sources import configure, is_scene, open_logs
from cdmisfa.modules import Module, Stack
from recorder.cameras.options import LiveOptions
from recorder.cameras.words import is_live, open_live
from recorder.images.options import ImageOptions
from replay.camera_logs.opening import ALL
from replay.camera_logs.options import CameraOptions
from replay.camera_logs.source import UnequalError
from replay.export.applied import Applied, AppliedSink, columns_of
from replay.inputs import locations
from replay.recordings.source import RecordedSource, SeveralRecordingsError
from replay.recordings.view_file import NoRecordingError
from replay.runs.run import Run
from replay.stored import StoredSource

KNOWN_WITHIN: Final = 2.0
"""Standard deviations of a module's slowness within which it knows a block, as its learner says."""

WINDOW: Final = 2000
"""Frames over which the variance is taken that tells whether a module is alive."""

AHEAD: Final = 640
"""Frames of a log that are read at once, about."""


class Application:
    """The modules of a run, ready to be applied.

    Args:
        path: of the run.

    Attributes:
        modules: in the order of learning.
        tau: frames of a block, as the run had them.

    Raises:
        UsageError: there is no such run, or it has no modules.
        LogDamagedError: they cannot be read.
    """

    def __init__(self, path: str | Path) -> None:
        run = Run(path)
        self.modules = run.modules
        if not self.modules:
            raise UsageError(f"{path} has no modules: learn longer, or name another run")
        self.tau = int(run.header.manifest["config"]["learner"]["tau"])
        self._stack = Stack(self.modules)
        self.recipe = self.modules[0].recipe or run.recipe()

    def open(
        self,
        words: Sequence[str],
        cameras: CameraOptions | None = None,
        live: LiveOptions | None = None,
        *,
        loop: bool = False,
        salvage: bool = False,
        say: Callable[[str], None] = lambda line: None,
    ) -> FrameSource:
        """Open a source whose frames are made as the modules' recipe says.

        Args:
            words: what `cdmisfa learn` takes.
            cameras: what of logs is taken; size, fit and colour are the recipe's.
            live: how live streams are put on one clock.
            loop: start again at the end.
            salvage: pass over what is damaged.
            say: told in a line when a camera's state changes.

        Raises:
            UsageError: no such source, or one whose frames the modules cannot take.
            LogDamagedError: it is damaged.
        """
        cameras, live = cameras or CameraOptions(), live or LiveOptions()
        if any(map(is_live, words)):
            source = open_live(words, self._live(words, cameras, live), say=say)
        elif is_scene(words, cameras):
            source = configure(words[0]).open_scene()
        else:
            source = self._log(words, cameras, loop=loop, salvage=salvage)
        shape = self.recipe.shape
        if source.spec.frame_shape != shape:
            source.close()
            raise UsageError(
                f"{words[0]} shows frames of {source.spec.frame_shape}, and the modules learned "
                f"from {shape}: choose what is as large, as with --field for numbers"
            )
        return source

    def _made(self, options: Any) -> dict[str, Any]:
        """The recipe, as options of images."""
        recipe = self.recipe
        numbers: dict[str, Any] = {"fields": options.fields or recipe.fields}
        if recipe.size is not None:
            numbers = {"size": recipe.size, "fit": recipe.fit, "color": recipe.color}
        return {**numbers, "depth": options.depth or recipe.range}

    def _live(self, words: Sequence[str], cameras: CameraOptions, live: LiveOptions) -> LiveOptions:
        stored = [word for word in words if not is_live(word)]
        if stored:
            raise UsageError(f"{stored[0]} is no live stream, as the others are: name them apart")
        of_images = {field.name for field in fields(ImageOptions)}
        of_logs = [
            option_name(field)
            for field in fields(CameraOptions)
            if field.name not in of_images and getattr(cameras, field.name) != field.default
        ]
        if of_logs:
            raise UsageError(f"{words[0]} is a live stream: {', '.join(of_logs)} is for logs")
        return replace(live, rate=cameras.rate, **self._made(cameras))

    def _log(self, words: Sequence[str], cameras: CameraOptions, **how: Any) -> FrameSource:
        if cameras == CameraOptions():
            with contextlib.suppress(NoRecordingError, SeveralRecordingsError):
                recorded = RecordedSource(locations(words), **how)
                if recorded.spec.frame_shape == self.recipe.shape or not recorded.spec.images:
                    return recorded
                recorded.close()
        cameras = replace(cameras, **self._made(cameras))
        if not cameras.topics and not cameras.fields:
            cameras = replace(cameras, topics=ALL)
        try:
            return open_logs(words, cameras=cameras, **how)
        except UnequalError:
            return open_logs(words, cameras=replace(cameras, align="time"), **how)

    def to(
        self,
        source: FrameSource,
        frames: int | None = None,
        stop: Callable[[], bool] = lambda: False,
    ) -> Iterator[Applied]:
        """Apply the modules to a source, from where it is.

        What is given of a block follows from its frames, and those before it since then: it is the
        same of a live stream and of its recording.

        Args:
            source: of frames as they learned from; left open.
            frames: end after so many of each stream; by default where the source ends.
            stop: asked before every block; true ends it.

        Yields:
            Each unbroken stretch of a stream within a block of the clock, in their order; the last
            block may be shorter.

        Raises:
            LogDamagedError: the log is damaged there; all before was given.
        """
        judges = [_Judge(self.modules) for _ in source.spec.streams]
        reads = _reads(source, self.tau, frames)
        for blocks in _ahead(reads) if isinstance(source, StoredSource) else reads:
            found = [part for block in blocks for part in self._parts(block)]
            for part, y in sorted(found, key=lambda one: (one[0].t, one[0].stream)):
                yield judges[part.stream].judge(part, y)
            if stop():
                return

    def _parts(self, block: Block) -> Iterator[tuple[Block, FloatArray]]:
        """A stretch cut where blocks of the clock begin, with the outputs on each part."""
        y, end = self._stack.transform(block.frames), block.t + len(block)
        cuts = range(block.t + self.tau - block.t % self.tau, end, self.tau)
        for low, high in itertools.pairwise([block.t, *cuts, end]):
            own = slice(low - block.t, high - block.t)
            part = Block(block.stream, low, block.frames[own], block.truth[own])
            yield part, np.ascontiguousarray(y[own])


def _reads(source: FrameSource, tau: int, frames: int | None) -> Iterator[Sequence[Block]]:
    """What a source shows, read after read, each to where a block of the clock ends."""
    stored = isinstance(source, StoredSource)
    step = max(AHEAD // tau, 1) * tau if stored else tau
    end = None if frames is None else source.t + frames
    if source.spec.length is not None:
        whole = source.t + source.spec.length
        end = whole if end is None else min(whole, end)
    while end is None or source.t < end:
        n = step - source.t % step
        n = n if end is None else min(n, end - source.t)
        try:
            yield source.take_all(n)
        except LogExhaustedError:
            yield _rest(source)
            return
        except LogDamagedError:
            if step == tau:
                raise
            step = tau  # up to the block that is damaged


def _rest(source: FrameSource) -> Sequence[Block]:
    """The last frames of a source that has too few for a block."""
    found: dict[int, list[Block]] = {}
    with contextlib.suppress(LogExhaustedError):
        while True:
            for block in source.take_all(1):
                found.setdefault(block.stream, []).append(block)
    rest = []
    for stream, blocks in found.items():
        unbroken = itertools.groupby(enumerate(blocks), lambda one: one[1].t - one[0])
        for _, those in unbroken:
            run = [block for _, block in those]
            frames = freeze(np.concatenate([block.frames for block in run]))
            truth = freeze(np.concatenate([block.truth for block in run]))
            rest.append(Block(stream, run[0].t, frames, truth))
    return rest


def _ahead(reads: Iterator[Sequence[Block]]) -> Iterator[Sequence[Block]]:
    """The same, the next one read in a thread meanwhile."""
    with ThreadPoolExecutor(1) as thread:
        coming = thread.submit(next, reads, None)
        while (now := coming.result()) is not None:
            coming = thread.submit(next, reads, None)
            yield now


class _Judge:
    """What tells, on one stream, whether modules are alive and how novel a block is."""

    def __init__(self, modules: Sequence[Module]) -> None:
        self._columns = list(columns_of(modules))
        self._firsts = [own.start for _, own in self._columns]
        self._mean = np.zeros(len(self._firsts))
        self._square = np.zeros(len(self._firsts))
        self._frames = 0

    def judge(self, block: Block, y: FloatArray) -> Applied:
        """What the modules give on a block, (n, R)."""
        count = y.shape[1]
        slowness = kernels.instantaneous_slowness(y) if len(y) > 1 else np.full(count, np.nan)
        own = y[:, self._firsts]
        self._frames += len(y)
        rate = max(min(2 * len(y) / (WINDOW + len(y)), 1.0), len(y) / self._frames)
        self._mean += rate * (own.mean(axis=0) - self._mean)
        self._square += rate * ((own * own).mean(axis=0) - self._square)
        variance = self._square - self._mean * self._mean
        alive = (PRESENT[0] < variance) & (variance < PRESENT[1])
        novelty = [_novelty(m, y[:, columns], slowness[columns]) for m, columns in self._columns]
        return Applied(block, y, slowness, alive, np.array(novelty))


def _novelty(module: Module, y: FloatArray, slowness: FloatArray) -> float:
    """How far a block is from what the module learned, 1 at the bound of what its learner knows.

    By the band of its slowness or, where its learner keeps none, by the steps from frame to frame
    of its first output, which had variance 1: ln of their size over that of then.
    """
    if np.isfinite(module.band_sd).all():
        away = np.abs(slowness - module.band_mean) / (KNOWN_WITHIN * module.band_sd)
        return float(away.max())
    steps = np.diff(y[:, 0])
    if not len(steps):
        return math.nan
    turn = 2 * math.pi * float(module.eta[0])
    return abs(log_ratio(math.sqrt(float(np.mean(steps * steps))), turn)) / STRANGE


class Totals:
    """What modules came to on the streams of a source.

    Args:
        spec: of the source.
        modules: in their order.

    Attributes:
        frames: of all streams.
        damaged: why the log was not applied to its end; None where it was.
    """

    def __init__(self, spec: SourceSpec, modules: Sequence[Module]) -> None:
        self.frames = 0
        self.damaged: LogDamagedError | None = None
        self._spec, self._modules = spec, list(columns_of(modules))
        self._sums: dict[tuple[int, int], list[float]] = {}

    def add(self, applied: Applied) -> None:
        """Take a block in."""
        block, count = applied.block, len(applied.block)
        self.frames += count
        for i, (_, own) in enumerate(self._modules):
            sums = self._sums.setdefault((block.stream, i), [0.0] * 5)
            sums[0] += count
            sums[1] += count * bool(applied.alive[i])
            sums[2] += count * (float(applied.novelty[i]) < 1)
            slowness = float(applied.slowness[own.start])
            if math.isfinite(slowness):
                sums[3] += count * slowness
                sums[4] += count

    def rows(self) -> list[dict[str, Any]]:
        """A row a stream and module, as JSON values: shares of its frames, mean slowness."""
        return [
            {
                "stream": self._spec.streams[stream],
                "module": self._modules[i][0].index,
                "frames": int(frames),
                "slowness": slowness / counted if counted else None,
                "alive": alive / frames,
                "known": known / frames,
            }
            for (stream, i), (frames, alive, known, slowness, counted) in sorted(self._sums.items())
        ]


def follow(
    applied: Iterable[Applied],
    sinks: Sequence[AppliedSink],
    totals: Totals,
    told: Callable[[], None] = lambda: None,
) -> None:
    """Hand every block to sinks and totals; damage of the log ends it and is noted."""
    try:
        for one in applied:
            for sink in sinks:
                sink.add(one)
            totals.add(one)
            told()
    except LogDamagedError as error:
        if not totals.frames:
            raise
        totals.damaged = error
