"""`Application`: apply the saved modules of a run to a source, block by block."""

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
from cdmisfa.agents.progress import decisions
from cdmisfa.agents.progress.config import ProgressConfig
from cdmisfa.agents.progress.learner import MIN_TEST_BLOCKS
from cdmisfa.core.arrays import FloatArray
from cdmisfa.core.blocks import Block, FrameSource, SourceSpec
from cdmisfa.core.errors import CdmisfaError, LogDamagedError, LogExhaustedError, UsageError
from cdmisfa.core.gaps import unbroken
from cdmisfa.core.names import kind_of_frames
from cdmisfa.core.processes import thread_count
from cdmisfa.experiments.sources import configure, is_scene, open_logs
from cdmisfa.features.following import SlownessSums
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
from replay.runs.run import StoredRun
from replay.storage.identity import file_sha256
from replay.stored_source import StoredSource, centre_as

# Standard deviations of its slowness within which a module of 1.0 and 2.0 explains a block, as in
# the paper and in `gate.c`.
EXPLAINED_WITHIN_SD: Final = 2.0

# Approximate size in bytes of the frames and outputs that are read at once from a log. A larger
# value takes more memory; the speed did not rise further.
READ_BYTES: Final = 2**22

# Consecutive frames within a block of the clock, and the outputs (n, R) on them.
Part = tuple[Block, FloatArray]


