"""Cells of neighbouring columns: those that change within a block, and those that stand still."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.arithmetic.compiled import compiled
from cdmisfa.features.incsfa.state import Float, State
from cdmisfa.features.lanes import LANES, load, store

DENSE = 0.6
"""Share of changing cells above which all count as changing."""

WORTH = 4
"""Columns that stand still cost K^2 / 2 multiply-adds to write: too many where a block has fewer
than K / WORTH frames."""

Cells = NDArray[np.int64]
"""Indices of cells: LANES neighbouring columns each, the first with index 0."""


@compiled
def _some_change(changed: NDArray[np.bool_], cells: Cells) -> int:
    """Write the cells with a column that changed to the front of `cells`; return how many."""
    count = 0
    for c in range(len(cells)):
        some = False
        for i in range(c * LANES, (c + 1) * LANES):
            some |= changed[i]
        cells[count] = c
        count += some
    return count


@compiled
def changing_cells(frames: NDArray[Any], components: int) -> Cells:
    """Which cells change within a block, in order; all, where too few stand still.

    Columns beyond the last whole cell belong to none and count as changing.

    Args:
        frames: (n, I) values or pixels.
        components: K.
    """
    n, size = frames.shape
    every = np.arange(size // LANES)
    if n * WORTH < components:
        return every
    changed = np.zeros(len(every) * LANES, np.bool_)
    cells = np.empty_like(every)
    first, last = frames[0], frames[n - 1]
    for i in range(len(changed)):
        changed[i] = last[i] != first[i]
    if _some_change(changed, cells) > DENSE * len(every):  # most often that tells
        return every
    for t in range(1, n - 1):
        row = frames[t]
        for i in range(len(changed)):
            changed[i] |= row[i] != first[i]
    count = _some_change(changed, cells)
    return every if count > DENSE * len(every) else cells[:count]


class Columns(NamedTuple):
    """Columns that change within a block: of the abstraction itself, or copies.

    Attributes:
        cells: where they are; what is beyond the last whole cell follows them.
        mean: (1, columns) running mean.
        v: (K, columns) CCIPCA vectors.
    """

    cells: Cells
    mean: Float
    v: Float


@compiled
def all_columns(state: State) -> Columns:
    """The abstraction's own arrays, whatever changes in them."""
    size = len(state.mean)
    return Columns(np.arange(size // LANES), state.mean.reshape((1, size)), state.v)


@compiled
def moving_columns(state: State, cells: Cells) -> Columns:
    """The columns that change: the abstraction's own arrays where all do, else copies.

    Args:
        state: mean and vectors.
        cells: where they are.
    """
    K, size = state.v.shape
    if len(cells) == size // LANES:
        return all_columns(state)
    width = len(cells) * LANES + size % LANES
    few = Columns(cells, np.empty((1, width)), np.empty((K, width)))
    gather(state.mean.reshape((1, size)), cells, few.mean)
    gather(state.v, cells, few.v)
    return few


@compiled
def copy_columns(source: Float, first: int, target: Float, start: int, count: int) -> None:
    """Set target[:, start : start + count] to source[:, first : first + count].

    Assignments of slices would have their error messages compiled, which takes seconds.
    """
    for j in range(len(target)):
        for i in range(count):
            target[j, start + i] = source[j, first + i]


@compiled
def gather(rows: Float, cells: Cells, few: Float) -> None:
    """Copy the columns of some cells, and what is beyond the last cell.

    Args:
        rows: (n, I).
        cells: where.
        few: (n, columns) set.
    """
    for j in range(len(rows)):
        for c in range(len(cells)):
            store(few, j, c * LANES, load(rows, j, cells[c] * LANES))
    beyond = rows.shape[1] % LANES
    copy_columns(rows, rows.shape[1] - beyond, few, few.shape[1] - beyond, beyond)


@compiled
def scatter(few: Float, cells: Cells, rows: Float) -> None:
    """Copy columns to where they are from; see `gather`.

    Args:
        few: (n, columns).
        cells: where.
        rows: (n, I) set there.
    """
    for j in range(len(rows)):
        for c in range(len(cells)):
            store(rows, j, cells[c] * LANES, load(few, j, c * LANES))
    beyond = rows.shape[1] % LANES
    copy_columns(few, few.shape[1] - beyond, rows, rows.shape[1] - beyond, beyond)
