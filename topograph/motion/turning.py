"""The loop over IMU samples that turns them to one instant."""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, error_model="numpy")
def _rotation(v):
    """Rotation (3, 3) of a rotation vector."""
    angle2 = v[0] ** 2 + v[1] ** 2 + v[2] ** 2
    angle = np.sqrt(angle2)
    a = np.sin(angle) / angle if angle > 1e-6 else 1.0 - angle2 / 6.0
    b = (1.0 - np.cos(angle)) / angle2 if angle > 1e-6 else 0.5
    x, y, z = v[0], v[1], v[2]
    return np.array(
        [
            [1.0 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y],
            [b * x * y + a * z, 1.0 - b * (x * x + z * z), b * y * z - a * x],
            [b * x * z - a * y, b * y * z + a * x, 1.0 - b * (x * x + y * y)],
        ]
    )


@njit(cache=True, error_model="numpy")
def mean_turned(t, gyro, force):
    """Mean (3,) of `force` (N, 3) turned to t = 0 by the `gyro` (N, 3), and the rotations (3, 3) that turned the first and the last.

    `t` (N,) s, rising. Small angles over one second: their order does not matter.
    """
    n = t.shape[0]
    angle = np.zeros((n, 3))
    for i in range(1, n):
        for k in range(3):
            angle[i, k] = angle[i - 1, k] + 0.5 * (gyro[i, k] + gyro[i - 1, k]) * (t[i] - t[i - 1])
    after = 0
    while after < n and t[after] <= 0.0:
        after += 1
    now = np.empty(3)
    for k in range(3):  # the turn at t = 0; the nearest end's outside of the samples
        a, b = max(after - 1, 0), min(after, n - 1)
        share = -t[a] / (t[b] - t[a]) if b > a else 0.0
        now[k] = angle[a, k] + share * (angle[b, k] - angle[a, k])
    mean = np.zeros(3)
    first, last = np.eye(3), np.eye(3)
    for i in range(n):
        R = _rotation(angle[i] - now)
        mean += R @ force[i]
        if i == 0:
            first = R
        last = R
    return mean / n, first, last
