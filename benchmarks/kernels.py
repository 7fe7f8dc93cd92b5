"""IncSFA kernels against plain numba, plain numpy, scikit-learn and the machine's limits."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Sequence
from typing import Any

import numba
import numpy as np
from cdmisfa.features.incsfa.state import Params, State, new_state, parameters
from cdmisfa.features.lanes import LANES, load, multiply_add, plus, store
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from benchmarks.report import SAMPLE, interleaved, middle, ratio, save
from cdmisfa.core.config import LearnerConfig
from cdmisfa.core.expansion import quadratic
from cdmisfa.features.incsfa import gram, strict
from recorder.world.oscillatory import one_period
from replay.recordings.source import RecordedSource

PIXELS = 6144
CASES = [(7, 1, 40), *((k, 5, t) for k in (16, 32, 64) for t in (10, 40, 100)), (32, 1, 40)]
"""(K, J, tau) for images."""

Update = Callable[..., None]


@numba.njit(cache=True, fastmath=True)
def plain_numba(
    state: State, params: Params, frames: NDArray[Any], gap: bool, xi: NDArray[np.float64]
) -> None:
    """The rule frame by frame in loops, as one writes it from the equations; vectorised."""
    K, size = state.v.shape
    mean, v, d, w, phi = state.mean, state.v, state.d, state.w, state.phi
    u, r, row = np.empty(size), np.empty(size), np.empty(size)
    z_dot, step = np.empty(K), np.empty(K)
    for t in range(len(frames)):
        state.counts[0] += 1
        n = state.counts[0]
        rate = max(2.0 / (params.mean_window + 1.0), 1.0 / n)
        for i in range(size):
            mean[i] += rate * (frames[t, i] - mean[i])
            u[i] = frames[t, i] - (mean[i] if n > 1 else 0.0)
            r[i] = u[i]
        k = n + 1
        amnesia = 0.0 if k < 20 else 3 * (k - 20) / 180 if k < 200 else 3 + (k - 200) / 2000
        weight = (1.0 + amnesia) / k
        for j in range(K):
            projection = 0.0
            for i in range(size):
                projection += r[i] * v[j, i]
            gain = weight / d[j] * projection
            square = projection = 0.0
            for i in range(size):
                v[j, i] = (1.0 - weight) * v[j, i] + gain * r[i]
                square += v[j, i] * v[j, i]
                projection += r[i] * v[j, i]
            d[j] = np.sqrt(square)
            for i in range(size):
                r[i] -= projection / square * v[j, i]
        for j in range(K):
            projection = 0.0
            for i in range(size):
                projection += u[i] * v[j, i]
            z = projection * d[j] ** -1.5
            z_dot[j] = z - state.z_prev[j]
            state.z_prev[j] = z
        if n == 1 or (gap and t == 0):
            continue
        square = 0.0
        for j in range(len(w)):
            along = (z_dot * w[j]).sum()
            step[:] = z_dot * along
            for p in range(j):
                step += 0.24 / params.nu * (w[p] * w[j]).sum() * w[p]
            rate = params.nu / (1.0 + 1.2 * j)
            w[j] = (1.5 - rate) * w[j] - rate * step
            w[j] /= np.sqrt((w[j] * w[j]).sum())
            row[:] = 0.0
            for q in range(K):
                factor = w[j, q] * d[q] ** -1.5
                for i in range(size):
                    row[i] += factor * v[q, i]
            for i in range(size):
                square += (row[i] - phi[j, i]) ** 2
                phi[j, i] = row[i]
        xi[t] = np.sqrt(square)


def plain_numpy(state: Any, params: Any, frames: NDArray[Any], gap: bool, xi: Any) -> None:
    """The rule frame by frame in numpy, as one writes it from the equations; in any float type."""
    real = state.mean.dtype.type
    window, nu = real(params.mean_window), real(params.nu)
    for t, x in enumerate(frames):
        state.counts[0] += 1
        n = int(state.counts[0])
        state.mean[:] += max(2 / (window + 1), 1 / real(n)) * (x - state.mean)
        u = x - state.mean if n > 1 else x.astype(real)
        k = real(n + 1)
        amnesia = 0 if k < 20 else 3 * (k - 20) / 180 if k < 200 else 3 + (k - 200) / 2000
        weight = (1 + amnesia) / k
        r = u.copy()
        for j, v in enumerate(state.v):
            gain = weight * (r @ v) / state.d[j]
            v *= 1 - weight
            v += gain * r
            square = v @ v
            r -= (r @ v) / square * v
            state.d[j] = np.sqrt(square)
        scale = state.d ** real(-1.5)
        z = (state.v @ u) * scale
        z_dot = z - state.z_prev
        state.z_prev[:] = z
        if n == 1 or (gap and t == 0):
            continue
        for j, w in enumerate(state.w):
            step = z_dot * (z_dot @ w)
            for p in state.w[:j]:
                step += real(24) / 100 / nu * p * (p @ w)
            rate = nu / (1 + real(12) / 10 * j)
            w *= real(3) / 2 - rate
            w -= rate * step
            w /= np.sqrt(w @ w)
        phi = (state.w * scale) @ state.v
        xi[t] = np.sqrt(((phi - state.phi) ** 2).sum())
        state.phi[:] = phi


def learning(
    kernel: Update, config: LearnerConfig, frames: NDArray[Any], n: int
) -> Callable[[], int]:
    """A call that learns n more frames, in blocks of tau."""
    state = new_state(np.random.default_rng(1), frames.shape[1], config)
    params, tau, xi = parameters(config), config.tau, np.empty(config.tau)
    position = 0

    def call() -> int:
        nonlocal position
        blocks = max(n // tau, 1)
        for _ in range(blocks):
            start = position % (len(frames) - tau + 1)
            kernel(state, params, frames[start : start + tau], False, xi)
            position += tau
        return blocks * tau

    return call


def learning_blocks(
    config: LearnerConfig, blocks: Sequence[NDArray[np.uint8]]
) -> Callable[[], int]:
    """A call of the Gram kernel that learns these blocks of tau frames."""
    state = new_state(np.random.default_rng(1), blocks[0].shape[1], config)
    params, xi = parameters(config), np.empty(config.tau)

    def call() -> int:
        for block in blocks:
            gram.update(state, params, block, False, xi)
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
    frames.flags.writeable = False
    return frames


@numba.njit(cache=True, fastmath=True)
def _modify(a: NDArray[np.float64], times: int) -> None:
    for _ in range(times):
        for i in range(a.shape[0]):
            a[i] = a[i] * 0.999 + 0.001


@numba.njit(cache=True, fastmath={"contract"})
def _multiply_add(a: NDArray[np.float64], times: int) -> None:
    """Twelve chains side by side, as each waits for itself, of the widest vectors there are."""
    y, z = load(a, 12, 0), load(a, 13, 0)
    c0, c1, c2 = load(a, 0, 0), load(a, 1, 0), load(a, 2, 0)
    c3, c4, c5 = load(a, 3, 0), load(a, 4, 0), load(a, 5, 0)
    c6, c7, c8 = load(a, 6, 0), load(a, 7, 0), load(a, 8, 0)
    c9, c10, c11 = load(a, 9, 0), load(a, 10, 0), load(a, 11, 0)
    for _ in range(times):
        c0, c1, c2 = multiply_add(z, c0, y), multiply_add(z, c1, y), multiply_add(z, c2, y)
        c3, c4, c5 = multiply_add(z, c3, y), multiply_add(z, c4, y), multiply_add(z, c5, y)
        c6, c7, c8 = multiply_add(z, c6, y), multiply_add(z, c7, y), multiply_add(z, c8, y)
        c9, c10, c11 = multiply_add(z, c9, y), multiply_add(z, c10, y), multiply_add(z, c11, y)
    store(a, 0, 0, plus(plus(plus(c0, c1), plus(c2, c3)), plus(plus(c4, c5), plus(c6, c7))))
    store(a, 1, 0, plus(plus(c8, c9), plus(c10, c11)))


def machine_limits(rounds: int) -> dict[str, float]:
    """What one core of this machine can do, in GB/s and GFMA/s."""
    source, target = np.ones(1 << 23), np.ones(1 << 23)
    vectors = np.ones(32 * PIXELS)
    small = np.full((14, LANES), 0.5)

    def copy() -> int:
        np.copyto(target, source)
        return 2 * source.nbytes

    def modify() -> int:
        _modify(vectors, 8)
        return 8 * 2 * vectors.nbytes

    def multiply_add() -> int:
        _multiply_add(small, 20_000)
        return 20_000 * 12 * LANES

    work = {"memcpy GB/s": copy, "read-modify-write of 32 vectors GB/s": modify}
    times = interleaved({**work, "FMA GFMA/s": multiply_add}, rounds)
    return {name: 0.001 / statistics.median(t) for name, t in times.items()}


def measure_images(rounds: int) -> list[dict[str, Any]]:
    """Microseconds per frame and ratios for every case with images."""
    frames = image_frames(240)
    results = []
    for components, outputs, tau in CASES:
        config = LearnerConfig(components=components, outputs=outputs, nu=0.01, tau=tau)
        work = {
            "gram": learning(gram.update, config, frames, 80),
            "plain numba": learning(plain_numba, config, frames, 20),
            "strict": learning(strict.update, config, frames, 10),
            "plain numpy": learning(plain_numpy, config, frames, 10),
        }
        if tau >= components:
            work["IncrementalPCA"] = incremental_pca(config, frames)
        times = interleaved(work, rounds)
        results.append(_result(times, "gram", K=components, J=outputs, tau=tau, inputs=PIXELS))
    return results


def measure_still(rounds: int) -> list[list[Any]]:
    """Rows of the Gram kernel: the sample log, and its frames with noise in every pixel."""
    source = RecordedSource(SAMPLE, loop=True)
    views = range(len(source.spec.streams))
    shown = [source.take(stream, 40).frames.reshape(40, PIXELS) for stream in (*views, *views)]
    rng = np.random.default_rng(3)
    noisy = [np.clip(b + rng.integers(-2, 3, b.shape), 0, 255).astype(np.uint8) for b in shown]
    for block in noisy:
        block.flags.writeable = False
    rows = []
    for components, outputs in ((8, 1), (16, 5), (32, 5), (64, 5)):
        config = LearnerConfig(components=components, outputs=outputs, nu=0.01, tau=40)
        work = {
            "still": learning_blocks(config, shown),
            "noise": learning_blocks(config, noisy),
        }
        times = interleaved(work, 3 * rounds)
        gain = f"{ratio(times['noise'], times['still']):.2f}x"
        still, all_of_it = middle(times["still"], 3), middle(times["noise"], 3)
        rows.append([components, outputs, still, all_of_it, gain])
    return rows


def contradictions(limits: dict[str, float], cases: list[dict[str, Any]]) -> list[str]:
    """Kernels that would do more multiply-adds a second than the machine can."""
    found = []
    for case in cases:
        taken = case["us_per_frame"][case["ours"]]
        rate = 3 * case["K"] * case["inputs"] / taken / 1000
        if rate > limits["FMA GFMA/s"]:
            found.append(f"{rate:.1f} GFMA/s at K = {case['K']}, {case['inputs']} inputs")
    return found


def measure_vectors(rounds: int) -> list[dict[str, Any]]:
    """Microseconds per frame and ratios for the oscillatory streams."""
    frames = quadratic(np.tile(one_period("x1"), (4, 1)))
    frames.flags.writeable = False
    results = []
    for outputs in (1, 5):
        config = LearnerConfig(outputs=outputs)
        work = {
            "strict": learning(strict.update, config, frames, 20_000),
            "plain numpy": learning(plain_numpy, config, frames, 200),
            "IncrementalPCA": incremental_pca(config, frames),
        }
        times = interleaved(work, rounds)
        results.append(_result(times, "strict", K=5, J=outputs, tau=config.tau, inputs=5))
    return results


def measure_errors(n: int) -> list[list[Any]]:
    """Errors against long double over n frames: two direct orders, and the Gram kernel.

    600 inputs, K = 16, J = 3, tau = 40. Of each: the worst error of phi over its largest weight,
    the worst of a vector over its largest, and the largest difference between the carried Gram
    matrix and that of the vectors, over their lengths.
    """
    size = 600
    config = LearnerConfig(components=16, outputs=3, nu=0.01, tau=40)
    rng = np.random.default_rng(2)
    mixing = rng.standard_normal((40, size)) / 40
    params, noted = parameters(config), {4_000, n // 10, n}
    first = new_state(np.random.default_rng(1), size, config)
    wide: list[Any] = [a.astype(np.longdouble) if a.dtype.kind == "f" else a for a in first]
    reference = State(*wide)
    runs: dict[str, tuple[Update, int, State]] = {
        name: (kernel, way, new_state(np.random.default_rng(1), size, config))
        for name, kernel, way in (
            ("direct, first to last", strict.update, 1),
            ("direct, last to first", strict.update, -1),
            ("gram", gram.update, 1),
        )
    }
    runs["direct, last to first"][2].v[:] = first.v[:, ::-1]
    xi, rows = np.empty(config.tau), []
    for start in range(0, n, config.tau):
        speed = np.linspace(0.02, 1.3, 40)
        phase = np.arange(start, start + config.tau)[:, None] * speed
        frames = 0.5 + np.sin(phase) @ mixing + 0.02 * rng.standard_normal((config.tau, size))
        plain_numpy(reference, params, frames, False, np.empty(config.tau, np.longdouble))
        for kernel, way, state in runs.values():
            shown = np.ascontiguousarray(frames[:, ::way])
            shown.flags.writeable = False
            kernel(state, params, shown, False, xi)
        if start + config.tau in noted:
            for name, (_, way, state) in runs.items():
                drift = np.abs((state.gram - state.v @ state.v.T) / np.outer(state.d, state.d))
                rows.append(
                    [start + config.tau, name]
                    + [
                        f"{float((np.abs(a[:, ::way] - b).max(1) / np.abs(b).max(1)).max()):.1e}"
                        for a, b in ((state.phi, reference.phi), (state.v, reference.v))
                    ]
                    + [f"{float(drift.max()):.1e}" if name == "gram" else ""]
                )
    return rows


def _result(times: dict[str, list[float]], ours: str, **case: int) -> dict[str, Any]:
    micros = {name: middle(t, 3) for name, t in times.items()}
    ratios = {name: round(ratio(t, times[ours]), 2) for name, t in times.items() if name != ours}
    return {**case, "ours": ours, "us_per_frame": micros, "times_faster_than": ratios}


def main(*, quick: bool = False, full: bool = False) -> None:
    """Measure, and write results/kernels.json."""
    rounds = 3 if quick else 7
    with threadpool_limits(1):
        errors = measure_errors(100_000 if full else 4_000 if quick else 10_000)
        limits = {name: round(x, 1) for name, x in machine_limits(rounds).items()}
        cases = [*measure_vectors(rounds), *measure_images(rounds)]
        still = measure_still(rounds)
    others = ("plain numba", "strict", "plain numpy", "IncrementalPCA")
    rows = [
        [c["inputs"], c["K"], c["J"], c["tau"], c["ours"], c["us_per_frame"][c["ours"]]]
        + [f"{c['times_faster_than'][o]}x" if o in c["times_faster_than"] else "" for o in others]
        for c in cases
    ]
    header = ["inputs", "K", "J", "tau", "kernel", "us a frame", *(f"vs {o}" for o in others)]
    save(
        "kernels",
        "IncSFA kernels",
        "CPU time of one thread, medians of interleaved rounds. IncrementalPCA does the "
        "whitening only; of the images of the first table every pixel changes. The second table "
        "is of the sample log, where most stand still within a block, against its frames with "
        "noise (6144 inputs, tau = 40); the third what one core of this machine can do, with the "
        "widest vectors it has, the fourth the errors against a run in long double "
        "(600 inputs, K = 16, J = 3, tau = 40).",
        [
            (header, rows),
            (["K", "J", "us a frame", "with noise", "gain"], still),
            (["limit", "value"], list(limits.items())),
            (["frames", "order", "phi", "vectors", "carried Gram matrix"], errors),
        ],
        limits=limits,
        cases=cases,
        errors=errors,
        contradictions=contradictions(limits, cases),
    )
