"""The streams of the arena by their names, words for what they show, and sets of them.

A word is as `flicker:pendulum#1>acrobot`; see `parse`.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np

from cdmisfa.core.arrays import ByteArray
from cdmisfa.core.errors import UsageError
from cdmisfa.core.registry import Registry, did_you_mean
from cdmisfa.studies.arena import pictures
from cdmisfa.studies.arena.pictures import LEARNED_FROM, Footage, Maker, Rng, atari, classic

HELD_OUT: Final = 4_000
"""Frames after those that a learner is shown, on which it is judged."""

NOISE_SD: Final = (0.01, 0.03, 0.1, 0.3, 1.0)
"""Of the distractors, as shares of the full range."""

CHANGE: Final = 60_000
"""Frame from which on a stream that changes shows something else."""


@dataclass(frozen=True, slots=True)
class Kind:
    """What there is to know of a stream before it is made.

    Attributes:
        make: footage, from a generator and how many frames are wanted.
        learnable: it has a slow feature that a linear learner can find.
        loops: its frames are few and fixed, so that it is judged on those it was learned from.
        images: its frames are pictures, and not a few values.
    """

    make: Maker
    learnable: bool = True
    loops: bool = False
    images: bool = True


CARS: Final = {"player": 14, **{f"car {k}": 108 + k for k in range(10)}}

STREAMS: Registry[Kind] = Registry(
    "stream",
    {
        "pendulum": Kind(classic("Pendulum-v1", 5, ("cos", "sin", "speed"))),
        "cartpole": Kind(classic("CartPole-v1", 1, ("x", "x speed", "angle", "angle speed"))),
        "acrobot": Kind(
            classic("Acrobot-v1", 5, ("cos 1", "sin 1", "cos 2", "sin 2", "speed 1", "speed 2"))
        ),
        "mountaincar": Kind(classic("MountainCar-v0", 10, ("x", "speed"))),
        "pong": Kind(atari("Pong", {"player": 51, "enemy": 50, "ball x": 49, "ball y": 54})),
        "breakout": Kind(atari("Breakout", {"player": 72, "ball x": 99, "ball y": 101})),
        "freeway": Kind(atari("Freeway", CARS)),
        "bikes": Kind(pictures.clip("bikes"), loops=True),
        "bigbuckbunny": Kind(pictures.clip("bigbuckbunny"), loops=True),
        "carphone": Kind(pictures.clip("carphone_pristine"), loops=True),
        "icub-left": Kind(pictures.icub("left", "object1"), loops=True),
        "icub-center": Kind(pictures.icub("center", "object2"), learnable=False, loops=True),
        "icub-right": Kind(pictures.icub("right", "object3"), loops=True),
        "x1": Kind(pictures.oscillatory("x1", lambda a: np.sin(4 * a - np.pi / 4)), images=False),
        "x2": Kind(pictures.oscillatory("x2", lambda a: np.sin(3 * a)), images=False),
        "x3": Kind(pictures.oscillatory("x3", lambda a: np.cos(2 * a)), images=False),
        "vector-noise": Kind(pictures.vector_noise, learnable=False, images=False),
        "light": Kind(pictures.light),
        "waves": Kind(pictures.waves),
        "noise": Kind(pictures.full_noise, learnable=False),
        "jumping": Kind(pictures.jumping, learnable=False),
        "constant": Kind(pictures.constant, learnable=False),
        "still": Kind(pictures.still, learnable=False),
        **{f"gaussian-{sd:g}": Kind(pictures.gaussian_noise(sd), False) for sd in NOISE_SD},
        **{f"uniform-{sd:g}": Kind(pictures.uniform_noise(sd), False) for sd in NOISE_SD},
    },
)
"""Every stream; `STREAMS.add` adds one."""

CAMERAS: Registry[Callable[[Rng, ByteArray], ByteArray]] = Registry(
    "camera", {"flicker": pictures.flicker, "shake": pictures.shake, "dim": pictures.low_contrast}
)
"""Bad cameras, through which any stream of pictures may be seen."""

_WORD: Final = re.compile(r"(?:(?P<camera>\w+):)?(?P<kind>[\w.-]+?)(?:#(?P<apart>\d+))?")


@dataclass(frozen=True, slots=True)
class Showing:
    """What a stream shows for a while.

    Attributes:
        kind: its name in `STREAMS`.
        camera: the camera in `CAMERAS` that sees it; "" for a good one.
        apart: shown again, it begins so many times `library.BEGIN_APART` frames later.
    """

    kind: str
    camera: str = ""
    apart: int = 0

    @property
    def name(self) -> str:
        """What it shows, wherever it begins: `flicker:pendulum`."""
        return f"{self.camera}:{self.kind}" if self.camera else self.kind

    @property
    def learnable(self) -> bool:
        """See `Kind`."""
        return STREAMS[self.kind].learnable


def parse(word: str) -> tuple[Showing, ...]:
    """What a stream shows, one thing after the other.

    Args:
        word: `CAMERA:NAME#APART`, of which only the name must be there; several such with a `>`
            between for a stream that changes.

    Raises:
        UsageError: no such stream or camera.

    Example:
        >>> parse("dim:pong#1")
        (Showing(kind='pong', camera='dim', apart=1),)
    """
    found = []
    for part in word.split(">"):
        fits = _WORD.fullmatch(part)
        if fits is None or fits["kind"] not in STREAMS:
            raise UsageError(f"no stream {part!r}: {did_you_mean(part, STREAMS)}")
        if fits["camera"]:
            CAMERAS[fits["camera"]]
        found.append(Showing(fits["kind"], fits["camera"] or "", int(fits["apart"] or 0)))
    return tuple(found)


def make_footage(name: str, seed: int, plain: Footage | None = None) -> Footage:
    """The frames of a stream, the same ones every time.

    Args:
        name: as `Showing.name` has it.
        seed: of all its randomness.
        plain: what a good camera shows of it, where that is there already.
    """
    (showing,) = parse(name)
    kind = STREAMS[showing.kind]
    if plain is None:
        plain = kind.make(_generator(showing.kind, seed), LEARNED_FROM + HELD_OUT)
    if not showing.camera:
        return replace(plain, loops=kind.loops)
    seen = CAMERAS[showing.camera](_generator(name, seed), plain.frames)
    return Footage(seen, plain.state, plain.names, kind.loops)


def _generator(name: str, seed: int) -> Rng:
    return np.random.default_rng(np.random.SeedSequence((seed, *name.encode())))


@dataclass(frozen=True, slots=True)
class ArenaSet:
    """Streams on one clock.

    Attributes:
        words: what each shows.
        about: what the set asks of a learner.
        frames: after so many a run is stopped that does not end by itself.
        goes_on: runs are not ended before, because something happens late.
    """

    words: tuple[str, ...]
    about: str
    frames: int = 240_000
    goes_on: bool = False

    @property
    def images(self) -> bool:
        """Whether frames are pictures."""
        return all(STREAMS[s.kind].images for word in self.words for s in parse(word))


SUITE: Final = ("control", "pendulum-pong", "clips", "games", "light", "cameras")
"""The sets that are run where none is named."""

SETS: Registry[ArenaSet] = Registry(
    "set",
    {
        name: ArenaSet(tuple(entry.pop("words")), **entry)
        for name, entry in tomllib.loads(Path(__file__).with_name("sets.toml").read_text()).items()
    },
)
"""Every set; `SETS.add` adds one."""
