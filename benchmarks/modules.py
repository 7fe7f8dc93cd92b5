"""How the cost of an iteration grows with the modules, and what of it is the digest."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from benchmarks.report import SAMPLE, interleaved, middle, ratio, save
from cdmisfa.agents.learner import CuriousLearner
from cdmisfa.core.config import LearnerConfig
from cdmisfa.core.signals import BlockSignals, canonical_bytes
from cdmisfa.features.outputs import project
from cdmisfa.modules import Module
from replay.logs.source import LoggedSource
from replay.open_sources import open_recording

MODULES = (0, 1, 10, 100)
CONFIG = LearnerConfig(components=32, outputs=5, nu=0.005, tau=40, expansion="none")
BLOCKS = 8


def learner_of(count: int, source: LoggedSource) -> CuriousLearner:
    """A learner with so many modules, that know nothing."""
    learner = CuriousLearner(CONFIG, source.spec, 0)
    rng = np.random.default_rng(5)
    J, size = learner.phi.shape
    modules = tuple(
        Module(
            index=k + 1,
            stream=source.spec.streams[0],
            stream_index=0,
            iteration=k,
            phi=rng.standard_normal((J, size)),
            mean=rng.random(size),
            band_mean=np.zeros(J),
            band_sd=np.zeros(J),
            eta=np.zeros(J),
            policy=np.zeros(len(source.spec.streams), np.int64),
        )
        for k in range(count)
    )
    learner.restore(dataclasses.replace(learner.state, modules=modules))
    return learner


def stepping(learner: CuriousLearner, source: LoggedSource) -> Callable[[], int]:
    """A call of some iterations, reading included."""

    def call() -> int:
        for _ in range(BLOCKS):
            learner.step(source.take(learner.stream, learner.tau))
        return BLOCKS

    return call


def digesting(signals: BlockSignals) -> Callable[[], int]:
    """A call that makes a record's canonical bytes some times."""

    def call() -> int:
        for _ in range(BLOCKS):
            canonical_bytes(signals)
        return BLOCKS

    return call


def projecting(
    function: Callable[..., NDArray[np.float64]],
    phi: NDArray[np.float64],
    frames: NDArray[np.uint8],
) -> Callable[[], int]:
    """A call that projects a block on rows."""
    offset = np.zeros(len(phi))

    def call() -> int:
        function(phi, offset, frames)
        return 1

    return call


def matrix_product(
    phi: NDArray[np.float64], offset: NDArray[np.float64], frames: NDArray[np.uint8]
) -> NDArray[np.float64]:
    """`project` by numpy's BLAS."""
    return np.asarray((frames * (1 / 255)) @ phi.T - offset)


def main(*, quick: bool = False) -> None:
    """Measure, and write results/modules.json."""
    source = open_recording(SAMPLE, loop=True)
    counts = MODULES[:3] if quick else MODULES
    work: dict[str, Callable[[], int]] = {}
    for count in counts:
        learner = learner_of(count, source)
        block = source.take(learner.stream, learner.tau)
        phi, frames = learner.frozen.phi, block.frames.reshape(learner.tau, -1)
        work[f"step {count}"] = stepping(learner, source)
        work[f"digest {count}"] = digesting(learner_of(count, source).step(block))
        work[f"project {count}"] = projecting(project, phi, frames)
        work[f"product {count}"] = projecting(matrix_product, phi, frames)
    with threadpool_limits(1):
        times = interleaved(work, 2 if quick else 9)
    rows = []
    for count in counts:
        step, digest = times[f"step {count}"], times[f"digest {count}"]
        ours, product = times[f"project {count}"], times[f"product {count}"]
        share = f"{ratio(product, ours):.2f}x" if count else ""
        projected = middle(ours) if count else ""
        more = f"{ratio(step, times['step 0']):.2f}x"
        rows.append([count, middle(step), more, projected, share, middle(digest, 1)])
    head = ["modules", "µs an iteration", "relative", "µs to project", "vs matrix product"]
    save(
        "modules",
        "Learning with many modules",
        "CPU time of an iteration (40 frames of the sample log, K = 32, J = 5, one thread) "
        "of a learner that has saved modules: each block is projected on all of them. Also: "
        "the projection alone, against a matrix product of numpy, and the digest of the "
        "signals.",
        [([*head, "µs for the digest"], rows)],
    )
