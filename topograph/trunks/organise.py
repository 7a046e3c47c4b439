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
    total, n = _rise(xyz, ring, int(ring.max()) + 1, SAMPLE)
    if (n < 3).any():  # rings of few returns, or of none
        total, n = _rise(xyz, ring, len(n), 1)
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


@njit(cache=True, error_model="numpy")
def _rise(xyz, ring, n, every):
    """Sum of tangents of elevation and their number, (n,), of every so-manieth point of each ring."""
    count, total = np.zeros(n, np.int64), np.zeros(n)
    for i in range(0, len(ring), every):
        x, y = xyz[i, 0], xyz[i, 1]
        flat = np.sqrt(x * x + y * y)
        if flat > 0.0 and np.isfinite(flat) and np.isfinite(xyz[i, 2]):
            total[ring[i]] += xyz[i, 2] / flat
            count[ring[i]] += 1
    return total, count


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
    return Scan(
        stamp_ns=scan.stamp_ns, frame=scan.frame, xyz=scan.xyz[:half], ring=ring, offset=offset, intensity=intensity
    )


@njit(cache=True, error_model="numpy", fastmath=FAST)
def _by_ring(xyz, ring, offset, n_rings, near, far):
    """The columns x, y, z and time (4, M) of the points between `near` and `far`, ring by ring, and where rings begin (R+1,)."""
    n = xyz.shape[0]
    near2, far2 = np.float32(near * near), np.float32(far * far)
    inside = np.empty(n, np.bool_)
    for i in range(n):  # without a branch, as most loops here: several points are done at once
        x, y, z = xyz[i, 0], xyz[i, 1], xyz[i, 2]
        d2 = x * x + y * y + z * z
        inside[i] = (d2 > near2) & (d2 < far2) & (ring[i] >= 0) & (ring[i] < n_rings)  # NaN compares false
    timed = offset.shape[0] == n
    if timed:
        for i in range(n):
            inside[i] &= offset[i] == offset[i]  # NaN: nobody knows when
    starts = np.zeros(n_rings + 1, np.int64)
    for i in range(n):
        if inside[i]:
            starts[ring[i] + 1] += 1
    for k in range(n_rings):
        starts[k + 1] += starts[k]
    fill = starts[:-1].copy()
    q = np.zeros((4, starts[n_rings]), np.float32)
    for i in range(n):
        if inside[i]:
            g = ring[i]
            k = fill[g]
            fill[g] = k + 1
            q[0, k], q[1, k], q[2, k] = xyz[i, 0], xyz[i, 1], xyz[i, 2]
            if timed:
                q[3, k] = offset[i]
    return q, starts


@njit(cache=True, error_model="numpy", fastmath=FAST)
def _once(q, starts):
    """Drops, in place, points that repeat the one before them in their ring; the rings' new starts."""
    x, y, z = q[0], q[1], q[2]
    again = 0
    for i in range(1, x.shape[0]):
        again += (x[i] == x[i - 1]) & (y[i] == y[i - 1]) & (z[i] == z[i - 1])
    if again == 0:
        return starts
    out = starts.copy()
    m = 0
    for k in range(starts.shape[0] - 1):
        out[k] = m
        for i in range(starts[k], starts[k + 1]):
            if i > starts[k] and x[i] == q[0, m - 1] and y[i] == q[1, m - 1] and z[i] == q[2, m - 1]:
                continue
            for c in range(4):
                q[c, m] = q[c, i]
            m += 1
    out[-1] = m
    return out


@njit(cache=True, error_model="numpy", fastmath=FAST)
def _jumbled(x, y):
    """Whether a ring's points (M,) are in no order. Firing order is azimuth order but for the place where the turn closes; a
    ring that comes round more than twice is several in one.
    """
    left, right, rounds = 0, 0, 0
    zero = np.float32(0.0)
    for i in range(1, x.shape[0]):
        side = x[i - 1] * y[i] - y[i - 1] * x[i]
        left += side > zero
        right += side < zero
        rounds += (x[i] < zero) & ((y[i] < zero) != (y[i - 1] < zero))
    return min(left, right) > 2 + x.shape[0] // 200 or rounds > 3


@njit(cache=True, error_model="numpy", fastmath=FAST)
def _moved(q, base_T_lidar, twist):
    """Takes points `q` (4, M) of the sensor, in place, to where the base has them at the stamp."""
    T, v = base_T_lidar.astype(np.float32), twist.astype(np.float32)
    r00, r01, r02, tx = T[0, 0], T[0, 1], T[0, 2], T[0, 3]
    r10, r11, r12, ty = T[1, 0], T[1, 1], T[1, 2], T[1, 3]
    r20, r21, r22, tz = T[2, 0], T[2, 1], T[2, 2], T[2, 3]
    vx, vy, vz, wx, wy, wz = v[0], v[1], v[2], v[3], v[4], v[5]
    half = np.float32(0.5)
    px, py, pz, pt = q[0], q[1], q[2], q[3]
    for k in range(px.shape[0]):
        x, y, z, t = px[k], py[k], pz[k], pt[k]
        bx = r00 * x + r01 * y + r02 * z + tx
        by = r10 * x + r11 * y + r12 * z + ty
        bz = r20 * x + r21 * y + r22 * z + tz
        # p + t (v + w x p) + t²/2 w x (v + w x p)
        ux, uy, uz = vx + wy * bz - wz * by, vy + wz * bx - wx * bz, vz + wx * by - wy * bx
        h = half * t * t
        px[k] = bx + t * ux + h * (wy * uz - wz * uy)
        py[k] = by + t * uy + h * (wz * ux - wx * uz)
        pz[k] = bz + t * uz + h * (wx * uy - wy * ux)


