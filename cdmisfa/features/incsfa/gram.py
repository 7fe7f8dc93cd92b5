"""IncSFA on the Gram matrix of the CCIPCA vectors: the fast path for images.

The trajectory is the strict kernel's up to rounding. All scalars of a frame come from
inner products (`coefficients`), and the vectors themselves are read and written once
for every four frames (`passes`); where a block's frames are all the same, they are read
and written once a block (`still`). xi has no cancellation.

Sums are reassociated, so the last digits may differ across CPUs, and between cuts of
the same frames into calls (the learner always cuts by tau); on one machine, with the
same cuts, the bits are the same on every run. No BLAS, one thread.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.arithmetic.compiled import compiled
from cdmisfa.features.incsfa.cells import all_columns, changing_cells, moving_columns, scatter
from cdmisfa.features.incsfa.coefficients import (
    ccipca_coefficients,
    change_of_features,
    features_in_vectors,
    follow,
)
from cdmisfa.features.incsfa.passes import GROUP, TILE, Work, gram_tile, new_work, run_pass
from cdmisfa.features.incsfa.state import Float, Params, State, amnesic_weight, mca_step
from cdmisfa.features.incsfa.still import new_still, settle_still

REFRESH = 1000
"""Frames after which the Gram matrix is computed from the vectors again."""

ARITHMETIC = 2
"""Version of the order in which this kernel computes, to be raised with every change of its bits:
since 2, what stands still within a block is learned apart."""

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
    """Frames of the next group: up to GROUP, but fewer where phi is older than the vectors.

    Then the group ends with the frame whose change is taken from phi itself.

    Args:
        left: frames left.
        pending: the last frame of the call before followed a gap.
        gap: the first of these frames follows a gap.
    """
    return min(left, (2 if gap else 1) if pending else GROUP)


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
    pending: bool,
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
        pending: phi is older than the vectors.
        now: brought up to date.
        xi: (count,) changes of phi; NaN where the frame follows a gap, and left alone
            where phi is to tell.
    """
    J, K = state.w.shape
    keep, gain, take = np.empty((3, GROUP, K))
    rest, scratch, z_dot = np.empty(K), np.empty(K), np.empty(K)
    rho, delta = np.empty(GROUP), np.empty(GROUP)
    m_before, gram_before, e_before = np.empty((J, K)), np.empty((K, K)), np.empty((GROUP, K))
    first = 0
    work.steps[:] = 0.0
    for t in range(count):
        if not (gap and t == 1):
            first = t
            for k in range(K):
                for j in range(J):
                    m_before[j, k] = now.m[j, k] if state.counts[0] > 0 else 0.0
                for i in range(K):
                    gram_before[k, i] = state.gram[k, i]
                for s in range(t, min(t + 2, GROUP)):
                    e_before[s, k] = work.e[k, s]
        for k in range(K):
            rest[k] = work.e[k, t]
        for s in range(GROUP):
            rho[s] = work.g[s, t]
        weight = amnesic_weight(state.counts[0] + 1)
        ccipca_coefficients(
            state.gram, state.d, weight, work.g[t, t], rest, keep[t], gain[t], take[t]
        )
        follow(work.e, rho, t, keep[t], gain[t], take[t])
        features_in_vectors(state.w, state.d, now.scale, now.m)
        for k in range(K):
            work.shrink[k] *= keep[t, k]
            work.steps[k, 2 * t] = gain[t, k] / work.shrink[k]
            work.steps[k, 2 * t + 1] = -take[t, k] * work.shrink[k]
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
        if not pending:
            xi[t] = change_of_features(
                now.m,
                m_before,
                gram_before,
                e_before,
                work.g,
                first,
                t,
                keep,
                gain,
                take,
                scratch,
                delta,
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
    now = Features(np.empty(K), np.empty((J, K)))
    if state.counts[2] == 0 or state.counts[2] >= REFRESH:
        refresh_gram(state.v, state.gram)
        state.counts[2] = 0
    state.counts[2] += n_frames
    features_in_vectors(state.w, state.d, now.scale, now.m)
    gap = gap or state.counts[0] == 0
    pending = state.counts[1] == 1
    columns = all_columns(state)
    if not pending:
        columns = moving_columns(state, changing_cells(frames, K))
    still = new_still(frames, state.mean, state.v, columns.cells)
    apart = len(still.cells) > 0
    work = new_work(columns.mean.shape[1], K, J)
    start = count = int(np.int64(0))  # a plain 0 has what is called compiled for it alone
    while True:
        new_episode = gap and start == 0
        learn_group(state, params.nu, work, count, new_episode, pending, now, xi[start:])
        start += count
        told = pending and state.counts[1] == 0
        pending = pending and not told
        following = group_length(n_frames - start, pending, gap and start == 0)
        last = following == 0
        shown = told or (last and state.counts[1] == 0)
        settle = shown or last
        for shrink in work.shrink:
            settle = settle or shrink < LEAST_SHRINK
        square = run_pass(
            state,
            columns,
            still,
            work,
            count,
            settle,
            now.m if shown and not apart else now.m[:0],
            frames,
            start,
            following,
            params.mean_window,
        )
        if told:
            xi[start - 1] = np.sqrt(square)
        if last:
            break
        count = following
    if apart:
        scatter(columns.mean, columns.cells, state.mean.reshape((1, size)))
        scatter(columns.v, columns.cells, state.v)
        settle_still(still, state.mean, state.v)
        if shown:
            # Nothing but phi: no frame is applied, none follows, none is settled. Written as 0 and
            # False the arguments would have all that is called compiled for them alone.
            whole, none = all_columns(state), following
            run_pass(
                state,
                whole,
                still,
                work,
                none,
                not apart,
                now.m,
                frames,
                none,
                none,
                params.mean_window,
            )
