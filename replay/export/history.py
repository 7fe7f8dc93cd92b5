"""A run as arrays over its iterations, for figures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from replay.runs.columns import SignalColumns
from replay.runs.log import TRUTH_TOPIC, WATCHED_TOPIC, RunHeader
from replay.runs.outline import Outline, read_outline
from replay.runs.stretches import Frames, read_columns, read_stretches

Float = NDArray[np.float64]

KEPT = 20_000
"""Last frames of each module's output that are kept."""

BETTER = 0.03
"""By how much a function must be followed better than a simpler one."""

FREQUENCIES = 12
"""Sines of an angle that are tried."""

STRIP = 8
"""Pictures of each module."""

LAST_BLOCKS = 40
"""Blocks before the save whose output is shown with what the frozen module says later."""

SHOWN = 6
"""Streams and modules that are drawn: the most watched, the first learned."""


LANES = 40
"""Streams whose states are drawn: the most watched."""


@dataclass(frozen=True, slots=True)
class Output:
    """What a frozen module says about its own stream.

    Attributes:
        t: (n,) frames at which that stream was watched after the save.
        y: (n,) its first output there.
        truth: (n, D) what the world knows at these frames; D may be 0.
    """

    module: int
    stream: int
    t: NDArray[np.int64]
    y: Float
    truth: Float

    def follows(self, names: Sequence[str]) -> Following | None:
        """What the world knows that the output follows most; None where it knows nothing.

        Args:
            names: of the columns of truth.
        """
        found = [
            fit
            for column, name in enumerate(names[: self.truth.shape[1]])
            if (fit := follow(self.truth[:, column], self.y, column, name)) is not None
        ]
        return max(found, key=lambda fit: fit.r, default=None)


@dataclass(frozen=True, slots=True)
class Following:
    """A function of something true that an output follows.

    Attributes:
        column: of the truth.
        function: in words, of the truth's name.
        r: correlation of the output with the function, 0 to 1.
        weights: (K,) of the terms.
        terms: (n,) truth -> (n, K).
    """

    column: int
    function: str
    r: float
    weights: Float
    terms: Callable[[Float], Float]

    def __call__(self, truth: Float) -> Float:
        """The function's values."""
        return np.asarray(self.terms(truth) @ self.weights)


def follow(truth: Float, y: Float, column: int, name: str) -> Following | None:
    """The simplest function of a true quantity that an output follows.

    Of an angle that goes round these are its sines, of all others a straight line or, where
    that is better by `BETTER`, a parabola: a slow feature need not be the quantity itself.

    Args:
        truth: (n,) its values.
        y: (n,) the output.
        column: number of the quantity.
        name: its name.
    """
    if len(truth) < 3 or np.std(truth) == 0 or np.std(y) == 0:
        return None
    powers = range(1, min(len(np.unique(truth)), 3))
    tried = [
        (name if k == 1 else f"a parabola of {name}", partial(_powers, degree=k)) for k in powers
    ]
    if _goes_round(truth):
        tried += [
            (f"sin({name if k == 1 else f'{k} {name}'} + c)", partial(_sines, frequency=k))
            for k in range(1, FREQUENCIES + 1)
        ]
    best: Following | None = None
    for function, terms in tried:
        table = terms(truth)
        weights: Float = np.linalg.lstsq(table, y, rcond=None)[0].astype(np.float64)
        fit = table @ weights
        r = float(np.corrcoef(fit, y)[0, 1]) if np.std(fit) > 0 else 0.0
        if best is None or r > best.r + BETTER:
            best = Following(column, function, r, weights, terms)
    return best


def _powers(x: Float, degree: int) -> Float:
    return np.stack([x**k for k in range(degree + 1)], axis=1)


def _sines(x: Float, frequency: int) -> Float:
    return np.stack([np.ones_like(x), np.sin(frequency * x), np.cos(frequency * x)], axis=1)


