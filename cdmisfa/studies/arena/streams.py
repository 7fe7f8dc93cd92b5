"""The streams of the arena by their names, words for what they show, and sets of them.

A word is as `flicker:pendulum#1>acrobot`; see `parse`.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np

from cdmisfa.core.errors import UsageError
from cdmisfa.core.registry import Registry, did_you_mean
from cdmisfa.studies.arena import cameras, elsewhere, pictures
from cdmisfa.studies.arena.cameras import Camera
from cdmisfa.studies.arena.elsewhere import atari, classic, grid, photograph, robot
from cdmisfa.studies.arena.pictures import DRIFT, Footage, Maker, Rng

FRAMES: Final = 16_000
"""Of a stream, unless its `Kind` says another number."""

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
        frames: how many it has.
    """

    make: Maker
    learnable: bool = True
    loops: bool = False
    images: bool = True
    frames: int = FRAMES


CARS: Final = {"player": 14, **{f"car {k}": 108 + k for k in range(10)}}

IMAGES: Final = ("datasets", "images")
"""Where scikit-learn has its photographs."""

SAMPLES: Final = ("mpl-data", "sample_data")
"""Where Matplotlib has its own."""

PARCEL: Final = "Minduka_Present_Blue_Pack.png"

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
        "enduro": Kind(atari("Enduro")),
        "invaders": Kind(atari("SpaceInvaders", {"player": 28, "invaders": 26})),
        "bowling": Kind(atari("Bowling", {"ball x": 30, "ball y": 41})),
        "boxing": Kind(atari("Boxing", {"player x": 32, "player y": 34, "enemy x": 33})),
        "tennis": Kind(atari("Tennis", {"player x": 26, "enemy x": 27, "ball x": 16})),
        "frozenlake": Kind(grid("FrozenLake8x8-v1", 8)),
        "cliff": Kind(grid("CliffWalking-v1", 12)),
        "taxi": Kind(grid("Taxi-v4", 5, 20)),
        "ant": Kind(robot("mjcf/ant.xml", 2.2)),
        "walker": Kind(robot("mjcf/walker2d.xml", 2.2)),
        "cheetah": Kind(robot("mjcf/half_cheetah.xml", 2.2)),
        "arm": Kind(robot("kuka_iiwa/model.urdf", 2.8)),
        "china": Kind(photograph("sklearn", "scikit-learn", *IMAGES, "china.jpg")),
        "flower": Kind(photograph("sklearn", "scikit-learn", *IMAGES, "flower.jpg")),
        "parcel": Kind(photograph("matplotlib", "matplotlib", *SAMPLES, PARCEL)),
        "hopper": Kind(photograph("matplotlib", "matplotlib", *SAMPLES, "grace_hopper.jpg")),
        "bikes": Kind(elsewhere.clip("bikes"), loops=True),
        "bigbuckbunny": Kind(elsewhere.clip("bigbuckbunny"), loops=True),
        "carphone": Kind(elsewhere.clip("carphone_pristine"), loops=True),
        "icub-left": Kind(elsewhere.icub("left", "object1"), loops=True),
        "icub-center": Kind(elsewhere.icub("center", "object2"), learnable=False, loops=True),
        "icub-right": Kind(elsewhere.icub("right", "object3"), loops=True),
        "x1": Kind(pictures.oscillatory("x1", lambda a: np.sin(4 * a - np.pi / 4)), images=False),
        "x2": Kind(pictures.oscillatory("x2", lambda a: np.sin(3 * a)), images=False),
        "x3": Kind(pictures.oscillatory("x3", lambda a: np.cos(2 * a)), images=False),
        "vector-noise": Kind(pictures.vector_noise, learnable=False, images=False),
        "light": Kind(pictures.light),
        "waves": Kind(pictures.waves),
        "drift": Kind(pictures.drifting, frames=12 * DRIFT // 5),
        "noise": Kind(pictures.full_noise, learnable=False),
        "jumping": Kind(pictures.jumping, learnable=False),
        "constant": Kind(pictures.constant, learnable=False),
        "still": Kind(pictures.still, learnable=False),
        "pink": Kind(pictures.pink, learnable=False),
        "salt": Kind(pictures.salt, learnable=False),
        "speckle": Kind(pictures.speckle, learnable=False),
        "shot": Kind(pictures.shot, learnable=False),
        "bands": Kind(pictures.bands, learnable=False),
        "shuffled": Kind(elsewhere.shuffled("bikes"), learnable=False),
        **{f"gaussian-{sd:g}": Kind(pictures.gaussian_noise(sd), False) for sd in NOISE_SD},
        **{f"uniform-{sd:g}": Kind(pictures.uniform_noise(sd), False) for sd in NOISE_SD},
    },
)
"""Every stream."""

CAMERAS: Registry[Camera] = Registry(
    "camera",
    {
        "flicker": cameras.flicker,
        "shake": cameras.shake,
        "dim": cameras.low_contrast,
        "lit": cameras.lit,
        "occluded": cameras.occluded,
        "pausing": cameras.pausing,
        **cameras.SIDES,
    },
)
"""Bad cameras, what may be before one, and other sides, for any stream of pictures."""

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
    def sided(self) -> bool:
        """Whether a good camera sees it, from whatever side."""
        return self.camera in ("", *cameras.SIDES)

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
        plain = kind.make(_generator(showing.kind, seed), kind.frames)
    if showing.camera:
        plain = CAMERAS[showing.camera](_generator(name, seed), plain)
    return replace(plain, loops=kind.loops)


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
        switch_cost: frames that are lost at each change of view, as of a head that has to turn.
    """

    words: tuple[str, ...]
    about: str
    frames: int = 240_000
    goes_on: bool = False
    switch_cost: int = 0

    @property
    def images(self) -> bool:
        """Whether frames are pictures."""
        return all(STREAMS[s.kind].images for word in self.words for s in parse(word))


SETS: Registry[ArenaSet] = Registry(
    "set",
    {
        name: ArenaSet(tuple(entry.pop("words")), **entry)
        for name, entry in tomllib.loads(Path(__file__).with_name("sets.toml").read_text()).items()
    },
)
"""Every set."""

REPORTED: Final = "reported-"
"""What sets begin with on which nothing may be tuned; all others are for that."""


def chosen_sets(words: Sequence[str]) -> list[str]:
    """Names of sets: of all, of those that are `reported`, of those for `tuning`, or as named."""
    reported = [name for name in SETS if name.startswith(REPORTED)]
    groups = {
        "all": list(SETS),
        "reported": reported,
        "tuning": [name for name in SETS if name not in reported],
    }
    return [name for word in words for name in groups.get(word, [word])]
