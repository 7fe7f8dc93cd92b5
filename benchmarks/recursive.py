"""The progress learner's recursive SFA against plain numpy, other libraries, and its products."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from benchmarks.kernels import image_frames
from benchmarks.report import interleaved, middle, ratio, save
from cdmisfa.agents.progress.config import ProgressConfig
from cdmisfa.core.arrays import FloatArray
from cdmisfa.features.recursive import RecursiveFeature

BLOCK = 40
"""Frames learned at once."""


class PlainNumpy:
    """The same recursion as one writes it: merge in the principal components, then whiten."""

    def __init__(self, size: int, components: int) -> None:
        self.components, self.seen = components, 0
        self.basis, self.variance = np.zeros((0, size)), np.zeros(0)
        self.differences, self.mean = np.zeros((0, 0)), np.zeros(size)
        self.last = np.zeros((0, size))

    def update(self, frames: FloatArray) -> FloatArray:
        """Learn from a block; the slow features, (components, I)."""
        m, seen = len(frames), self.seen
        centred, shift = frames - frames.mean(0), frames.mean(0) - self.mean
        weighted = np.concatenate(
            [
                np.sqrt(seen * self.variance)[:, None] * self.basis,
                centred,
                np.sqrt(seen * m / (seen + m)) * shift[None],
            ]
        )
        values, vectors = np.linalg.eigh(weighted @ weighted.T)
        kept = min(2 * self.components, int((values > 1e-10 * values[-1]).sum()))
        values, vectors = values[::-1][:kept], vectors[:, ::-1][:, :kept]
        basis = (vectors / np.sqrt(values)).T @ weighted
        turn = basis @ self.basis.T
        steps = basis @ np.diff(np.concatenate([self.last, frames]), axis=0).T
        total = seen * (turn @ self.differences @ turn.T) + steps @ steps.T
        self.basis, self.variance = basis, values / (seen + m)
        self.differences, self.mean = total / (seen + m), self.mean + m / (seen + m) * shift
        self.seen, self.last = seen + m, frames[-1:]
        scale = 1 / np.sqrt(self.variance[: self.components])
        white = scale[:, None] * self.differences[: len(scale), : len(scale)] * scale
        slow = np.linalg.eigh(white)[1].T * scale
        return np.asarray(slow @ basis[: len(scale)])


def products(size: int, components: int, frames: FloatArray) -> Callable[[], int]:
    """A call of the matrix products alone that a block cannot do without."""
    basis = np.ones((2 * components, size))
    weights = np.ones((2 * components, 2 * components + BLOCK))

    def call() -> int:
        block = frames[:BLOCK]
        _ = basis @ block.T, block @ block.T
        _ = weights[:, : 2 * components] @ basis + weights[:, 2 * components :] @ block
        return 1

    return call


def blocks(update: Callable[[FloatArray], Any], frames: FloatArray) -> Callable[[], int]:
    """A call that learns a few blocks."""

    def call() -> int:
        for start in range(0, len(frames) - BLOCK + 1, BLOCK):
            update(frames[start : start + BLOCK])
        return len(frames) // BLOCK

    return call


def candidates(frames: FloatArray, components: int) -> dict[str, Callable[[], int]]:
    """What is compared, as far as it is installed and can hold so many inputs."""
    from sklearn.decomposition import IncrementalPCA

    size = frames.shape[1]
    pca = IncrementalPCA(n_components=2 * components)
    found = {
        "recursive SFA": blocks(RecursiveFeature(size, components).update, frames),
        "plain numpy": blocks(PlainNumpy(size, components).update, frames),
        "IncrementalPCA": blocks(pca.partial_fit, frames),
        "its products alone": products(size, components, frames),
    }
    if size <= 1000:  # it keeps two matrices of inputs by inputs
        try:
            from deeptime.decomposition import TICA
        except ImportError:
            return found
        tica = TICA(lagtime=1)
        found["TICA"] = blocks(lambda x: tica.partial_fit((x[:-1], x[1:])), frames)
    return found


def main(*, quick: bool = False, full: bool = False) -> None:
    """Measure, and write results/recursive.json."""
    components = ProgressConfig().components
    images = image_frames(80 if quick else 240)
    others = ("plain numpy", "IncrementalPCA", "TICA", "its products alone")
    rows = []
    with threadpool_limits(1):
        for size in (256, images.shape[1]):
            frames = np.ascontiguousarray(images[:, :size])
            frames.flags.writeable = False
            times = interleaved(candidates(frames, components), 2 if quick else 7)
            ours = times["recursive SFA"]
            faster = [f"{ratio(times[o], ours):.2f}x" if o in times else "" for o in others]
            rows.append([size, components, middle(ours), *faster])
    save(
        "recursive",
        "Recursive SFA",
        f"What the progress learner learns a block of {BLOCK} frames with. CPU time of one thread, "
        "medians of interleaved rounds. IncrementalPCA of scikit-learn keeps as many components "
        "and finds no slow features; TICA of deeptime updates its covariances only, without "
        "solving for anything, and is left out where these would be of thousands of inputs, or "
        "where it is not installed. Its products alone: in numpy's BLAS.",
        [(["inputs", "K", "us a block", *(f"vs {o}" for o in others)], rows)],
    )
