"""Frozen modules applied to a source, block by block; `apply_logs` does that for many logs."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import itertools
import json
import math
import os
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from cdmisfa import kernels
from cdmisfa.agents.progress.candidate import log_ratio
from cdmisfa.agents.progress.decisions import CHANGED_SLOWNESS_LOG, MODULE_VARIANCE_BOUNDS
from cdmisfa.core.arrays import FloatArray
from cdmisfa.core.blocks import Block, FrameSource, SourceSpec, unbroken
from cdmisfa.core.errors import CdmisfaError, LogDamagedError, LogExhaustedError, UsageError
from cdmisfa.core.processes import thread_count
from cdmisfa.experiments.sources import configure, is_scene, open_logs
from cdmisfa.modules import Module, Stack, columns_of
from recorder.cameras.words import is_live, open_live
from recorder.images.framing import Recipe
from recorder.images.options import InputOptions
from replay.export.applied import Applied, AppliedSink
from replay.logs.formats.recording import NoRecordingError
from replay.logs.formats.views import SeveralRecordingsError
from replay.logs.open_logs import is_external_format
from replay.open_sources import locations, open_recording, with_every_topic
from replay.runs.folders import MODULES_FILE
from replay.runs.run import Run
from replay.storage.identity import file_sha256
from replay.stored_source import StoredSource, centre_as

# Standard deviations of a module's slowness within which it knows a block, as its learner says.
KNOWN_WITHIN: Final = 2.0

# Frames over which the variance is taken that decides whether a module is alive.
WINDOW: Final = 2000

# Approximate bytes of frames and outputs of a log that are read at once.
READ_BYTES: Final = 2**22

# Consecutive frames within a block of the clock, and the outputs (n, R) on them.
Part = tuple[Block, FloatArray]


class Application:
    """The modules of a run, ready to be applied.

    Args:
        path: the run's folder.

    Attributes:
        modules: the modules in the order of learning.
        tau: frames of a block of the run.

    Raises:
        UsageError: the run does not exist or has no modules.
        LogDamagedError: the modules cannot be read.
    """

    def __init__(self, path: str | Path) -> None:
        run = Run(path)
        self._path = str(path)
        self.modules = run.modules
        if not self.modules:
            raise UsageError(f"{path} has no modules: learn longer, or name another run")
        self.tau = int(run.header.manifest["config"]["learner"]["tau"])
        self._stack = Stack(self.modules)
        self.recipe = self.modules[0].recipe or Recipe(run.header.spec.frame_shape)
        self._folder = run.log.parent

    @functools.cached_property
    def identity(self) -> str:
        """The hash of the modules and of everything else that decides the outputs."""
        modules = file_sha256(self._folder / MODULES_FILE)
        text = json.dumps([modules, self.tau, self.recipe.as_json()])
        return hashlib.sha256(text.encode()).hexdigest()

    def __reduce__(self) -> tuple[Any, ...]:
        """Let another process read the run by itself, once, instead of sending the modules."""
        return _read_application, (os.path.abspath(self._path), self.identity)

    def open(
        self,
        words: Sequence[str],
        inputs: InputOptions | None = None,
        *,
        loop: bool = False,
        skip_damaged: bool = False,
        say: Callable[[str], None] = lambda line: None,
    ) -> FrameSource:
        """Open a source whose frames are made as the modules' recipe says.

        Args:
            words: the source, as `cdmisfa learn` takes it.
            inputs: the part of logs that is used; size, fit and colour are the recipe's.
            loop: start again at the end.
            skip_damaged: skip damaged parts.
            say: called with a line when the state of a camera changes.

        Raises:
            UsageError: the source does not exist, or its frames have another shape.
            LogDamagedError: the source is damaged.
        """
        inputs = inputs or InputOptions()
        if any(map(is_live, words)):
            source = open_live(words, self._with_recipe(inputs), say=say)
        elif is_scene(words):
            source = configure(words[0], inputs=inputs).open_scene()
        else:
            source = self._open_log(words, inputs, loop=loop, skip_damaged=skip_damaged)
        if source.spec.frame_shape != self.recipe.shape:
            source.close()
            raise UsageError(
                f"{words[0]} shows frames of {source.spec.frame_shape}, and the modules learned "
                f"from {self.recipe.shape}: choose the streams with --topic, or numbers with "
                "--field"
            )
        return centre_as(self.recipe.centre, source, words[0])

    def _with_recipe(self, inputs: InputOptions) -> InputOptions:
        recipe, numbers_range = self.recipe, inputs.range or self.recipe.range
        if recipe.size is None:
            return replace(inputs, fields=inputs.fields or recipe.fields, range=numbers_range)
        how: Any = {"size": recipe.size, "fit": recipe.fit, "color": recipe.color}
        return replace(inputs, **how, range=numbers_range)

    def _open_log(self, words: Sequence[str], inputs: InputOptions, **how: Any) -> FrameSource:
        places = locations(words)
        if not inputs.external and not any(map(is_external_format, places)):
            with contextlib.suppress(NoRecordingError, SeveralRecordingsError):
                recorded = open_recording(places, **how)
                if recorded.spec.frame_shape == self.recipe.shape or not recorded.spec.images:
                    return recorded
                recorded.close()
        return with_every_topic(
            lambda inputs: open_logs(words, inputs=inputs, **how), self._with_recipe(inputs)
        )

    def to(
        self,
        source: FrameSource,
        frames: int | None = None,
        stop: Callable[[], bool] = lambda: False,
    ) -> Generator[Applied]:
        """Apply the modules to a source, from its current frame.

        The results on a block depend on its frames and on those before it alone: a live stream
        and its recording give the same.

        Args:
            source: frames of the shape that the modules learned from; left open.
            frames: end after this many frames of each stream; by default where the source ends.
            stop: called before every block; true ends the generator.

        Yields:
            Each unbroken stretch of a stream within a block of the clock, in their order; the last
            block may be shorter.

        Raises:
            LogDamagedError: the log is damaged at the next frame; all frames before were yielded.
        """
        stored = isinstance(source, StoredSource)
        reads = _reads(source, self._step(source.spec) if stored else self.tau, self.tau, frames)
        judges = [_Judge(self.modules) for _ in source.spec.streams]
        for parts in self._ahead(reads) if stored else map(self._projected, reads):
            for part, y in sorted(parts, key=lambda part: (part[0].t, part[0].stream)):
                yield judges[part.stream].judge(part, y)
            if stop():
                return

    def _step(self, spec: SourceSpec) -> int:
        """Return frames of a log that are read at once, whole blocks."""
        pixels = math.prod(spec.frame_shape) * np.dtype(spec.dtype).itemsize
        outputs = sum(len(module.phi) for module in self.modules)
        frame_bytes = len(spec.streams) * (pixels + 8 * outputs)
        return max(READ_BYTES // frame_bytes // self.tau, 1) * self.tau

    def _ahead(self, reads: Iterator[Sequence[Block]]) -> Iterator[list[Part]]:
        """Read in one thread, and compute outputs in as many threads as there are processors."""
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
        """Compute the outputs, and cut stretches where blocks of the clock begin."""
        parts = []
        for block in blocks:
            y, end = self._stack.transform(block.frames), block.t + len(block)
            cuts = range(block.t + self.tau - block.t % self.tau, end, self.tau)
            for low, high in itertools.pairwise([block.t, *cuts, end]):
                rows = slice(low - block.t, high - block.t)
                part = Block(block.stream, low, block.frames[rows], block.truth[rows])
                parts.append((part, y[rows]))
        return parts


@functools.lru_cache(1)
def _read_application(path: str, identity: str) -> Application:
    application = Application(path)
    if application.identity != identity:
        raise CdmisfaError(f"{path} has other modules where a worker is: share one folder")
    return application


def _reads(
    source: FrameSource, step: int, tau: int, frames: int | None
) -> Iterator[Sequence[Block]]:
    """Read a source piece by piece, each to where a block of the clock ends.

    Args:
        source: read from its current frame.
        step: frames that are read at once, whole blocks.
        tau: frames of a block.
        frames: end after this many.
    """
    counts = [n for n in (frames, source.spec.length) if n is not None]
    end = source.t + min(counts, default=math.inf)
    while source.t < end:
        try:
            yield source.take_all(int(min(step - source.t % step, end - source.t)))
        except LogExhaustedError:
            yield _read_rest(source)
            return
        except LogDamagedError:
            if step == tau:
                yield _read_rest(source)
                raise
            step = tau  # up to the damaged block, and then frame by frame


def _read_rest(source: FrameSource) -> Sequence[Block]:
    """Read the last frames of a source that has too few for a block, or none that are whole."""
    blocks: list[Block] = []
    with contextlib.suppress(LogExhaustedError, LogDamagedError):
        while True:
            blocks += source.take_all(1)
    return unbroken(blocks)


class _Judge:
    """Judges on one stream whether modules are alive and how novel a block is.

    The novelty of a block is 1 at the bound of what the module's learner knows: by the band of its
    slowness or, where the learner keeps none, by the logarithm of the ratio of the steps of its
    first output from frame to frame to those while learning (its variance was 1 then).
    """

    def __init__(self, modules: Sequence[Module]) -> None:
        self._firsts = [columns.start for _, columns in columns_of(modules)]
        self._centre = np.concatenate([module.band_mean for module in modules])
        self._width = KNOWN_WITHIN * np.concatenate([module.band_sd for module in modules])
        self._step_sizes = {
            i: 2 * math.pi * float(module.eta[0])
            for i, module in enumerate(modules)
            if not np.isfinite(module.band_sd).all()
        }
        self._mean = np.zeros(len(modules))
        self._square = np.zeros(len(modules))
        self._frames = 0

    def judge(self, block: Block, y: FloatArray) -> Applied:
        """Return the outputs (n, R) on a block with their slowness, presence and novelty."""
        slowness = np.full(y.shape[1], np.nan)
        if len(y) > 1:
            slowness = kernels.instantaneous_slowness(y)
        first = y[:, self._firsts]
        self._frames += len(y)
        rate = max(min(2 * len(y) / (WINDOW + len(y)), 1.0), len(y) / self._frames)
        self._mean += rate * (first.mean(axis=0) - self._mean)
        self._square += rate * ((first * first).mean(axis=0) - self._square)
        variance = self._square - self._mean * self._mean
        alive = (MODULE_VARIANCE_BOUNDS[0] < variance) & (variance < MODULE_VARIANCE_BOUNDS[1])
        distance = np.abs(slowness - self._centre) / self._width
        novelty = np.maximum.reduceat(distance, self._firsts)
        if self._step_sizes and len(y) > 1:
            steps = np.diff(first, axis=0)
            sizes = np.sqrt((steps * steps).mean(axis=0)).tolist()
            for i, learned in self._step_sizes.items():
                novelty[i] = abs(log_ratio(sizes[i], learned)) / CHANGED_SLOWNESS_LOG
        return Applied(block, y, slowness, alive, novelty)


class Totals:
    """Sums of the outputs of modules over the streams of a source.

    Args:
        spec: the spec of the source.
        modules: the modules in their order.

    Attributes:
        frames: the number of frames of all streams.
        damaged: why the log was not applied to its end; None where it was.
    """

    def __init__(self, spec: SourceSpec, modules: Sequence[Module]) -> None:
        self.frames = 0
        self.damaged: LogDamagedError | None = None
        self._spec, self._modules = spec, modules
        self._firsts = [columns.start for _, columns in columns_of(modules)]
        self._sums: dict[int, FloatArray] = {}

    def add(self, applied: Applied) -> None:
        """Add a block."""
        count = len(applied.block)
        self.frames += count
        sums = self._sums.setdefault(applied.block.stream, np.zeros((5, len(self._modules))))
        slowness = applied.slowness[self._firsts]
        finite = np.isfinite(slowness)
        sums[0] += count
        sums[1] += count * applied.alive
        sums[2] += count * (applied.alive & (applied.novelty < 1))
        sums[3] += count * np.where(finite, slowness, 0)
        sums[4] += count * finite

    def rows(self) -> list[dict[str, Any]]:
        """Return a row per stream and module as JSON values: shares of frames, mean slowness."""
        return [
            {
                "stream": self._spec.streams[stream],
                "module": module.index,
                "frames": int(frames),
                "slowness": slowness / counted if counted else None,
                "alive": alive / frames,
                "known": known / frames,
            }
            for stream, sums in sorted(self._sums.items())
            for module, (frames, alive, known, slowness, counted) in zip(
                self._modules, sums.T.tolist(), strict=True
            )
        ]


def follow(
    applied: Iterable[Applied],
    sinks: Sequence[AppliedSink],
    totals: Totals,
    progress: Callable[[], None] = lambda: None,
) -> None:
    """Hand every block to sinks and totals; damage of the log ends that and is noted there."""
    try:
        for block in applied:
            for sink in sinks:
                sink(block)
            totals.add(block)
            progress()
    except LogDamagedError as error:
        if not totals.frames:
            raise
        totals.damaged = error
