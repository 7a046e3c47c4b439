"""What the beams say of the space around a column: which heights and sides of it they met, and which they passed."""

from __future__ import annotations

import numpy as np
from numba import njit

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
FINEST = 0.05
"""Directions nearer to each other than this at the column's range are not looked at one by one, m."""

_LEVELS, _SIDES = np.array(LEVELS), np.array(SIDES)


@njit(cache=True)
def look_at_patch(near, tangent, R, eye, x, y, z, lx, ly, ground, radius, out):
    """(PATCH_SIZE,) `out` of the column through (x, y, z) with slope (lx, ly): for each height and distance beside it the
    balance of beams that met something at its range and of those that passed, -1 to 1, and how much was looked at, 0 to 1.
    """
    out[:] = 0.0
    ax, ay, az = R[0, 2], R[1, 2], R[2, 2]
    if abs(az) < 0.3:
        return
    met, through = np.zeros((ROWS, COLUMNS)), np.zeros((ROWS, COLUMNS))
    for k in range(near.shape[0]):
        zk = z
        for _ in range(3):  # a ring is a cone about the sensor's axis: where it crosses the column
            dx, dy, dz = x + lx * (zk - z) - eye[0], y + ly * (zk - z) - eye[1], zk - eye[2]
            up = ax * dx + ay * dy + az * dz
            flat = np.sqrt(max(dx * dx + dy * dy + dz * dz - up * up, 1e-6))
            zk += (tangent[k] * flat - up) / az
            zk = min(max(zk, z - 8.0), z + 8.0)
        h = zk - ground
        if h < _LEVELS[0] or h >= _LEVELS[ROWS]:
            continue
        row = 0
        while h >= _LEVELS[row + 1]:
            row += 1
        dx, dy = x + lx * (zk - z) - eye[0], y + ly * (zk - z) - eye[1]
        d = np.sqrt(dx * dx + dy * dy)
        b = bin_of(dx, dy)
        a = abs(dx) + abs(dy)
        width = (4.0 / BINS) * a * a / d  # of a bin of the diamond angle, in metres across
        every = max(int(FINEST / width), 1)
        wide = int((radius + _SIDES[COLUMNS - 1]) / width)
        tolerance = 0.2 + radius + 0.01 * d
        for q in range(-(wide // every) * every, wide + 1, every):
            v = near[k, (b + q) % BINS]
            side = abs(q) * width - radius
            column = 0
            while column < COLUMNS - 1 and side > _SIDES[column]:
                column += 1
            if v == 0:
                through[row, column] += 0.5 if h > 1.8 else 0.0  # the sky; lower down nobody knows
            elif abs(v - d) < tolerance:
                met[row, column] += 1.0
            elif v > d + MARGIN:
                through[row, column] += 1.0
    n = 0
    for row in range(ROWS):
        for column in range(COLUMNS):
            total = met[row, column] + through[row, column]
            out[n] = (met[row, column] - through[row, column]) / (total + 1.0)
            out[n + 1] = total / (total + 2.0)
            n += 2
