"""Runs: unbroken stretches of one ring at trunk height; and chains of runs, one above the other."""

from __future__ import annotations

import numpy as np
from numba import njit

from topograph.trunks.ground import HALF, ground_at

# Columns of a run.
FIRST, LAST, RING, PX, PY, PZ, RANGE, WIDTH, FREE, HEIGHT, COUNT, BEARING = range(12)
RUN_SIZE = 12


CELLS = 8 * HALF
"""Cells of 0.25 m across the grids of canopy and undergrowth."""


@njit(cache=True)
def heights(p, plane, grid):
    """Height above ground (M,) of points; counts of what is overhead (1.9-5 m) and beside (0.3-1.5 m) per 0.25 m cell."""
    m = p.shape[0]
    h = np.empty(m, np.float32)
    above = np.zeros((CELLS, CELLS), np.int32)
    beside = np.zeros((CELLS, CELLS), np.int32)
    for i in range(m):
        x, y = p[i, 0], p[i, 1]
        h[i] = p[i, 2] - ground_at(x, y, plane, grid)
        a, b = int(4.0 * (x + HALF)), int(4.0 * (y + HALF))
        if 0 <= a < CELLS and 0 <= b < CELLS:
            if 1.9 < h[i] < 5.0:
                above[a, b] += 1
            elif 0.3 < h[i] < 1.5:
                beside[a, b] += 1
    return h, above, beside


@njit(cache=True)
def count_around(cells, x, y, inner, outer):
    """Points within `inner` m, and between `inner` and `outer` m, of a position."""
    i, j = int(4.0 * (x + HALF)), int(4.0 * (y + HALF))
    near, far = 0, 0
    k = int(4.0 * outer) + 1
    for a in range(max(i - k, 0), min(i + k + 1, CELLS)):
        for b in range(max(j - k, 0), min(j + k + 1, CELLS)):
            if cells[a, b] == 0:
                continue
            dx, dy = 0.25 * (a + 0.5) - HALF - x, 0.25 * (b + 0.5) - HALF - y
            d2 = dx * dx + dy * dy
            if d2 < inner * inner:
                near += cells[a, b]
            elif d2 < outer * outer:
                far += cells[a, b]
    return near, far


@njit(cache=True)
def sides_covered(cells, x, y, inner, outer):
    """Octants around a position that hold points between `inner` and `outer` m: a canopy is all around its trunk."""
    i, j = int(4.0 * (x + HALF)), int(4.0 * (y + HALF))
    k = int(4.0 * outer) + 1
    covered = np.zeros(8, np.int64)
    for a in range(max(i - k, 0), min(i + k + 1, CELLS)):
        for b in range(max(j - k, 0), min(j + k + 1, CELLS)):
            if cells[a, b] == 0:
                continue
            dx, dy = 0.25 * (a + 0.5) - HALF - x, 0.25 * (b + 0.5) - HALF - y
            d2 = dx * dx + dy * dy
            if inner * inner < d2 < outer * outer:
                covered[int((np.arctan2(dy, dx) + np.pi) / (2.0 * np.pi) * 7.999)] = 1
    return covered.sum()


@njit(cache=True)
def find_runs(p, r, a, h, starts, step, low, high, widest):
    """Runs (K, RUN_SIZE) and the run (M,) of each point or -1.

    Columns: first and last point, ring, mean xyz (m), mean range, width, free sides, height, count, bearing. A leaf
    before a trunk does not end its run: up to three strange returns are passed over.
    """
    n_rings = starts.shape[0] - 1
    m = p.shape[0]
    out = np.empty((max(m // 2, 1), RUN_SIZE), np.float64)
    label = np.full(m, -1, np.int64)
    k = 0
    for ring in range(n_rings):
        lo, hi = starts[ring], starts[ring + 1]
        for i in range(lo, hi):
            if label[i] >= 0 or not (low < h[i] < high):
                continue
            bound = 0.13 + 0.003 * r[i]
            n, last = 1, i
            label[i] = k
            sx, sy, sz = float(p[i, 0]), float(p[i, 1]), float(p[i, 2])
            sr, sh, sa = float(r[i]), float(h[i]), float(a[i])
            recent = float(r[i])
            j = i + 1
            while j < hi and abs(a[j] - a[last]) < max(4.2 * step, 0.1 / r[i]):
                if label[j] < 0 and low < h[j] < high and abs(r[j] - recent) < bound:
                    label[j] = k
                    last = j
                    n += 1
                    recent += 0.4 * (r[j] - recent)  # noise must not end a run that bends
                    sx += p[j, 0]
                    sy += p[j, 1]
                    sz += p[j, 2]
                    sr += r[j]
                    sh += h[j]
                    sa += a[j]
                j += 1
            width = (abs(a[last] - a[i]) + step) * r[i]
            if n < 2 or width > 1.6 * widest or n < 0.4 * width / (step * r[i]) or k >= out.shape[0]:
                for j in range(i, last + 1):
                    if label[j] == k:
                        label[j] = -2
                continue
            # A side is free when what is seen beside the run lies behind it (or is nothing).
            mean, free = sr / n, 0.0
            if i == lo or abs(a[i] - a[i - 1]) > 3.2 * step or r[i - 1] > mean + 0.3:
                free += 1.0
            if last == hi - 1 or abs(a[last + 1] - a[last]) > 3.2 * step or r[last + 1] > mean + 0.3:
                free += 1.0
            row = out[k]
            row[FIRST], row[LAST], row[RING] = i, last, ring
            row[PX], row[PY], row[PZ] = sx / n, sy / n, sz / n
            row[RANGE], row[WIDTH], row[FREE] = mean, width, free
            row[HEIGHT], row[COUNT], row[BEARING] = sh / n, n, sa / n
            k += 1
    return out[:k], label


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
            d = np.sqrt(dx * dx + dy * dy)
            dz = abs(runs[j, PZ] - runs[i, PZ])
            if d > 0.12 + 0.35 * dz + 0.004 * runs[i, RANGE]:
                continue
            wide, thin = max(runs[i, WIDTH], runs[j, WIDTH]), min(runs[i, WIDTH], runs[j, WIDTH])
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
