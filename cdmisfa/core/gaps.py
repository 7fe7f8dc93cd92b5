"""Stretches of frames without a gap, as blocks."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import groupby
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.blocks import Block, freeze, one_block


def stretches(
    rows: Sequence[Sequence[Any]], t: int, truth: NDArray[np.float64]
) -> tuple[Block, ...]:
    """Return the blocks of consecutive frames of all streams, one for each stretch without a gap.

    Args:
        rows: frame of each stream at each step, None for a missing one.
        t: number of the first step.
        truth: (n, D) truth of the steps, read-only.
    """
    blocks: list[Block] = []
    for stream, column in enumerate(zip(*rows, strict=True)):
        for is_gap, stretch in groupby(enumerate(column), lambda step: step[1] is None):
            if not is_gap:
                steps, frames = zip(*stretch, strict=True)
                part = truth[steps[0] : steps[-1] + 1]
                blocks.append(Block(stream, t + steps[0], freeze(np.stack(frames)), part))
    return tuple(blocks)


def unbroken(blocks: Iterable[Block]) -> list[Block]:
    """Return the stretches without a gap of streams that were read in pieces.

    Args:
        blocks: pieces, those of each stream in order of time.
    """
    by_stream: dict[int, list[list[Block]]] = {}
    for block in blocks:
        runs = by_stream.setdefault(block.stream, [[]])
        if runs[-1] and runs[-1][-1].t + len(runs[-1][-1]) != block.t:
            runs.append([])
        runs[-1].append(block)
    return [one_block(run) for runs in by_stream.values() for run in runs]
