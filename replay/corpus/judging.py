"""What each block of a log is: known to a module, novel or noise; called in other processes."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.blocks import Block, SourceSpec
from cdmisfa.core.errors import CdmisfaError, LogExhaustedError
from cdmisfa.modules import Module
from replay.corpus.choosing import (
    AREAS,
    CELLS,
    EVERY,
    Described,
    Features,
    areas,
    described,
    distances,
    usual_distance,
)
from replay.export.applied import Applied
from replay.inputs import open_to_look
from replay.runs.log import WATCHED_TOPIC, read_batches
from replay.runs.run import Run
from replay.storage.location import location

SECONDS: Final = 2.0
"""Of a block where no run says how many frames it has."""

LEAST: Final = 3
"""Frames of a block that is judged."""

VERDICTS: Final = ("known", "novel", "noise")
KNOWN, NOVEL, NOISE = range(3)

PICTURES: Final = 1000
"""That a run watched, of which so many to twice as many are kept."""

NONE: Final = -1
"""Instead of the index of a module."""


class Applies(Protocol):
    """The modules of a run, ready to be applied: `cdmisfa.experiments.apply.Application`."""

    tau: int

    @property
    def modules(self) -> Sequence[Module]:
        """In their order."""

    def open(self, words: Sequence[str], *, salvage: bool) -> Any:
        """Open logs as the modules take them."""

    def to(self, source: Any) -> Iterator[Applied]:
        """Apply the modules to them, block by block."""


class Verdict(NamedTuple):
    """What a block is.

    Attributes:
        kind: one of `VERDICTS`, by its place there.
        shown: what it shows.
        module: index of the one that knows it, or `NONE`.
        novelty: to the module to which it is least, NaN where there is none.
    """

    kind: int
    shown: Described
    module: int = NONE
    novelty: float = np.nan


def verdict_on(block: Block, applied: Applied | None, modules: Sequence[Module]) -> Verdict:
    """Judge a block of `LEAST` frames or more.

    Args:
        block: as its stream shows it.
        applied: what the modules of a run give on it, where there is a run.
        modules: of the run.
    """
    shown = described(block.frames)
    verdict = Verdict(NOISE if shown.noise else NOVEL, shown)
    if applied is None:
        return verdict
    near = np.where(applied.alive, applied.novelty, np.inf)
    nearest = int(np.argmin(near))
    novelty = float(near[nearest])
    if novelty < 1:
        return Verdict(KNOWN, shown, modules[nearest].index, novelty)
    return verdict._replace(novelty=novelty) if np.isfinite(novelty) else verdict


def frames_of_block(spec: SourceSpec, known: Applies | None) -> int:
    """Frames of the blocks that are judged: as the run had them, or `SECONDS`."""
    return known.tau if known else max(round(SECONDS * spec.fps), LEAST)


@dataclass(frozen=True, slots=True)
class Judged:
    """The blocks of a log, an entry each, in the order in which they were shown.

    Attributes:
        spec: of the log.
        tau: frames of a block of the clock.
        stream: (n,) which.
        t: (n,) first frame.
        frames: (n,) how many.
        verdict: (n,) one of `VERDICTS`, by its place there.
        module: (n,) index of the one that knows it, or `NONE`.
        novelty: (n,) to the module to which it is least, NaN where there is none.
        strange: (n,) how far it looks from what the run watched: 1 as two pictures of that differ
            in the mean, infinite without a run.
        features: (n, F), see `Described.cells`.
    """

    spec: SourceSpec
    tau: int
    stream: NDArray[np.int64]
    t: NDArray[np.int64]
    frames: NDArray[np.int64]
    verdict: NDArray[np.int64]
    module: NDArray[np.int64]
    novelty: NDArray[np.float64]
    strange: NDArray[np.float64]
    features: Features

    def seconds(self) -> list[float]:
        """Of each of `VERDICTS`, streams together."""
        frames = np.bincount(self.verdict, self.frames, len(VERDICTS))
        found: list[float] = (frames / self.spec.fps).tolist()
        return found


@dataclass(frozen=True, slots=True)
class Watched:
    """What a run watched looks like.

    Attributes:
        looks: (n, areas), see `described`.
        size: of two of them, how far they are from each other in the mean square.
    """

    looks: NDArray[np.float64]
    size: float

    @classmethod
    def by(cls, path: Path) -> Watched:
        """What a run watched, evenly, at most `PICTURES`."""
        run = Run(path)
        some: list[NDArray[np.float64]] = []
        step, at = 1, 0
        for batch in read_batches(run.log, run.header, topics=(WATCHED_TOPIC,)):
            for _, frames in batch.watched:
                own = frames[-at % step :: step]
                some.extend(areas(areas(own, CELLS), AREAS).reshape(len(own), -1))
                at += len(frames)
                while len(some) > 2 * PICTURES:
                    some, step = some[::2], 2 * step
        looks = np.array(some)
        variance = float(looks.var(axis=0).sum()) if some else 0.0
        pictures = run.header.spec.images
        return cls(looks, usual_distance(variance, looks.shape[-1], pictures=pictures))

    def strange(self, looks: NDArray[np.float64]) -> float:
        """How far the frame of a block, (n, areas), is from them that is farthest."""
        if not len(self.looks) or looks.shape[1] != self.looks.shape[1]:
            return np.inf
        away = distances(looks[::EVERY], self.looks).min(axis=1)
        return float(away.max()) / self.size


def open_for(files: Sequence[str], known: Applies | None) -> Any:
    """Open a log as modules take it or, without, as it is; what is damaged is passed over."""
    if known is not None:
        return known.open(files, salvage=True)
    return open_to_look([location(file) for file in files], salvage=True)


def judge(files: Sequence[str], known: Applies | None, watched: Watched | None) -> Judged | str:
    """Judge the blocks of a log; in words, why it cannot be."""
    try:
        with contextlib.closing(open_for(files, known)) as source:
            return _judged(source, known, watched)
    except CdmisfaError as error:
        return str(error)


def _judged(source: Any, known: Applies | None, watched: Watched | None) -> Judged:
    spec = source.spec
    tau, modules = frames_of_block(spec, known), known.modules if known else ()
    rows: list[tuple[float, ...]] = []
    features: list[Features] = []
    for block, applied in _blocks(source, tau, known):
        if len(block) >= LEAST:
            found = verdict_on(block, applied, modules)
            strange = np.inf if watched is None else watched.strange(found.shown.looks)
            about = found.kind, found.module, found.novelty, strange
            rows.append((block.stream, block.t, len(block), *about))
            features.append(found.shown.cells)
    columns = np.array(rows, np.float64).reshape(-1, 7).T
    stream, t, frames, verdict, module = columns[:5].astype(np.int64)
    shown = np.array(features, np.float32).reshape(len(rows), -1 if rows else 0)
    return Judged(spec, tau, stream, t, frames, verdict, module, columns[5], columns[6], shown)


def _blocks(source: Any, tau: int, known: Applies | None) -> Iterator[tuple[Block, Applied | None]]:
    """Each unbroken stretch of a stream within a block of the clock, and what modules give."""
    if known is not None:
        for applied in known.to(source):
            yield applied.block, applied
        return
    end = source.first_frame + source.frames
    with contextlib.suppress(LogExhaustedError):
        while source.t < end:
            for block in source.take_all(min(tau - source.t % tau, end - source.t)):
                yield block, None
