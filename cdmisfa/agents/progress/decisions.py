"""Decisions of the progress learner: when a stream is learned, explained, rejected or changed.

Most functions read a `Candidate`; the others read or write the table of streams, an array of
`STREAM`. No threshold depends on the units, the contrast or the noise of a stream. Where a comment
says "benchmark seeds 100 to 105", the value was chosen on nine sets of three streams made with
these seeds, and on nothing that the published results use.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa.agents.progress.candidate import Candidate, log_ratio
from cdmisfa.agents.progress.config import ProgressConfig
from cdmisfa.core.outcomes import CONSTANT, NO_PROGRESS, NOTHING_SLOW, REJECTIONS, TOO_SLOW
from cdmisfa.core.signals import STATES
from cdmisfa.features.outputs import window_rate
from cdmisfa.modules import Module

# Test windows after which the full threshold `learner.settled` applies; before, the threshold grows
# with the square of the number of windows. Measured on the sample recording of the iCub and on six
# sets of synthetic streams (decision 0025): 5 gives the same modules and takes 3 percent more
# blocks; smaller values save an output before its slow feature was seen to vary.
SETTLING_WINDOWS = 4.5

# Test windows before a candidate may be rejected: 12 blocks with the default configuration. On the
# benchmark seeds noise had 0.95 to 1.04 of its typical slowness by then, learnable streams 0.1 to
# 0.6. Smaller values reject streams whose slow feature has not moved yet; larger ones spend more
# blocks on noise.
MIN_REJECTION_WINDOWS = 0.24

# Test windows before a candidate may be rejected for lack of progress, and after which the
# candidate of a decided stream is dropped: 16,000 frames with the default configuration, twice
# `learner.window`. Set by hand. Smaller values reject streams that pause.
MAX_STALLED_WINDOWS = 8

# No progress: the mean learning error of the last STALLED_BLOCKS blocks is above this share of the
# mean of the earlier errors in memory. Set by hand. A smaller ratio rejects streams that improve
# slowly.
STALLED_BLOCKS, STALLED_ERROR_RATIO = 30, 0.95

# Bounds of the variance of an output on frames not learned from yet; on learned frames it is 1.
# Measured on the benchmark seeds 100 to 105: with 0.3 to 3 one module was 1.38 times as fast as
# batch SFA's, with 0.5 to 2 none was.
VARIANCE_BOUNDS = (0.5, 2.0)

# Bounds of the variance of a module's output, which was 1 where it was learned, on a stream that
# shows what the module encodes. Set by hand: a factor of ten, which a change of contrast alone
# seldom reaches.
MODULE_VARIANCE_BOUNDS = (0.1, 10.0)

# Bounds of `Candidate.improvement` over one test window. Above the first a candidate still
# improves and is not saved; below the second an output that still rotates is saved. Measured on the
# benchmark seeds 100 to 105: without the first, outputs of cartpole and freeway were saved while
# they improved by 17 to 37 percent in 20 blocks; without the second they took up to 500 blocks.
IMPROVEMENT_ONGOING, IMPROVEMENT_NEGLIGIBLE = 0.1, 0.03

# Change per block, as a multiple of `learner.settled`, from which an output has no direction at
# all, even if nothing is gained. Measured: without it jumping images were learned twice with 32
# components and 20 frames a block, at a change of 0.35 (decision 0025).
ROTATING_CHANGE = 4.0

# Bounds of the fitted slowness divided by the stream's typical slowness: below the first a feature
# may be saved, above the second the stream may be rejected. Measured for the second (decision
# 0025): jumping images are rejected after 30, 24 and 18 blocks with 0.75, 0.7 and 0.65; of 153
# starts of learnable streams with 8 components 2, 6 and 12 would be rejected at once. The first is
# set by hand, below `learner.slow`.
FITTED_RATIO_SLOW, FITTED_RATIO_FLAT = 0.65, 0.7

# Correlation from which two outputs are the same feature, see `Agreement`. Measured with the next
# two constants on 176 pairs of views of one world and 7,100 pairs of different worlds (decision
# 0039): 63 percent of the former share a module, 0.75 percent of the latter do so falsely.
SAME_FEATURE_CORRELATION = 0.8

# Largest slowness of a module on a stream, as a multiple of the candidate's, at which the module
# explains the stream. The benchmark counts a feature as learned up to the same ratio. Larger values
# let smooth modules explain streams of other worlds.
SLOWNESS_TOLERANCE = 1.25

# Correlation of two mean images from which both may show one world. Measured as above: 0.6 gives
# 65 percent and 1.6 percent, 0.7 gives 61 percent and 0.24 percent.
MEAN_IMAGE_CORRELATION = 0.65

# Variance of a mean image, as a share of the variance of the frames, below which the mean image is
# flat and its correlation says nothing. Measured: 0.007 for a light on a gray wall, 0.1 and more
# for every other stream.
FLAT_MEAN_VARIANCE = 0.03

# Variance of the output of a stream's own module below which the stream no longer shows what the
# module encodes: the first if the correlation with the candidate is above OWN_MODULE_CORRELATION,
# the second otherwise. Measured on the benchmark seeds 100 to 105 over 8,000 blocks without any
# change: without these rules pong and cartpole are learned a second time in 4 of 10 runs, with them
# no stream is.
ABSENT_VARIANCE, WEAK_VARIANCE = 0.003, 0.05
OWN_MODULE_CORRELATION = 0.6

# |ln| of the slowness of a stream's module now divided by its slowness at the decision, from which
# the module encodes something else there: a factor of 2.2. Measured on eight swaps of one stream of
# three (decision 0026): all were noticed. With 0.3, and a test of the settled candidate alone,
# unchanged streams are learned again, 9 times in 20,000 blocks.
CHANGED_SLOWNESS_LOG = 0.8

LEARNING, LEARNED, EXPLAINED, REJECTED = range(len(STATES))

# Reasons by the code that is stored in the table of streams; 0 is none.
REASONS = ("", *REJECTIONS)

# One row of the table of streams. The names are part of stored states and do not change.
STREAM = np.dtype(
    [
        ("state", "i8"),  # index in STATES
        ("module", "i8"),  # index of the module that gives the stream's slow feature; -1 none
        ("why", "i8"),  # index in REASONS
        ("next", "i8"),  # number of the frame after the last block; -1 before the first block
        ("last", "i8"),  # iteration of the last block
        ("visits", "i8"),  # number of blocks
        ("decided", "i8"),  # value of `visits` at the last decision
        ("looks", "i8"),  # number of times the stream was tried again after a rejection
        ("slowness", "f8"),  # slowness at the decision, on frames not learned from
        ("then_power", "f8"),  # mean square of the module's output at the decision
        ("then_steps", "f8"),  # mean square of its differences at the decision
        ("power", "f8"),  # the same two averages over recent blocks
        ("steps", "f8"),
        ("watched", "i8"),  # number of blocks in these two averages
    ]
)


def relative_slowness(candidate: Candidate) -> float:
    """Return the tested slowness divided by the typical slowness: 1 if nothing is slow.

    Equation: P4
    """
    return float(candidate.tested[0]) / max(candidate.typical, 1e-12)


def relative_fitted_slowness(candidate: Candidate) -> float:
    """Return the fitted slowness divided by the typical slowness, see `relative_slowness`."""
    return candidate.fitted / max(candidate.typical, 1e-12)


def disagreement(candidate: Candidate) -> float:
    """Return |ln(tested / fitted)|, by how much slowness differs on new and on learned frames."""
    return abs(log_ratio(float(candidate.tested[0]), candidate.fitted))


def slow_outputs(candidate: Candidate, config: ProgressConfig) -> NDArray[np.int64]:
    """Return (J,) 1 for each output that meets the criteria of a saved slowest output, else 0."""
    low, high = VARIANCE_BOUNDS
    tested, fitted = candidate.tested, candidate.sfa.output_slowness
    apart = [abs(log_ratio(float(a), float(b))) for a, b in zip(tested, fitted, strict=True)]
    varies = (low < candidate.variance) & (candidate.variance < high)
    agrees, below = np.array(apart) < config.agreement, config.slow * candidate.typical
    return np.asarray(agrees & varies & (tested < below), dtype=np.int64)


def is_learned(candidate: Candidate, config: ProgressConfig) -> bool:
    """Return whether the slowest output may be saved: slow on new frames, varying and settled.

    The threshold of settling grows with the number of tests, so that an output that hardly changes
    is saved sooner. An output that keeps rotating among equally slow directions has settled if the
    rotation gains nothing.
    """
    windows = candidate.tests / candidate.test_window
    if windows < 1.0:
        return False
    share = min(1.0, windows / SETTLING_WINDOWS)
    settled = candidate.change < config.settled * (share * share)
    rotating = (
        windows >= SETTLING_WINDOWS
        and candidate.change < ROTATING_CHANGE * config.settled
        and abs(candidate.improvement) < IMPROVEMENT_NEGLIGIBLE
    )
    low, high = VARIANCE_BOUNDS
    return (
        (settled or rotating)
        and not candidate.improvement > IMPROVEMENT_ONGOING
        and disagreement(candidate) < config.agreement
        and low < float(candidate.variance[0]) < high
        and relative_slowness(candidate) < config.slow
        and relative_fitted_slowness(candidate) < FITTED_RATIO_SLOW
    )


def rejection_reason(candidate: Candidate, config: ProgressConfig) -> str:
    """Return the reason in `REJECTIONS` for which a stream is rejected now, or ""."""
    if not candidate.varies:
        enough = candidate.blocks >= MIN_REJECTION_WINDOWS * candidate.test_window
        return CONSTANT if enough else ""
    if (
        candidate.tests >= MIN_REJECTION_WINDOWS * candidate.test_window
        and relative_slowness(candidate) > config.even
        and relative_fitted_slowness(candidate) > FITTED_RATIO_FLAT
    ):
        return NOTHING_SLOW
    if candidate.blocks >= MAX_STALLED_WINDOWS * candidate.test_window:
        recent = candidate.errors[-STALLED_BLOCKS:].mean()
        if recent > STALLED_ERROR_RATIO * candidate.errors[:-STALLED_BLOCKS].mean():
            return NO_PROGRESS
    return ""


def has_vanished(candidate: Candidate, config: ProgressConfig) -> bool:
    """Return whether a settled feature no longer varies: it followed a single event."""
    return (
        candidate.tests >= SETTLING_WINDOWS * candidate.test_window
        and candidate.change < config.settled
        and float(candidate.variance[0]) < MODULE_VARIANCE_BOUNDS[0]
    )


def is_promising(candidate: Candidate, config: ProgressConfig) -> bool:
    """Return whether the candidate of a rejected stream has found something slow after all."""
    return (
        candidate.varies
        and candidate.tests >= MIN_REJECTION_WINDOWS * candidate.test_window
        and relative_slowness(candidate) < config.slow
        and relative_fitted_slowness(candidate) < FITTED_RATIO_SLOW
    )


def explaining_module(
    candidate: Candidate, modules: Mapping[int, Module], previous: int, frames: NDArray[Any]
) -> int | None:
    """Return the index of the saved module that gives a candidate's feature, or None.

    Such a module is as slow on the stream as a new module must be, and the mean images are alike:
    without the second condition a smooth weighting of pixels follows many features of other worlds.

    Args:
        candidate: candidate of the stream.
        modules: the saved modules for frames of the candidate's kind, by index.
        previous: index of the module that the stream had before, tried first; -1 for none.
        frames: (n, I) the last block of the stream, see `RecursiveFeature.compare`.
    """
    low, high = MODULE_VARIANCE_BOUNDS
    similar = [i for i, module in modules.items() if _similar_mean(module, candidate)]
    for index in sorted(similar, key=lambda index: index != previous):
        variance, eta, rho = candidate.sfa.compare(modules[index].phi[0], frames)
        if (
            low < variance < high
            and rho > SAME_FEATURE_CORRELATION
            and eta <= SLOWNESS_TOLERANCE * candidate.fitted
        ):
            return index
    if previous in similar and _still_applies(candidate, modules[previous], frames):
        return previous
    return None


def _similar_mean(module: Module, candidate: Candidate) -> bool:
    """Return whether the mean images of a module and of a candidate's stream are alike.

    Values that are no images, and mean images that are flat, count as alike.
    """
    if len(module.frame_shape) < 2:
        return True
    a, b = (mean - mean.mean() for mean in (module.mean, candidate.sfa.mean))
    square_a, square_b, product = ((x * y).sum() for x, y in ((a, a), (b, b), (a, b)))
    flat = max(square_a, square_b) < FLAT_MEAN_VARIANCE * candidate.sfa.state.variance.sum()
    return bool(flat or product > MEAN_IMAGE_CORRELATION * math.sqrt(square_a * square_b))


def _still_applies(candidate: Candidate, module: Module, frames: NDArray[Any]) -> bool:
    """Return whether a stream still shows what its own module encodes, if more weakly."""
    agreement = candidate.sfa.compare(module.phi[0], frames)
    if agreement.rho > SAME_FEATURE_CORRELATION:
        return agreement.variance > ABSENT_VARIANCE
    same = abs(log_ratio(agreement.slowness, float(module.eta[0]))) < CHANGED_SLOWNESS_LOG
    if not same and agreement.slowness > SLOWNESS_TOLERANCE * candidate.fitted:
        return False
    least = ABSENT_VARIANCE if agreement.rho > OWN_MODULE_CORRELATION else WEAK_VARIANCE
    return agreement.variance > least


def new_streams(n: int) -> NDArray[Any]:
    """Return the table of n streams before their first block, (n,) of `STREAM`."""
    streams = np.zeros(n, STREAM)
    streams["module"] = streams["next"] = -1
    streams["slowness"] = np.nan
    return streams


def record_decision(row: Any, state: int, module: int, slowness: float, reason: int = 0) -> None:
    """Write a decision into the stream's row of the table.

    Args:
        row: the row, changed in place.
        state: LEARNING, LEARNED, EXPLAINED or REJECTED.
        module: index of the module that gives the stream's slow feature; -1 for none.
        slowness: slowness on frames not learned from (cycles a frame).
        reason: index in `REASONS`.
    """
    row["state"], row["module"], row["why"] = state, module, reason
    row["decided"], row["slowness"] = row["visits"], slowness


def start_monitoring(row: Any, power: float, slowness: float) -> None:
    """Store mean square and slowness of the output of a stream's module, for `output_changed`."""
    turn = 2.0 * math.pi * slowness
    row["then_power"], row["then_steps"] = power, power * (turn * turn)
    row["watched"] = 0


