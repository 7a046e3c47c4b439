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


NONE = np.uint64(0xFFFFFFFFFFFFFFFF)
"""A bin without a point: further than any."""


@njit(cache=True, error_model="numpy", fastmath=FAST)
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


@njit(cache=True, error_model="numpy")
def wrapped(b):
    """A bin that may have gone once past either end."""
    if b < 0:
        return b + BINS
    return b - BINS if b >= BINS else b


@njit(cache=True, error_model="numpy", fastmath=FAST)
def ring_image(p, r, u, starts, eye):
    """Nearest horizontal range (R, BINS) of what each ring met in each direction (0: no return), and the slope
    (R, BINS) of the beam that met it, metres of height per metre.
    """
    rings, m = starts.shape[0] - 1, r.shape[0]
    zero, two, four = np.float32(0.0), np.float32(2.0), np.float32(4.0)
    scale, end = np.float32(BINS / 4.0), np.float32(BINS)
    bins = np.empty(m, np.int32)
    for i in range(m):  # bin_of in single precision, without a branch: several points are done at once
        x, y = u[i, 0], u[i, 1]
        t = y / (abs(x) + abs(y))
        t = two - t if x < zero else (four + t if y < zero else t)
        t *= scale
        bins[i] = np.int32(t) if (t >= zero) & (t < end) else np.int32(0)  # rounding at the end of the turn; NaN
    # Range and number of a point in one word: the nearest point of a bin is the least word, found without a branch.
    bits = r.view(np.uint32)
    words = np.full((rings, BINS), NONE)
    for k in range(rings):
        row = words[k]
        for i in range(starts[k], starts[k + 1]):
            b = np.uint32(bins[i])
            row[b] = min(row[b], (np.uint64(bits[i]) << np.uint64(32)) | np.uint64(i))
    near, slope = np.zeros((rings, BINS), np.float32), np.zeros((rings, BINS), np.float32)
    ez = np.float32(eye[2])
    for k in range(rings):
        for column in range(BINS):
            if words[k, column] != NONE:
                nearest = np.uint32(words[k, column])
                near[k, column] = r[nearest]
                slope[k, column] = (p[nearest, 2] - ez) / r[nearest]
    return near, slope


@njit(cache=True, error_model="numpy")
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


@njit(cache=True, error_model="numpy")
def _cells(first, last):
    """A word with the bits of the cells from `first` up to before `last`, m."""
    i0, i1 = max(int(first), 0), min(int(np.floor(last)), CELLS)
    if i1 <= i0:
        return np.uint32(0)
    word = np.uint32(0xFFFFFFFF) if i1 == CELLS else (np.uint32(1) << np.uint32(i1)) - np.uint32(1)
    return word & ~((np.uint32(1) << np.uint32(i0)) - np.uint32(1))


@njit(cache=True, error_model="numpy")
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


@njit(cache=True, error_model="numpy", fastmath=FAST)
def crossings(tangent, R, eye, x, y, z, lx, ly, out):
    """Height (m), horizontal distance from the sensor (m), direction (x, y) of the places (4, rings) `out`, in single precision, where the
    rings, of tangents of elevation `tangent` (rings,), cross a column through (x, y, z) with slope (lx, ly); False where rings run along it.

    A ring is a cone about the sensor's axis: where it crosses the column is found by three steps of a fixed point.
    """
    if abs(R[2, 2]) < 0.3:
        return False
    ax, ay, az = np.float32(R[0, 2]), np.float32(R[1, 2]), np.float32(R[2, 2])
    x0, y0, z0 = np.float32(x - eye[0]), np.float32(y - eye[1]), np.float32(z - eye[2])
    mx, my = np.float32(lx), np.float32(ly)
    far, least = np.float32(8.0), np.float32(1e-6)
    height, distance, across, along = out[0], out[1], out[2], out[3]
    n = tangent.shape[0]
    for k in range(n):
        height[k] = np.float32(0.0)  # above z, until the end
    for _ in range(3):  # all rings at once
        for k in range(n):
            rise = height[k]
            dx, dy, dz = x0 + mx * rise, y0 + my * rise, z0 + rise
            up = ax * dx + ay * dy + az * dz
            flat = np.sqrt(max(dx * dx + dy * dy + dz * dz - up * up, least))
            height[k] = min(max(rise + (tangent[k] * flat - up) / az, -far), far)
    for k in range(n):
        dx, dy = x0 + mx * height[k], y0 + my * height[k]
        distance[k], across[k], along[k] = np.sqrt(dx * dx + dy * dy), dx, dy
        height[k] += np.float32(z)
    return True


CROWN_STEP = 0.08
"""Directions nearer to each other than this at a crown's range are not looked at one by one, m."""


@njit(cache=True, error_model="numpy")
def look_at(near, crossed, ground, radius, highest, out):
    """What the rings say of a column that they cross as in `crossed` (4, rings): (SEEN_SIZE,) `out`.

    At 0.3-1.7 m: rings that met it, passed it, crossed it. At 1.9-4.5 m: rings that met its axis or passed it; the share of
    directions within 1 m that met something at its range, and how many were looked at. TOP is 1 where the next rings
    above `highest` passed, -1 where they met it, 0 unknown.
    """
    out[:] = 0.0
    above = 0.0
    tops = 0
    for k in range(near.shape[0]):
        h = crossed[0, k] - ground
        if h < 0.3 or h > 4.5 or (1.7 < h < 1.9):
            continue
        d = crossed[1, k]
        b = bin_of(crossed[2, k], crossed[3, k])
        width = d * (4.0 / BINS) * 1.2  # of a bin, about
        reach = max(int(0.6 * radius / max(width, 1e-3)), 0)
        tolerance = 0.25 + radius + 0.01 * d
        met, through, blocked = False, True, False
        for q in range(b - reach, b + reach + 1):
            v = near[k, wrapped(q)]
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
            every = max(int(CROWN_STEP / width), 1)
            wide = min(int(1.0 / max(width, 1e-3)), 60) // every * every
            for q in range(b - wide, b + wide + 1, every):
                v = near[k, wrapped(q)]
                if v == 0 or v > d - 1.0:
                    out[CROWN_SEEN] += every
                    if v > 0 and v < d + 1.0:
                        out[CROWN_HIT] += every
        if h > highest + 0.05 and tops < 2 and h < 3.5 and not blocked:
            tops += 1
            above += -1.0 if met else (1.0 if through else 0.0)
    out[TOP] = 0.5 * above
