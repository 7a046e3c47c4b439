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


@njit(cache=True, fastmath=FAST)
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


@njit(cache=True)
def look_around(cells, x, y, first, second, third, out):
    """Points within `first` m, from there to `second` and to `third` m, and the octants covered in the outer two: (5,) `out`."""
    i, j = int(4.0 * (x + HALF)), int(4.0 * (y + HALF))
    out[:] = 0.0
    inner, outer = 0, 0
    k = int(4.0 * third) + 1
    one, two, three = first * first, second * second, third * third
    for a in range(max(i - k, 0), min(i + k + 1, CELLS)):
        for b in range(max(j - k, 0), min(j + k + 1, CELLS)):
            c = cells[a, b]
            if c == 0:
                continue
            dx, dy = 0.25 * (a + 0.5) - HALF - x, 0.25 * (b + 0.5) - HALF - y
            d2 = dx * dx + dy * dy
            if d2 >= three:
                continue
            octant = 1 << ((dx > 0) * 4 + (dy > 0) * 2 + (abs(dx) > abs(dy)) * 1)
            if d2 < one:
                out[0] += c
            elif d2 < two:
                out[1] += c
                inner |= octant
            else:
                out[2] += c
                outer |= octant
    for bit in range(8):
        out[3] += (inner >> bit) & 1
        out[4] += (outer >> bit) & 1


FAILED, WALL = -2, -3
"""Labels of points whose run was none: another may start at them, or not."""


@njit(cache=True, fastmath=FAST)
def find_runs(p, r, u, h, starts, step, low, high, widest):
    """Runs (K, RUN_SIZE) and the run (M,) of each point or -1.

    Columns: first and last point, ring, mean xyz (m), mean range, width, free sides, height, count. A leaf
    before a trunk does not end its run: up to three strange returns are passed over.
    """
    n_rings = starts.shape[0] - 1
    m = p.shape[0]
    out = np.empty((max(m // 2, 1), RUN_SIZE), np.float64)
    label = np.full(m, -1, np.int32)
    k = 0
    gap, beyond = np.float32(4.2 * step), np.float32(0.3)
    for ring in range(n_rings):
        lo, hi = starts[ring], starts[ring + 1]
        for i in range(lo, hi):
            if label[i] >= 0 or label[i] == WALL or not (low < h[i] < high):
                continue
            bound = np.float32(0.13) + np.float32(0.003) * r[i]
            reach = max(gap, np.float32(0.1) / r[i])
            n, last = 1, i
            label[i] = k
            sx, sy, sz = float(p[i, 0]), float(p[i, 1]), float(p[i, 2])
            sr, sh = float(r[i]), float(h[i])
            recent = r[i]
            j = i + 1
            while j < hi and angle_between(u, j, last) < reach:
                if label[j] < 0 and low < h[j] < high and abs(r[j] - recent) < bound:
                    label[j] = k
                    last = j
                    n += 1
                    recent += np.float32(0.4) * (r[j] - recent)  # noise must not end a run that bends
                    sx += p[j, 0]
                    sy += p[j, 1]
                    sz += p[j, 2]
                    sr += r[j]
                    sh += h[j]
                j += 1
            width = 0.0
            if n > 1:
                width = (np.arcsin(min(angle_between(u, last, i), np.float32(1.0))) + step) * r[i]
            if n < 2 or width > 1.6 * widest or n < 0.4 * width / (step * r[i]) or k >= out.shape[0]:
                # What is too wide is a wall from each of its points: looked at once, and its end is no column.
                failed = WALL if width > 1.6 * widest else FAILED
                for j in range(i, last + 1):
                    if label[j] == k:
                        label[j] = failed
                continue
            # A side is free when what is seen beside the run lies behind it (or is nothing).
            mean, free = sr / n, 0.0
            if i == lo or angle_between(u, i, i - 1) > 3.2 * step or r[i - 1] > mean + beyond:
                free += 1.0
            if last == hi - 1 or angle_between(u, last + 1, last) > 3.2 * step or r[last + 1] > mean + beyond:
                free += 1.0
            row = out[k]
            row[FIRST], row[LAST], row[RING] = i, last, ring
            row[PX], row[PY], row[PZ] = sx / n, sy / n, sz / n
            row[RANGE], row[WIDTH], row[FREE] = mean, width, free
            row[HEIGHT], row[COUNT] = sh / n, n
            k += 1
    return out[:k], label


FARTHEST_LINK = 1.2
"""Runs further from each other than this are never of one thing, m."""


@njit(cache=True)
def link(runs):
    """Chain (K,) of each run: runs of neighbouring rings that stand above each other are one thing."""
    k = runs.shape[0]
    chain = np.arange(k)
    above = np.full(k, -1, np.int64)
    below_cost = np.full(k, 1e9)
    below = np.full(k, -1, np.int64)
    for i in range(k):
        best, cost = -1, 1e9
        for j in range(i + 1, k):
            rings = runs[j, RING] - runs[i, RING]
            if rings > 2:
                break
            if rings < 1:
                continue
            dx, dy = runs[j, PX] - runs[i, PX], runs[j, PY] - runs[i, PY]
            if dx * dx + dy * dy > FARTHEST_LINK**2:
                continue
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
