"""The parts of the Gram kernel that work on coefficients only: K and J, never I.

CCIPCA's update needs the vectors v_j and the residual r_i of the frame only through
their inner products. With the K x K Gram matrix of the vectors these follow exactly,
in O(K^2) a frame.
"""

from __future__ import annotations

import numpy as np

from cdmisfa.core.arithmetic.compiled import reordered
from cdmisfa.features.incsfa.state import Float, rank_floor, whitening_scale


@reordered
def ccipca_coefficients(
    gram: Float,
    d: Float,
    weight: float,
    energy: float,
    e: Float,
    keep: Float,
    gain: Float,
    take: Float,
) -> None:
    """One CCIPCA step on inner products: v_j' = keep_j v_j + gain_j r_j, r -= take_j v_j'.

    Args:
        gram: (K, K) inner products v_i.v_j; brought up to date in place.
        d: (K,) lengths |v_j|; brought up to date in place.
        weight: weight of the new frame.
        energy: |u|^2 of the centred frame.
        e: (K,) u.v_j; overwritten.
        keep: (K,) receives keep_j.
        gain: (K,) receives gain_j.
        take: (K,) receives take_j.
    """
    K = d.shape[0]
    floor = rank_floor(d)
    for i in range(K):
        kept = 1.0 - weight if d[i] > floor else 1.0
        square = gram[i, i]
        g = weight * e[i] / d[i]
        updated = kept * kept * square + g * (2.0 * kept * e[i] + g * energy)
        projection = kept * e[i] + g * energy
        t = projection / updated
        row, rest = gram[i, i + 1 :], e[i + 1 :]
        for j in range(K - i - 1):
            row[j] = kept * row[j] + g * rest[j]
            rest[j] -= t * row[j]
        energy = max(energy - projection * t, 0.0)
        gram[i, i] = updated
        keep[i], gain[i], take[i] = kept, g, t
    _finish_gram(gram, keep, gain, take)
    for i in range(K):
        d[i] = np.sqrt(gram[i, i])


@reordered
def _finish_gram(gram: Float, keep: Float, gain: Float, take: Float) -> None:
    """Turn v_j'.v_i (j < i, upper triangle) into v_j'.v_i' and mirror it.

    Along a row each product waits for the one before; four rows at a time fill the wait.
    """
    K = keep.shape[0]
    p = np.zeros(4)
    for first in range(0, K, 4):
        stop = min(first + 4, K)
        for j in range(first, stop):
            rest = 0.0
            for i in range(j + 1, stop):
                x = keep[i] * gram[j, i] + gain[i] * rest
                rest -= take[i] * x
                gram[j, i] = gram[i, j] = x
            p[j - first] = rest
        a, b, c, d = p[0], p[1], p[2], p[3]
        for i in range(stop, K):
            w = keep[i] * gram[first, i] + gain[i] * a
            x = keep[i] * gram[first + 1, i] + gain[i] * b
            y = keep[i] * gram[first + 2, i] + gain[i] * c
            z = keep[i] * gram[first + 3, i] + gain[i] * d
            a -= take[i] * w
            b -= take[i] * x
            c -= take[i] * y
            d -= take[i] * z
            gram[first, i] = gram[i, first] = w
            gram[first + 1, i] = gram[i, first + 1] = x
            gram[first + 2, i] = gram[i, first + 2] = y
            gram[first + 3, i] = gram[i, first + 3] = z


@reordered
def follow(f: Float, rho: Float, first: int, keep: Float, gain: Float, take: Float) -> None:
    """Bring inner products with the vectors over one CCIPCA step.

    Any linear functional obeys f_j' = keep_j f_j + gain_j rho; rho -= take_j f_j'.

    Args:
        f: (K, m) inner products of the vectors with m frames, in place.
        rho: (m,) inner products of those frames with the step's frame; overwritten.
        first: column to start at.
        keep: (K,) the step's coefficients, as the next two.
        gain: (K,).
        take: (K,).
    """
    for j in range(f.shape[0]):
        for s in range(first, f.shape[1]):
            x = keep[j] * f[j, s] + gain[j] * rho[s]
            rho[s] -= take[j] * x
            f[j, s] = x


@reordered
def features_in_vectors(w: Float, d: Float, scale: Float, m: Float) -> None:
    """Express phi on the vectors: m = w diag(scale).

    Args:
        w: (J, K) MCA rows.
        d: (K,) lengths of the vectors.
        scale: (K,) receives the whitening scales.
        m: (J, K) receives the coefficients.
    """
    floor = rank_floor(d)
    for k in range(d.shape[0]):
        scale[k] = whitening_scale(d[k], floor)
        for j in range(w.shape[0]):
            m[j, k] = w[j, k] * scale[k]


@reordered
def change_of_features(
    m: Float,
    m_before: Float,
    gram_before: Float,
    e_before: Float,
    g: Float,
    first: int,
    last: int,
    keep: Float,
    gain: Float,
    take: Float,
    change: Float,
    delta: Float,
) -> float:
    """Length xi of the change of phi over a few frames of a group, without cancellation.

    phi' - phi = D v + sum_t delta_t u_t, with D and delta from the adjoint of the CCIPCA steps.

    Args:
        m: (J, K) phi's coefficients on the vectors after the steps.
        m_before: (J, K) phi's coefficients on those before them.
        gram_before: (K, K) inner products before them.
        e_before: (m, K) the group's inner products with the vectors before them.
        g: (m, m) the group's inner products.
        first: index of the first of the frames.
        last: index of the last.
        keep: (m, K) coefficients of the group's steps, as the next two.
        gain: (m, K).
        take: (m, K).
        change: (K,) scratch.
        delta: (m,) scratch.
    """
    J, K = m.shape
    xi = 0.0
    for r in range(J):
        for k in range(K):
            change[k] = m[r, k]
        for t in range(last, first - 1, -1):
            along = 0.0
            for k in range(K - 1, -1, -1):
                x = change[k] - take[t, k] * along
                along += gain[t, k] * x
                change[k] = keep[t, k] * x
            delta[t] = along
        for k in range(K):
            change[k] -= m_before[r, k]
        for s in range(first, last + 1):
            along = 0.0
            for k in range(K):
                along += e_before[s, k] * change[k]
            xi += 2.0 * delta[s] * along
            for t in range(first, last + 1):
                xi += delta[s] * delta[t] * g[s, t]
        for k in range(K):
            along = 0.0
            for q in range(K):
                along += gram_before[k, q] * change[q]
            xi += change[k] * along
    return float(np.sqrt(max(xi, 0.0)))
