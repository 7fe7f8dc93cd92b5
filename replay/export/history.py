"""A run as arrays over its iterations, for figures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.arrays import FloatArray
from replay.following import OutputHistory, read_outputs
from replay.runs.log import WATCHED_TOPIC, RunHeader, read_batches, read_columns
from replay.runs.run import Outline, read_outline

STRIP = 8
"""Pictures of each module."""

SHOWN = 6
"""Streams and modules that are drawn: the most watched, the first learned."""

LANES = 40
"""Streams whose states are drawn: the most watched."""


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
    eta: FloatArray
    eta_dot: FloatArray
    stay_reward: FloatArray
    policy: NDArray[np.int64]
    lanes: tuple[int, ...]
    state: NDArray[np.int64]
    known_by: NDArray[np.int64]
    error: FloatArray
    tested: FloatArray
    fitted: FloatArray
    outputs: tuple[OutputHistory, ...]
    pictures: tuple[Strip, ...]


def read_history(path: Path) -> History:
    """Read what a run's figures need; see `read_batches`."""
    outline = read_outline(path)
    header, n, shown = outline.header, outline.iterations, outline.streams(SHOWN)
    stream = np.empty(n, dtype=np.int64)
    policy = np.empty((n, len(shown)), dtype=np.int64)
    stay = np.full((n, len(shown)), np.nan)
    lanes, known_by = outline.streams(LANES), np.empty(n, dtype=np.int64)
    state = np.empty((n, len(lanes)), dtype=np.int64)
    at = 0
    for columns in read_columns(path, header):
        rows = slice(at, at := at + len(columns))
        stream[rows] = columns["stream"]
        policy[rows] = columns["policy"][:, shown]
        state[rows], known_by[rows] = columns["state"][:, lanes], columns["known_by"]
        if columns["R"].size:
            stay[rows] = columns["R"][:, shown, 0, shown]
    outputs = read_outputs(path, outline, SHOWN)
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


def _pictures(path: Path, header: RunHeader, outputs: Sequence[OutputHistory]) -> tuple[Strip, ...]:
    """Images spread over the range of each module's output."""
    wanted = {o.module: dict(zip(o.t.tolist(), o.y.tolist(), strict=True)) for o in outputs}
    found: dict[int, list[tuple[int, NDArray[Any], float]]] = {o.module: [] for o in outputs}
    for batch in read_batches(path, header, topics=(WATCHED_TOPIC,)):
        for frames, images in batch.watched:
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
