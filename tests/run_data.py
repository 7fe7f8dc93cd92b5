"""Synthetic runs: records with every shape a learner can give, without a learner."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.blocks import Block, SourceSpec, freeze
from cdmisfa.core.signals import SIGNALS, BlockSignals
from cdmisfa.modules import Module
from replay.runs.log import read_batches, read_columns
from replay.runs.modules import save_modules
from replay.runs.writer import RunWriter

START_NS = 1_451_606_400_000_000_000
DELTA = 0.0008
IMAGE = SourceSpec(
    ("left", "center", "right"), (12, 16), "uint8", ("box_y", "ball_y"), 50.0, START_NS
)
VECTOR = SourceSpec(("x1", "x2", "x3"), (2,), "float64", ("theta",), 50.0, START_NS)


PROGRESS = {"algorithm": "progress", "settled": 0.05, "agreement": 0.25, "delta": None}
"""Settings of a progress learner."""

LEARNING, LEARNED, KNOWN, GIVEN_UP = range(4)
UNTOLD = ("share", "eta_dot", "gate_mean", "gate_sd", "band_sd", "xi", "xi_dot", "expert", "Q")
UNTOLD += ("roc_error", "roc_error_inst", "roc_error_frozen")


def read_signals(path: Path) -> Iterator[BlockSignals]:
    """Every record of a run, in order, one by one."""
    for columns in read_columns(path):
        yield from columns.records()


def block_of(spec: SourceSpec, stream: int, t: int, tau: int, rng: np.random.Generator) -> Block:
    """A block whose frames tell which stream and frame they are."""
    shape = (tau, *spec.frame_shape)
    if spec.dtype == "uint8":
        frames: NDArray[Any] = np.full(shape, (40 * stream + 20) % 250, dtype=np.uint8)
        frames[np.arange(tau), :, (t + np.arange(tau)) // 10 % spec.frame_shape[1]] = 250
    else:
        frames = rng.standard_normal(shape)
    truth = np.sin((t + np.arange(tau))[:, None] / 50 + np.arange(len(spec.truth)))
    return Block(stream, t, freeze(frames), freeze(truth))


def signals_of(
    spec: SourceSpec, k: int, rng: np.random.Generator, *, tau: int, modules: int, outputs: int = 1
) -> BlockSignals:
    """One record: `modules` frozen modules, NaN where a learner has nothing to say."""
    n, j, t = len(spec.streams), outputs, k * tau
    novel = bool(rng.random() < 0.8)
    blank = np.full(j, np.nan)

    def maybe(shape: tuple[int, ...]) -> NDArray[np.float64]:
        return rng.standard_normal(shape) if novel else np.full(shape, np.nan)

    reward = float(rng.standard_normal()) if novel and k > 20 else float("nan")
    return BlockSignals(
        iteration=k,
        t=t,
        log_time=spec.time_ns(t),
        stream=int(rng.integers(n)),
        module=modules + 1,
        novel=novel,
        known_by=0 if novel else int(modules > 0) or -1,
        saved=False,
        share=float(rng.random()),
        novel_blocks=k,
        y=maybe((tau, j)),
        y_frozen=rng.standard_normal((modules, tau, j)),
        eta=maybe((j,)),
        eta_dot=np.abs(maybe((j,))) * 1e-3,
        variance=np.abs(maybe((j,))),
        eta_inst=maybe((j,)) if k else blank,
        gate_mean=maybe((j,)),
        gate_sd=np.abs(maybe((j,))),
        eta_inst_frozen=0.01 + 0.001 * rng.standard_normal((modules, j)),
        band_mean=np.full((modules, j), 0.01),
        band_sd=np.full((modules, j), 0.001),
        roc_error_inst=abs(reward),
        roc_error=float(rng.random()),
        roc_error_frozen=rng.random(modules),
        xi=float(rng.random()),
        xi_dot=-reward,
        curiosity=reward,
        expert=abs(reward) * 0.1,
        reward=reward * 1.1,
        R=rng.standard_normal((n, 2, n)) if n <= 64 else np.empty((0, 2, 0)),
        Q=rng.standard_normal((n, 2)),
        policy=rng.integers(0, 2, n),
        epsilon=1.2 * 0.999**k,
        explored=bool(rng.random() < 0.5),
        action=int(rng.integers(2)),
        next_stream=int(rng.integers(n)),
        change=float(rng.random()),
        tested=float(rng.random()),
        fitted=float(rng.random()),
        learning_error=float(rng.random()),
        interest=rng.random(n),
        state=rng.integers(-1, 4, n),
        typical=float(rng.random()),
        regret=float(rng.random()),
    )


def run_of(
    spec: SourceSpec,
    iterations: int,
    *,
    tau: int = 40,
    seed: int = 0,
    outputs: int = 1,
    saves: bool = False,
) -> Iterator[tuple[BlockSignals, Block]]:
    """A run in which a module is frozen after every third of it."""
    rng = np.random.default_rng(seed)
    for k in range(iterations):
        modules = 3 * k // max(iterations, 1)
        signals = signals_of(spec, k, rng, tau=tau, modules=modules, outputs=outputs)
        saved = saves and 3 * (k + 1) // iterations > modules
        signals = dataclasses.replace(signals, saved=saved)
        yield signals, block_of(spec, signals.stream, signals.t, tau, rng)


def module_of(
    index: int, iteration: int, phi: NDArray[Any], stream: int = 0, name: str = "a"
) -> Module:
    """A module of one output with these weights, (1, I)."""
    one = np.ones(1)
    about = {"index": index, "stream": name, "stream_index": stream, "iteration": iteration}
    bands = {"band_mean": 0 * one, "band_sd": one, "eta": one}
    policy = np.zeros(3, dtype=int)
    return Module(**about, phi=phi, mean=np.zeros(phi.shape[1]), **bands, policy=policy)


def save_modules_of(folder: Path, spec: SourceSpec, records: Sequence[BlockSignals]) -> None:
    """Write a module of one output, with equal weights, for each record that saved one."""
    phi, saves = np.ones((1, int(np.prod(spec.frame_shape)))), [r for r in records if r.saved]
    made = [module_of(i, r.iteration, phi, r.stream) for i, r in enumerate(saves, 1)]
    save_modules(folder / "modules.npz", made)


def having(phi: NDArray[Any]) -> Any:
    """What stands for a learner whose weights, frozen or not, are these."""
    return SimpleNamespace(phi=phi, modules=[SimpleNamespace(phi=phi)])


def write_run(
    path: Path,
    spec: SourceSpec,
    iterations: int,
    *,
    tau: int = 40,
    seed: int = 0,
    saves: bool = False,
    learner: Mapping[str, Any] | None = None,
    source: Mapping[str, Any] | None = None,
    edit: Callable[[BlockSignals], BlockSignals] = lambda signals: signals,
    **options: Any,
) -> list[BlockSignals]:
    """Write such a run to a file and return its records.

    Its manifest has the keys `learner.*` of `learner`, and `source`; `edit` is done to each record
    before.
    """
    config = {"learner": {"tau": tau, "delta": DELTA, **(learner or {})}}
    manifest = {"config": config, "seed": seed, "source": source or {"kind": "test"}}
    writer = RunWriter(path, spec, manifest, **options)
    phi_size = int(np.prod(spec.frame_shape))
    records = []
    for made, block in run_of(spec, iterations, tau=tau, seed=seed, saves=saves):
        signals = edit(made)
        phi = np.full((1, phi_size), float(signals.iteration))
        writer.block(block, signals, having(phi))
        records.append(signals)
    writer.event(iterations * tau, iterations - 1, "stopped: the test is over")
    writer.close()
    return records


def parts_of(run: Path, kind: str) -> list[Any]:
    """What a run's log holds of one kind: "watched", "truth", "phi" or "events"."""
    return [part for batch in read_batches(run) for part in getattr(batch, kind)]


def rows_of(run: Path, kind: str) -> NDArray[Any]:
    """Everything of one kind that belongs to frames, (frames, ...)."""
    return np.concatenate([values for _, values in parts_of(run, kind)])


def by_progress(signals: BlockSignals) -> BlockSignals:
    """The record as a progress learner would have it.

    From the tenth iteration on the first stream is learned; from then on, module 1 knows the
    second, module 2 from the twentieth on. The third is given up and looked at again.
    """
    k = signals.iteration
    states = [LEARNED, KNOWN, GIVEN_UP if k < 25 else LEARNING] if k >= 10 else [LEARNING] * 3
    blank: dict[str, Any] = {
        name: np.full(np.shape(getattr(signals, name)), np.nan) if SIGNALS[name].dims else np.nan
        for name in UNTOLD
    }
    known_by = (1, 1 + k // 20, 0)[k % 3] if k >= 10 else 0
    untested: dict[str, Any] = dict.fromkeys(("tested", "change"), np.nan) if k % 11 == 0 else {}
    return dataclasses.replace(
        signals,
        **blank,
        **untested,
        R=np.empty((0, 2, 0)),
        known_by=known_by,
        stream=k % 3,
        state=np.array(states),
    )