class Application:
    """The modules of a run, ready to be applied.

    Args:
        path: folder of the run.

    Attributes:
        modules: the modules, in the order in which they were saved.
        tau: number of frames in a block of the run.
        recipe: recipe by which raw images become frames.

    Raises:
        UsageError: the run does not exist or has no modules.
        LogDamagedError: the modules cannot be read.
    """

    def __init__(self, path: str | Path) -> None:
        run = StoredRun(path)
        self._path = str(path)
        self.modules = run.modules
        if not self.modules:
            raise UsageError(f"{path} has no modules: learn longer, or name another run")
        learner = run.header.manifest["config"]["learner"]
        self.tau = int(learner["tau"])
        # A module is judged over the window in which the learner tested it before its save.
        test_frames = int(learner.get("test_frames", ProgressConfig().test_frames))
        self._window = max(test_frames, MIN_TEST_BLOCKS * self.tau)
        self._stack = Stack(self.modules)
        recipes = [module.recipe or Recipe(module.frame_shape) for module in self.modules]
        self.recipe, self._recipes = recipes[0], recipes
        self._shapes = list(dict.fromkeys(recipe.shape for recipe in recipes))
        stated = run.header.manifest["source"]
        self._topics = tuple(stated.get("topics", ()))
        self._times = {name: stated[name] for name in ("time", "stamp") if name in stated}
        self._folder = run.log.parent

    @functools.cached_property
    def identity(self) -> str:
        """Hash of the modules and of everything else that the outputs depend on."""
        modules = file_sha256(self._folder / MODULES_FILE)
        text = json.dumps([modules, self.tau, self.recipe.as_json()])
        return hashlib.sha256(text.encode()).hexdigest()

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle as the path of the run: a worker reads the modules once, from the disk."""
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
        """Open a source, and make its frames by the modules' recipe.

        Args:
            words: the source, as `cdmisfa learn` takes it.
            inputs: which part of logs to use; size, fit and color come from the recipe.
            loop: True to start again at the end.
            skip_damaged: True to skip damaged parts.
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
        shapes = [shape for shape, _ in source.spec.every_kind]
        if not set(shapes) & set(self._shapes):
            source.close()
            here, learned = (" and ".join(map(kind_of_frames, s)) for s in (shapes, self._shapes))
            raise UsageError(
                f"{words[0]} has {here}, but the run learned from {learned}: name a log with such "
                "frames, or choose streams with --topic or numbers with --field"
            )
        return centre_as(self.recipe.centre, source, words[0])

    def _with_recipe(self, inputs: InputOptions) -> InputOptions:
        framing: Any = {"range": inputs.range or self.recipe.range}
        for recipe in self._recipes:
            if recipe.size is None:
                framing["fields"] = inputs.fields or recipe.fields
            else:
                framing |= {"size": recipe.size, "fit": recipe.fit, "color": recipe.color}
        return replace(inputs, **framing)

    def _open_log(self, words: Sequence[str], inputs: InputOptions, **options: Any) -> FrameSource:
        places = locations(words)
        if not inputs.external and not any(map(is_external_format, places)):
            with contextlib.suppress(NoRecordingError, SeveralRecordingsError):
                recorded = open_recording(places, **options)
                if recorded.spec.frame_shape in self._shapes or not recorded.spec.images:
                    return recorded
                recorded.close()
        attempts = [how := self._with_recipe(inputs)]
        if how.size and how.fields:  # the log may have the same topics, images only, or numbers
            named = replace(how, topics=inputs.topics or self._topics)
            attempts = [named, how, replace(how, size=None, fit="crop", color=False)]
        if self._times and inputs.time is None:  # the log may have the same times, or none
            attempts = [*(replace(how, **self._times) for how in attempts), *attempts]
        for how in attempts[:-1]:
            with contextlib.suppress(UsageError):
                return with_every_topic(lambda i: open_logs(words, inputs=i, **options), how)
        return with_every_topic(lambda i: open_logs(words, inputs=i, **options), attempts[-1])

    def to(
        self,
        source: FrameSource,
        frames: int | None = None,
        stop: Callable[[], bool] = lambda: False,
    ) -> Generator[Applied]:
        """Apply the modules to a source, from its current frame.

        The results on a block depend only on its frames and on earlier ones, so that a live stream
        and its recording give the same results.

        Args:
            source: a source of frames in the shape that the modules learned from; it stays open.
            frames: largest number of frames of each stream; None: up to the end of the source.
            stop: called before every block; True ends the generator.

        Yields:
            Each stretch of a stream without a gap within a block of the clock, in order of time;
            the last block can be shorter.

        Raises:
            LogDamagedError: the log is damaged at the next frame; all frames before were yielded.
        """
        stored = isinstance(source, StoredSource)
        reads = _reads(source, self._step(source.spec) if stored else self.tau, self.tau, frames)
        trackers = [_ModuleTracker(self.modules, self._window) for _ in source.spec.streams]
        for parts in self._ahead(reads) if stored else map(self._projected, reads):
            for part, y in sorted(parts, key=lambda part: (part[0].t, part[0].stream)):
                yield trackers[part.stream].update(part, y)
            if stop():
                return

    def _step(self, spec: SourceSpec) -> int:
        """Return the number of frames of a log to read at once, a multiple of tau."""
        kinds = map(spec.kind, range(len(spec.streams)))
        pixels = sum(math.prod(shape) * np.dtype(dtype).itemsize for shape, dtype in kinds)
        outputs = sum(len(module.phi) for module in self.modules)
        frame_bytes = pixels + 8 * len(spec.streams) * outputs
        return max(READ_BYTES // frame_bytes // self.tau, 1) * self.tau

    def _ahead(self, reads: Iterator[Sequence[Block]]) -> Iterator[list[Part]]:
        """Read in one thread, and compute outputs in one thread for each processor."""
        cores = thread_count()

        def read() -> Future[list[Part]] | None:
            blocks = next(reads, None)
            return None if blocks is None else pool.submit(self._projected, blocks)

        with ThreadPoolExecutor(cores) as pool, ThreadPoolExecutor(1) as reader:
            futures = deque(reader.submit(read) for _ in range(cores + 1))
            while (parts := futures.popleft().result()) is not None:
                futures.append(reader.submit(read))
                yield parts.result()

    def _projected(self, blocks: Sequence[Block]) -> list[Part]:
        """Compute the outputs, and cut stretches at the beginnings of blocks of the clock."""
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
        raise CdmisfaError(f"{path} has other modules on a worker: use a folder that all share")
    return application


def _reads(
    source: FrameSource, step: int, tau: int, frames: int | None
) -> Iterator[Sequence[Block]]:
    """Read at most some frames; each piece of `step` frames ends with a block of `tau` frames."""
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
            step = tau  # read block by block up to the damage, and then frame by frame


def _read_rest(source: FrameSource) -> Sequence[Block]:
    """Read the last frames of a source that has less than a block, or is damaged there."""
    blocks: list[Block] = []
    with contextlib.suppress(LogExhaustedError, LogDamagedError):
        while True:
            blocks += source.take_all(1)
    return unbroken(blocks)


class _ModuleTracker:
    """Running statistics of the modules on one stream: whether they are alive, and novelty.

    A module explains a block if the novelty is at most 1, the bound of the learner. For modules of
    1.0 and 2.0 that is the band of the slowness within the block, as in `gate.c`. For those of the
    progress learner it is `decisions.novelty` of all outputs, over the window of its tests and
    relative to training, where the variance of an output was 1 and its slowness eta.
    """

    def __init__(self, modules: Sequence[Module], window: int) -> None:
        self._window = window
        self._columns = [columns for _, columns in columns_of(modules)]
        self._firsts = [columns.start for columns in self._columns]
        self._centre = np.concatenate([module.band_mean for module in modules])
        self._width = EXPLAINED_WITHIN_SD * np.concatenate([module.band_sd for module in modules])
        self._steps = {  # mean squares of the differences of the outputs in training
            i: (2 * math.pi * module.eta) ** 2
            for i, module in enumerate(modules)
            if not np.isfinite(module.band_sd).all()
        }
        self._moments = np.zeros((3, len(self._centre)))
        self._frames = 0

    def update(self, block: Block, y: FloatArray) -> Applied:
        """Return the outputs (n, R) on a block with their slowness, liveness and novelty."""
        slowness, novelty = np.full(y.shape[1], np.nan), np.full(len(self._firsts), np.nan)
        if len(y) > 1:
            slowness = kernels.instantaneous_slowness(y)
            squares = [y * y, np.diff(y, axis=0) ** 2]
            self._frames += len(y)
            rate = max(min(2 * len(y) / (self._window + len(y)), 1.0), len(y) / self._frames)
            now = np.stack([values.mean(axis=0) for values in (y, *squares)])
            self._moments += rate * (now - self._moments)
            with np.errstate(invalid="ignore"):  # an output can be infinitely fast here and there
                distance = np.abs(slowness - self._centre) / self._width
            novelty = np.maximum.reduceat(distance, self._firsts)
        mean, power, steps = self._moments
        variance = (power - mean * mean)[self._firsts]
        low, high = decisions.MODULE_VARIANCE_BOUNDS
        for i, trained in self._steps.items() if len(y) > 1 else ():
            at = self._columns[i]
            novelty[i] = decisions.novelty(power[at].tolist(), (steps[at] / trained).tolist())
        return Applied(block, y, slowness, (low < variance) & (variance < high), novelty)


class Totals:
    """Totals over the outputs of modules on all streams of a source.

    Args:
        spec: properties of the source.
        modules: the modules.

    Attributes:
        frames: total number of frames of all streams.
        damaged: the error at which reading the log ended; None if it was read to its end.
    """

    def __init__(self, spec: SourceSpec, modules: Sequence[Module]) -> None:
        self.frames = 0
        self.damaged: LogDamagedError | None = None
        self._spec, self._modules = spec, modules
        self._firsts = [columns.start for _, columns in columns_of(modules)]
        self._sums: dict[int, FloatArray] = {}
        self._slowness: dict[int, SlownessSums] = {}
        self._ends: dict[int, int] = {}

    def add(self, applied: Applied) -> None:
        """Add a block."""
        block, stream, count = applied.block, applied.block.stream, len(applied.block)
        self.frames += count
        sums = self._sums.setdefault(stream, np.zeros((4, len(self._modules))))
        sums[0] += count
        sums[1] += count * applied.alive
        sums[2] += count * ~np.isnan(applied.novelty)
        sums[3] += count * (applied.novelty <= 1)
        slowness = self._slowness.setdefault(stream, SlownessSums(len(self._firsts)))
        slowness.add(applied.y[:, self._firsts], gap=block.t != self._ends.get(stream))
        self._ends[stream] = block.t + count

    def rows(self) -> list[dict[str, Any]]:
        """Return slowness and shares of frames for each stream and module, as JSON values.

        `slowness` is that of the first output over all frames, as `learn` measures it on held-out
        frames. `alive` is a share of all frames, and `explained` the share of the frames with a
        novelty on which it is at most 1; a value that does not exist is None.
        """
        return [
            {
                "stream": self._spec.streams[stream],
                "module": module.index,
                "frames": int(frames),
                "slowness": slowness if math.isfinite(slowness) else None,
                "alive": alive / frames,
                "explained": explained / judged if judged else None,
            }
            for stream, sums in sorted(self._sums.items())
            for module, slowness, (frames, alive, judged, explained) in zip(
                self._modules,
                self._slowness[stream].slowness.tolist(),
                sums.T.tolist(),
                strict=True,
            )
            if module.frame_shape in ((), self._spec.kind(stream)[0])
        ]


def follow(
    applied: Iterable[Applied],
    sinks: Sequence[AppliedSink],
    totals: Totals,
    progress: Callable[[], None] = lambda: None,
) -> None:
    """Pass every block to sinks and totals; note damage of the log in `totals` and end there."""
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