def monitor_output(row: Any, y: NDArray[np.float64], window: int) -> None:
    """Update the running averages of a stream's row with its module's output on a block.

    Args:
        row: the row, changed in place.
        y: (n,) the output.
        window: exponential window of the averages (blocks).
    """
    row["watched"] += 1
    rate = window_rate(window, int(row["watched"]))
    row["power"] += rate * (float(np.mean(y * y)) - row["power"])
    row["steps"] += rate * (float(np.mean(np.diff(y) ** 2)) - row["steps"])


def output_changed(row: Any, window: int) -> bool:
    """Return whether the output of a stream's module differs from the output at the decision.

    The test is quick and rough: a stream that fails it is learned again, and only the new
    candidate decides whether the stream shows anything new.
    """
    power, steps = float(row["power"] / row["then_power"]), float(row["steps"] / row["then_steps"])
    if row["watched"] < MIN_REJECTION_WINDOWS * window:
        return False
    return not novelty([power], [steps]) <= 1.0


def novelty(power: Sequence[float], steps: Sequence[float]) -> float:
    """Return how far a module's outputs are from those in training; above 1 they have changed.

    The arguments are recent averages divided by the averages in training, for one or more outputs.
    The value is 1 where the power differs by `MODULE_VARIANCE_BOUNDS`, or the speed by
    `CHANGED_SLOWNESS_LOG`, in the mean of the logarithms over the outputs.
    """
    power_log, steps_log = (
        sum(abs(log_ratio(ratio, 1.0)) for ratio in ratios) / len(ratios)
        for ratios in (power, steps)
    )
    widest = log_ratio(MODULE_VARIANCE_BOUNDS[1], 1.0)
    return max(power_log / widest, 0.5 * steps_log / CHANGED_SLOWNESS_LOG)


def outcomes(
    names: Sequence[str],
    streams: NDArray[Any],
    candidates: Mapping[int, Candidate],
    test_frames: int,
) -> list[dict[str, Any]]:
    """Return the outcome of every stream, as JSON values.

    Args:
        names: names of the S streams.
        streams: the table of streams, (S,) of `STREAM`.
        candidates: the candidates by index of their stream.
        test_frames: length of a test window (frames), within which a slow output must vary.
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
