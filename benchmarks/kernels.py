"""IncSFA kernels against plain numba, plain numpy, scikit-learn and the machine's limits."""

from __future__ import annotations

import statistics
import types
from collections.abc import Callable
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from benchmarks.report import interleaved, ratio, save
from cdmisfa.config import LearnerConfig
from cdmisfa.expansion import quadratic
from cdmisfa.incsfa import gram, new_state, parameters, strict
from cdmisfa.streams import one_period

PIXELS = 6144
CASES = [(7, 1, 40), *((k, 5, t) for k in (16, 32, 64) for t in (10, 40, 100)), (32, 1, 40)]
"""(K, J, tau) for images."""

Update = Callable[..., None]


def plain_numba() -> Update:
    """The strict kernel compiled with fastmath: the rule frame by frame, vectorised."""
    names = ("centre", "ccipca_step", "whiten", "slow_features", "update")
    scope = dict(vars(strict))
    for name in names:
        source = vars(strict)[name].py_func
        scope[name] = numba.njit(fastmath=True)(types.FunctionType(source.__code__, scope, name))
    kernel: Update = scope["update"]
    return kernel


def plain_numpy(state: Any, params: Any, frames: NDArray[Any], gap: bool, xi: Any) -> None:
    """The rule frame by frame in numpy, as one writes it from the equations."""
    for t, x in enumerate(frames):
        state.counts[0] += 1
        n = int(state.counts[0])
        state.mean[:] += max(2 / (params.mean_window + 1), 1 / n) * (x - state.mean)
        u = x if n == 1 else x - state.mean
        k = n + 1
        amnesia = 0 if k < 20 else 3 * (k - 20) / 180 if k < 200 else 3 + (k - 200) / 2000
        weight = (1 + amnesia) / k
        r = u.copy()
        for j, v in enumerate(state.v):
            v *= 1 - weight
            v += weight * (r @ v) / (1 - weight) / state.d[j] * r
            square = v @ v
            r -= (r @ v) / square * v
            state.d[j] = np.sqrt(square)
        scale = state.d**-1.5
        z = (state.v @ u) * scale
        z_dot = z - state.z_prev
        state.z_prev[:] = z
        if n == 1 or (gap and t == 0):
            continue
        for j, w in enumerate(state.w):
            step = z_dot * (z_dot @ w)
            for p in state.w[:j]:
                step += 0.24 / params.nu * p * (p @ w)
            rate = params.nu / (1 + 1.2 * j)
            w *= 1.5 - rate
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


@numba.njit(cache=True, fastmath={"contract", "reassoc"})
def _multiply_add(a: NDArray[np.float64], times: int) -> None:
    x = a.copy()
    for _ in range(times):
        for i in range(128):
            y = a[i]
            for _ in range(8):
                y = y * 0.999 + 0.001
            x[i] += y
    a[:128] = x[:128]


def machine_limits(rounds: int) -> dict[str, float]:
    """What one core of this machine can do, in GB/s and GFMA/s."""
    source, target = np.ones(1 << 23), np.ones(1 << 23)
    vectors = np.ones(32 * PIXELS)
    small = np.ones(128)

    def copy() -> int:
        np.copyto(target, source)
        return 2 * source.nbytes

    def modify() -> int:
        _modify(vectors, 8)
        return 8 * 2 * vectors.nbytes

    def multiply_add() -> int:
        _multiply_add(small, 2000)
        return 2000 * 128 * 8

    work = {"memcpy GB/s": copy, "read-modify-write of 32 vectors GB/s": modify}
    times = interleaved({**work, "FMA GFMA/s": multiply_add}, rounds)
    return {name: 0.001 / statistics.median(t) for name, t in times.items()}


def measure_images(rounds: int) -> list[dict[str, Any]]:
    """Microseconds per frame and ratios for every case with images."""
    frames = image_frames(240)
    plain = plain_numba()
    results = []
    for components, outputs, tau in CASES:
        config = LearnerConfig(components=components, outputs=outputs, nu=0.01, tau=tau)
        work = {
            "gram": learning(gram.update, config, frames, 80),
            "plain numba": learning(plain, config, frames, 20),
            "strict": learning(strict.update, config, frames, 10),
            "plain numpy": learning(plain_numpy, config, frames, 10),
        }
        if tau >= components:
            work["IncrementalPCA"] = incremental_pca(config, frames)
        times = interleaved(work, rounds)
        results.append(_result(times, "gram", K=components, J=outputs, tau=tau, inputs=PIXELS))
    return results


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


def _result(times: dict[str, list[float]], ours: str, **case: int) -> dict[str, Any]:
    micros = {name: round(statistics.median(t), 3) for name, t in times.items()}
    ratios = {name: round(ratio(t, times[ours]), 2) for name, t in times.items() if name != ours}
    return {**case, "ours": ours, "us_per_frame": micros, "times_faster_than": ratios}


def main(*, quick: bool = False, full: bool = False) -> None:
    """Measure, and write results/kernels.json."""
    rounds = 3 if quick else 7
    with threadpool_limits(1):
        _measure(rounds)


def _measure(rounds: int) -> None:
    limits = {name: round(x, 1) for name, x in machine_limits(rounds).items()}
    cases = [*measure_vectors(rounds), *measure_images(rounds)]
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
        "whitening only. The last table is what one core of this machine can do.",
        [(header, rows), (["limit", "value"], list(limits.items()))],
        limits=limits,
        cases=cases,
    )
