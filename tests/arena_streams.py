"""Small streams for tests of the arena: made in no time, and needing no package."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from cdmisfa.arena.pictures import Rng, Shown, pixels, stateless
from cdmisfa.arena.sets import SETS, ArenaSet
from cdmisfa.arena.streams import STREAMS, Kind

SHAPE = (6, 8)


def sway(rng: Rng, n: int) -> Shown:
    """Two patterns that fade slowly, and at once, and one that flickers."""
    slow = np.sin(2 * np.pi * np.arange(n) / 400 + rng.uniform(0, 6))
    fast = rng.standard_normal(n)
    first, second = rng.uniform(-1, 1, (2, *SHAPE))
    frames = 127 + 60 * slow[:, None, None] * first + 20 * fast[:, None, None] * second
    return Shown(pixels(frames), slow[:, None], ("slow",))


def hiss(rng: Rng, n: int) -> Shown:
    """Noise."""
    return stateless(rng.integers(0, 256, (n, *SHAPE), dtype=np.uint8))


def blank(rng: Rng, n: int) -> Shown:
    """One grey."""
    return stateless(np.full((n, *SHAPE), 90, np.uint8))


KINDS = {
    "sway": Kind(sway),
    "swing": Kind(sway),
    "hiss": Kind(hiss, learnable=False),
    "blank": Kind(blank, learnable=False),
    "short": Kind(lambda rng, n: sway(rng, 400), loops=True),
}


SET = ArenaSet(("sway", "hiss", "swing"), "two fading patterns, and noise", frames=60_000)


@pytest.fixture(scope="module")
def tiny() -> Iterator[None]:
    """The small streams among those of the arena, and the set `tiny` of some."""
    for name, kind in KINDS.items():
        STREAMS.add(name, kind)
    SETS.add("tiny", SET)
    yield
    SETS.remove("tiny")
    for name in KINDS:
        STREAMS.remove(name)
