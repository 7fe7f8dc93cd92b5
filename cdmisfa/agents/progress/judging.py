"""What is kept of each stream, and what is decided of it from its candidate."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa.agents.progress.candidate import Candidate, log_ratio
from cdmisfa.agents.progress.config import ProgressConfig
from cdmisfa.core.signals import STATES
from cdmisfa.features.outputs import window_rate
from cdmisfa.modules import Module

FULL = 4.5
"""Windows of tests after which an output counts as settled at `learner.settled`; until then the
threshold grows with the square of their number."""

STILL_GAINING = 0.1
"""Regret above which nothing is settled, however little the output changes with a block."""

HOPELESS = (CONSTANT, NOTHING_SLOW, NO_PROGRESS) = (
    "it is constant",
    "nothing in it is slow",
    "it made no progress",
)
"""Why a candidate is given up."""

EARLY = 0.24
"""Windows of tests before a candidate may be given up."""

PATIENCE = 8
"""Windows of tests after which a candidate that has made no progress of late is given up."""

LIVELY = (0.5, 2.0)
"""Variance of an output on frames not yet learned from, where its mean and scale hold."""

PASSED_ON = 0.03
"""Regret below which nothing was gained of late, however much the output changes."""

TURNING = 4.0
"""Change over `learner.settled` from which an output has no direction at all."""

SLOW_AGAIN = 0.65
"""Share of the typical slowness below which what was fitted counts as slow."""

TOO_EVEN = 0.7
"""Share of the typical slowness above which what was fitted counts as no slower than the rest."""

PRESENT = (0.1, 10.0)
"""Variance of a module's output, which had 1, on a stream that shows what it encodes."""

SAME = 0.8
"""Correlation from which outputs are the same, see `Likeness`."""

ALIKE = 0.65
"""Correlation of mean pictures from which they may be of one world."""

EVEN = 0.03
"""Variance of a mean picture over that of frames, below which it is even."""

AS_SLOW = 1.25
"""Slowness of a module over the candidate's, up to which it is as slow."""

FAINT = 0.003
"""Variance below which a stream does not show what its own module encodes at all."""

WEAK, STILL_SAME = 0.05, 0.6
"""Variance and correlation from which a stream still shows what its own module encodes."""

STRANGE = 0.8
"""|ln| of the slowness of a stream's module over that of then, from which it gives other things."""


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


def gain(candidate: Candidate) -> float:
    """Tested slowness over that of the stream's typical direction: 1 where nothing is slow.

    Equation: P4
    """
    return float(candidate.tested[0]) / max(candidate.typical, 1e-12)


def flatness(candidate: Candidate) -> float:
    """Fitted slowness over that of the stream's typical direction, see `gain`."""
    return candidate.fitted / max(candidate.typical, 1e-12)


def disagreement(candidate: Candidate) -> float:
    """|ln(tested / fitted)|: what the slowness on new frames says of that on old ones."""
    return abs(log_ratio(float(candidate.tested[0]), candidate.fitted))


def slow_outputs(candidate: Candidate, config: ProgressConfig) -> NDArray[np.int64]:
    """(J,) 1 where an output is slow on new frames too, and alive; the slowest was judged so."""
    low, high = LIVELY
    tested, fitted = candidate.tested, candidate.sfa.state.spectrum[: len(candidate.variance)]
    apart = [abs(log_ratio(float(a), float(b))) for a, b in zip(tested, fitted, strict=True)]
    alive = (low < candidate.variance) & (candidate.variance < high)
    agrees, below = np.array(apart) < config.agreement, config.slow * candidate.typical
    return np.asarray(agrees & alive & (tested < below), dtype=np.int64)


def mastered(candidate: Candidate, config: ProgressConfig) -> bool:
    """Whether a candidate has become a module: slow on new frames too, alive, and settled.

    The change that counts as settled grows with the tests: the firmer an output stands, the
    sooner it is a module. An output that goes on turning among directions that are equally slow
    is settled when nothing is gained by it.
    """
    windows = candidate.tests / candidate.test_window
    if windows < 1.0:
        return False
    grown = min(1.0, windows / FULL)
    firm = candidate.change < config.settled * (grown * grown)
    turning = (
        windows >= FULL
        and candidate.change < TURNING * config.settled
        and abs(candidate.regret) < PASSED_ON
    )
    low, high = LIVELY
    return (
        (firm or turning)
        and not candidate.regret > STILL_GAINING
        and disagreement(candidate) < config.agreement
        and low < float(candidate.variance[0]) < high
        and gain(candidate) < config.slow
        and flatness(candidate) < SLOW_AGAIN
    )


