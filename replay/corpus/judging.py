"""What each block of a log is: known to a module, novel or noise; called in other processes."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final, Protocol

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.blocks import Block, SourceSpec
from cdmisfa.core.errors import CdmisfaError, LogExhaustedError
from cdmisfa.modules import Module
from replay.corpus.choosing import Features, described
from replay.export.applied import Applied
from replay.inputs import open_to_look
from replay.storage.location import location

SECONDS: Final = 2.0
"""Of a block where no run says how many frames it has."""

LEAST: Final = 3
"""Frames of a block that is judged."""

VERDICTS: Final = ("known", "novel", "noise")
KNOWN, NOVEL, NOISE = range(3)

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
        features: (n, F), see `described`.
    """

    spec: SourceSpec
    tau: int
    stream: NDArray[np.int64]
    t: NDArray[np.int64]
    frames: NDArray[np.int64]
    verdict: NDArray[np.int64]
    module: NDArray[np.int64]
    novelty: NDArray[np.float64]
    features: Features

    def seconds(self) -> list[float]:
        """Of each of `VERDICTS`, streams together."""
        frames = np.bincount(self.verdict, self.frames, len(VERDICTS))
        found: list[float] = (frames / self.spec.fps).tolist()
        return found


def open_log(files: Sequence[str], known: Applies | None) -> Any:
    """Open a log as modules take it or, without, as it is; what is damaged is passed over."""
    if known is not None:
        return known.open(files, salvage=True)
    return open_to_look([location(file) for file in files], salvage=True)


def judge(files: Sequence[str], known: Applies | None) -> Judged | str:
    """Judge the blocks of a log; in words, why it cannot be."""
    try:
        with contextlib.closing(open_log(files, known)) as source:
            return _judged(source, known)
    except CdmisfaError as error:
        return str(error)


def _judged(source: Any, known: Applies | None) -> Judged:
    spec = source.spec
    tau = known.tau if known else max(round(SECONDS * spec.fps), LEAST)
    rows: list[tuple[int, int, int, int, int, float]] = []
    features: list[Features] = []
    for block, novelty in _blocks(source, tau, known):
        if len(block) < LEAST:
            continue
        own, noise = described(block.frames)
        verdict, module, least = (NOISE if noise else NOVEL), NONE, np.nan
        if known is not None and np.isfinite(novelty).any():
            nearest = int(np.argmin(novelty))
            least = float(novelty[nearest])
            if least < 1:
                verdict, module = KNOWN, known.modules[nearest].index
        rows.append((block.stream, block.t, len(block), verdict, module, least))
        features.append(own)
    columns = np.array(rows, np.float64).reshape(-1, 6).T
    stream, t, frames, verdict, module = columns[:5].astype(np.int64)
    shown = np.array(features, np.float32).reshape(len(rows), -1 if rows else 0)
    return Judged(spec, tau, stream, t, frames, verdict, module, columns[5], shown)


def _blocks(source: Any, tau: int, known: Applies | None) -> Iterator[tuple[Block, Any]]:
    """Each unbroken stretch of a stream within a block of the clock, and its novelty."""
    if known is not None:
        for applied in known.to(source):
            yield applied.block, np.where(applied.alive, applied.novelty, np.inf)
        return
    end = source.first_frame + source.frames
    with contextlib.suppress(LogExhaustedError):
        while source.t < end:
            for block in source.take_all(min(tau - source.t % tau, end - source.t)):
                yield block, None
