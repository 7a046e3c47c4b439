"""Brings the points of a sweep into ring order, moves them to one instant, and into the base's axes."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from topograph.bags import Scan
from topograph.geometry import Array

FAST = {"contract", "reassoc", "arcp", "nsz"}
"""Liberties with floating point that keep the meaning of NaN."""
HALF = 32
"""Ground cells of 1 m in each direction from the base."""


def rings_of(scan: Scan, flipped: bool = False) -> tuple[NDArray[np.int32], Array]:
    """Ring (N,) of each point, counted from below upwards, and the tangent (R,) of each ring's elevation in the sensor's
    frame: lasers by the field, whatever their numbers, or clusters of elevation, or bins. `flipped`: the sensor hangs
    upside down.

    A sensor with fixed lasers shows its elevations as narrow peaks; a cloud without such peaks gets half-degree bins.
    """
    xyz = scan.xyz
    ring = scan.ring
    if ring is None or not len(ring) or ring.min() < 0 or ring.max() >= MOST_RINGS:
        ring = _clusters(xyz)
    full, total, n = _rise(xyz, ring, int(ring.max()) + 1, SAMPLE)
    if (n[full > 0] < 3).any():
        _, total, n = _rise(xyz, ring, len(n), 1)
    tangent = total / np.maximum(n, 1)
    tangent[n == 0] = np.inf  # nothing was returned: no place among the others
    order = np.argsort(-tangent if flipped else tangent, kind="stable")
    rank = np.empty(len(n), np.int32)
    rank[order] = np.arange(len(n))
    some = int((n > 0).sum())
    if flipped:  # rings without returns came first
        order, rank = order[len(n) - some :], rank - (len(n) - some)
    out = ring if np.array_equal(rank, np.arange(len(n))) else rank[ring]
    return out.astype(np.int32, copy=False), tangent[order[:some]]


MOST_RINGS = 512
"""A ring field with more than this is none."""
SAMPLE = 7
"""Every so-manieth point tells a ring's elevation; no divisor of the usual numbers of lasers, which fire in turn."""


@njit(cache=True)
def _rise(xyz, ring, n, every):
    """Points (n,) of each ring; sum of tangents of elevation and their number, (n,), of every so-manieth point."""
    full, count, total = np.zeros(n, np.int64), np.zeros(n, np.int64), np.zeros(n)
    for i in range(len(ring)):
        full[ring[i]] += 1
    for i in range(0, len(ring), every):
        x, y = xyz[i, 0], xyz[i, 1]
        flat = np.sqrt(x * x + y * y)
        if flat > 0.0 and np.isfinite(flat) and np.isfinite(xyz[i, 2]):
            total[ring[i]] += xyz[i, 2] / flat
            count[ring[i]] += 1
    return full, total, count


def _clusters(xyz: NDArray[np.float32]) -> NDArray[np.int32]:
    """Ring (N,) of points without a ring field."""
    with np.errstate(invalid="ignore"):
        elevation = np.degrees(np.arctan2(xyz[:, 2], np.hypot(xyz[:, 0], xyz[:, 1])))
    finite = np.isfinite(elevation)
    if not finite.any():
        return np.zeros(len(xyz), np.int32)
    count, edges = np.histogram(elevation[finite], np.arange(-91.0, 91.0, 0.05))
    full = np.flatnonzero(count > max(3, 0.0005 * finite.sum()))
    groups = np.split(full, np.flatnonzero(np.diff(full) > 2) + 1)
    share = sum(count[g[0] : g[-1] + 1].sum() for g in groups if len(g)) / finite.sum()
    narrow = len(groups) >= 4 and np.median([len(g) for g in groups]) < 6 and len(groups) <= 160 and share > 0.8
    if narrow:
        middle = np.array([0.5 * (edges[g[0]] + edges[g[-1] + 1]) for g in groups])
        split = 0.5 * (middle[1:] + middle[:-1])
    else:
        split = np.arange(-60.0, 60.0, 0.5)
    return np.searchsorted(split, np.where(finite, elevation, 0.0)).astype(np.int32)


