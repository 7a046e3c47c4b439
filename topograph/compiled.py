"""Small numerics for compiled kernels. numba compiles each of numpy's anew for every program: its percentile, median and 3x3 solve
took ten of a cold start's sixty seconds.
"""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, error_model="numpy")
def quantile(values, share):
    """Quantile of (N,) values, N > 0, linear between them (as numpy's default)."""
    a = np.sort(values)
    at = share * (a.shape[0] - 1)
    i = int(at)
    return a[i] + (at - i) * (a[min(i + 1, a.shape[0] - 1)] - a[i])


@njit(cache=True, error_model="numpy")
def determinant3(A):
    """Determinant of A (3, 3)."""
    return (
        A[0, 0] * (A[1, 1] * A[2, 2] - A[1, 2] * A[2, 1])
        - A[0, 1] * (A[1, 0] * A[2, 2] - A[1, 2] * A[2, 0])
        + A[0, 2] * (A[1, 0] * A[2, 1] - A[1, 1] * A[2, 0])
    )


@njit(cache=True, error_model="numpy")
def solve3(A, b):
    """x (3,) with A x = b for a symmetric positive definite A (3, 3), by its factors L D Lᵀ; b (3,). NaN or infinite where A is singular."""
    d0 = A[0, 0]
    l1, l2 = A[1, 0] / d0, A[2, 0] / d0
    d1 = A[1, 1] - l1 * l1 * d0
    l21 = (A[2, 1] - l2 * l1 * d0) / d1
    d2 = A[2, 2] - l2 * l2 * d0 - l21 * l21 * d1
    y1 = b[1] - l1 * b[0]
    y2 = b[2] - l2 * b[0] - l21 * y1
    x = np.empty(3)
    x[2] = y2 / d2
    x[1] = y1 / d1 - l21 * x[2]
    x[0] = b[0] / d0 - l1 * x[1] - l2 * x[2]
    return x
