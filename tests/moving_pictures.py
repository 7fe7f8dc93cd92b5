"""Small streams of pictures whose slow feature is known, as a source."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.blocks import Block, ClockedSource, SourceSpec, check_request, freeze

SHAPE = (12, 16)
LENGTH = 6000
Rng = np.random.Generator


def _blob(where: NDArray[Any]) -> NDArray[Any]:
    """A bright spot that moves across, at (n,) places from -1 to 1."""
    rows, columns = np.meshgrid(np.arange(12.0), np.arange(16.0), indexing="ij")
    x = 7.5 + 6.0 * where[:, None, None]
    return np.exp(-((columns - x) ** 2 + (rows - 6.0) ** 2) / 8.0)


def swing(rng: Rng, n: int) -> tuple[NDArray[Any], NDArray[Any]]:
    """A spot on a pendulum; its place."""
    where = np.sin(np.arange(n) / 17.0 + rng.random())
    return 60 + 150 * _blob(where), where


def stroll(rng: Rng, n: int) -> tuple[NDArray[Any], NDArray[Any]]:
    """A light that comes and goes at random; how bright it is."""
    steps, bright = rng.normal(0, 1, n), np.zeros(n)
    for t in range(1, n):
        bright[t] = 0.97 * bright[t - 1] + 0.24 * steps[t]
    picture = np.random.default_rng(1).random(SHAPE)
    shown = 110 + 25 * np.tanh(bright)[:, None, None] * picture
    return shown + rng.normal(0, 3, (n, *SHAPE)), bright


def dawn(rng: Rng, n: int) -> tuple[NDArray[Any], NDArray[Any]]:
    """A light that only rises; how bright it is."""
    bright = np.linspace(0.5, 2.0, n)
    picture = np.random.default_rng(1).random(SHAPE)
    return 80 * bright[:, None, None] * picture + rng.normal(0, 4, (n, *SHAPE)), bright


def noise(rng: Rng, n: int) -> tuple[NDArray[Any], NDArray[Any]]:
    """Nothing to be learned."""
    return rng.integers(0, 256, (n, *SHAPE)).astype(float), np.zeros(n)


def constant(rng: Rng, n: int) -> tuple[NDArray[Any], NDArray[Any]]:
    """One grey."""
    return np.full((n, *SHAPE), 90.0), np.zeros(n)


KINDS: Mapping[str, Callable[[Rng, int], tuple[NDArray[Any], NDArray[Any]]]] = {
    "swing": swing,
    "stroll": stroll,
    "dawn": dawn,
    "noise": noise,
    "constant": constant,
}


class MovingPictures(ClockedSource):
    """Streams by their names, as "swing", "swing.2" (the same once more) or "swing>noise".

    The latter changes at frame `changes_at`. Streams begin again after `LENGTH` frames.
    """

    def __init__(self, *names: str, seed: int = 0, changes_at: int = 0) -> None:
        self.names = names
        self._spec = SourceSpec(names, SHAPE, "uint8", ("state",))
        self._at = changes_at
        self._shown = [
            [self._made(word.partition(".")[0], seed) for word in name.split(">")] for name in names
        ]

    @staticmethod
    def _made(kind: str, seed: int) -> tuple[NDArray[Any], NDArray[Any]]:
        frames, state = KINDS[kind](np.random.default_rng(seed), LENGTH)
        return frames.clip(0, 255).astype(np.uint8), state

    def take(self, stream: int, n: int) -> Block:
        check_request(self.spec, stream, n)
        at = self.t + np.arange(n)
        frames, state = (part[at % LENGTH] for part in self._shown[stream][0])
        if len(self._shown[stream]) > 1:
            later = at >= self._at
            frames[later] = self._shown[stream][1][0][at[later] % LENGTH]
            state[later] = self._shown[stream][1][1][at[later] % LENGTH]
        self._t += n
        return Block(stream, self._t - n, freeze(frames), freeze(state[:, None]))

    def describe(self) -> Mapping[str, Any]:
        return {"kind": "moving pictures", "streams": list(self.names)}
