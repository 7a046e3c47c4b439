"""Runs: unbroken stretches of one ring at trunk height; and chains of runs, one above the other."""

from __future__ import annotations

import numpy as np
from numba import njit

from topograph.trunks.ground import HALF, ground_at

# Columns of a run.
FIRST, LAST, RING, PX, PY, PZ, RANGE, WIDTH, FREE, HEIGHT, COUNT, BEARING = range(12)
RUN_SIZE = 12


@njit(cache=True)
def heights(p, plane, grid):  # type: ignore[no-untyped-def]
    """Height above ground (M,) of points; and counts of canopy (1.8-5 m) and of undergrowth (0.3-1.5 m) per 1 m cell."""
    m = p.shape[0]
    h = np.empty(m, np.float32)
    size = 2 * HALF
    above = np.zeros((size, size), np.int32)
    beside = np.zeros((size, size), np.int32)
    for i in range(m):
        x, y = p[i, 0], p[i, 1]
        h[i] = p[i, 2] - ground_at(x, y, plane, grid)
        a, b = int(np.floor(x)) + HALF, int(np.floor(y)) + HALF
        if 0 <= a < size and 0 <= b < size:
            if 1.8 < h[i] < 5.0:
                above[a, b] += 1
            elif 0.3 < h[i] < 1.5:
                beside[a, b] += 1
    return h, above, beside


@njit(cache=True)
def find_runs(p, r, a, h, starts, step, low, high, widest):  # type: ignore[no-untyped-def]
    """Runs (K, RUN_SIZE): first and last point, ring, mean xyz (m), mean range, width, free sides, height, count, bearing."""
    n_rings = starts.shape[0] - 1
    out = np.empty((max(p.shape[0] // 2, 1), RUN_SIZE), np.float64)
    k = 0
    for ring in range(n_rings):
        lo, hi = starts[ring], starts[ring + 1]
        i = lo
        while i < hi:
            if not (low < h[i] < high):
                i += 1
                continue
            j = i
            while j + 1 < hi and low < h[j + 1] < high:
                gap = abs(a[j + 1] - a[j])
                if gap > 3.2 * step or abs(r[j + 1] - r[j]) > 0.16 + 0.003 * r[j]:
                    break
                j += 1
            n = j - i + 1
            width = (abs(a[j] - a[i]) + step) * r[i]
            if n >= 2 and width < 1.6 * widest and k < out.shape[0]:
                sx = sy = sz = sr = sh = sa = 0.0
                for q in range(i, j + 1):
                    sx += p[q, 0]
                    sy += p[q, 1]
                    sz += p[q, 2]
                    sr += r[q]
                    sh += h[q]
                    sa += a[q]
                # A side is free when what is seen beside the run lies behind it (or is nothing).
                free = 0.0
                mean = sr / n
                if i == lo or abs(a[i] - a[i - 1]) > 3.2 * step or r[i - 1] > mean + 0.3:
                    free += 1.0
                if j == hi - 1 or abs(a[j + 1] - a[j]) > 3.2 * step or r[j + 1] > mean + 0.3:
                    free += 1.0
                row = out[k]
                row[FIRST], row[LAST], row[RING] = i, j, ring
                row[PX], row[PY], row[PZ] = sx / n, sy / n, sz / n
                row[RANGE], row[WIDTH], row[FREE] = mean, width, free
                row[HEIGHT], row[COUNT], row[BEARING] = sh / n, n, sa / n
                k += 1
            i = j + 1
    return out[:k]


@njit(cache=True)
def link(runs):  # type: ignore[no-untyped-def]
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