def once(scan: Scan) -> Scan:
    """The scan without its second half where that repeats the first."""
    half = len(scan.xyz) // 2
    if half == 0 or len(scan.xyz) % 2 or not np.array_equal(scan.xyz[:2], scan.xyz[half : half + 2]):
        return scan
    if not np.array_equal(scan.xyz[:half], scan.xyz[half:], equal_nan=True):
        return scan
    ring = None if scan.ring is None else scan.ring[:half]
    offset = None if scan.offset is None else scan.offset[:half]
    intensity = None if scan.intensity is None else scan.intensity[:half]
    return Scan(scan.stamp_ns, scan.frame, scan.xyz[:half], ring, offset, intensity)


@njit(cache=True, fastmath=FAST)
def organise(xyz, ring, offset, base_T_lidar, twist, n_rings, near, far):
    """Points in ring order: base-frame xyz (M, 3), horizontal range from the sensor (M,), horizontal direction from it (M, 2),
    ring starts (R+1,), and the lowest point (2 HALF, 2 HALF) of each ground cell. A point that repeats the one before it in
    its ring is dropped.

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
    before = np.zeros((n_rings, 3), np.float32)
    for i in range(n):
        k = ring[i]
        inside[i] &= (k >= 0) & (k < n_rings)
        if timed and offset[i] != offset[i]:  # NaN: nobody knows when
            inside[i] = False
        if inside[i]:
            if before[k, 0] == xyz[i, 0] and before[k, 1] == xyz[i, 1] and before[k, 2] == xyz[i, 2]:
                inside[i] = False
                continue
            before[k, 0], before[k, 1], before[k, 2] = xyz[i, 0], xyz[i, 1], xyz[i, 2]
            count[k + 1] += 1
    for k in range(n_rings):
        count[k + 1] += count[k]
    starts = count.copy()
    m = count[n_rings]
    p = np.empty((m, 3), np.float32)
    r = np.empty(m, np.float32)
    u = np.empty((m, 2), np.float32)
    fill = count[:-1].copy()
    before[:] = 0.0
    turns = np.zeros((n_rings, 2), np.int64)
    rounds = np.zeros(n_rings, np.int64)
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
        rounds[g] += (x < 0) & ((y < 0) != (before[g, 1] < 0))
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
        flat = max(np.sqrt(ex * ex + ey * ey), np.float32(1e-3))  # straight above or below
        one = np.float32(1.0) / flat
        r[k] = flat
        u[k, 0], u[k, 1] = ex * one, ey * one
        cx, cy = int(bx + HALF), int(by + HALF)
        if bx > -HALF and by > -HALF and cx < 2 * HALF and cy < 2 * HALF and bz < low[cx, cy]:
            low[cx, cy] = bz
    for k in range(n_rings):
        lo, hi = starts[k], starts[k + 1]
        if hi - lo < 3:
            continue
        # Firing order is azimuth order but for the place where the turn closes; anything else is sorted. A ring that
        # comes round more than twice is several in one.
        if min(turns[k, 0], turns[k, 1]) > 2 + (hi - lo) // 200 or rounds[k] > 3:
            order = np.argsort(np.arctan2(u[lo:hi, 1], u[lo:hi, 0]))
            p[lo:hi] = p[lo:hi][order]
            r[lo:hi] = r[lo:hi][order]
            u[lo:hi] = u[lo:hi][order]
    return p, r, u, starts, low


@njit(cache=True, fastmath=FAST)
def angle_between(u, i, j):
    """Angle (sine of it) between two points of a ring as the sensor sees them."""
    return abs(u[i, 0] * u[j, 1] - u[i, 1] * u[j, 0])


@njit(cache=True)
def angular_step(u, starts):
    """Angle between neighbouring firings, rad: the commonest small step within rings, from a sample of them."""
    m = u.shape[0]
    every = max(1, m // 1200)
    out = np.empty(m // every + len(starts))
    n = 0
    for k in range(len(starts) - 1):
        for i in range(starts[k], starts[k + 1] - 1, every):
            a = angle_between(u, i, i + 1)
            if 2e-4 < a < 0.05:
                out[n] = a
                n += 1
    if n < 50:
        return 0.0035
    steps = np.sort(out[:n])
    low = steps[int(0.3 * n)]
    last = np.searchsorted(steps, 1.6 * low)
    return min(max(steps[last // 2], 8e-4), 0.02)
