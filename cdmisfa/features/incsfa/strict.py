"""IncSFA frame by frame, in plain order: the reference, and the fast path for few inputs.

No reassociation, one thread: the same bits on every run, however frames are cut into
calls. Across CPUs only the contraction of a*b+c may differ, and numba does not contract.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.arithmetic.compiled import compiled, inlined
from cdmisfa.core.blocks import PIXEL, UINT8
from cdmisfa.features.incsfa.state import (
    Float,
    Params,
    State,
    amnesic_weight,
    mca_step,
    mean_rate,
    rank_floor,
    whitening_scale,
)

TILE = 256
"""Columns of phi computed at a time, so that they stay in L1."""


FEW = 32
"""Up to so many inputs phi is computed weight by weight, as there is little to vectorise."""


@inlined
def centre(
    frames: NDArray[Any], t: int, scale: float, mean: Float, n: int, window: float, u: Float
) -> None:
    """Take the n-th frame (from 1) into the mean and subtract it; the very first is not centred.

    Args:
        frames: (n, I) as they came.
        t: index of the one.
        scale: 1 for values, 1/255 for pixels.
        mean: (I,) updated in place.
        n: number of this frame.
        window: frames of the running mean.
        u: (I,) receives the centred frame.
    """
    rate = mean_rate(n, window)
    for i in range(mean.shape[0]):
        x = frames[t, i] * scale
        mean[i] += rate * (x - mean[i])
        u[i] = x if n == 1 else x - mean[i]


@inlined
def ccipca_step(v: Float, d: Float, weight: float, r: Float) -> None:
    """Turn the vectors towards the principal components; r is left with what none explains.

    v_j <- (1-w) v_j + w (r.v_j)/|v_j| r, then r <- r - (r.v_j) v_j / |v_j|^2.

    Source: Weng et al. 2003.

    Args:
        v: (K, I) vectors, in place.
        d: (K,) their lengths, in place.
        weight: w, weight of the new frame.
        r: (I,) the centred frame; overwritten.
    """
    K, D = v.shape
    floor = rank_floor(d)
    projection = 0.0
    for i in range(D):
        projection += r[i] * v[0, i]
    for j in range(K):
        keep = 1.0 - weight if d[j] > floor else 1.0
        gain = weight / d[j] * projection
        square = 0.0
        projection = 0.0
        for i in range(D):
            x = keep * v[j, i] + gain * r[i]
            v[j, i] = x
            square += x * x
            projection += r[i] * x
        d[j] = np.sqrt(square)
        take = projection / square
        projection = 0.0
        following = min(j + 1, K - 1)
        for i in range(D):
            rest = r[i] - take * v[j, i]
            r[i] = rest
            projection += rest * v[following, i]


@inlined
def whiten(v: Float, scale: Float, u: Float, z: Float) -> None:
    """z_j = (u.v_j) |v_j|^-3/2, a component of unit variance.

    Args:
        v: (K, I) CCIPCA vectors.
        scale: (K,) |v_j|^-3/2, 0 for rounding noise.
        u: (I,) centred frame.
        z: (K,) receives the whitened frame.
    """
    for j in range(v.shape[0]):
        projection = 0.0
        for i in range(v.shape[1]):
            projection += u[i] * v[j, i]
        z[j] = projection * scale[j]


@inlined
def slow_features(w: Float, scale: Float, v: Float, phi: Float, row: Float) -> float:
    """Set phi to w diag(scale) v; return xi, the length of its change.

    Args:
        w: (J, K) MCA rows.
        scale: (K,) whitening scales.
        v: (K, I) CCIPCA vectors.
        phi: (J, I) weights, in place.
        row: (width,) scratch: how many columns are done at a time.
    """
    xi = 0.0
    K, size = v.shape
    if size <= FEW:
        for j in range(w.shape[0]):
            for i in range(size):
                new = 0.0
                for k in range(K):
                    new += w[j, k] * scale[k] * v[k, i]
                change = new - phi[j, i]
                xi += change * change
                phi[j, i] = new
        return float(np.sqrt(xi))
    for start in range(0, size, row.shape[0]):
        width = min(row.shape[0], size - start)
        for j in range(w.shape[0]):
            row[:] = 0.0
            for k in range(0, K - 3, 4):
                f0, f1 = w[j, k] * scale[k], w[j, k + 1] * scale[k + 1]
                f2, f3 = w[j, k + 2] * scale[k + 2], w[j, k + 3] * scale[k + 3]
                v0, v1 = v[k, start : start + width], v[k + 1, start : start + width]
                v2, v3 = v[k + 2, start : start + width], v[k + 3, start : start + width]
                for i in range(width):
                    row[i] += (f0 * v0[i] + f1 * v1[i]) + (f2 * v2[i] + f3 * v3[i])
            for k in range(K - K % 4, K):
                f0, v0 = w[j, k] * scale[k], v[k, start : start + width]
                for i in range(width):
                    row[i] += f0 * v0[i]
            old = phi[j, start : start + width]
            for i in range(width):
                change = row[i] - old[i]
                xi += change * change
                old[i] = row[i]
    return float(np.sqrt(xi))


@compiled
def update(state: State, params: Params, frames: NDArray[Any], gap: bool, xi: Float) -> None:
    """Learn from consecutive frames.

    The first frame after a gap, and the very first, update mean and whitening only.

    Args:
        state: changed in place.
        params: constants of the rule.
        frames: (n, I) float64 values or uint8 pixels; not changed.
        gap: the first frame does not follow the last one of the call before.
        xi: (n,) receives the change of phi at each frame, NaN after a gap.
    """
    n_frames, D = frames.shape
    K = state.d.shape[0]
    pixel = PIXEL if frames.dtype == UINT8 else 1.0
    nu, window = params.nu, params.mean_window
    mean, v, d, w = state.mean, state.v, state.d, state.w  # a look-up in the loop costs 10 ns
    z_prev, phi, counts = state.z_prev, state.phi, state.counts
    u, r, row = np.empty(D), np.empty(D), np.empty(min(D, TILE))
    z, z_dot, scale, step = np.empty(K), np.empty(K), np.empty(K), np.empty(K)
    for t in range(n_frames):
        counts[0] += 1
        n = counts[0]
        centre(frames, t, pixel, mean, n, window, u)
        for i in range(D):
            r[i] = u[i]
        ccipca_step(v, d, amnesic_weight(n), r)
        floor = rank_floor(d)
        for k in range(K):
            scale[k] = whitening_scale(d[k], floor)
        whiten(v, scale, u, z)
        for k in range(K):
            z_dot[k] = z[k] - z_prev[k]
            z_prev[k] = z[k]
        if n == 1 or (gap and t == 0):
            xi[t] = np.nan
            counts[1] = 1
        else:
            mca_step(w, z_dot, scale, nu, step)
            xi[t] = slow_features(w, scale, v, phi, row)
            counts[1] = 0
