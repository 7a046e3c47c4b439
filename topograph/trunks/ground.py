"""The ground under a sweep: a robust plane and the grid of what the ground differs from it."""

from __future__ import annotations

import numpy as np
from numba import njit

from topograph.compiled import quantile, solve3
from topograph.trunks.organise import FAST, HALF

DIFFUSED = 12
"""Steps by which ground that was seen spreads into what was not: about as many metres."""


NOTHING = np.float32(1e9)
"""Height of a cell without ground, m."""


@njit(cache=True, error_model="numpy", fastmath=FAST)
def fit_ground(low):
    """Plane (3,) z = a + b x + c y, and residual heights (2·HALF, 2·HALF) on 1 m cells, all in the base's frame, m, from
    the lowest points of the cells (1e9: none).

    Lowest points of cells vote; a cell that stands above its neighbours shows a thing, not the ground. Gaps are
    filled by diffusion, towards the plane where nothing is near.
    """
    size = 2 * HALF
    xs = np.empty(size * size)
    ys, zs = np.empty(size * size), np.empty(size * size)
    n = 0
    for i in range(size):
        for j in range(size):
            u, v = i - HALF + 0.5, j - HALF + 0.5
            if low[i, j] < 1e8 and u * u + v * v < 225.0:
                xs[n], ys[n], zs[n] = u, v, low[i, j]
                n += 1
    plane = np.zeros(3)
    grid = np.zeros((size, size), np.float32)
    if n < 6:
        return plane, grid
    near = np.empty(n)
    m = 0
    for k in range(n):
        if xs[k] ** 2 + ys[k] ** 2 < 49.0:
            near[m] = zs[k]
            m += 1
    plane[0] = quantile(near[:m], 0.25) if m > 5 else quantile(zs[:n], 0.15)
    less = np.empty(n)
    for k in range(n):
        less[k] = 1.0 / (1.0 + 0.01 * (xs[k] ** 2 + ys[k] ** 2))
    for turn in range(6):
        s = np.zeros((3, 3))
        t = np.zeros(3)
        width = 0.6 if turn < 3 else 0.25
        for k in range(n):
            e = zs[k] - plane[0] - plane[1] * xs[k] - plane[2] * ys[k]
            q = e / width if e < 0 else 2.0 * e / width
            w = 1.0 / (1.0 + q * q) ** 2
            w *= less[k]
            s[0, 0] += w
            s[0, 1] += w * xs[k]
            s[0, 2] += w * ys[k]
            s[1, 1] += w * xs[k] * xs[k]
            s[1, 2] += w * xs[k] * ys[k]
            s[2, 2] += w * ys[k] * ys[k]
            t[0] += w * zs[k]
            t[1] += w * zs[k] * xs[k]
            t[2] += w * zs[k] * ys[k]
        s[1, 0], s[2, 0], s[2, 1] = s[0, 1], s[0, 2], s[1, 2]
        s[1, 1] += 1.0  # a weak pull to level: a few cells in a row fix no slope
        s[2, 2] += 1.0
        s[0, 0] += 1e-9
        solved = solve3(s, t)
        plane[0], plane[1], plane[2] = solved[0], solved[1], solved[2]
    # A rim of two cells of nothing: no neighbour is looked for outside.
    high = np.full((size + 4, size + 4), NOTHING)
    for i in range(size):
        for j in range(size):
            if low[i, j] < 1e8:
                u, v = i - HALF + 0.5, j - HALF + 0.5
                e = low[i, j] - plane[0] - plane[1] * u - plane[2] * v
                bound = 0.4 + 0.035 * np.sqrt(u * u + v * v)
                if -bound - 0.3 < e < bound:
                    high[i + 2, j + 2] = e
    # A cell much above a neighbour shows a thing; drop it.
    reach = np.empty((5, 5), np.float32)
    for di in range(5):
        for dj in range(5):
            reach[di, dj] = 0.12 * np.sqrt((di - 2.0) ** 2 + (dj - 2.0) ** 2)
    for _ in range(2):
        for i in range(1, size - 1):
            for j in range(1, size - 1):
                if high[i + 2, j + 2] >= NOTHING:
                    continue
                least = NOTHING
                for di in range(5):
                    for dj in range(5):
                        least = min(least, high[i + di, j + dj] + reach[di, dj])
                if high[i + 2, j + 2] > least + np.float32(0.12):
                    high[i + 2, j + 2] = NOTHING
    valid = high[2:-2, 2:-2] < NOTHING
    for i in range(size):
        for j in range(size):
            grid[i, j] = high[i + 2, j + 2] if valid[i, j] else 0.0
    share, around = np.zeros((size, size), np.float32), np.zeros((size, size), np.float32)
    for i in range(1, size - 1):
        for j in range(1, size - 1):
            around[i, j] = 0.25 * 0.25 if valid[i, j] else 0.25 * 0.985
            share[i, j] = 0.75 if valid[i, j] else 0.0
    other = grid.copy()
    for _ in range(DIFFUSED):
        for i in range(1, size - 1):
            for j in range(1, size - 1):
                sides = grid[i - 1, j] + grid[i + 1, j] + grid[i, j - 1] + grid[i, j + 1]
                other[i, j] = share[i, j] * grid[i, j] + around[i, j] * sides
        grid, other = other, grid
    return plane, grid


@njit(cache=True, error_model="numpy")
def ground_at(x, y, plane, grid):
    """Ground height at a position in the base's frame, bilinear between cell centres."""
    u, v = x + HALF - 0.5, y + HALF - 0.5
    i, j = int(np.floor(u)), int(np.floor(v))
    z = plane[0] + plane[1] * x + plane[2] * y
    if i < 0 or j < 0 or i > 2 * HALF - 2 or j > 2 * HALF - 2:
        return z
    a, b = u - i, v - j
    return (
        z
        + (1 - a) * ((1 - b) * grid[i, j] + b * grid[i, j + 1])
        + a * ((1 - b) * grid[i + 1, j] + b * grid[i + 1, j + 1])
    )
