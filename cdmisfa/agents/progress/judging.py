"""The decisions of the progress learner: on a candidate, and on a stream, in the table of streams.

The thresholds do not depend on the units, the contrast or the noise of a stream; decision records
0025 to 0029 say how they were found.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa.agents.progress.attention import ProgressConfig
from cdmisfa.agents.progress.candidate import Candidate, log_ratio
from cdmisfa.core.signals import STATES
from cdmisfa.features.outputs import window_rate
from cdmisfa.modules import Module

# Windows of tests after which an output is settled at `learner.settled`; until then the threshold
# grows with the square of their number.
FULL = 4.5

# Windows of tests before a candidate may be rejected, and after which one without recent progress
# is.
EARLY = 0.24
PATIENCE = 8

# Variance of an output on frames not yet learned from, where its mean and scale hold.
VARIANCE_BOUNDS = (0.5, 2.0)

# Variance of a module's output, which had 1, on a stream that shows what it encodes.
PRESENT = (0.1, 10.0)

# Improvement, the log of the slowness that the candidate of a window ago has now over its own:
# above the first nothing is settled, below the second nothing was gained recently.
STILL_IMPROVING, NO_IMPROVEMENT = 0.1, 0.03

# Change over `learner.settled` from which an output has no direction at all.
NO_DIRECTION = 4.0

# Shares of the typical slowness: below the first, what was fitted is slow; above the second, it is
# no slower than the rest.
FITTED_SLOW, FITTED_FLAT = 0.65, 0.7

# Why a candidate is rejected.
REJECTIONS = (CONSTANT, NOTHING_SLOW, NO_PROGRESS) = (
    "it is constant",
    "nothing in it is slow",
    "it made no progress",
)

# Correlation from which outputs are the same, see `Likeness`.
SAME = 0.8

# Slowness of a module over the candidate's, up to which it is as slow.
AS_SLOW = 1.25

# Correlation of mean images from which they may be of one world, and variance of a mean image over
# that of frames, below which it is flat.
MEAN_CORRELATION, FLAT_MEAN = 0.65, 0.03

# A stream no longer shows what its own module encodes at a variance below the first, or below the
# second where the correlation is below `STILL_SAME`.
ABSENT, WEAK = 0.003, 0.05
STILL_SAME = 0.6

# |ln| of the slowness of a stream's module over the slowness at the decision, from which the module
# encodes other things there.
CHANGED = 0.8

LEARNING, LEARNED, KNOWN, GIVEN_UP = range(len(STATES))

# Why a stream was rejected, by the code that is stored.
REASONS = ("", *REJECTIONS)

# Reported of a stream that was learned, but hardly varied within a window of tests.
TOO_SLOW = (
    "slower than tests can tell, so it may hold for these frames only; for what takes longer to "
    "come and go raise learner.test_frames and learner.window, both as many times"
)

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
    low, high = VARIANCE_BOUNDS
    tested, fitted = candidate.tested, candidate.sfa.state.spectrum[: len(candidate.variance)]
    apart = [abs(log_ratio(float(a), float(b))) for a, b in zip(tested, fitted, strict=True)]
    alive = (low < candidate.variance) & (candidate.variance < high)
    agrees, below = np.array(apart) < config.agreement, config.slow * candidate.typical
    return np.asarray(agrees & alive & (tested < below), dtype=np.int64)


def mastered(candidate: Candidate, config: ProgressConfig) -> bool:
    """Return whether a candidate has become a module: slow on new frames too, alive, and settled.

    The change that counts as settled grows with the tests: an output that
    hardly changes is a module sooner. An output that keeps turning among directions that are
    equally slow is settled when nothing is gained by it.
    """
    windows = candidate.tests / candidate.test_window
    if windows < 1.0:
        return False
    grown = min(1.0, windows / FULL)
    firm = candidate.change < config.settled * (grown * grown)
    turning = (
        windows >= FULL
        and candidate.change < NO_DIRECTION * config.settled
        and abs(candidate.regret) < NO_IMPROVEMENT
    )
    low, high = VARIANCE_BOUNDS
    return (
        (firm or turning)
        and not candidate.regret > STILL_IMPROVING
        and disagreement(candidate) < config.agreement
        and low < float(candidate.variance[0]) < high
        and gain(candidate) < config.slow
        and flatness(candidate) < FITTED_SLOW
    )


def hopeless(candidate: Candidate, config: ProgressConfig) -> str:
    """Return why a candidate is rejected, or "" where it is not."""
    if not candidate.alive:
        return CONSTANT if candidate.blocks >= EARLY * candidate.test_window else ""
    if (
        candidate.tests >= EARLY * candidate.test_window
        and gain(candidate) > config.even
        and flatness(candidate) > FITTED_FLAT
    ):
        return NOTHING_SLOW
    if candidate.blocks >= PATIENCE * candidate.test_window:
        errors = candidate.errors
        if errors[-30:].mean() > 0.95 * errors[:-30].mean():
            return NO_PROGRESS
    return ""


def stale(candidate: Candidate, config: ProgressConfig) -> bool:
    """Return whether a candidate's feature is settled but seen no more: a single event."""
    return (
        candidate.tests >= FULL * candidate.test_window
        and candidate.change < config.settled
        and float(candidate.variance[0]) < PRESENT[0]
    )


