"""IncSFA on the Gram matrix of the CCIPCA vectors: the fast path for images.

The trajectory is the strict kernel's up to rounding. All scalars of a frame come from
inner products (`coefficients`), and the vectors themselves are read and written once
for every four frames (`passes`). xi has no cancellation.

Sums are reassociated, so the last digits may differ across CPUs, and between cuts of
the same frames into calls (the learner always cuts by tau); on one machine, with the
same cuts, the bits are the same on every run. No BLAS, one thread.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.arithmetic.compiled import compiled
from cdmisfa.features.incsfa.coefficients import (
    ccipca_coefficients,
    change_of_features,
    features_in_vectors,
    follow,
)
from cdmisfa.features.incsfa.passes import GROUP, TILE, Work, gram_tile, new_work, run_pass
from cdmisfa.features.incsfa.state import Float, Params, State, amnesic_weight, mca_step

REFRESH = 1000
"""Frames after which the Gram matrix is computed from the vectors again."""


LEAST_SHRINK = 0.01
"""Where the vectors have shrunk by more than this, they are brought to length."""


class Features(NamedTuple):
    """The slow features after the last frame, on the CCIPCA vectors.

    Attributes:
        scale: (K,) whitening scales.
        m: (J, K) phi = m v.
    """

    scale: Float
    m: Float


@compiled
def group_length(left: int, pending: bool, gap: bool) -> int:
    """Frames of the next group: up to GROUP, but one after a gap ends with its second frame.

    That frame's change spans two steps and is taken from phi itself.

    Args:
        left: frames left.
        pending: the frame before followed a gap.
        gap: the first of these frames follows a gap.
    """
    return min(left, 2 if gap else 1 if pending else GROUP)


@compiled
def refresh_gram(v: Float, gram: Float) -> None:
    """Compute the inner products of the vectors anew.

    Args:
        v: (K, I) CCIPCA vectors.
        gram: (K, K) receives v v^T.
    """
    gram[:] = 0.0
    for start in range(0, v.shape[1], TILE):
        gram_tile(v, start, min(TILE, v.shape[1] - start), gram)


@compiled
def learn_group(
    state: State,
    nu: float,
    work: Work,
    count: int,
    gap: bool,
    now: Features,
    xi: Float,
) -> None:
    """Learn from a group's inner products: everything but `state.v` and `state.phi`.

    Args:
        state: gram, d, w, z_prev and counts are brought up to date.
        nu: learning rate of MCA.
        work: the group; receives its steps, and e is overwritten.
        count: frames in the group.
        gap: its first frame follows a gap.
        now: brought up to date.
        xi: (count,) changes of phi; NaN where the frame follows a gap, and left alone
            where the frame before does.
    """
    J, K = state.w.shape
    keep, gain, take = np.empty(K), np.empty(K), np.empty(K)
    e, scratch, z_dot = np.empty(K), np.empty(K), np.empty(K)
    rho, m_before, gram_before = np.empty(GROUP), np.empty((J, K)), np.empty((K, K))
    work.steps[:] = 0.0
    for t in range(count):
        energy = work.g[t, t]
        gram_before[:] = state.gram
        m_before[:] = now.m
        for k in range(K):
            e[k] = scratch[k] = work.e[k, t]
        for s in range(GROUP):
            rho[s] = work.g[s, t]
        weight = amnesic_weight(state.counts[0] + 1)
        ccipca_coefficients(state.gram, state.d, weight, energy, scratch, keep, gain, take)
        follow(work.e, rho, t, keep, gain, take)
        features_in_vectors(state.w, state.d, now.scale, now.m)
        for k in range(K):
            work.shrink[k] *= keep[k]
            work.steps[k, 2 * t] = gain[k] / work.shrink[k]
            work.steps[k, 2 * t + 1] = -take[k] * work.shrink[k]
            z = work.e[k, t] * now.scale[k]
            z_dot[k] = z - state.z_prev[k]
            state.z_prev[k] = z
        state.counts[0] += 1
        if gap and t == 0:
            xi[t] = np.nan
            state.counts[1] = 1
            continue
        mca_step(state.w, z_dot, now.scale, nu, scratch)
        features_in_vectors(state.w, state.d, now.scale, now.m)
        if state.counts[1] == 0:
            xi[t] = change_of_features(
                now.m, m_before, gram_before, e, energy, keep, gain, take, scratch
            )
        state.counts[1] = 0


@compiled
def update(state: State, params: Params, frames: NDArray[Any], gap: bool, xi: Float) -> None:
    """Learn from consecutive frames; the trajectory is that of `strict.update`.

    Args:
        state: changed in place.
        params: constants of the rule.
        frames: (n, I) float64 values or uint8 pixels; not changed.
        gap: the first frame does not follow the last one of the call before.
        xi: (n,) receives the change of phi at each frame, NaN after a gap.
    """
    n_frames, size = frames.shape
    J, K = state.w.shape
    work = new_work(size, K, J)
    now = Features(np.empty(K), np.empty((J, K)))
    if state.counts[2] == 0 or state.counts[2] >= REFRESH:
        refresh_gram(state.v, state.gram)
        state.counts[2] = 0
    state.counts[2] += n_frames
    features_in_vectors(state.w, state.d, now.scale, now.m)
    gap = gap or state.counts[0] == 0
    start = count = 0
    while True:
        new_episode = gap and start == 0
        spans = count > (1 if new_episode else 0) and (new_episode or state.counts[1] == 1)
        learn_group(state, params.nu, work, count, new_episode, now, xi[start:])
        start += count
        following = group_length(n_frames - start, state.counts[1] == 1, gap and start == 0)
        shown = spans or (following == 0 and state.counts[1] == 0)
        settle = shown or following == 0 or work.shrink.min() < LEAST_SHRINK
        m = now.m if shown else now.m[:0]
        square = run_pass(
            state, work, count, settle, m, frames, start, following, params.mean_window
        )
        if spans:
            xi[start - 1] = np.sqrt(square)
        if following == 0:
            break
        count = following
