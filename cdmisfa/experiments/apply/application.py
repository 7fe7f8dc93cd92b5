"""Frozen modules at work: applied to a source, block by block, and what they come to there."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import itertools
import json
import math
import os
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from cdmisfa import kernels
from cdmisfa.agents.progress.candidate import log_ratio
from cdmisfa.agents.progress.judging import PRESENT, STRANGE
from cdmisfa.core.arrays import FloatArray
from cdmisfa.core.blocks import Block, FrameSource, SourceSpec, unbroken
from cdmisfa.core.errors import LogDamagedError, LogExhaustedError, UsageError
from cdmisfa.core.processes import thread_count
from cdmisfa.experiments.sources import configure, is_scene, of_scene, open_logs
from cdmisfa.modules import Module, Stack, columns_of
from recorder.cameras.words import is_live, open_live, refuse_stored
from recorder.images.options import InputOptions
from replay.arrays import TAKES, ArrayLog, are_arrays
from replay.camera_logs.opening import ALL, log_format, only_foreign
from replay.camera_logs.source import UnequalError
from replay.export.applied import Applied
from replay.inputs import locations
from replay.recordings.source import RecordedSource, SeveralRecordingsError
from replay.recordings.view_file import NoRecordingError
from replay.runs.folders import MODULES_FILE
from replay.runs.run import Run
from replay.storage.identity import file_sha256
from replay.stored import StoredSource, centre_as

KNOWN_WITHIN: Final = 2.0
"""Standard deviations of a module's slowness within which it knows a block, as its learner says."""

WINDOW: Final = 2000
"""Frames over which the variance is taken that tells whether a module is alive."""

READ: Final = 2**22
"""Bytes of frames and outputs of a log that are taken at once, about."""

