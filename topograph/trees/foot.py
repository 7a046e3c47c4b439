"""Where the ground lies under each tree, from what all sightings of it say."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from topograph.geometry import Array, transform
from topograph.trees.detections import Detections
from topograph.trees.robust import weighted_median

NEAR = 3.0
"""Range within which a sweep's ground is as good as it gets, m: beyond, beams graze the grass, and its error grows as the range."""
GROUND_SIGMA = 0.04
"""What no view of a tree shows: grass, mounds and furrows smaller than the cells of the front end's ground, m."""
OWN = 0.7
"""Share of the spread of a tree's grounds that they have in common; 0.5-1 tried on simulated seeds below 1000."""
SPREAD, SIGHTINGS = 0.012, 4.0
"""Spread of grounds that is there before any was compared, m per metre of range, and how many sightings it counts as."""


def grounds(detections: Detections, tree: NDArray[np.int64], map_T_scan: Array, n: int) -> tuple[Array, Array]:
    """Height (T,) of the ground under each of `n` trees in the map, and its sigma (T,), m: the median of what the sightings state,
    weighted by the inverse square of their range. NaN where no sighting saw ground (recorded detections).
    """
    d = detections
    z, sigma = np.full(n, np.nan), np.full(n, np.nan)
    rows = np.flatnonzero((tree >= 0) & np.isfinite(d.height) & np.isfinite(d.kinds).all(axis=1))
    if not len(rows):
        return z, sigma
    ground = transform(map_T_scan[d.scan[rows]], d.p[rows])[:, 2] - d.height[rows]
    weight = 1.0 / np.maximum(np.linalg.norm(d.p[rows, :2], axis=1), NEAR) ** 2
    order = np.argsort(tree[rows], kind="stable")
    ends = np.searchsorted(tree[rows][order], np.arange(n + 1))
    for j in np.flatnonzero(np.diff(ends)).tolist():
        mine = order[ends[j] : ends[j + 1]]
        z[j] = weighted_median(ground[mine], weight[mine])
        w = weight[mine]
        count = w.sum() ** 2 / (w @ w)  # as many sightings of one weight
        seen = 1.48 * weighted_median(np.abs(ground[mine] - z[j]), w)
        usual = SPREAD / np.sqrt(w.mean())
        spread = np.sqrt((SIGHTINGS * usual**2 + (count - 1.0) * seen**2) / (SIGHTINGS + count - 1.0))
        sigma[j] = np.hypot(GROUND_SIGMA, (OWN + (1.0 - OWN) / np.sqrt(count)) * spread)
    return z, sigma
