"""Sets of streams, their footage, and what batch SFA finds in it.

A word names what a stream shows, as `flicker:pendulum#1>acrobot`; see `parse`.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.arena import pictures, worlds
from benchmarks.arena.pictures import CAMERAS, Footage
from cdmisfa.core.arrays import FloatArray
from cdmisfa.core.blocks import PIXEL, UINT8, Block, SourceSpec
from cdmisfa.core.expansion import expand
from cdmisfa.features.following import batch_outputs
from cdmisfa.features.sfa import slowness
from cdmisfa.modules import Module

CHANGE = 60_000
"""Frame from which on a stream of two phases shows the second."""

BEGIN_APART = 997
"""Frames between the beginnings of a stream that is shown twice."""


def _read(name: str) -> dict[str, dict[str, Any]]:
    return tomllib.loads(Path(__file__).with_name(name).read_text("utf-8"))


STREAMS = _read("streams.toml")
SETS = _read("sets.toml")

REPORTED = [name for name in SETS if name.startswith("reported-")]
TUNING = [name for name in SETS if name not in REPORTED]
GROUPS = {"all": list(SETS), "reported": REPORTED, "tuning": TUNING}
"""Groups of sets; nothing is tuned on the reported ones."""


class Showing(NamedTuple):
    """A phase of a stream; `apart` is how many times `BEGIN_APART` later it begins."""

    kind: str
    camera: str = ""
    apart: int = 0

    @property
    def name(self) -> str:
        return f"{self.camera}:{self.kind}" if self.camera else self.kind

    @property
    def learnable(self) -> bool:
        return bool(STREAMS[self.kind].get("learnable", True))


_WORD = re.compile(r"(?:(\w+):)?([\w.-]+?)(?:#(\d+))?")


def parse(word: str) -> tuple[Showing, ...]:
    """Return the phases of a stream in order.

    Args:
        word: `CAMERA:NAME#APART`, where only the name is required; a stream that changes has
            two of them, separated by `>`.

    Example:
        >>> parse("lit:pong#1")
        (Showing(kind='pong', camera='lit', apart=1),)
    """
    parts = [_WORD.fullmatch(part).groups("") for part in word.split(">")]
    return tuple(Showing(kind, camera, int(apart or 0)) for camera, kind, apart in parts)


def make_footage(name: str, seed: int) -> Footage:
    """Return the frames of a stream, the same ones every time.

    Args:
        name: as `Showing.name` has it.
        seed: of all its randomness.
    """
    camera, _, kind = name.rpartition(":")
    rng = np.random.default_rng(np.random.SeedSequence((seed, *name.encode())))
    if camera:
        return CAMERAS[camera](rng, make_footage(kind, seed))
    entry = STREAMS[kind]
    maker, *arguments = entry["make"]
    make = getattr(pictures, maker, None) or getattr(worlds, maker)
    return make(rng, entry.get("frames", 16_000), *arguments)


def refer(footage: Footage, components: int, expansion: str) -> tuple[Module, Module]:
    """Return the results of batch SFA on the frames that a learner sees.

    Args:
        footage: of the stream.
        components: K, as many as the learner has.
        expansion: the learner's.

    Returns:
        The slowest output, and the K leading principal components.
    """
    frames = footage.training
    x = expand(expansion, frames.reshape(len(frames), -1))
    scale = PIXEL if frames.dtype == UINT8 else 1.0
    phi, mean, directions = batch_outputs([(x, False)], len(x), components, outputs=1)
    return linear(phi, mean, expansion, scale), linear(directions, mean, expansion, scale)


def linear(phi: FloatArray, mean: FloatArray, expansion: str, scale: float) -> Module:
    """Return weights (J, I) of a centred frame as a module."""
    none, policy = np.zeros(len(phi)), np.zeros(0, np.int64)
    names = {"expansion": expansion, "scale": scale}
    return Module(0, "", 0, 0, phi, mean, none, none, none, policy, **names)


def slowest_output(module: Module, footage: Footage) -> tuple[FloatArray, float]:
    """Return a module's first output on the following frames, (n,), and its slowness.

    The slowness is infinite where the output does not vary.
    """
    y = module.transform(footage.following)[:, 0]
    return y, float(slowness(y[:, None])[0]) if y.max() > y.min() else np.inf


class ArenaSource:
    """Streams on one clock; each begins again when its frames are over.

    Args:
        words: what each stream shows, see `parse`.
        seed: of the streams.
    """

    def __init__(self, words: Sequence[str], seed: int) -> None:
        self.phases = [parse(word) for word in words]
        names = {showing.name for phases in self.phases for showing in phases}
        self.footage = {name: make_footage(name, seed) for name in sorted(names)}
        frames = next(iter(self.footage.values())).frames
        self.spec = SourceSpec(tuple(words), frames.shape[1:], str(frames.dtype))
        self.reference = cache(lambda name, *terms: refer(self.footage[name], *terms))
        self.t = 0

    def showing(self, stream: int, t: int) -> Showing:
        """Return the phase of a stream at frame t."""
        phases = self.phases[stream]
        return phases[min(t // CHANGE, len(phases) - 1)]

    def take(self, stream: int, n: int) -> Block:
        """Return the next n frames of a stream."""
        frames = np.empty((n, *self.spec.frame_shape), self.spec.dtype)
        for k, t in enumerate(range(self.t, self.t + n)):
            showing = self.showing(stream, t)
            source = self.footage[showing.name].training
            frames[k] = source[(t + showing.apart * BEGIN_APART) % len(source)]
        frames.flags.writeable = False
        block = Block(stream, self.t, frames, np.zeros((n, 0)))
        self.t += n
        return block
