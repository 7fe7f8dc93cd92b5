"""The streams of the arena by their names, and words such as `flicker:pendulum#1>acrobot`."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from cdmisfa.arena import environments, pictures
from cdmisfa.arena.pictures import Rng, Shown
from cdmisfa.core.errors import UsageError
from cdmisfa.core.registry import Registry, did_you_mean
from recorder.world.oscillatory import PERIOD, one_period

LEARNED_FROM: Final = 12_000
"""Frames that a learner is shown before a stream begins again."""

HELD_OUT: Final = 4_000
"""Frames after them on which it is judged."""

BEGIN_APART: Final = 997
"""Frames between the beginnings of a stream shown twice."""

NOISE_SD: Final = (0.01, 0.03, 0.1, 0.3, 1.0)
"""Of the distractors, as shares of the full range."""


@dataclass(frozen=True, slots=True)
class Kind:
    """What there is to know of a stream before it is made.

    Attributes:
        make: frames, and the state behind them, from a generator and how many are wanted.
        learnable: it has a slow feature that a linear learner can find.
        loops: its frames are few and fixed, so that it is judged on those it was learned from.
        images: its frames are pictures, and not a few values.
    """

    make: Callable[[Rng, int], Shown]
    learnable: bool = True
    loops: bool = False
    images: bool = True


SLOW_SOURCES: Mapping[str, Callable[[NDArray[Any]], NDArray[Any]]] = {
    "x1": lambda theta: np.sin(4 * theta - np.pi / 4),
    "x2": lambda theta: np.sin(3 * theta),
    "x3": lambda theta: np.cos(2 * theta),
}
"""The slow feature in each oscillatory stream."""


def oscillatory(name: str) -> Callable[[Rng, int], Shown]:
    """One of the paper's oscillatory streams, and its slow feature as the state."""

    def make(rng: Rng, n: int) -> Shown:
        index = np.arange(n) % PERIOD
        source = SLOW_SOURCES[name](2 * np.pi * index / PERIOD)
        return Shown(one_period(name)[index], source[:, None], ("slow",))

    return make


STREAMS: Registry[Kind] = Registry(
    "stream",
    {
        "pendulum": Kind(environments.classic("Pendulum-v1", 5, ("cos", "sin", "speed"))),
        "cartpole": Kind(
            environments.classic("CartPole-v1", 1, ("x", "x speed", "angle", "angle speed"))
        ),
        "acrobot": Kind(
            environments.classic(
                "Acrobot-v1", 5, ("cos 1", "sin 1", "cos 2", "sin 2", "speed 1", "speed 2")
            )
        ),
        "mountaincar": Kind(environments.classic("MountainCar-v0", 10, ("x", "speed"))),
        "pong": Kind(
            environments.atari("Pong", {"player": 51, "enemy": 50, "ball x": 49, "ball y": 54})
        ),
        "breakout": Kind(
            environments.atari("Breakout", {"player": 72, "ball x": 99, "ball y": 101})
        ),
        "freeway": Kind(
            environments.atari(
                "Freeway", {"player": 14, **{f"car {k}": 108 + k for k in range(10)}}
            )
        ),
        "bikes": Kind(environments.clip("bikes"), loops=True),
        "bigbuckbunny": Kind(environments.clip("bigbuckbunny"), loops=True),
        "carphone": Kind(environments.clip("carphone_pristine"), loops=True),
        "icub-left": Kind(environments.icub("left", "object1"), loops=True),
        "icub-center": Kind(environments.icub("center", "object2"), learnable=False, loops=True),
        "icub-right": Kind(environments.icub("right", "object3"), loops=True),
        **{name: Kind(oscillatory(name), images=False) for name in SLOW_SOURCES},
        "vector-noise": Kind(pictures.vector_noise, learnable=False, images=False),
        "light": Kind(pictures.light),
        "waves": Kind(pictures.waves),
        "noise": Kind(pictures.full_noise, learnable=False),
        "jumping": Kind(pictures.jumping, learnable=False),
        "constant": Kind(pictures.constant, learnable=False),
        "still": Kind(pictures.still, learnable=False),
        **{
            f"{name}-{sd:g}": Kind(make(sd), learnable=False)
            for name, make in (("gaussian", pictures.gaussian), ("uniform", pictures.uniform))
            for sd in NOISE_SD
        },
    },
)
"""Every stream; `STREAMS.add` adds one."""

CAMERAS: Registry[Callable[[Rng, NDArray[np.uint8]], NDArray[np.uint8]]] = Registry(
    "camera", {"flicker": pictures.flicker, "shake": pictures.shake, "dim": pictures.dim}
)
"""Bad cameras, through which any stream of pictures may be seen."""

_WORD: Final = re.compile(r"(?:(?P<camera>\w+):)?(?P<kind>[\w.-]+?)(?:#(?P<apart>\d+))?")


@dataclass(frozen=True, slots=True)
class Signal:
    """What a stream shows for a while.

    Attributes:
        kind: its name in `STREAMS`.
        camera: the camera in `CAMERAS` that sees it; "" for a good one.
        apart: shown again, it begins so many times `BEGIN_APART` frames later.
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


def parse(word: str) -> tuple[Signal, ...]:
    """What a stream shows, one thing after the other.

    Args:
        word: `CAMERA:NAME#APART`, of which only the name must be there; several such with a `>`
            between for a stream that changes.

    Raises:
        UsageError: no such stream or camera.

    Example:
        >>> parse("dim:pong#1")
        (Signal(kind='pong', camera='dim', apart=1),)
    """
    found = []
    for part in word.split(">"):
        fits = _WORD.fullmatch(part)
        if fits is None or fits["kind"] not in STREAMS:
            raise UsageError(f"no stream {part!r}: {did_you_mean(part, STREAMS)}")
        if fits["camera"]:
            CAMERAS[fits["camera"]]
        found.append(Signal(fits["kind"], fits["camera"] or "", int(fits["apart"] or 0)))
    return tuple(found)


def make(name: str, seed: int, plain: Shown | None = None) -> Shown:
    """The frames of a stream, the same ones every time.

    Args:
        name: as `Signal.name` has it.
        seed: of all its randomness.
        plain: what a good camera shows of it, where that is there already.
    """
    (signal,) = parse(name)
    if plain is None:
        rng = _generator(signal.kind, seed)
        plain = STREAMS[signal.kind].make(rng, LEARNED_FROM + HELD_OUT)
    if not signal.camera:
        return plain
    seen = CAMERAS[signal.camera](_generator(name, seed), plain.frames)
    return Shown(seen, plain.state, plain.names)


def _generator(name: str, seed: int) -> Rng:
    return np.random.default_rng(np.random.SeedSequence((seed, *name.encode())))