def hopeless(candidate: Candidate, config: ProgressConfig) -> str:
    """Why a candidate is given up, or "" where it is not."""
    if not candidate.alive:
        return CONSTANT if candidate.blocks >= EARLY * candidate.test_window else ""
    if (
        candidate.tests >= EARLY * candidate.test_window
        and gain(candidate) > config.even
        and flatness(candidate) > TOO_EVEN
    ):
        return NOTHING_SLOW
    if candidate.blocks >= PATIENCE * candidate.test_window:
        errors = candidate.errors
        if errors[-30:].mean() > 0.95 * errors[:-30].mean():
            return NO_PROGRESS
    return ""


def stale(candidate: Candidate, config: ProgressConfig) -> bool:
    """Whether what a candidate found is settled but seen no more: it was a single event."""
    return (
        candidate.tests >= FULL * candidate.test_window
        and candidate.change < config.settled
        and float(candidate.variance[0]) < PRESENT[0]
    )


def promising(candidate: Candidate, config: ProgressConfig) -> bool:
    """Whether a stream that was given up is worth learning after all."""
    return (
        candidate.alive
        and candidate.tests >= EARLY * candidate.test_window
        and gain(candidate) < config.slow
        and flatness(candidate) < SLOW_AGAIN
    )


def alike(module: Module, candidate: Candidate) -> bool:
    """Whether a stream looks in the mean as that of a module, where that says anything.

    It says nothing of values that are no pictures, nor of pictures that are even in the mean.
    """
    if len(module.frame_shape) < 2:
        return True
    a, b = (mean - mean.mean() for mean in (module.mean, candidate.sfa.mean))
    one, other, shared = ((x * y).sum() for x, y in ((a, a), (b, b), (a, b)))
    even = max(one, other) < EVEN * candidate.sfa.state.variance.sum()
    return bool(even or shared > ALIKE * math.sqrt(one * other))


def known_by(
    candidate: Candidate, modules: list[Module], own: int, frames: NDArray[Any]
) -> int | None:
    """Index in `modules` of the one that gives what the candidate found, its own first, if any.

    That is as slow there as what is learned must be, and the streams look `alike`: a smooth
    weighting follows many a thing, of other worlds, too.

    Args:
        candidate: what was found.
        modules: frozen.
        own: index of the stream's own module, -1 where it has none.
        frames: (n, I) the last block of the stream, see `RecursiveFeature.compare`.
    """
    low, high = PRESENT
    near = [index for index, module in enumerate(modules) if alike(module, candidate)]
    for index in sorted(near, key=lambda index: index != own):
        variance, eta, rho = candidate.sfa.compare(modules[index].phi[0], frames)
        if low < variance < high and rho > SAME and eta <= AS_SLOW * candidate.fitted:
            return index
    if own in near and _still_there(candidate, modules[own], frames):
        return own
    return None


def _still_there(candidate: Candidate, module: Module, frames: NDArray[Any]) -> bool:
    """Whether a stream shows what its own module encodes, at times less and differently."""
    like = candidate.sfa.compare(module.phi[0], frames)
    if like.rho > SAME:
        return like.variance > FAINT
    itself = abs(log_ratio(like.slowness, float(module.eta[0]))) < STRANGE
    if not itself and like.slowness > AS_SLOW * candidate.fitted:
        return False
    return like.variance > (FAINT if like.rho > STILL_SAME else WEAK)


def strange(steps: float, power: float, blocks: int, window: int) -> bool:
    """Whether a stream's module gives something else there than when the stream was decided.

    A quick, rough test: the stream is then learned again, and only that decides whether it
    shows anything new.

    Args:
        steps: recent mean square of the differences of its output, over that of then.
        power: recent mean square of its output, over that of then.
        blocks: blocks behind both.
        window: blocks of a window of tests.
    """
    low, high = PRESENT
    if blocks < EARLY * window:
        return False
    return not low < power < high or 0.5 * abs(log_ratio(steps, 1.0)) > STRANGE


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


def take_output(own: Any, y: NDArray[np.float64], window: int) -> None:
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
