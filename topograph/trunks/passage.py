"""Where the beams went: what each ring met in each direction, and which places were seen through.

"Nothing there" and "not looked at" are different things: a place is empty only where a beam passed through it.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from topograph.trunks.organise import FAST, HALF

BINS = 768
"""Directions of the image of a sweep: 0.35 to 0.7 degrees each, by the diamond angle, which costs no arctangent."""
SECTORS = 360
"""Directions of the record of passage, one degree each."""
CELLS = 32
"""Cells of 1 m in range of the record of passage: the bits of one word."""
MARGIN = 0.45
"""A beam has passed a place when it met something no nearer than this behind it, m."""
THICK = 0.2
"""So far before and behind a return the thing that was met may reach, m."""
LOW, HIGH = 0.4, 1.6
"""Heights between which a beam that passes contradicts a trunk, m: above weeds, below crowns."""


@njit(cache=True, fastmath=FAST)
def bin_of(x, y):
    """Direction of (x, y), 0 to BINS - 1."""
    a = abs(x) + abs(y)
    if a <= 0.0:
        return 0
    t = y / a
    if x < 0:
        t = 2.0 - t
    elif y < 0:
        t = 4.0 + t
    k = int(t * (BINS / 4.0))
    return k if k < BINS else BINS - 1


@njit(cache=True, fastmath=FAST)
def ring_image(p, r, starts, eye):
    """Nearest horizontal range (R, BINS) of what each ring met in each direction (0: no return), and the slope
    (R, BINS) of the beam that met it, metres of height per metre.
    """
    rings = starts.shape[0] - 1
    near = np.zeros((rings, BINS), np.float32)
    slope = np.zeros((rings, BINS), np.float32)
    ex, ey, ez = np.float32(eye[0]), np.float32(eye[1]), np.float32(eye[2])
    zero, two, four, scale = np.float32(0.0), np.float32(2.0), np.float32(4.0), np.float32(BINS / 4.0)
    for k in range(rings):
        for i in range(starts[k], starts[k + 1]):
            x, y = p[i, 0] - ex, p[i, 1] - ey
            a = abs(x) + abs(y)
            if not a > zero:  # NaN too
                continue
            t = y / a  # bin_of, inlined in single precision: this is a loop over all points
            if x < zero:
                t = two - t
            elif y < zero:
                t = four + t
            b = min(int(t * scale), BINS - 1)
            q = near[k, b]
            if q == zero or r[i] < q:
                near[k, b] = r[i]
                slope[k, b] = p[i, 2] - ez
    for k in range(rings):
        for b in range(BINS):
            slope[k, b] /= max(near[k, b], np.float32(0.1))
    return near, slope


@njit(cache=True)
def _towards(b):
    """A vector in the direction of (broken) bin `b`: back from the diamond angle."""
    t = 4.0 * b / BINS
    if t < 1:
        return 1.0 - t, t
    if t < 2:
        return 1.0 - t, 2.0 - t
    if t < 3:
        return t - 3.0, 2.0 - t
    return t - 3.0, t - 4.0


@njit(cache=True)
def _cells(first, last):
    """A word with the bits of the cells from `first` up to before `last`, m."""
    i0, i1 = max(int(first), 0), min(int(np.floor(last)), CELLS)
    if i1 <= i0:
        return np.uint32(0)
    word = np.uint32(0xFFFFFFFF) if i1 == CELLS else (np.uint32(1) << np.uint32(i1)) - np.uint32(1)
    return word & ~((np.uint32(1) << np.uint32(i0)) - np.uint32(1))


@njit(cache=True)
def passage(near, slope, eye, plane, grid):
    """Places seen through: (SECTORS,) words, bit i of one is set when all beams of that direction that could have met
    a trunk i to i + 1 m away went on, at the height of a trunk. Directions are in the base's axes, about the sensor.
    """
    rings = near.shape[0]
    free, met = np.zeros(BINS, np.uint32), np.zeros(BINS, np.uint32)
    known = np.zeros(BINS, np.bool_)
    i, j = int(eye[0] + HALF), int(eye[1] + HALF)
    under = plane[0] + plane[1] * eye[0] + plane[2] * eye[1]
    if 0 <= i < 2 * HALF and 0 <= j < 2 * HALF:
        under += grid[i, j]
    high = eye[2] - under
    full = np.uint32(0xFFFFFFFF)
    for b in range(BINS):
        dx, dy = _towards(b + 0.5)
        n = np.sqrt(dx * dx + dy * dy)
        fall = (plane[1] * dx + plane[2] * dy) / n
        for k in range(rings):
            q = near[k, b]
            if q <= 0:
                continue
            known[b] = True
            s = slope[k, b] - fall
            if LOW < high + s * q < HIGH:  # it met something as high as a trunk: others may pass above and below that
                met[b] |= _cells(q - THICK, q + THICK + 1.0)
            first, last = 0.0, q - MARGIN
            if s < 0:
                last = min(last, (LOW - high) / s) if high > LOW else 0.0
                if high > HIGH:
                    first = (HIGH - high) / s
            elif s > 0:
                last = min(last, (HIGH - high) / s) if high < HIGH else 0.0
                if high < LOW:
                    first = (LOW - high) / s
            elif not LOW < high < HIGH:
                continue
            free[b] |= _cells(np.ceil(first), last)  # whole cells only
    out = np.full(SECTORS, full, np.uint32)
    some = np.zeros(SECTORS, np.bool_)
    for b in range(BINS):
        if not known[b]:
            continue
        for e in range(2):  # a bin's two edges may lie in two sectors
            dx, dy = _towards(b + 0.05 + 0.9 * e)
            k = int((np.arctan2(dy, dx) + np.pi) * (SECTORS / (2 * np.pi))) % SECTORS
            out[k] &= free[b] & ~met[b]
            some[k] = True
    for k in range(SECTORS):
        if not some[k]:
            out[k] = np.uint32(0)
    return out


# Columns of what the rings say of one place.
TRUNK_HIT, TRUNK_PASS, TRUNK_RINGS, AXIS_HIT, AXIS_PASS, CROWN_HIT, CROWN_SEEN, TOP = range(8)
SEEN_SIZE = 8


@njit(cache=True)
def look_at(near, tangent, R, eye, x, y, z, lx, ly, ground, radius, highest, out):
    """What the rings say of a column through (x, y, z) with slope (lx, ly): (SEEN_SIZE,) `out`.

    At 0.3-1.7 m: rings that met it, passed it, crossed it. At 1.9-4.5 m: rings that met its axis or passed it; the share of
    directions within 1 m that met something at its range, and how many were looked at. TOP is 1 where the next rings
    above `highest` passed, -1 where they met it, 0 unknown.
    """
    out[:] = 0.0
    # A ring is a cone about the sensor's axis: where it crosses the column is found by two steps of a fixed point.
    ax, ay, az = R[0, 2], R[1, 2], R[2, 2]
    if abs(az) < 0.3:
        return
    above = 0.0
    tops = 0
    for k in range(near.shape[0]):
        zk = z
        for _ in range(3):
            dx, dy, dz = x + lx * (zk - z) - eye[0], y + ly * (zk - z) - eye[1], zk - eye[2]
            up = ax * dx + ay * dy + az * dz
            flat = np.sqrt(max(dx * dx + dy * dy + dz * dz - up * up, 1e-6))
            zk += (tangent[k] * flat - up) / az
            zk = min(max(zk, z - 8.0), z + 8.0)
        h = zk - ground
        if h < 0.3 or h > 4.5 or (1.7 < h < 1.9):
            continue
        dx, dy = x + lx * (zk - z) - eye[0], y + ly * (zk - z) - eye[1]
        d = np.sqrt(dx * dx + dy * dy)
        b = bin_of(dx, dy)
        width = d * (4.0 / BINS) * 1.2  # of a bin, about
        reach = max(int(0.6 * radius / max(width, 1e-3)), 0)
        tolerance = 0.25 + radius + 0.01 * d
        met, through, blocked = False, True, False
        for q in range(-reach, reach + 1):
            v = near[k, (b + q) % BINS]
            if v > 0 and abs(v - d) < tolerance:
                met = True
            elif v > 0 and v < d - tolerance:
                blocked = True
            if v > 0 and v < d + MARGIN:
                through = False
        nothing = near[k, b] <= 0
        if h <= 1.7:
            out[TRUNK_RINGS] += met or not blocked
            if met:
                out[TRUNK_HIT] += 1
            elif through and not nothing:
                out[TRUNK_PASS] += 1
        else:
            if met:
                out[AXIS_HIT] += 1
            elif through:
                out[AXIS_PASS] += 1  # no return upwards is the sky
            wide = min(int(1.0 / max(width, 1e-3)), 60)
            for q in range(-wide, wide + 1):
                v = near[k, (b + q) % BINS]
                if v == 0 or v > d - 1.0:
                    out[CROWN_SEEN] += 1
                    if v > 0 and v < d + 1.0:
                        out[CROWN_HIT] += 1
        if h > highest + 0.05 and tops < 2 and h < 3.5 and not blocked:
            tops += 1
            above += -1.0 if met else (1.0 if through else 0.0)
    out[TOP] = 0.5 * above
