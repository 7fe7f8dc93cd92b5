"""What the progress learner keeps of each stream, whether or not it holds a candidate of it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa.agents.progress.candidate import Candidate
from cdmisfa.agents.progress.judging import HOPELESS, strange
from cdmisfa.core.signals import STATES
from cdmisfa.features.slowness import window_rate

LEARNING, LEARNED, KNOWN, GIVEN_UP = range(len(STATES))

REASONS = ("", *HOPELESS)
"""Why a stream was given up, by the code that is kept."""

TOO_SLOW = (
    "slower than tests can tell, so it may hold for these frames only; for what takes longer to "
    "come and go raise learner.test_frames and learner.window, both as many times"
)
"""Said of a stream that was learned, but hardly varied within a window of tests."""

STREAM = np.dtype(
    [
        ("state", "i8"),  # code in STATES
        ("module", "i8"),  # place in the modules of the one that gives its slow feature; -1 none
        ("why", "i8"),  # code in REASONS
        ("next", "i8"),  # frame after its last block; -1 where it was never watched
        ("last", "i8"),  # iteration of its last block
        ("visits", "i8"),  # blocks it was watched
        ("decided", "i8"),  # blocks it had been watched when its state was decided
        ("looks", "i8"),  # times it was begun anew after it had been given up
        ("slowness", "f8"),  # of what it came to, on frames not learned from
        ("then_power", "f8"),  # mean square of its module's output when its state was decided
        ("then_steps", "f8"),  # mean square of the differences of that
        ("power", "f8"),  # the same of late
        ("steps", "f8"),
        ("watched", "i8"),  # blocks since then
    ]
)


def new_streams(n: int) -> NDArray[Any]:
    """The table of n streams of which nothing is known, (n,) of `STREAM`."""
    streams = np.zeros(n, STREAM)
    streams["module"] = streams["next"] = -1
    streams["slowness"] = np.nan
    return streams


def decide(own: Any, state: int, module: int, slowness: float, why: int = 0) -> None:
    """Note what a stream has come to, now."""
    own["state"], own["module"], own["why"] = state, module, why
    own["decided"], own["slowness"] = own["visits"], slowness


def begin_watching(own: Any, power: float, slowness: float) -> None:
    """Note the mean square and the slowness of the output of a stream's module, to compare with."""
    turn = 2.0 * math.pi * slowness
    own["then_power"], own["then_steps"] = power, power * (turn * turn)
    own["watched"] = 0


def watch(own: Any, y: NDArray[np.float64], window: int) -> None:
    """Take the output of a stream's module on a block in, (n,)."""
    own["watched"] += 1
    rate = window_rate(window, int(own["watched"]))
    own["power"] += rate * (float(np.mean(y * y)) - own["power"])
    own["steps"] += rate * (float(np.mean(np.diff(y) ** 2)) - own["steps"])


def differs(own: Any, window: int) -> bool:
    """Whether a stream's module gives something else there than it did; see `strange`."""
    power, steps = own["power"] / own["then_power"], own["steps"] / own["then_steps"]
    return strange(float(steps), float(power), int(own["watched"]), window)


def outcomes(
    names: Sequence[str], streams: NDArray[Any], held: Mapping[int, Candidate], test_frames: int
) -> list[dict[str, Any]]:
    """The `outcome` of every stream.

    Args:
        names: of the S streams.
        streams: their table, (S,) of `STREAM`.
        held: the candidates that there are, by their stream.
        test_frames: see `outcome`.
    """
    return [
        outcome(name, streams[place], held.get(place), test_frames)
        for place, name in enumerate(names)
    ]


def outcome(name: str, own: Any, candidate: Candidate | None, test_frames: int) -> dict[str, Any]:
    """What became of a stream, as JSON values.

    Args:
        name: of the stream.
        own: its row of the table.
        candidate: of it, if one is held.
        test_frames: frames of a window of tests, within which a slow output must be seen to vary.
    """
    slowness, module = float(own["slowness"]), int(own["module"])
    learning = int(own["state"]) == LEARNING
    if learning and candidate is not None:
        slowness = float(candidate.tested[0])
    why = REASONS[int(own["why"])]
    if int(own["state"]) == LEARNED and slowness * test_frames < 1.0:
        why = TOO_SLOW
    return {
        "stream": name,
        "state": STATES[int(own["state"])],
        "module": module + 1 if module >= 0 else None,
        "blocks": int(own["visits" if learning else "decided"]),
        "slowness": slowness if math.isfinite(slowness) else None,
        "why": why,
    }
