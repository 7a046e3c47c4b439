"""Brings the points of a sweep into ring order, moves them to one instant, and into the base's axes."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from topograph.bags import Scan

HALF = 32
"""Ground cells of 1 m in each direction from the base."""


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


FAST = {"contract", "reassoc", "arcp", "nsz"}
"""Liberties with floating point that keep the meaning of NaN."""


@njit(cache=True, fastmath=FAST)
def organise(xyz, ring, offset, base_T_lidar, twist, n_rings, near, far):
    """Points in ring order: base-frame xyz (M, 3), horizontal range from the sensor (M,), ring starts (R+1,), the tangent
    of the highest ring's elevation, and the lowest point (2 HALF, 2 HALF) of each ground cell.

    `offset` (N,) s or empty; `twist` (6,) of the base. First the motion during the sweep is taken out, to second
    order in the sweep's time; then the points are where they were at the stamp, seen from the base then.
    """
    n = xyz.shape[0]
    R = base_T_lidar[:3, :3].astype(np.float32)
    tx, ty, tz = np.float32(base_T_lidar[0, 3]), np.float32(base_T_lidar[1, 3]), np.float32(base_T_lidar[2, 3])
    v = twist.astype(np.float32)
    vx, vy, vz, wx, wy, wz = v[0], v[1], v[2], v[3], v[4], v[5]
    half = np.float32(0.5)
    timed = offset.shape[0] == n
    count = np.zeros(n_rings + 1, np.int64)
    near2, far2 = np.float32(near * near), np.float32(far * far)
    inside = np.empty(n, np.bool_)
    for i in range(n):
        x, y, z = xyz[i, 0], xyz[i, 1], xyz[i, 2]
        d2 = x * x + y * y + z * z
        inside[i] = (d2 > near2) & (d2 < far2)  # NaN compares false
    for i in range(n):
        k = ring[i]
        inside[i] &= (k >= 0) & (k < n_rings)
        if inside[i]:
            count[k + 1] += 1
    for k in range(n_rings):
        count[k + 1] += count[k]
    starts = count.copy()
    m = count[n_rings]
    p = np.empty((m, 3), np.float32)
    r = np.empty(m, np.float32)
    fill = count[:-1].copy()
    before = np.zeros((n_rings, 2), np.float32)
    turns = np.zeros((n_rings, 2), np.int64)
    low = np.full((2 * HALF, 2 * HALF), 1e9, np.float32)
    for i in range(n):
        if not inside[i]:
            continue
        g = ring[i]
        k = fill[g]
        fill[g] = k + 1
        x, y, z = xyz[i, 0], xyz[i, 1], xyz[i, 2]
        # Order is judged before the motion is taken out: near leaves and far ground shift differently.
        side = before[g, 0] * y - before[g, 1] * x
        turns[g, 0] += side > 0
        turns[g, 1] += side < 0
        before[g, 0], before[g, 1] = x, y
        bx = R[0, 0] * x + R[0, 1] * y + R[0, 2] * z + tx
        by = R[1, 0] * x + R[1, 1] * y + R[1, 2] * z + ty
        bz = R[2, 0] * x + R[2, 1] * y + R[2, 2] * z + tz
        if timed:
            t = offset[i]
            # p + t (v + w x p) + t²/2 w x (v + w x p)
            ux, uy, uz = vx + wy * bz - wz * by, vy + wz * bx - wx * bz, vz + wx * by - wy * bx
            h = half * t * t
            bx += t * ux + h * (wy * uz - wz * uy)
            by += t * uy + h * (wz * ux - wx * uz)
            bz += t * uz + h * (wx * uy - wy * ux)
        p[k, 0], p[k, 1], p[k, 2] = bx, by, bz
        ex, ey = bx - tx, by - ty
        r[k] = np.sqrt(ex * ex + ey * ey)
        cx, cy = int(bx + HALF), int(by + HALF)
        if bx > -HALF and by > -HALF and cx < 2 * HALF and cy < 2 * HALF and bz < low[cx, cy]:
            low[cx, cy] = bz
    for k in range(n_rings):
        lo, hi = starts[k], starts[k + 1]
        if hi - lo < 3:
            continue
        # Firing order is azimuth order but for the place where the turn closes; anything else is sorted.
        if min(turns[k, 0], turns[k, 1]) > 2 + (hi - lo) // 200:
            order = np.argsort(np.arctan2(p[lo:hi, 1] - ty, p[lo:hi, 0] - tx))
            p[lo:hi] = p[lo:hi][order]
            r[lo:hi] = r[lo:hi][order]
    top = 0.26
    for k in range(n_rings - 1, -1, -1):
        if starts[k + 1] - starts[k] > 20:
            rise = 0.0
            for i in range(starts[k], starts[k + 1]):
                rise += (p[i, 2] - tz) / max(r[i], np.float32(0.1))
            top = rise / (starts[k + 1] - starts[k])
            break
    return p, r, starts, top, low


@njit(cache=True)
def angle_between(p, r, eye, i, j):
    """Angle (sine of it) between two points of a ring as the sensor sees them."""
    ax, ay, bx, by = p[i, 0] - eye[0], p[i, 1] - eye[1], p[j, 0] - eye[0], p[j, 1] - eye[1]
    return abs(ax * by - ay * bx) / (r[i] * r[j])


@njit(cache=True)
def angular_step(p, r, eye, starts):
    """Angle between neighbouring firings, rad: the commonest small step within rings, from a sample of them."""
    m = p.shape[0]
    every = max(1, m // 1200)
    out = np.empty(m // every + len(starts))
    n = 0
    for k in range(len(starts) - 1):
        for i in range(starts[k], starts[k + 1] - 1, every):
            a = angle_between(p, r, eye, i, i + 1)
            if 2e-4 < a < 0.05:
                out[n] = a
                n += 1
    if n < 50:
        return 0.0035
    steps = np.sort(out[:n])
    low = steps[int(0.3 * n)]
    last = np.searchsorted(steps, 1.6 * low)
    return min(max(steps[last // 2], 8e-4), 0.02)