def promising(candidate: Candidate, config: ProgressConfig) -> bool:
    """Return whether a rejected stream is worth learning after all."""
    return (
        candidate.alive
        and candidate.tests >= EARLY * candidate.test_window
        and gain(candidate) < config.slow
        and flatness(candidate) < FITTED_SLOW
    )


def known_by(
    candidate: Candidate, modules: list[Module], own: int, frames: NDArray[Any]
) -> int | None:
    """Return the index of the module that gives a candidate's feature, the stream's own first.

    Such a module is as slow on the stream as a new module must be, and the streams look alike
    in the mean: a smooth weighting follows many a thing, also in other worlds.

    Args:
        candidate: of the stream.
        modules: frozen.
        own: index of the stream's own module, -1 where it has none.
        frames: (n, I) the last block of the stream, see `RecursiveFeature.compare`.
    """
    low, high = PRESENT
    near = [index for index, module in enumerate(modules) if _alike(module, candidate)]
    for index in sorted(near, key=lambda index: index != own):
        variance, eta, rho = candidate.sfa.compare(modules[index].phi[0], frames)
        if low < variance < high and rho > SAME and eta <= AS_SLOW * candidate.fitted:
            return index
    if own in near and _shows_module(candidate, modules[own], frames):
        return own
    return None


def _alike(module: Module, candidate: Candidate) -> bool:
    """Return whether a stream looks in the mean as that of a module, where that says anything.

    It says nothing of values that are no images, nor of images that are flat in the mean.
    """
    if len(module.frame_shape) < 2:
        return True
    a, b = (mean - mean.mean() for mean in (module.mean, candidate.sfa.mean))
    one, other, shared = ((x * y).sum() for x, y in ((a, a), (b, b), (a, b)))
    flat = max(one, other) < FLAT_MEAN * candidate.sfa.state.variance.sum()
    return bool(flat or shared > MEAN_CORRELATION * math.sqrt(one * other))


def _shows_module(candidate: Candidate, module: Module, frames: NDArray[Any]) -> bool:
    """Return whether a stream shows what its own module encodes, if less and differently."""
    like = candidate.sfa.compare(module.phi[0], frames)
    if like.rho > SAME:
        return like.variance > ABSENT
    unchanged = abs(log_ratio(like.slowness, float(module.eta[0]))) < CHANGED
    if not unchanged and like.slowness > AS_SLOW * candidate.fitted:
        return False
    return like.variance > (ABSENT if like.rho > STILL_SAME else WEAK)


def new_streams(n: int) -> NDArray[Any]:
    """Return the table of n streams that were never watched, (n,) of `STREAM`."""
    streams = np.zeros(n, STREAM)
    streams["module"] = streams["next"] = -1
    streams["slowness"] = np.nan
    return streams


def decide(row: Any, state: int, module: int, slowness: float, why: int = 0) -> None:
    """Write the outcome of a stream into its row of the table."""
    row["state"], row["module"], row["why"] = state, module, why
    row["decided"], row["slowness"] = row["visits"], slowness


def begin_watching(row: Any, power: float, slowness: float) -> None:
    """Store mean square and slowness of the output of a stream's module, for `differs`."""
    turn = 2.0 * math.pi * slowness
    row["then_power"], row["then_steps"] = power, power * (turn * turn)
    row["watched"] = 0


def take_output(row: Any, y: NDArray[np.float64], window: int) -> None:
    """Average the output of a stream's module on a block, (n,)."""
    row["watched"] += 1
    rate = window_rate(window, int(row["watched"]))
    row["power"] += rate * (float(np.mean(y * y)) - row["power"])
    row["steps"] += rate * (float(np.mean(np.diff(y) ** 2)) - row["steps"])


def differs(row: Any, window: int) -> bool:
    """Return whether a stream's module gives something else there than at the decision.

    A quick, rough test: the stream is then learned again, and only that decides whether it
    shows anything new.
    """
    power, steps = float(row["power"] / row["then_power"]), float(row["steps"] / row["then_steps"])
    if row["watched"] < EARLY * window:
        return False
    low, high = PRESENT
    return not low < power < high or 0.5 * abs(log_ratio(steps, 1.0)) > CHANGED


def outcomes(
    names: Sequence[str],
    streams: NDArray[Any],
    candidates: Mapping[int, Candidate],
    test_frames: int,
) -> list[dict[str, Any]]:
    """Return the outcome of every stream, as JSON values.

    Args:
        names: of the S streams.
        streams: their table, (S,) of `STREAM`.
        candidates: by their streams.
        test_frames: frames of a window of tests, within which a slow output must vary visibly.
    """
    table = []
    for place, (name, row) in enumerate(zip(names, streams, strict=True)):
        state, module, slowness = int(row["state"]), int(row["module"]), float(row["slowness"])
        if state == LEARNING and place in candidates:
            slowness = float(candidates[place].tested[0])
        unproven = state == LEARNED and slowness * test_frames < 1.0
        table.append(
            {
                "stream": name,
                "state": STATES[state],
                "module": module + 1 if module >= 0 else None,
                "blocks": int(row["visits" if state == LEARNING else "decided"]),
                "slowness": slowness if math.isfinite(slowness) else None,
                "why": TOO_SLOW if unproven else REASONS[int(row["why"])],
            }
        )
    return table
