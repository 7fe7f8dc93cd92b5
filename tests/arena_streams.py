"""Small streams for tests of the arena: made in no time, and needing no package."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import pytest

from cdmisfa.studies.arena.pictures import Footage, Rng, pixels, stateless
from cdmisfa.studies.arena.streams import SETS, STREAMS, ArenaSet, Kind

SHAPE = (6, 8)


def fading(patterns: int) -> Callable[[Rng, int], Footage]:
    """A pattern that comes and goes slowly, and one that flickers."""
    slow_one, fast_one = np.random.default_rng(patterns).uniform(-1, 1, (2, *SHAPE))

    def make(rng: Rng, n: int) -> Footage:
        slow = np.sin(2 * np.pi * np.arange(n) / 400 + rng.uniform(0, 6))
        fast = rng.standard_normal(n)
        frames = 127 + 60 * slow[:, None, None] * slow_one + 20 * fast[:, None, None] * fast_one
        return Footage(pixels(frames), slow[:, None], ("slow",))

    return make


def late(rng: Rng, n: int) -> Footage:
    """A fading pattern, of which a pixel flickers once a learner has seen all it is shown."""
    footage = fading(0)(rng, n)
    footage.frames[: -n // 4, 0, 0] = 127
    footage.frames[-n // 4 :, 0, 0] = rng.integers(0, 256, n - n * 3 // 4)
    return footage


def hiss(rng: Rng, n: int) -> Footage:
    """Noise."""
    return stateless(rng.integers(0, 256, (n, *SHAPE), dtype=np.uint8))


def blank(rng: Rng, n: int) -> Footage:
    """One grey."""
    return stateless(np.full((n, *SHAPE), 90, np.uint8))


KINDS = {
    "sway": Kind(fading(0)),
    "echo": Kind(fading(0)),
    "swing": Kind(fading(1)),
    "late": Kind(late),
    "hiss": Kind(hiss, learnable=False),
    "blank": Kind(blank, learnable=False),
    "short": Kind(lambda rng, n: fading(2)(rng, 400), loops=True),
}


SET = ArenaSet(("sway", "hiss", "swing"), "two fading patterns, and noise", frames=60_000)


@pytest.fixture(scope="module")
def tiny() -> Iterator[None]:
    """The small streams among those of the arena, and the set `tiny` of some."""
    for name, kind in KINDS.items():
        STREAMS[name] = kind
    SETS["tiny"] = SET
    yield
    del SETS["tiny"]
    for name in KINDS:
        del STREAMS[name]
