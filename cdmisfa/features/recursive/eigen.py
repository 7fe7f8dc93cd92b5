"""Eigenvectors of small symmetric matrices, the same bits whatever library numpy was built with.

Householder reduction to a tridiagonal matrix, then the implicit QL method. Reflectors and
vectors lie in rows, so that every inner loop runs along memory.

Source: Golub and Van Loan, Matrix Computations, 8.3.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.arithmetic.compiled import reordered

Float = NDArray[np.float64]

SWEEPS = 60
"""Most QL steps for one eigenvalue; two or three are what it takes."""

ROUNDING = 2.3e-16


@reordered
def eigen(matrix: Float, values: Float, vectors: Float) -> None:
    """Eigenvalues, the largest first, and the eigenvectors of a symmetric matrix.

    Args:
        matrix: (n, n), overwritten.
        values: (n,) receives the eigenvalues.
        vectors: (n, n) receives the eigenvectors, one a row.
    """
    n = matrix.shape[0]
    if n == 0:
        return
    beside, factors, row = np.zeros(n), np.zeros(n), np.empty(n)
    for k in range(n - 2):
        values[k] = matrix[k, k]
        largest = 0.0
        for i in range(k + 1, n):
            largest = max(largest, abs(matrix[i, k]))
        if largest == 0.0:
            continue
        reflector, square = vectors[k], 0.0
        for i in range(k + 1, n):
            reflector[i] = matrix[i, k] / largest
            square += reflector[i] * reflector[i]
        length = -np.sqrt(square) if reflector[k + 1] > 0.0 else np.sqrt(square)
        factors[k] = 1.0 / (square - reflector[k + 1] * length)
        reflector[k + 1] -= length
        beside[k] = length * largest
        for j in range(k + 1, n):
            row[j] = 0.0
        for i in range(k + 1, n):
            share, own = reflector[i], matrix[i]
            for j in range(k + 1, n):
                row[j] += share * own[j]
        along = 0.0
        for j in range(k + 1, n):
            row[j] *= factors[k]
            along += row[j] * reflector[j]
        along *= 0.5 * factors[k]
        for j in range(k + 1, n):
            row[j] -= along * reflector[j]
        for i in range(k + 1, n):
            share, other, own = reflector[i], row[i], matrix[i]
            for j in range(k + 1, n):
                own[j] -= share * row[j] + other * reflector[j]
    if n > 1:
        values[n - 2], beside[n - 2] = matrix[n - 2, n - 2], matrix[n - 1, n - 2]
    values[n - 1] = matrix[n - 1, n - 1]
    _reflectors_to_vectors(matrix, factors, vectors, row)
    for k in range(n):
        for _ in range(SWEEPS):
            if not _ql_step(k, values, beside, vectors):
                break
    _sort(values, vectors)


@reordered
def _reflectors_to_vectors(product: Float, factors: Float, vectors: Float, row: Float) -> None:
    """Multiply the reflectors in the rows of `vectors` out, and leave their product there."""
    n = product.shape[0]
    for i in range(n):
        for j in range(n):
            product[i, j] = 1.0 if i == j else 0.0
    for k in range(n - 3, -1, -1):
        if factors[k] == 0.0:
            continue
        reflector = vectors[k]
        for j in range(k + 1, n):
            row[j] = 0.0
        for i in range(k + 1, n):
            share, own = reflector[i], product[i]
            for j in range(k + 1, n):
                row[j] += share * own[j]
        for i in range(k + 1, n):
            share, own = reflector[i] * factors[k], product[i]
            for j in range(k + 1, n):
                own[j] -= share * row[j]
    for i in range(n):
        for j in range(n):
            vectors[j, i] = product[i, j]


@reordered
def _ql_step(first: int, values: Float, beside: Float, vectors: Float) -> bool:
    """One implicit QL step from `first` on; false where that eigenvalue stands alone already."""
    n = len(values)
    last = first
    while last < n - 1:
        if abs(beside[last]) <= ROUNDING * (abs(values[last]) + abs(values[last + 1])):
            break
        last += 1
    if last == first:
        return False
    g = (values[first + 1] - values[first]) / (2.0 * beside[first])
    r = np.sqrt(g * g + 1.0)
    g = values[last] - values[first] + beside[first] / (g + (r if g >= 0.0 else -r))
    s = c = 1.0
    p = 0.0
    for i in range(last - 1, first - 1, -1):
        f, b = s * beside[i], c * beside[i]
        r = np.sqrt(f * f + g * g)
        beside[i + 1] = r
        if r == 0.0:
            values[i + 1] -= p
            beside[last] = 0.0
            return True
        s, c = f / r, g / r
        g = values[i + 1] - p
        r = (values[i] - g) * s + 2.0 * c * b
        p = s * r
        values[i + 1] = g + p
        g = c * r - b
        below, above = vectors[i], vectors[i + 1]
        for k in range(n):
            x = above[k]
            above[k] = s * below[k] + c * x
            below[k] = c * below[k] - s * x
    values[first] -= p
    beside[first] = g
    beside[last] = 0.0
    return True


@reordered
def _sort(values: Float, vectors: Float) -> None:
    """The largest eigenvalue first, by selection: few change places."""
    n = len(values)
    for i in range(n - 1):
        k = i
        for j in range(i + 1, n):
            if values[j] > values[k]:
                k = j
        if k != i:
            values[i], values[k] = values[k], values[i]
            for j in range(n):
                vectors[i, j], vectors[k, j] = vectors[k, j], vectors[i, j]