@njit(cache=True, error_model="numpy", fastmath=FAST)
def _seen_from(q, eye_x, eye_y):
    """Points (M, 3), horizontal range (M,) and direction (M, 2) from the sensor of points `q` (4, M) of the base."""
    px, py, pz = q[0], q[1], q[2]
    m = px.shape[0]
    p, r, u = np.empty((m, 3), np.float32), np.empty(m, np.float32), np.empty((m, 2), np.float32)
    tx, ty, one, least = np.float32(eye_x), np.float32(eye_y), np.float32(1.0), np.float32(1e-6)
    for k in range(m):
        x, y = px[k] - tx, py[k] - ty
        r[k] = np.sqrt(max(x * x + y * y, least))  # straight above or below
    for k in range(m):
        near = one / r[k]
        u[k, 0], u[k, 1] = (px[k] - tx) * near, (py[k] - ty) * near
    for k in range(m):
        p[k, 0], p[k, 1], p[k, 2] = px[k], py[k], pz[k]
    return p, r, u


@njit(cache=True, error_model="numpy", fastmath=FAST)
def _lowest(q):
    """Lowest point (2 HALF, 2 HALF) of each ground cell, 1e9 where there is none."""
    px, py, pz = q[0], q[1], q[2]
    m = px.shape[0]
    cell = np.empty(m, np.int32)
    side, zero, end = np.float32(HALF + 1), np.float32(0.0), np.float32(2 * HALF + 2)
    row = np.int32(2 * HALF + 2)
    for k in range(m):  # the first cell, of the rim, is for all that is outside, and for what is no number
        i, j = px[k] + side, py[k] + side
        inside = (i >= zero) & (j >= zero) & (i < end) & (j < end)
        cell[k] = np.int32(i) * row + np.int32(j) if inside else np.int32(0)
    low = np.full((2 * HALF + 2) * (2 * HALF + 2), np.float32(1e9))
    for k in range(m):
        c = np.uint32(cell[k])
        low[c] = min(low[c], pz[k])
    return low.reshape(2 * HALF + 2, 2 * HALF + 2)[1:-1, 1:-1].copy()


@njit(cache=True, error_model="numpy")
def _by_azimuth(p, r, u):
    """Sorts the points of one ring, in place, by the direction in which the sensor sees them."""
    n = r.shape[0]
    azimuth = np.empty(n)
    for i in range(n):
        azimuth[i] = np.arctan2(u[i, 1], u[i, 0])
    order = np.argsort(azimuth)
    old_p, old_r, old_u = p.copy(), r.copy(), u.copy()
    for i in range(n):
        k = order[i]
        r[i] = old_r[k]
        u[i, 0], u[i, 1] = old_u[k, 0], old_u[k, 1]
        p[i, 0], p[i, 1], p[i, 2] = old_p[k, 0], old_p[k, 1], old_p[k, 2]


@njit(cache=True, error_model="numpy", fastmath=FAST)
def organise(xyz, ring, offset, base_T_lidar, twist, n_rings, near, far):
    """Points in ring order: base-frame xyz (M, 3), horizontal range from the sensor (M,), horizontal direction from it (M, 2),
    ring starts (R+1,), and the lowest point (2 HALF, 2 HALF) of each ground cell. A point that repeats the one before it in
    its ring is dropped.

    `offset` (N,) s or empty; `twist` (6,) of the base. First the motion during the sweep is taken out, to second
    order in the sweep's time; then the points are where they were at the stamp, seen from the base then.
    """
    q, starts = _by_ring(xyz, ring, offset, n_rings, near, far)
    starts = _once(q, starts)
    q = q[:, : starts[n_rings]].copy()
    # Order is judged before the motion is taken out: near leaves and far ground shift differently.
    jumbled = np.zeros(n_rings, np.bool_)
    for k in range(n_rings):
        jumbled[k] = _jumbled(q[0, starts[k] : starts[k + 1]], q[1, starts[k] : starts[k + 1]])
    _moved(q, base_T_lidar, twist)
    p, r, u = _seen_from(q, base_T_lidar[0, 3], base_T_lidar[1, 3])
    for k in range(n_rings):
        lo, hi = starts[k], starts[k + 1]
        if jumbled[k] and hi - lo > 2:
            _by_azimuth(p[lo:hi], r[lo:hi], u[lo:hi])
    return p, r, u, starts, _lowest(q)


@njit(cache=True, error_model="numpy", fastmath=FAST)
def angle_between(u, i, j):
    """Angle (sine of it) between two points of a ring as the sensor sees them."""
    return abs(u[i, 0] * u[j, 1] - u[i, 1] * u[j, 0])


SAMPLED_STEPS = 500
"""Pairs of neighbouring firings that tell the angle between them."""


@njit(cache=True, error_model="numpy")
def angular_step(u, starts):
    """Angle between neighbouring firings, rad: the commonest small step within rings, from a sample of them."""
    m = u.shape[0]
    every = max(1, m // SAMPLED_STEPS)
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
