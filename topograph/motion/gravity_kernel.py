"""The complementary filter of roll and pitch, compiled. numba types the arguments by itself."""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, error_model="numpy")
def gravity_kernel(q0, rate, force, dt, tau, gravity):
    n = len(rate)
    out = np.empty((n, 4))
    x, y, z, w = q0[0], q0[1], q0[2], q0[3]
    out[0, 0], out[0, 1], out[0, 2], out[0, 3] = x, y, z, w
    for k in range(n - 1):
        h = dt[k]
        wx = 0.5 * (rate[k, 0] + rate[k + 1, 0])
        wy = 0.5 * (rate[k, 1] + rate[k + 1, 1])
        wz = 0.5 * (rate[k, 2] + rate[k + 1, 2])
        f0, f1, f2 = force[k, 0], force[k, 1], force[k, 2]
        size = np.sqrt(f0 * f0 + f1 * f1 + f2 * f2)
        if abs(size - gravity) < 1.5:
            # Up as the attitude has it, in the body; its cross product with the force turns one onto the other.
            ux, uy, uz = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
            fx, fy, fz = f0 / size, f1 / size, f2 / size
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
