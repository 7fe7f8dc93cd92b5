"""The sets of streams that learners are compared on, each a list of words; see `streams.parse`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from cdmisfa.arena.source import CHANGE
from cdmisfa.arena.streams import NOISE_SD, STREAMS, parse
from cdmisfa.core.registry import Registry

NOISES: Final = tuple(f"{name}-{sd:g}" for name in ("gaussian", "uniform") for sd in NOISE_SD)

DISTRACTORS: Final = ("noise", *NOISES, "jumping", "constant", "still")

CONTROL: Final = ("pendulum", "cartpole", "acrobot", "mountaincar")

GAMES: Final = ("pong", "breakout", "freeway")


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
        "control": ArenaSet(("cartpole", "acrobot", "mountaincar"), "three simulated tasks"),
        "pendulum-pong": ArenaSet(("pendulum", "noise", "pong"), "noise among two streams"),
        "clips": ArenaSet(("bikes", "bigbuckbunny", "carphone"), "short videos that loop"),
        "games": ArenaSet(("freeway", "breakout", "noise"), "two games, and noise"),
        "light": ArenaSet(("light", "still", "noise"), "drifting light; all else is noise"),
        "cameras": ArenaSet(
            ("flicker:pendulum", "shake:mountaincar", "dim:pong"), "three bad cameras"
        ),
        "oscillatory": ArenaSet(("x1", "x2", "x3"), "the paper's oscillatory streams"),
        "oscillatory-noise": ArenaSet(
            ("x1", "x2", "x3", "vector-noise"), "the paper's streams, and noise beside them"
        ),
        "icub": ArenaSet(
            ("icub-left", "icub-center", "icub-right"), "the paper's robot: a recording that loops"
        ),
        "noises": ArenaSet(("pendulum", *NOISES), "noise of every strength"),
        "distractors": ArenaSet(
            ("mountaincar", "noise", "jumping", "constant", "still"), "what has nothing slow"
        ),
        "twice": ArenaSet(("pendulum", "pendulum#1", "pong"), "the same stream twice"),
        "change": ArenaSet(
            ("pendulum>freeway", "mountaincar", "noise"),
            f"the first stream changes at frame {CHANGE}",
            goes_on=True,
        ),
        "change-to-noise": ArenaSet(
            ("pendulum", "mountaincar>noise", "noise>pong"),
            f"at frame {CHANGE} one stream ends in noise, and one comes out of it",
            goes_on=True,
        ),
        "unchanged": ArenaSet(
            (*CONTROL, *GAMES, "light", "noise"),
            "nothing changes in 20,000 blocks: no module may come twice",
            frames=800_000,
            goes_on=True,
        ),
        "five-of-twenty": ArenaSet(
            (*CONTROL, "pong", *DISTRACTORS, "noise#1"), "five learnable streams among twenty"
        ),
        "hundred": ArenaSet(
            (
                *CONTROL,
                *GAMES,
                "light",
                *(f"{camera}:{name}" for camera in ("flicker", "shake") for name in CONTROL),
                *(f"{name}#{k}" for k in range(1, 7) for name in DISTRACTORS),
            ),
            "sixteen learnable streams among a hundred",
            frames=1_000_000,
        ),
        "small": ArenaSet(
            ("waves", "light", "gaussian-0.1"), "made by numpy alone: to try the arena", 60_000
        ),
    },
)
"""Every set; `SETS.add` adds one."""
