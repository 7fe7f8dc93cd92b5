"""What modules come to on a source, and where that is written."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import numpy as np

from cdmisfa.core.arrays import FloatArray
from cdmisfa.core.blocks import SourceSpec
from cdmisfa.core.errors import LogDamagedError
from cdmisfa.modules import Module, columns_of
from replay.export.applied import Applied, AppliedSink, written


def written_to(
    place: Path,
    spec: SourceSpec,
    modules: Sequence[Module],
    *,
    force: bool,
    log: str | None = None,
) -> AbstractContextManager[AppliedSink]:
    """What writes a file of outputs, by its name; see `written`."""
    if place.suffix.lower() == ".rrd":
        from replay.view.applied import written_view  # takes half a second

        return written_view(place, spec, modules, force=force)
    return written(place, spec, modules, force=force, log=log)


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
        self._spec, self._modules = spec, modules
        self._firsts = [own.start for _, own in columns_of(modules)]
        self._sums: dict[int, FloatArray] = {}

    def add(self, applied: Applied) -> None:
        """Take a block in."""
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
        """A row a stream and module, as JSON values: shares of its frames, mean slowness."""
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