def _goes_round(x: Float) -> bool:
    """Whether these are angles of all around a circle, in radians."""
    turn = 2 * np.pi
    return bool(x.min() >= 0 and x.max() <= turn and np.ptp(x) > 0.9 * turn)


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
        outline: the run in short, of n iterations.
        shown: the streams that are drawn.
        stream: (n,) stream watched.
        eta: (n, J), as eta_dot.
        stay_reward: (n, shown) R(s, stay, s).
        policy: (n, shown) 0 stay, 1 switch.
        lanes: the streams whose states are drawn; state: (n, lanes) what became of each.
        known_by: (n,) module that gives what the watched stream shows, from 1.
        error: (n,) learning error of the candidate, NaN where it was not tested yet; so are
            tested and fitted, its slowness on new frames and on those it learned from.
    """

    outline: Outline
    shown: tuple[int, ...]
    stream: NDArray[np.int64]
    eta: Float
    eta_dot: Float
    stay_reward: Float
    policy: NDArray[np.int64]
    lanes: tuple[int, ...]
    state: NDArray[np.int64]
    known_by: NDArray[np.int64]
    error: Float
    tested: Float
    fitted: Float
    outputs: tuple[Output, ...]
    pictures: tuple[Strip, ...]


def read_history(path: Path) -> History:
    """Read what a run's figures need; see `read_stretches`."""
    outline = read_outline(path)
    header, n, shown = outline.header, outline.iterations, outline.streams(SHOWN)
    stream = np.empty(n, dtype=np.int64)
    policy = np.empty((n, len(shown)), dtype=np.int64)
    stay = np.full((n, len(shown)), np.nan)
    lanes, known_by = outline.streams(LANES), np.empty(n, dtype=np.int64)
    state = np.empty((n, len(lanes)), dtype=np.int64)
    heard = [
        _OutputCollector(save.module, save.stream, alone=header.by_progress)
        for save in outline.saved[:SHOWN]
    ]
    at = 0
    for columns in read_columns(path, header):
        rows = slice(at, at := at + len(columns))
        stream[rows] = columns["stream"]
        policy[rows] = columns["policy"][:, shown]
        state[rows], known_by[rows] = columns["state"][:, lanes], columns["known_by"]
        if columns["R"].size:
            stay[rows] = columns["R"][:, shown, 0, shown]
        for module in heard:
            module.add(columns)
    truth = _truth(path, header) if header.spec.truth else None
    outputs = tuple(module.output(truth) for module in heard if module.blocks)
    lines = outline.lines
    untested = np.isnan(lines["tested"])
    return History(
        outline=outline,
        shown=tuple(shown),
        stream=stream,
        eta=lines["eta"].reshape(n, outline.outputs),
        eta_dot=lines["eta_dot"].reshape(n, outline.outputs),
        stay_reward=stay,
        policy=policy,
        lanes=tuple(lanes),
        state=state,
        known_by=known_by,
        error=np.where(untested, np.nan, lines["learning_error"]),
        tested=lines["tested"],
        fitted=np.where(untested, np.nan, lines["fitted"]),
        outputs=outputs,
        pictures=_pictures(path, header, outputs) if header.spec.images else (),
    )


class _OutputCollector:
    """What a module says whenever its own stream is watched; at its save, what it last said.

    Args:
        module: its number.
        stream: its own.
        alone: it was learned from its own stream alone, while others were learned from theirs.
    """

    def __init__(self, module: int, stream: int, *, alone: bool) -> None:
        self._module, self._stream, self._alone = module, stream, alone
        self.blocks: list[tuple[int, Float]] = []

    def add(self, columns: SignalColumns) -> None:
        own, frozen = columns["stream"] == self._stream, columns["y_frozen"]
        if frozen.shape[1] >= self._module:
            said = frozen[own, self._module - 1, :, 0]
            self.blocks += zip(columns.frames[own].tolist(), said, strict=True)
            return
        # Before it is frozen the abstraction still changes: only its last blocks count.
        own &= self._alone | (columns["module"] == self._module)
        own &= np.isfinite(columns["y"]).all(axis=(1, 2))
        self.blocks += zip(columns.frames[own].tolist(), columns["y"][own, :, 0], strict=True)
        del self.blocks[: -LAST_BLOCKS - int(columns["saved"][own].any())]

    def output(self, truth: Frames | None) -> Output:
        """What was heard last, with what the world knew then."""
        blocks = self.blocks[-max(KEPT // max(len(self.blocks[0][1]), 1), 1) :]
        t = np.concatenate([start + np.arange(len(y)) for start, y in blocks])
        known = np.empty((len(t), 0))
        if truth is not None:
            frames, values = truth
            at = np.searchsorted(frames, t)
            if at.max() < len(frames) and (frames[at] == t).all():
                known = values[at]
        y = np.concatenate([y for _, y in blocks])
        return Output(module=self._module, stream=self._stream, t=t, y=y, truth=known)


def _truth(path: Path, header: RunHeader) -> Frames | None:
    """What the world knew at each frame that was watched."""
    stretches = read_stretches(path, header, topics=(TRUTH_TOPIC,))
    pieces = [piece for stretch in stretches for piece in stretch.truth]
    if not pieces:
        return None
    frames, values = zip(*pieces, strict=True)
    return np.concatenate(frames), np.concatenate(values)


def _pictures(path: Path, header: RunHeader, outputs: Sequence[Output]) -> tuple[Strip, ...]:
    """Images spread over the range of each module's output."""
    wanted = {o.module: dict(zip(o.t.tolist(), o.y.tolist(), strict=True)) for o in outputs}
    found: dict[int, list[tuple[int, NDArray[Any], float]]] = {o.module: [] for o in outputs}
    for stretch in read_stretches(path, header, topics=(WATCHED_TOPIC,)):
        for frames, images in stretch.watched:
            for t, image in zip(frames.tolist(), images, strict=True):
                for module, values in wanted.items():
                    if t in values:
                        found[module].append((t, image.copy(), values[t]))
    strips = []
    for output in outputs:
        shown = sorted(found[output.module], key=lambda frame: frame[2])
        if shown:
            chosen = np.linspace(0, len(shown) - 1, min(STRIP, len(shown))).astype(int)
            picked = tuple(shown[i] for i in chosen)
            strips.append(Strip(output.module, output.stream, picked))
    return tuple(strips)
