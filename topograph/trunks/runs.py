"""Runs: unbroken stretches of one ring at trunk height; and chains of runs, one above the other."""

from __future__ import annotations

import numpy as np
from numba import njit

from topograph.trunks.organise import FAST, HALF, angle_between

# Columns of a run.
FIRST, LAST, RING, PX, PY, PZ, RANGE, WIDTH, FREE, HEIGHT, COUNT = range(11)
RUN_SIZE = 11


CELLS = 8 * HALF
"""Cells of 0.25 m across the grids of canopy and undergrowth."""


@njit(cache=True, error_model="numpy", fastmath=FAST)
def heights(p, plane, grid):
    """Height above ground (M,) of points; counts of what is overhead (1.9-5 m) and beside (0.3-1.5 m) per 0.25 m cell."""
    m = p.shape[0]
    h = np.empty(m, np.float32)
    above = np.zeros((CELLS, CELLS), np.int16)
    beside = np.zeros((CELLS, CELLS), np.int16)
    half, quarter, one = np.float32(HALF), np.float32(4.0), np.float32(1.0)
    shift, last = np.float32(HALF - 0.5), 2 * HALF - 2
    p0, p1, p2 = np.float32(plane[0]), np.float32(plane[1]), np.float32(plane[2])
    for i in range(m):
        x, y = p[i, 0], p[i, 1]
        t = p[i, 2] - p0 - p1 * x - p2 * y
        u, v = x + shift, y + shift  # ground_at, inlined: this is the one loop over all points that needs it
        if u >= 0 and v >= 0:
            a, b = int(u), int(v)
            if a <= last and b <= last:
                fu, fv = u - a, v - b
                t -= (one - fu) * ((one - fv) * grid[a, b] + fv * grid[a, b + 1])
                t -= fu * ((one - fv) * grid[a + 1, b] + fv * grid[a + 1, b + 1])
        h[i] = t
        if 0.3 < t < 5.0 and (t < 1.5 or t > 1.9):
            a, b = int(quarter * (x + half)), int(quarter * (y + half))
            if 0 <= a < CELLS and 0 <= b < CELLS:
                if t > 1.9:
                    above[a, b] += 1
                else:
                    beside[a, b] += 1
    return h, above, beside


@njit(cache=True, error_model="numpy")
def look_around(cells, x, y, first, second, third, out):
    """Points within `first` m, from there to `second` and to `third` m, and the octants covered in the outer two: (5,) `out`."""
    i, j = int(4.0 * (x + HALF)), int(4.0 * (y + HALF))
    k = int(4.0 * third) + 1
    one, two, three = first * first, second * second, third * third
    count, octants = np.zeros(4), np.zeros(4, np.int64)  # of each zone, the last one is beyond
    for a in range(max(i - k, 0), min(i + k + 1, CELLS)):
        dx = 0.25 * (a + 0.5) - HALF - x
        dx2 = dx * dx
        for b in range(max(j - k, 0), min(j + k + 1, CELLS)):
            c = cells[a, b]
            if c == 0:
                continue
            dy = 0.25 * (b + 0.5) - HALF - y
            d2 = dx2 + dy * dy
            zone = (d2 >= one) + (d2 >= two) + (d2 >= three)
            count[zone] += c
            octants[zone] |= 1 << ((dx > 0) * 4 + (dy > 0) * 2 + (dx2 > dy * dy) * 1)
    out[0], out[1], out[2], out[3], out[4] = count[0], count[1], count[2], 0.0, 0.0
    for bit in range(8):
        out[3] += (octants[1] >> bit) & 1
        out[4] += (octants[2] >> bit) & 1


FAILED, WALL = -2, -3
"""Labels of points whose run was none: another may start at them, or not."""


