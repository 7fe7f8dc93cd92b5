"""Columns that do not change within a block: all of them together cost what one column does.

Where every frame of a block shows the same x, the centred frames are a_t p with p = x - mean
and numbers a_t, so the vectors there stay combinations of what they were and of p: v becomes
L v + beta p. L, beta and the inner products v.p obey the rule that columns obey, and go through
the same passes as the columns that change; what stands still is read once and written once.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.arithmetic.compiled import compiled, reordered
from cdmisfa.core.blocks import PIXEL, UINT8
from cdmisfa.features.incsfa.cells import Cells
from cdmisfa.features.incsfa.state import Float, mean_rate
from cdmisfa.features.inner_products import ROWS
from cdmisfa.features.lanes import LANES, add, load, multiply_add, store, total, zeros

BATCH = 32
"""Cells that are settled together."""


class Still(NamedTuple):
    """Columns that stand still, and how the vectors there come from those before the block.

    Attributes:
        cells: where they are.
        p: (1, columns) their centred values.
        energy: (1,) |p|^2.
        table: (K, K + 2 and more) L, then beta, then the inner products v.p.
        r: (ROWS, as wide) the group's frames on the table's columns.
        a: (ROWS,) the group's frames are a p here.
        taken: (1,) share of p that the mean has taken in so far. Its sum is far more exact than
            the product of what each frame leaves.
    """

    cells: Cells
    p: Float
    energy: Float
    table: Float
    r: Float
    a: Float
    taken: Float


@compiled
def new_still(frames: NDArray[Any], mean: Float, v: Float, moving: Cells) -> Still:
    """What stands still in a block, where all cells but `moving` do.

    Args:
        frames: (n, I) values or pixels.
        mean: (I,) running mean before.
        v: (K, I) vectors before.
        moving: cells that change.
    """
    K, every = len(v), len(mean) // LANES
    count = every - len(moving)
    cells, p = np.empty(count, np.int64), np.empty((1, count * LANES))
    scale = PIXEL if frames.dtype == UINT8 else 1.0
    found = passed = 0
    for cell in range(every):
        if passed < len(moving) and moving[passed] == cell:
            passed += 1
            continue
        cells[found] = cell
        for i in range(LANES):
            at = cell * LANES + i
            p[0, found * LANES + i] = frames[0, at] * scale - mean[at]
        found += 1
    width = (K + 2 + LANES - 1) // LANES * LANES if count > 0 else 0
    still = Still(
        cells,
        p,
        np.zeros(1),
        np.zeros((K, width)),
        np.zeros((ROWS, width)),
        np.zeros(ROWS),
        np.zeros(1),
    )
    if count > 0:
        _begin(still, v)
    return still


@reordered
def _begin(still: Still, v: Float) -> None:
    """Set the table, and |p|^2, before the block's first frame.

    Args:
        still: energy and table are set.
        v: (K, I) vectors.
    """
    K, p = len(v), still.p
    a = zeros()
    for n in range(len(still.cells)):
        x = load(p, 0, n * LANES)
        a = multiply_add(a, x, x)
    still.energy[0] = total(a)
    for j in range(K):
        still.table[j, j] = 1.0
    for j in range(0, K - 3, 4):
        a, b, c, d = zeros(), zeros(), zeros(), zeros()
        for n in range(len(still.cells)):
            x, start = load(p, 0, n * LANES), still.cells[n] * LANES
            a = multiply_add(a, load(v, j, start), x)
            b = multiply_add(b, load(v, j + 1, start), x)
            c = multiply_add(c, load(v, j + 2, start), x)
            d = multiply_add(d, load(v, j + 3, start), x)
        for k, y in enumerate((total(a), total(b), total(c), total(d))):
            still.table[j + k, K + 1] = y
    for j in range(K - K % 4, K):
        a = zeros()
        for n in range(len(still.cells)):
            a = multiply_add(a, load(v, j, still.cells[n] * LANES), load(p, 0, n * LANES))
        still.table[j, K + 1] = total(a)


@compiled
def centre_still(still: Still, count: int, n: int, window: float) -> None:
    """Centre the next group where it stands still.

    Args:
        still: a and r are set, taken grows.
        count: frames of the group.
        n: number of frames seen before them.
        window: frames of the running mean.
    """
    K = len(still.table)
    still.r[:] = 0.0
    still.a[:] = 0.0
    for s in range(count):
        still.taken[0] += mean_rate(n + s + 1, window) * (1.0 - still.taken[0])
        a = 1.0 if n + s == 0 else 1.0 - still.taken[0]
        still.a[s] = a
        still.r[s, K], still.r[s, K + 1] = a, a * still.energy[0]


@compiled
def measure_still(still: Still, g: Float, e: Float) -> None:
    """Add the share of what stands still to the inner products of a group.

    Args:
        still: of the group.
        g: (ROWS, ROWS) of its frames with each other, in place.
        e: (K, ROWS) of the vectors with them, in place.
    """
    h = len(still.table) + 1
    for s in range(ROWS):
        for t in range(ROWS):
            g[s, t] += still.a[s] * still.a[t] * still.energy[0]
        for j in range(len(e)):
            e[j, s] += still.table[j, h] * still.a[s]


@reordered
def settle_still(still: Still, mean: Float, v: Float) -> None:
    """Bring mean and vectors to the end of the block where it stands still.

    Args:
        still: after the block.
        mean: (I,) in place.
        v: (K, I) in place.
    """
    K, table, cells = len(v), still.table, still.cells
    before = np.empty((K, BATCH * LANES))
    for first in range(0, len(cells), BATCH):
        few = min(BATCH, len(cells) - first)
        for j in range(K):
            for n in range(few):
                store(before, j, n * LANES, load(v, j, cells[first + n] * LANES))
        for j in range(0, K - 3, 4):
            for n in range(few):
                x, start = load(still.p, 0, (first + n) * LANES), cells[first + n] * LANES
                a, b = add(zeros(), table, j, K, x), add(zeros(), table, j + 1, K, x)
                c, d = add(zeros(), table, j + 2, K, x), add(zeros(), table, j + 3, K, x)
                for k in range(j + 4):
                    x = load(before, k, n * LANES)
                    a, b = add(a, table, j, k, x), add(b, table, j + 1, k, x)
                    c, d = add(c, table, j + 2, k, x), add(d, table, j + 3, k, x)
                store(v, j, start, a)
                store(v, j + 1, start, b)
                store(v, j + 2, start, c)
                store(v, j + 3, start, d)
        for j in range(K - K % 4, K):
            for n in range(few):
                a = add(zeros(), table, j, K, load(still.p, 0, (first + n) * LANES))
                for k in range(j + 1):
                    a = add(a, table, j, k, load(before, k, n * LANES))
                store(v, j, cells[first + n] * LANES, a)
    for n in range(len(cells)):
        for i in range(LANES):
            mean[cells[n] * LANES + i] += still.taken[0] * still.p[0, n * LANES + i]