Part = tuple[Block, FloatArray]
"""Frames that follow one another within a block of the clock, and the outputs on them, (n, R)."""


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
        self._path = str(path)
        self.modules = run.modules
        if not self.modules:
            raise UsageError(f"{path} has no modules: learn longer, or name another run")
        self.tau = int(run.header.manifest["config"]["learner"]["tau"])
        self._stack = Stack(self.modules)
        self.recipe = self.modules[0].recipe or run.recipe()
        self._folder = run.log.parent

    @functools.cached_property
    def identity(self) -> str:
        """What is another one where the run has other modules, or applies them otherwise."""
        modules = file_sha256(self._folder / MODULES_FILE)
        text = json.dumps([modules, self.tau, self.recipe.as_json()])
        return hashlib.sha256(text.encode()).hexdigest()

    def __reduce__(self) -> tuple[Any, ...]:
        """Another process reads the run by itself, once."""
        return _application, (os.path.abspath(self._path), self.identity)

    def open(
        self,
        words: Sequence[str],
        inputs: InputOptions | None = None,
        *,
        loop: bool = False,
        salvage: bool = False,
        say: Callable[[str], None] = lambda line: None,
    ) -> FrameSource:
        """Open a source whose frames are made as the modules' recipe says.

        Args:
            words: what `cdmisfa learn` takes.
            inputs: what of logs is taken; size, fit and colour are the recipe's.
            loop: start again at the end.
            salvage: pass over what is damaged.
            say: told in a line when a camera's state changes.

        Raises:
            UsageError: no such source, or one whose frames the modules cannot take.
            LogDamagedError: it is damaged.
        """
        inputs = inputs or InputOptions()
        if any(map(is_live, words)):
            refuse_stored(words, inputs)
            source = open_live(words, replace(inputs, **self.made(inputs)), say=say)
        elif is_scene(words, inputs):
            source = configure(words[0], settings=of_scene((), inputs)).open_scene()
        else:
            source = self._log(words, inputs, loop=loop, salvage=salvage)
        shape = self.recipe.shape
        if source.spec.frame_shape != shape:
            source.close()
            raise UsageError(
                f"{words[0]} shows frames of {source.spec.frame_shape}, and the modules learned "
                f"from {shape}: choose what is as large, as with --field for numbers"
            )
        return centre_as(self.recipe.centre, source, words[0])

    def made(self, options: InputOptions) -> dict[str, Any]:
        """The recipe, as options of images; what it leaves open is that of others."""
        recipe = self.recipe
        numbers: dict[str, Any] = {"fields": options.fields or recipe.fields}
        if recipe.size is not None:
            numbers = {"size": recipe.size, "fit": recipe.fit, "color": recipe.color}
        return {**numbers, "range": options.range or recipe.range}

    def _log(self, words: Sequence[str], inputs: InputOptions, **how: Any) -> FrameSource:
        places = locations(words)
        if are_arrays(places):
            arrays = open_logs(words, inputs=inputs, **how)
            if not isinstance(arrays, ArrayLog) or not arrays.spec.images or not self.recipe.size:
                return arrays
            arrays.close()
            try:
                for array in arrays.arrays.values():
                    self.recipe.refuse_turned((array.shape[1], array.shape[2]))
            except UsageError as error:
                raise UsageError(f"{words[0]}: {error}") from None
            taken = {name: value for name, value in self.made(inputs).items() if name in TAKES}
            return open_logs(words, inputs=replace(inputs, **taken), **how)
        if not inputs.external and not any(map(only_foreign, places)):
            with contextlib.suppress(NoRecordingError, SeveralRecordingsError):
                recorded = RecordedSource(places, **how)
                if recorded.spec.frame_shape == self.recipe.shape or not recorded.spec.images:
                    return recorded
                recorded.close()
        numbers = inputs.fields or any(log_format(place) == "table" for place in places)
        if numbers and self.recipe.size is not None:
            height, width = self.recipe.size
            raise UsageError(
                f"{words[0]} shows numbers, and the modules learned from pictures of "
                f"{width}x{height}: choose pictures"
            )
        inputs = replace(inputs, **self.made(inputs))
        if not inputs.topics and not inputs.fields:
            inputs = replace(inputs, topics=ALL)
        try:
            return open_logs(words, inputs=inputs, **how)
        except UnequalError:
            return open_logs(words, inputs=replace(inputs, align="time"), **how)

    def to(
        self,
        source: FrameSource,
        frames: int | None = None,
        stop: Callable[[], bool] = lambda: False,
    ) -> Generator[Applied]:
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
        stored = isinstance(source, StoredSource)
        reads = _reads(source, self._step(source.spec) if stored else self.tau, self.tau, frames)
        judges = [_Judge(self.modules) for _ in source.spec.streams]
        for parts in self._ahead(reads) if stored else map(self._projected, reads):
            for part, y in sorted(parts, key=lambda one: (one[0].t, one[0].stream)):
                yield judges[part.stream].judge(part, y)
            if stop():
                return

    def _step(self, spec: SourceSpec) -> int:
        """Frames of a log that are read at once, whole blocks."""
        pixels = math.prod(spec.frame_shape) * np.dtype(spec.dtype).itemsize
        each = len(spec.streams) * (pixels + 8 * sum(len(module.phi) for module in self.modules))
        return max(READ // each // self.tau, 1) * self.tau

    def _ahead(self, reads: Iterator[Sequence[Block]]) -> Iterator[list[Part]]:
        """What is read in a thread, and projected in as many as it may use."""
        cores = thread_count()

        def read() -> Future[list[Part]] | None:
            blocks = next(reads, None)
            return None if blocks is None else pool.submit(self._projected, blocks)

        with ThreadPoolExecutor(cores) as pool, ThreadPoolExecutor(1) as reader:
            coming = deque(reader.submit(read) for _ in range(cores + 1))
            while (parts := coming.popleft().result()) is not None:
                coming.append(reader.submit(read))
                yield parts.result()

    def _projected(self, blocks: Sequence[Block]) -> list[Part]:
        return [part for block in blocks for part in self._parts(block)]

    def _parts(self, block: Block) -> list[Part]:
        """A stretch cut where blocks of the clock begin, with the outputs on each part."""
        y, end, parts = self._stack.transform(block.frames), block.t + len(block), []
        cuts = range(block.t + self.tau - block.t % self.tau, end, self.tau)
        for low, high in itertools.pairwise([block.t, *cuts, end]):
            own = slice(low - block.t, high - block.t)
            part = Block(block.stream, low, block.frames[own], block.truth[own])
            parts.append((part, y[own]))
        return parts


@functools.lru_cache(1)
def _application(path: str, identity: str) -> Application:
    application = Application(path)
    if application.identity != identity:
        raise UsageError(f"{path} has other modules where a worker is: share one folder")
    return application


def _reads(
    source: FrameSource, step: int, tau: int, frames: int | None
) -> Iterator[Sequence[Block]]:
    """What a source shows, read after read, each to where a block of the clock ends.

    Args:
        source: from where it is.
        step: frames that are read at once, whole blocks.
        tau: frames of a block.
        frames: end after so many.
    """
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
                yield _rest(source)
                raise
            step = tau  # up to the block that is damaged, and then frame by frame


def _rest(source: FrameSource) -> Sequence[Block]:
    """The last frames of a source that has too few for a block, or none that are whole."""
    blocks: list[Block] = []
    with contextlib.suppress(LogExhaustedError, LogDamagedError):
        while True:
            blocks += source.take_all(1)
    return unbroken(blocks)


class _Judge:
    """What tells, on one stream, whether modules are alive and how novel a block is.

    How far a block is from what a module learned is 1 at the bound of what its learner knows: by
    the band of its slowness or, where its learner keeps none, by the steps from frame to frame of
    its first output, which had variance 1: ln of their size over that of then.
    """

    def __init__(self, modules: Sequence[Module]) -> None:
        self._firsts = [own.start for _, own in columns_of(modules)]
        self._centre = np.concatenate([module.band_mean for module in modules])
        self._width = KNOWN_WITHIN * np.concatenate([module.band_sd for module in modules])
        self._turns = {
            i: 2 * math.pi * float(module.eta[0])
            for i, module in enumerate(modules)
            if not np.isfinite(module.band_sd).all()
        }
        self._mean = np.zeros(len(modules))
        self._square = np.zeros(len(modules))
        self._frames = 0

    def judge(self, block: Block, y: FloatArray) -> Applied:
        """What the modules give on a block, (n, R)."""
        slowness = np.full(y.shape[1], np.nan)
        if len(y) > 1:
            slowness = kernels.instantaneous_slowness(y)
        own = y[:, self._firsts]
        self._frames += len(y)
        rate = max(min(2 * len(y) / (WINDOW + len(y)), 1.0), len(y) / self._frames)
        self._mean += rate * (own.mean(axis=0) - self._mean)
        self._square += rate * ((own * own).mean(axis=0) - self._square)
        variance = self._square - self._mean * self._mean
        alive = (PRESENT[0] < variance) & (variance < PRESENT[1])
        away = np.abs(slowness - self._centre) / self._width
        novelty = np.maximum.reduceat(away, self._firsts)
        if self._turns and len(y) > 1:
            steps = np.diff(own, axis=0)
            sizes = np.sqrt((steps * steps).mean(axis=0)).tolist()
            for i, turn in self._turns.items():
                novelty[i] = abs(log_ratio(sizes[i], turn)) / STRANGE
        return Applied(block, y, slowness, alive, novelty)
