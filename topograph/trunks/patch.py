"""What the beams say of the space around a column: which heights and sides of it they met, and which they passed."""

from __future__ import annotations

import numpy as np
from numba import njit

from topograph.trunks.organise import FAST
from topograph.trunks.passage import BINS, MARGIN, bin_of

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

_LEVELS, _SIDES = np.array(LEVELS, np.float32), np.array(SIDES, np.float32)


BEAMS = BINS // 2
"""Looked at to one side of a column at most: half a turn."""


@njit(cache=True, error_model="numpy", fastmath=FAST)
def look_at_patch(around, crossed, ground, radius, work, out):
    """(PATCH_SIZE,) `out` of a column that the rings cross as in `crossed` (4, rings), see passage.py: for each height and
    distance beside it the balance of beams that met something at its range and of those that passed, -1 to 1, and how much
    was looked at, 0 to 1.

    `around` (rings, 2 BINS) is the rings' image with half a turn more at either end; `work` (2, BEAMS) int32 is written over.
    """
    sums = np.zeros((ROWS, COLUMNS, 2), np.int32)  # met; passed, in halves
    hit, passed = work[0], work[1]
    side, none = np.float32(radius), np.float32(0.0)
    for k in range(around.shape[0]):
        h = crossed[0, k] - ground
        if h < _LEVELS[0] or h >= _LEVELS[ROWS]:
            continue
        row = 0
        while h >= _LEVELS[row + 1]:
            row += 1
        d, dx, dy = crossed[1, k], crossed[2, k], crossed[3, k]
        a = abs(dx) + abs(dy)
        bins = np.float32(BINS / 4.0) * d / (a * a)  # of the diamond angle, in a metre across
        every = max(int(np.float32(FINEST) * bins), 1)
        n = min(int((side + _SIDES[COLUMNS - 1]) * bins), BEAMS - 1) // every + 1
        tolerance = np.float32(0.2) + side + np.float32(0.01) * d
        first, last = max(d - tolerance, none), d + tolerance
        behind = max(d + np.float32(MARGIN), last)
        sky = np.int32(h > 1.8)  # no return is the sky, half a beam that passed; lower down nobody knows
        _judge(around[k], bin_of(dx, dy) + BEAMS, every, n, first, last, behind, sky, hit, passed)
        q = 0
        for column in range(COLUMNS):
            end = min(int((side + _SIDES[column]) * bins) // every, n - 1)
            hits, passes = np.int32(0), np.int32(0)
            while q <= end:
                hits += hit[q]
                passes += passed[q]
                q += 1
            sums[row, column, 0] += hits
            sums[row, column, 1] += passes
    n = 0
    one, half = np.float32(1.0), np.float32(0.5)
    for row in range(ROWS):
        for column in range(COLUMNS):
            met, through = np.float32(sums[row, column, 0]), half * np.float32(sums[row, column, 1])
            total = met + through
            out[n] = (met - through) / (total + one)
            out[n + 1] = total / (total + one + one)
            n += 2


@njit(cache=True, error_model="numpy", fastmath=FAST, inline="always")
def _judge(ring, middle, every, n, first, last, behind, sky, hit, passed):
    """Of each pair of beams left and right, from the middle outwards: how many met something between `first` and `last`; and how many
    went further than `behind`, in halves; no return is `sky` of them. Without a branch: what a beam met is as good as a toss.
    """
    one, two, no, none = np.int32(1), np.int32(2), np.int32(0), np.float32(0.0)
    b, e = np.uint64(middle), np.uint64(every)
    for i in range(np.uint64(n)):  # unsigned: no index is below zero
        v, w = ring[b + e * i], ring[b - e * i]
        hit[i] = (one if (v > first) & (v < last) else no) + (one if (w > first) & (w < last) else no)
        passed[i] = (two if v > behind else (sky if v == none else no)) + (
            two if w > behind else (sky if w == none else no)
        )
    v = ring[b]  # one beam is in the middle
    hit[0] = one if (v > first) & (v < last) else no
    passed[0] = two if v > behind else (sky if v == none else no)
