"""A run as arrays over its iterations, for figures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.signals import BlockSignals
from replay.runs.log import read_signals, read_truth, read_watched
from replay.runs.outline import Saved, read_outline

Float = NDArray[np.float64]

KEPT = 20_000
"""Last frames of each module's output that are kept."""

STRIP = 8
"""Pictures of each module."""

SHOWN = 6
"""Streams and modules that are drawn: the most watched, the first learned."""


@dataclass(frozen=True, slots=True)
class Output:
    """What a frozen module says about its own stream.

    Attributes:
        module: its index, from 1.
        stream: stream it was learned on.
        t: (n,) frames at which that stream was watched after the save.
        y: (n,) its first output there.
        truth: (n, D) what the world knows at these frames; D may be 0.
    """

    module: int
    stream: int
    t: NDArray[np.int64]
    y: Float
    truth: Float

    def best_truth(self) -> tuple[int, float] | None:
        """The column of truth that the output follows most, and its correlation."""
        found: list[tuple[float, int, float]] = []
        for column in range(self.truth.shape[1]):
            values = self.truth[:, column]
            if len(values) > 2 and np.std(values) > 0 and np.std(self.y) > 0:
                r = float(np.corrcoef(values, self.y)[0, 1])
                found.append((abs(r), column, r))
        if not found:
            return None
        _, column, r = max(found)
        return column, r


@dataclass(frozen=True, slots=True)
class Strip:
    """Pictures of one stream with the output of its module: (t, image, y)."""

    module: int
    stream: int
    frames: tuple[tuple[int, NDArray[Any], float], ...]


@dataclass(frozen=True, slots=True)
class History:
    """What a run's figures are made of.

    Attributes:
        streams: names of the streams.
        truth: names of what the world knows.
        delta: threshold of eta-dot.
        saved: the saves.
        shown: the streams that are drawn.
        iterations: number of iterations, n.
        stream: (n,) stream watched.
        eta: (n, J) slowness.
        eta_dot: (n, J) its change.
        stay_reward: (n, shown) R(s, stay, s).
        policy: (n, shown) 0 stay, 1 switch.
        epsilon: (n,).
        outputs: what the modules say about their streams.
        pictures: what they saw.
    """

    streams: tuple[str, ...]
    truth: tuple[str, ...]
    delta: float | None
    saved: tuple[Saved, ...]
    shown: tuple[int, ...]
    iterations: int
    stream: NDArray[np.int64]
    eta: Float
    eta_dot: Float
    stay_reward: Float
    policy: NDArray[np.int64]
    epsilon: Float
    outputs: tuple[Output, ...]
    pictures: tuple[Strip, ...]


def read_history(path: Path) -> History:
    """Read what a run's figures need.

    Raises:
        UsageError: there is no such run.
        LogDamagedError: it cannot be read.
    """
    outline = read_outline(path)
    shown, n, width = outline.streams(SHOWN), outline.iterations, max(outline.outputs, 1)
    stream, policy = np.zeros(n, dtype=np.int64), np.zeros((n, len(shown)), dtype=np.int64)
    eta, eta_dot = np.zeros((n, width)), np.zeros((n, width))
    stay, epsilon = np.full((n, len(shown)), np.nan), np.zeros(n)
    said: dict[int, list[tuple[int, Float]]] = {}
    learned = {s.module: s.stream for s in outline.saved[:SHOWN]}
    for k, signals in enumerate(read_signals(path)):
        stream[k], epsilon[k] = signals.stream, signals.epsilon
        eta[k], eta_dot[k], policy[k] = signals.eta, signals.eta_dot, signals.policy[shown]
        if signals.R.size:
            stay[k] = signals.R[shown, 0, shown]
        _listen(signals, learned, said)
    truth = dict(read_truth(path)) if outline.header.spec.truth else {}
    outputs = tuple(
        _output(module, learned[module], parts, truth) for module, parts in said.items()
    )
    return History(
        streams=outline.names(),
        truth=outline.header.spec.truth,
        delta=outline.delta,
        saved=outline.saved,
        shown=tuple(shown),
        iterations=n,
        stream=stream,
        eta=eta,
        eta_dot=eta_dot,
        stay_reward=stay,
        policy=policy,
        epsilon=epsilon,
        outputs=outputs,
        pictures=_pictures(path, outputs) if len(outline.header.spec.frame_shape) == 2 else (),
    )


def _listen(
    signals: BlockSignals, learned: dict[int, int], said: dict[int, list[tuple[int, Float]]]
) -> None:
    """Keep what each module says when its own stream is watched; at its save, what it last said."""
    for module, stream in learned.items():
        if signals.stream != stream:
            continue
        if len(signals.y_frozen) >= module:
            said.setdefault(module, []).append((signals.t, signals.y_frozen[module - 1, :, 0]))
        elif signals.module == module and np.isfinite(signals.y).all():
            # Before it is frozen the abstraction still changes: only its last blocks count.
            parts = said.setdefault(module, [])
            parts.append((signals.t, signals.y[:, 0]))
            if not signals.saved:
                del parts[:-LAST_BLOCKS]


LAST_BLOCKS = 40
"""Blocks before the save whose output is shown with what the frozen module says later."""


def _output(
    module: int,
    stream: int,
    parts: Sequence[tuple[int, Float]],
    truth: dict[int, Float],
) -> Output:
    parts = parts[-max(KEPT // max(len(parts[0][1]), 1), 1) :]
    known = [truth[t] for t, _ in parts if t in truth]
    whole = len(known) == len(parts)
    t = np.concatenate([start + np.arange(len(y)) for start, y in parts])
    return Output(
        module=module,
        stream=stream,
        t=t,
        y=np.concatenate([y for _, y in parts]),
        truth=np.concatenate(known) if whole else np.empty((len(t), 0)),
    )


def _pictures(path: Path, outputs: Sequence[Output]) -> tuple[Strip, ...]:
    """Images spread over the range of each module's output."""
    wanted = {o.module: dict(zip(o.t.tolist(), o.y.tolist(), strict=True)) for o in outputs}
    found: dict[int, list[tuple[int, NDArray[Any], float]]] = {o.module: [] for o in outputs}
    for t, images in read_watched(path):
        for module, values in wanted.items():
            if t in values:
                found[module].append((t, images[0], values[t]))
    strips = []
    for output in outputs:
        frames = sorted(found[output.module], key=lambda frame: frame[2])
        if frames:
            chosen = np.linspace(0, len(frames) - 1, min(STRIP, len(frames))).astype(int)
            picked = tuple(frames[i] for i in chosen)
            strips.append(Strip(output.module, output.stream, picked))
    return tuple(strips)