@njit(cache=True, error_model="numpy", fastmath=FAST)
def find_runs(p, r, u, h, starts, step, low, high, widest):
    """Runs (K, RUN_SIZE) and the run (M,) of each point or -1.

    Columns: first and last point, ring, mean xyz (m), mean range, width, free sides, height, count. A leaf
    before a trunk does not end its run: up to three strange returns are passed over.
    """
    n_rings = starts.shape[0] - 1
    m = p.shape[0]
    label = np.full(m, -1, np.int32)
    # Points at trunk height alone, one after the other: most are not, and are never looked at again.
    at, ends = np.empty(m + 1, np.int64), np.empty(n_rings + 1, np.int64)
    n_at = 0
    for ring in range(n_rings):
        ends[ring] = n_at
        for i in range(starts[ring], starts[ring + 1]):
            at[n_at] = i
            n_at += (h[i] > low) & (h[i] < high)
    ends[n_rings] = n_at
    taken = np.full(n_at, -1, np.int32)
    us, rs = np.empty((n_at, 2), np.float32), np.empty(n_at, np.float32)
    for a in range(n_at):
        us[a, 0], us[a, 1], rs[a] = u[at[a], 0], u[at[a], 1], r[at[a]]
    turn = np.zeros(n_at, np.float32)  # from the one before, as its sine: small, so that turns add up
    for a in range(1, n_at):
        turn[a] = us[a - 1, 0] * us[a, 1] - us[a - 1, 1] * us[a, 0]
    out = np.empty((max(n_at // 2, 1), RUN_SIZE), np.float64)
    k = 0
    gap, beyond = np.float32(4.2 * step), np.float32(0.3)
    for ring in range(n_rings):
        lo, hi, stop = starts[ring], starts[ring + 1], ends[ring + 1]
        for a in range(ends[ring], stop):
            if taken[a] >= 0 or taken[a] == WALL:
                continue
            bound = np.float32(0.13) + np.float32(0.003) * rs[a]
            reach = max(gap, np.float32(0.1) / rs[a])
            n, last = 1, a
            taken[a] = k
            recent, since = rs[a], np.float32(0.0)
            for b in range(a + 1, stop):
                since += turn[b]
                if abs(since) >= reach:
                    break
                if taken[b] < 0 and abs(rs[b] - recent) < bound:
                    taken[b] = k
                    last, since = b, np.float32(0.0)
                    n += 1
                    recent += np.float32(0.4) * (rs[b] - recent)  # noise must not end a run that bends
            width = 0.0
            if n > 1:
                width = (np.arcsin(min(angle_between(us, last, a), np.float32(1.0))) + step) * rs[a]
            if n < 2 or width > 1.6 * widest or n < 0.4 * width / (step * rs[a]):
                # What is too wide is a wall from each of its points: looked at once, and its end is no column.
                failed = WALL if width > 1.6 * widest else FAILED
                for b in range(a, last + 1):
                    if taken[b] == k:
                        taken[b] = failed
                continue
            sx, sy, sz, sr, sh = 0.0, 0.0, 0.0, 0.0, 0.0
            for b in range(a, last + 1):
                if taken[b] == k:
                    j = at[b]
                    label[j] = k
                    sx += p[j, 0]
                    sy += p[j, 1]
                    sz += p[j, 2]
                    sr += r[j]
                    sh += h[j]
            first, final = at[a], at[last]
            # A side is free when what is seen beside the run lies behind it (or is nothing).
            mean, free = sr / n, 0.0
            if first == lo or angle_between(u, first, first - 1) > 3.2 * step or r[first - 1] > mean + beyond:
                free += 1.0
            if final == hi - 1 or angle_between(u, final + 1, final) > 3.2 * step or r[final + 1] > mean + beyond:
                free += 1.0
            row = out[k]
            row[FIRST], row[LAST], row[RING] = first, final, ring
            row[PX], row[PY], row[PZ] = sx / n, sy / n, sz / n
            row[RANGE], row[WIDTH], row[FREE] = mean, width, free
            row[HEIGHT], row[COUNT] = sh / n, n
            k += 1
    return out[:k], label


FARTHEST_LINK = 1.2
"""Runs further from each other than this are never of one thing, m."""


@njit(cache=True, error_model="numpy")
def link(runs):
    """Chain (K,) of each run: runs of neighbouring rings that stand above each other are one thing."""
    k = runs.shape[0]
    chain = np.arange(k)
    above = np.full(k, -1, np.int64)
    below_cost = np.full(k, 1e9)
    below = np.full(k, -1, np.int64)
    x, y, ring = runs[:, PX].copy(), runs[:, PY].copy(), runs[:, RING].copy()
    first, end = 0, 0
    for i in range(k):
        best, cost = -1, 1e9
        while first < k and ring[first] <= ring[i]:
            first += 1
        while end < k and ring[end] <= ring[i] + 2:
            end += 1
        for j in range(first, end):
            dx, dy = x[j] - x[i], y[j] - y[i]
            if dx * dx + dy * dy > FARTHEST_LINK**2:
                continue
            rings = ring[j] - ring[i]
            d = np.sqrt(dx * dx + dy * dy)
            dz = abs(runs[j, PZ] - runs[i, PZ])
            wide, thin = max(runs[i, WIDTH], runs[j, WIDTH]), min(runs[i, WIDTH], runs[j, WIDTH])
            if d > 0.12 + 0.35 * dz + 0.004 * runs[i, RANGE] + 0.12 * max(wide - 0.3, 0.0):
                continue
            c = d + 0.15 * rings + 0.1 * (wide - thin)
            if c < cost:
                best, cost = j, c
        if best >= 0 and cost < below_cost[best]:
            if below[best] >= 0:
                above[below[best]] = -1
            above[i], below[best], below_cost[best] = best, i, cost
    for i in range(k):  # runs are in ring order: what is below is named already
        if below[i] >= 0:
            chain[i] = chain[below[i]]
    return chain
