"""`RecursiveSFA` and `IncSFA` against others that learn from batches: time, memory, slowness."""

from __future__ import annotations

import contextlib
import gc
import tracemalloc
from collections.abc import Callable
from typing import Any

import numpy as np
from sklearn.decomposition import IncrementalPCA
from threadpoolctl import threadpool_limits

from benchmarks.report import interleaved, middle, ratio, save
from cdmisfa import IncSFA, RecursiveSFA
from cdmisfa.core.arrays import FloatArray

FEATURES, WHITENED, BATCH = 5, 20, 1000
CASES = ((20_000, 20), (20_000, 300), (2000, 2000))
"""Samples, and values of each."""

LARGEST = 300
"""Most values for methods that process all of them sample by sample, or copy X often."""


def samples(n: int, size: int) -> FloatArray:
    """Return mixed sines of 0.002 to 0.4 cycles a sample, with noise, (n, size)."""
    rng = np.random.default_rng(0)
    turns = np.outer(np.arange(n), np.geomspace(0.002, 0.4, size)) + rng.random(size)
    mixed = np.sin(2 * np.pi * turns) @ (rng.standard_normal((size, size)) / np.sqrt(size))
    return mixed + 0.1 * rng.standard_normal(mixed.shape)


def candidates(X: FloatArray) -> dict[str, Callable[[], Any]]:
    """Return the installed estimators by name; each call fits a new one."""
    size = X.shape[1]

    def by_batches(model: Any, learn: Callable[[Any, FloatArray], Any]) -> Any:
        for start in range(0, len(X), BATCH):
            learn(model, X[start : start + BATCH])
        return model

    estimators: dict[str, Callable[[], Any]] = {
        "RecursiveSFA": lambda: RecursiveSFA(FEATURES, n_whitened=WHITENED).fit(X),
        "IncSFA": lambda: IncSFA(FEATURES, n_whitened=WHITENED).fit(X),
        "IncrementalPCA": lambda: by_batches(
            IncrementalPCA(min(32, size)), lambda pca, x: pca.partial_fit(x)
        ),
    }
    with contextlib.suppress(ImportError):
        from deeptime.decomposition import TICA

        def tica(*, batches: bool) -> Any:
            model = TICA(lagtime=1, dim=FEATURES)
            if batches:
                by_batches(model, lambda tica, x: tica.partial_fit((x[:-1], x[1:])))
            else:
                model.fit(X)
            return model.fetch_model()

        estimators["TICA"] = lambda: tica(batches=False)
        estimators["TICA, batches"] = lambda: tica(batches=True)
    if WHITENED < size <= LARGEST:
        estimators["RecursiveSFA, all"] = lambda: RecursiveSFA(FEATURES, n_whitened=size).fit(X)
    if size <= LARGEST:
        with contextlib.suppress(ImportError):
            from sksfa import SFA

            estimators["sklearn-sfa"] = lambda: SFA(FEATURES).fit(X)
    return estimators


def allocated(call: Callable[[], Any]) -> float:
    """Return the peak memory of numpy and Python during a call, in MB."""
    gc.collect()
    tracemalloc.start()
    call()
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return most / 1e6


def slowness(y: FloatArray) -> float:
    """Return the slowness of the slowest output, (n, J), in cycles a sample."""
    moves = (np.diff(y, axis=0) ** 2).mean(axis=0)
    return float(np.sqrt(moves / y.var(axis=0)).min() / (2 * np.pi))


def main(*, quick: bool = False) -> None:
    """Measure, and write results/estimators.json."""
    rows = []
    with threadpool_limits(1):
        for n, size in CASES[: 1 if quick else None]:
            X, following = np.split(samples(2 * n, size), 2)
            estimators = candidates(X)
            work = {name: lambda c=call: bool(c()) or 1 for name, call in estimators.items()}
            times = interleaved(work, 1 if quick or size >= LARGEST else 3)
            for name, call in estimators.items():
                took = f"{middle(times[name]) / 1e6:.3g}"
                against = f"{ratio(times[name], times['RecursiveSFA']):.3g}x"
                slowest = f"{slowness(np.asarray(call().transform(following))):.2g}"
                row = [f"{n:,} x {size:,}", name, took, against, f"{allocated(call):.1f}", slowest]
                rows.append(row)
    head = ["samples x values", "", "CPU s", "vs RecursiveSFA", "MB allocated", "slowness"]
    save(
        "estimators",
        "Estimators against other libraries",
        f"Learn {FEATURES} features of an array: sums of as many sines as there are values "
        "(0.002 to 0.4 cycles a sample) and noise. CPU time of one thread, memory allocated "
        "meanwhile, and the slowness of the slowest output on as many further samples "
        f"(smaller is better). RecursiveSFA and IncSFA first reduce the values to {WHITENED} "
        'principal components; the others and "RecursiveSFA, all" use all values. '
        'IncrementalPCA (32 components) does not look for slow features. "Batches": of '
        f"{BATCH:,} samples.",
        [(head, rows)],
    )
