"""IncSFA kernels against plain numpy, scikit-learn and the machine's limits."""

from __future__ import annotations

import itertools
import statistics
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from benchmarks.report import SAMPLE, interleaved, middle, ratio, save
from cdmisfa import kernels
from cdmisfa.core.blocks import freeze
from cdmisfa.core.config import LearnerConfig
from cdmisfa.core.expansion import quadratic
from cdmisfa.features.incsfa import IncSFAState, new_state
from recorder.world.oscillatory import one_period
from replay.open_sources import open_recording
from tests.reference.incsfa import PlainIncSFA

PIXELS = 6144
CASES = [(7, 1, 40), *((k, 5, t) for k in (16, 32, 64) for t in (10, 40, 100)), (32, 1, 40)]
"""(K, J, tau) for images."""

FRAME, GRAM = "by_frame", "by_gram"
"""The two kernels, as `incsfa_update` names them."""

PRODUCT = "matrix product GFMA/s"


def learning(by: str, config: LearnerConfig, frames: NDArray[Any], n: int) -> Callable[[], int]:
    """A call of a kernel that learns n more frames, in blocks of tau."""
    state = new_state(np.random.default_rng(1), frames.shape[1], config)
    abstraction, tau = kernels.incsfa(state, config.nu, config.mean_window), config.tau
    starts = (t % (len(frames) - tau + 1) for t in itertools.count(0, tau))

    def call() -> int:
        for start in itertools.islice(starts, n // tau or 1):
            kernels.incsfa_update(abstraction, frames[start : start + tau], False, by)
        return (n // tau or 1) * tau

    return call


def plain_numpy(config: LearnerConfig, frames: NDArray[Any], n: int) -> Callable[[], int]:
    """A call that learns n more frames by the equations, in numpy."""
    state = new_state(np.random.default_rng(1), frames.shape[1], config)
    plain, endless = PlainIncSFA(state, config), itertools.cycle(frames)

    def call() -> int:
        for x in itertools.islice(endless, n):
            plain.learn(x)
        return n

    return call


def learning_blocks(
    config: LearnerConfig, blocks: Sequence[NDArray[np.uint8]]
) -> Callable[[], int]:
    """A call of the Gram kernel that learns these blocks of tau frames."""
    state = new_state(np.random.default_rng(1), blocks[0].shape[1], config)
    abstraction = kernels.incsfa(state, config.nu, config.mean_window)

    def call() -> int:
        for block in blocks:
            kernels.incsfa_update(abstraction, block, False, GRAM)
        return len(blocks) * config.tau

    return call


def incremental_pca(config: LearnerConfig, frames: NDArray[Any]) -> Callable[[], int]:
    """A call that gives one block to scikit-learn's IncrementalPCA: the whitening part only."""
    from sklearn.decomposition import IncrementalPCA

    pca = IncrementalPCA(n_components=config.components)

    def call() -> int:
        pca.partial_fit(frames[: config.tau])
        return config.tau

    return call


def image_frames(n: int) -> NDArray[np.float64]:
    """Images of 80 latents with noise around one half, (n, 6144)."""
    rng = np.random.default_rng(0)
    latents = rng.standard_normal((n, 80)) @ (rng.standard_normal((80, PIXELS)) / 80)
    frames = 0.5 + latents + 0.01 * rng.standard_normal((n, PIXELS))
    return freeze(frames)


def machine_limits(rounds: int) -> dict[str, float]:
    """What one core of this machine can do with numpy, in GB/s and GFMA/s."""
    source, target = np.ones(1 << 23), np.ones(1 << 23)
    vectors, matrix = np.ones(32 * PIXELS), np.full((512, 512), 0.5)

    def copy() -> int:
        np.copyto(target, source)
        return 2 * source.nbytes

    def modify() -> int:
        np.multiply(vectors, 0.999, out=vectors)
        return 2 * vectors.nbytes

    def multiply() -> int:
        np.matmul(matrix, matrix)
        return matrix.size * len(matrix)

    work = {"copy GB/s": copy, "multiplying 32 vectors in place GB/s": modify}
    times = interleaved({**work, PRODUCT: multiply}, rounds)
    return {name: 0.001 / statistics.median(t) for name, t in times.items()}


def measure_images(rounds: int) -> list[dict[str, Any]]:
    """Microseconds per frame and ratios for every case with images."""
    frames = image_frames(240)
    results = []
    for components, outputs, tau in CASES:
        config = LearnerConfig(components=components, outputs=outputs, nu=0.01, tau=tau)
        work = {
            "by Gram matrix": learning(GRAM, config, frames, 80),
            "by frame": learning(FRAME, config, frames, 10),
            "plain numpy": plain_numpy(config, frames, 10),
        }
        if tau >= components:
            work["IncrementalPCA"] = incremental_pca(config, frames)
        times = interleaved(work, rounds)
        results.append(
            _result(times, "by Gram matrix", K=components, J=outputs, tau=tau, inputs=PIXELS)
        )
    return results


def measure_still(rounds: int) -> list[list[Any]]:
    """Rows of the Gram kernel: the sample log, and its frames with noise in every pixel."""
    source = open_recording(SAMPLE, loop=True)
    views = range(len(source.spec.streams))
    blocks = [source.take(stream, 40).frames.reshape(40, PIXELS) for stream in (*views, *views)]
    rng = np.random.default_rng(3)
    noise = [rng.integers(-2, 3, b.shape) for b in blocks]
    noisy = [
        freeze(np.clip(b + n, 0, 255).astype(np.uint8)) for b, n in zip(blocks, noise, strict=True)
    ]
    rows = []
    for components, outputs in ((8, 1), (16, 5), (32, 5), (64, 5)):
        config = LearnerConfig(components=components, outputs=outputs, nu=0.01, tau=40)
        work = {"still": learning_blocks(config, blocks), "noise": learning_blocks(config, noisy)}
        times = interleaved(work, 3 * rounds)
        gain = f"{ratio(times['noise'], times['still']):.2f}x"
        still, all_of_it = middle(times["still"], 3), middle(times["noise"], 3)
        rows.append([components, outputs, still, all_of_it, gain])
    return rows


def measure_vectors(rounds: int) -> list[dict[str, Any]]:
    """Microseconds per frame and ratios for the oscillatory streams."""
    frames = freeze(quadratic(np.tile(one_period("x1"), (4, 1))))
    results = []
    for outputs in (1, 5):
        config = LearnerConfig(outputs=outputs)
        work = {
            "by frame": learning(FRAME, config, frames, 20_000),
            "plain numpy": plain_numpy(config, frames, 200),
            "IncrementalPCA": incremental_pca(config, frames),
        }
        times = interleaved(work, rounds)
        results.append(_result(times, "by frame", K=5, J=outputs, tau=config.tau, inputs=5))
    return results


def measure_errors(n: int) -> list[list[Any]]:
    """Errors against long double over n frames: frame by frame in two orders, and the Gram kernel.

    600 inputs, K = 16, J = 3, tau = 40. Of each: the worst error of phi over its largest weight,
    the worst of a vector over its largest, and the largest difference between the carried Gram
    matrix and that of the vectors, over their lengths.
    """
    size = 600
    config = LearnerConfig(components=16, outputs=3, nu=0.01, tau=40)
    rng = np.random.default_rng(2)
    mixing = rng.standard_normal((40, size)) / 40
    noted = {4_000, n // 10, n}
    first = new_state(np.random.default_rng(1), size, config)
    reference = PlainIncSFA(first, config, np.longdouble)
    runs: dict[str, tuple[str, int, IncSFAState]] = {
        name: (by, way, IncSFAState(*(array.copy() for array in first)))
        for name, by, way in (
            ("by frame, first to last", FRAME, 1),
            ("by frame, last to first", FRAME, -1),
            ("by Gram matrix", GRAM, 1),
        )
    }
    runs["by frame, last to first"][2].v[:] = first.v[:, ::-1]
    abstractions = {
        name: kernels.incsfa(state, config.nu, config.mean_window)
        for name, (_, _, state) in runs.items()
    }
    rows = []
    for start in range(0, n, config.tau):
        speed = np.linspace(0.02, 1.3, 40)
        phase = np.arange(start, start + config.tau)[:, None] * speed
        frames = 0.5 + np.sin(phase) @ mixing + 0.02 * rng.standard_normal((config.tau, size))
        for x in frames:
            reference.learn(x)
        for name, (by, way, _) in runs.items():
            part = freeze(np.ascontiguousarray(frames[:, ::way]))
            kernels.incsfa_update(abstractions[name], part, False, by)
        if start + config.tau in noted:
            for name, (by, way, state) in runs.items():
                drift = np.abs((state.gram - state.v @ state.v.T) / np.outer(state.d, state.d))
                rows.append(
                    [start + config.tau, name]
                    + [
                        f"{float((np.abs(a[:, ::way] - b).max(1) / np.abs(b).max(1)).max()):.1e}"
                        for a, b in ((state.phi, reference.phi), (state.v, reference.v))
                    ]
                    + [f"{float(drift.max()):.1e}" if by == GRAM else ""]
                )
    return rows


def _result(times: dict[str, list[float]], ours: str, **case: int) -> dict[str, Any]:
    micros = {name: middle(t, 3) for name, t in times.items()}
    ratios = {name: round(ratio(t, times[ours]), 2) for name, t in times.items() if name != ours}
    return {**case, "ours": ours, "us_per_frame": micros, "times_faster_than": ratios}


def main(*, quick: bool = False) -> None:
    """Measure, and write results/kernels.json."""
    rounds = 3 if quick else 7
    with threadpool_limits(1):
        errors = measure_errors(4_000 if quick else 10_000)
        limits = {name: round(x, 1) for name, x in machine_limits(rounds).items()}
        cases = [*measure_vectors(rounds), *measure_images(rounds)]
        still = measure_still(rounds)
    competitors = ("plain numpy", "by frame", "IncrementalPCA")
    rows = [
        [c["inputs"], c["K"], c["J"], c["tau"], c["ours"], c["us_per_frame"][c["ours"]]]
        + [
            f"{c['times_faster_than'][o]}x" if o in c["times_faster_than"] else ""
            for o in competitors
        ]
        for c in cases
    ]
    header = ["inputs", "K", "J", "tau", "kernel", "µs a frame", *(f"vs {o}" for o in competitors)]
    save(
        "kernels",
        "IncSFA kernels",
        "CPU time of one thread, medians of interleaved rounds. IncrementalPCA does only the "
        "whitening. First table: images in which every pixel changes. Second: the sample "
        "log, where most pixels are constant within a block, against its frames with noise "
        "(6144 inputs, tau = 40). Third: limits of numpy on one core of this machine. "
        "Fourth: errors against long double (600 inputs, K = 16, J = 3, tau = 40).",
        [
            (header, rows),
            (["K", "J", "µs a frame", "with noise", "gain"], still),
            (["limit", "value"], list(limits.items())),
            (["frames", "order", "phi", "vectors", "carried Gram matrix"], errors),
        ],
    )
