"""Robust online clustering, which gates CD-MISFA 1.0 in place of slowness.

One node for each label (the stream's index) holds centres of what the abstraction gives out
there. Sources: node, winner and error: Luciw, Kompella, Kazerounian and Schmidhuber 2013;
clusters with counts: Guedalia, London and Werman 1999. What we read into them is decision 0014.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.arithmetic.compiled import compiled
from cdmisfa.core.arithmetic.elementary import exp

Float = NDArray[np.float64]

FORGOTTEN = 0.5
"""A centre whose count has decayed below this is empty again."""


@compiled
def nearest(centres: Float, counts: Float, y: Float) -> tuple[int, float]:
    """The centre nearest to a block's output, and its root mean square distance.

    Where a node has no centre yet the index is -1 and the distance is that to zero: the size
    of the output itself.

    Args:
        centres: (C, n, J) of one node.
        counts: (C,) how much each centre has seen; 0 is an empty place.
        y: (n, J) output on the block.
    """
    n, outputs = y.shape
    best = -1
    least = math.inf
    for c in range(len(counts)):
        if counts[c] > 0.0:
            square = 0.0
            for t in range(n):
                for j in range(outputs):
                    square += (y[t, j] - centres[c, t, j]) ** 2
            if square < least:
                best = c
                least = square
    if best < 0:
        least = 0.0
        for t in range(n):
            for j in range(outputs):
                least += y[t, j] ** 2
    return best, math.sqrt(least / (n * outputs))


@compiled
def cluster(
    centres: Float, counts: Float, label: int, y: Float, radius: float, memory: float
) -> float:
    """Take a block's output into the node of its label; return its distance from the winner.

    Every centre of every label decays; the winner moves by 1/count when it lies within the
    radius, else the block becomes a centre in place of the weakest one.

    Args:
        centres: (S, C, n, J), in place.
        counts: (S, C), in place.
        label: which node, from 0.
        y: (n, J) output on the block.
        radius: distance within which a centre is near.
        memory: blocks after which a count has decayed to 1/e.
    """
    keep = exp(-1.0 / memory)
    for s in range(counts.shape[0]):
        for c in range(counts.shape[1]):
            counts[s, c] *= keep
            if counts[s, c] < FORGOTTEN:
                counts[s, c] = 0.0
    winner, error = nearest(centres[label], counts[label], y)
    near = winner >= 0 and error <= radius
    place = winner if near else np.argmin(counts[label])
    counts[label, place] = counts[label, place] + 1.0 if near else 1.0
    n, outputs = y.shape
    for t in range(n):  # whole arrays would be tested for their shapes, in seconds of compiling
        for j in range(outputs):
            centre = centres[label, place, t, j]
            moved = centre + (y[t, j] - centre) / counts[label, place]
            centres[label, place, t, j] = moved if near else y[t, j]
    return error


@compiled
def known_to(
    centres: Float, counts: Float, label: int, y_frozen: Float, threshold: float, error: Float
) -> int:
    """First frozen module (from 1) whose error on a block is below the threshold, or 0.

    Args:
        centres: (M, S, C, n, J) of the frozen modules.
        counts: (M, S, C).
        label: the block's stream.
        y_frozen: (M, n, J) outputs of the frozen modules on the block.
        threshold: error below which an abstraction is saved and a block is known.
        error: (M,) written: error of each module, NaN where it has no centre under the label.
    """
    known_by = 0
    for m in range(len(counts)):
        winner, distance = nearest(centres[m, label], counts[m, label], y_frozen[m])
        error[m] = distance if winner >= 0 else math.nan
        if error[m] < threshold and known_by == 0:
            known_by = m + 1
    return known_by
