"""What the beams say of the space around a column: which heights and sides of it they met, and which they passed."""

from __future__ import annotations

import numpy as np
from numba import njit

from topograph.trunks.organise import FAST
from topograph.trunks.passage import BINS, MARGIN, bin_of, wrapped

LEVELS = (0.05, 0.3, 0.6, 1.0, 1.4, 1.8, 2.3, 3.2, 4.5)
"""Heights above ground between the patch's rows, m."""
SIDES = (0.0, 0.12, 0.3, 0.6, 1.1)
"""Distances from the column's side between the patch's columns, m; before the first lies the column itself."""
ROWS, COLUMNS = len(LEVELS) - 1, len(SIDES)
PATCH_SIZE = 2 * ROWS * COLUMNS
PATCH_NAMES = tuple(
    f"{what}_{row}_{column}" for row in range(ROWS) for column in range(COLUMNS) for what in ("met", "seen")
)
"""Features of the patch, row by row from the ground up."""
HIGH_NAMES = tuple(n for n in PATCH_NAMES if LEVELS[int(n.split("_")[1])] >= 1.8)
"""Those above trunk height."""
FINEST = 0.07
"""Directions nearer to each other than this at the column's range are not looked at one by one, m."""

_LEVELS, _SIDES = np.array(LEVELS), np.array(SIDES)


@njit(cache=True, error_model="numpy", fastmath=FAST)
def look_at_patch(near, crossed, ground, radius, out):
    """(PATCH_SIZE,) `out` of a column that the rings cross as in `crossed` (rings, 4), see passage.py: for each height and
    distance beside it the balance of beams that met something at its range and of those that passed, -1 to 1, and how much
    was looked at, 0 to 1.
    """
    met, through = np.zeros((ROWS, COLUMNS), np.float32), np.zeros((ROWS, COLUMNS), np.float32)
    one, zero = np.float32(1.0), np.float32(0.0)
    for k in range(near.shape[0]):
        h = crossed[k, 0] - ground
        if h < _LEVELS[0] or h >= _LEVELS[ROWS]:
            continue
        row = 0
        while h >= _LEVELS[row + 1]:
            row += 1
        d, dx, dy = crossed[k, 1], crossed[k, 2], crossed[k, 3]
        b = bin_of(dx, dy)
        a = abs(dx) + abs(dy)
        width = (4.0 / BINS) * a * a / d  # of a bin of the diamond angle, in metres across
        every = max(int(FINEST / width), 1)
        first, last = np.float32(d - 0.2 - radius - 0.01 * d), np.float32(d + 0.2 + radius + 0.01 * d)
        behind = max(np.float32(d + MARGIN), last)
        sky = np.float32(0.5) if h > 1.8 else zero  # no return: the sky; lower down nobody knows
        ring = near[k]
        q = 0
        for column in range(COLUMNS):
            end = min(int((radius + _SIDES[column]) / width), BINS // 2 - 1)
            hits, passes = zero, zero
            while q <= end:  # sums without a branch: what a beam met is as good as a toss
                v = ring[wrapped(b + q)]
                hits += (v > first) & (v < last) & (v > zero)
                passes += (v > behind) + sky * (v == zero)
                if q > 0:
                    v = ring[wrapped(b - q)]
                    hits += (v > first) & (v < last) & (v > zero)
                    passes += (v > behind) + sky * (v == zero)
                q += every
            met[row, column] += hits
            through[row, column] += passes
    n = 0
    for row in range(ROWS):
        for column in range(COLUMNS):
            total = met[row, column] + through[row, column]
            out[n] = (met[row, column] - through[row, column]) / (total + one)
            out[n + 1] = total / (total + 2 * one)
            n += 2
