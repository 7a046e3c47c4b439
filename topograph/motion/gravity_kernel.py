"""The complementary filter of roll and pitch, compiled. numba types the arguments by itself."""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True)
def gravity_kernel(q0, rate, force, dt, tau, gravity):
    n = len(rate)
    out = np.empty((n, 4))
    x, y, z, w = q0
    out[0] = q0
    for k in range(n - 1):
        h = dt[k]
        wx = 0.5 * (rate[k, 0] + rate[k + 1, 0])
        wy = 0.5 * (rate[k, 1] + rate[k + 1, 1])
        wz = 0.5 * (rate[k, 2] + rate[k + 1, 2])
        f = force[k]
        size = np.sqrt(f[0] ** 2 + f[1] ** 2 + f[2] ** 2)
        if abs(size - gravity) < 1.5:
            # Up as the attitude has it, in the body; its cross product with the force turns one onto the other.
            ux, uy, uz = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
            fx, fy, fz = f[0] / size, f[1] / size, f[2] / size
            # A turn by up x force would move the body's measured up onto the predicted one.
            wx += (fy * uz - fz * uy) / tau[k]
            wy += (fz * ux - fx * uz) / tau[k]
            wz += (fx * uy - fy * ux) / tau[k]
        rx, ry, rz = wx * h, wy * h, wz * h
        a = np.sqrt(rx * rx + ry * ry + rz * rz)
        s = np.sin(a / 2) / a if a > 1e-12 else 0.5
        c = np.cos(a / 2)
        dx, dy, dz = rx * s, ry * s, rz * s
        x, y, z, w = (
            w * dx + x * c + y * dz - z * dy,
            w * dy - x * dz + y * c + z * dx,
            w * dz + x * dy - y * dx + z * c,
            w * c - x * dx - y * dy - z * dz,
        )
        norm = np.sqrt(x * x + y * y + z * z + w * w)
        x, y, z, w = x / norm, y / norm, z / norm, w / norm
        out[k + 1, 0], out[k + 1, 1], out[k + 1, 2], out[k + 1, 3] = x, y, z, w
    return out
