"""Brings the points of a sweep into ring order, moves them to one instant, and into the base's axes."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from topograph.bags import Scan
from topograph.geometry import Array


def rings_of(scan: Scan) -> tuple[NDArray[np.int32], int]:
    """Ring (N,) of each point from below upwards, and their number: the field, or clusters of elevation, or bins.

    A sensor with fixed lasers shows its elevations as narrow peaks; a cloud without such peaks gets half-degree bins.
    """
    if scan.ring is not None and len(scan.ring) and scan.ring.min() >= 0 and scan.ring.max() < 256:
        return scan.ring, int(scan.ring.max()) + 1
    xyz = scan.xyz
    with np.errstate(invalid="ignore"):
        elevation = np.degrees(np.arctan2(xyz[:, 2], np.hypot(xyz[:, 0], xyz[:, 1])))
    finite = np.isfinite(elevation)
    if not finite.any():
        return np.zeros(len(xyz), np.int32), 1
    count, edges = np.histogram(elevation[finite], np.arange(-91.0, 91.0, 0.05))
    full = np.flatnonzero(count > max(3, 0.0005 * finite.sum()))
    groups = np.split(full, np.flatnonzero(np.diff(full) > 2) + 1)
    share = sum(count[g[0] : g[-1] + 1].sum() for g in groups if len(g)) / finite.sum()
    narrow = len(groups) >= 4 and np.median([len(g) for g in groups]) < 6 and len(groups) <= 160 and share > 0.8
    if narrow:
        middle = np.array([0.5 * (edges[g[0]] + edges[g[-1] + 1]) for g in groups])
        split = 0.5 * (middle[1:] + middle[:-1])
    else:
        split = np.arange(-30.0, 30.0, 0.5)
    ring = np.searchsorted(split, np.where(finite, elevation, 0.0)).astype(np.int32)
    return ring, len(split) + 1


@njit(cache=True)
def organise(xyz, ring, offset, base_T_lidar, twist, n_rings, near, far):
    """Points sorted by ring, azimuth within it: base-frame xyz (M, 3), range (M,), azimuth (M,), ring starts (R+1,).

    `offset` (N,) s or empty; `twist` (6,) of the base. First the motion during the sweep is taken out, to second
    order in the sweep's time; then the points are where they were at the stamp, seen from the base then.
    """
    n = xyz.shape[0]
    R = base_T_lidar[:3, :3]
    tx, ty, tz = base_T_lidar[0, 3], base_T_lidar[1, 3], base_T_lidar[2, 3]
    vx, vy, vz, wx, wy, wz = twist[0], twist[1], twist[2], twist[3], twist[4], twist[5]
    timed = offset.shape[0] == n
    count = np.zeros(n_rings + 1, np.int64)
    distance = np.empty(n, np.float32)
    near2, far2 = near * near, far * far
    for i in range(n):
        x, y, z = xyz[i, 0], xyz[i, 1], xyz[i, 2]
        d2 = x * x + y * y + z * z
        k = ring[i]
        if near2 < d2 < far2 and 0 <= k < n_rings:  # NaN compares false
            distance[i] = np.sqrt(d2)
            count[k + 1] += 1
        else:
            distance[i] = -1.0
    for k in range(n_rings):
        count[k + 1] += count[k]
    starts = count.copy()
    m = count[n_rings]
    p = np.empty((m, 3), np.float32)
    r = np.empty(m, np.float32)
    a = np.empty(m, np.float32)
    fill = count[:-1].copy()
    for i in range(n):
        if distance[i] < 0:
            continue
        k = fill[ring[i]]
        fill[ring[i]] += 1
        x, y, z = xyz[i, 0], xyz[i, 1], xyz[i, 2]
        bx = R[0, 0] * x + R[0, 1] * y + R[0, 2] * z + tx
        by = R[1, 0] * x + R[1, 1] * y + R[1, 2] * z + ty
        bz = R[2, 0] * x + R[2, 1] * y + R[2, 2] * z + tz
        if timed:
            t = offset[i]
            # p + t (v + w x p) + t²/2 w x (v + w x p)
            ux, uy, uz = vx + wy * bz - wz * by, vy + wz * bx - wx * bz, vz + wx * by - wy * bx
            h = 0.5 * t * t
            bx, by, bz = (
                bx + t * ux + h * (wy * uz - wz * uy),
                by + t * uy + h * (wz * ux - wx * uz),
                bz + t * uz + h * (wx * uy - wy * ux),
            )
        p[k, 0], p[k, 1], p[k, 2] = bx, by, bz
        r[k] = np.sqrt(x * x + y * y)
        a[k] = np.arctan2(y, x)
    for k in range(n_rings):
        lo, hi = starts[k], starts[k + 1]
        if hi - lo < 3:
            continue
        # Firing order is azimuth order but for the place where the turn closes; anything else is sorted.
        up, down = 0, 0
        for i in range(lo + 1, hi):
            d = a[i] - a[i - 1]
            if d < 0:
                down += 1
            elif d > 0:
                up += 1
        if min(up, down) > 2 + (hi - lo) // 200:
            order = np.argsort(a[lo:hi])
            p[lo:hi] = p[lo:hi][order]
            r[lo:hi] = r[lo:hi][order]
            a[lo:hi] = a[lo:hi][order]
    return p, r, a, starts


def angular_step(azimuth: Array, starts: NDArray[np.int64]) -> float:
    """Angle between neighbouring firings, rad: the commonest small step within rings."""
    step = np.abs(np.diff(azimuth))
    step = step[(step > 2e-4) & (step < 0.05)]
    if len(step) < 50:
        return 0.0035
    low = np.percentile(step, 30)
    return float(np.clip(np.median(step[step < 1.6 * low]), 8e-4, 0.02))
