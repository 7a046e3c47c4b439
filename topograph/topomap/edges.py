"""Which trees are neighbours."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import Delaunay, QhullError, cKDTree

from topograph.geometry import Array
from topograph.ranges import Count, Positive, Share


@dataclass(frozen=True, slots=True)
class TopomapConfig:
    """Nodes, viewpoints and edges.

    Attributes:
        edges: "gabriel" (no radius needed) or "radius" (the thesis's rule, 4.3.3).
        radius: of the thesis's rule, m.
        viewpoint_cosine: least inner product of viewpoints that are one (4.3.3).
        clouds_per_viewpoint: clouds registered into one, the fullest first.
        voxel: of a viewpoint cloud, m.
    """

    edges: Literal["gabriel", "radius"] = "gabriel"
    radius: Positive = 8.0
    viewpoint_cosine: Share = 0.87
    clouds_per_viewpoint: Count = 10
    voxel: Positive = 0.02


def neighbours(xy: Array, config: TopomapConfig) -> NDArray[np.int64]:
    """Edges (E, 2) between trees at `xy` (T, 2), a < b.

    Gabriel graph: two trees are neighbours when no third stands in the circle over their distance. It is part of the
    Delaunay triangulation and needs no scale. The long edges that gaps and the outer rim leave are dropped: those
    more than three times the median edge at both their ends.

    >>> bent = np.array([[0.0, 0.0], [4.0, 0.5], [8.0, 0.0]])
    >>> neighbours(bent, TopomapConfig()).tolist()      # the first and the last have one between them
    [[0, 1], [1, 2]]
    """
    n = len(xy)
    if n < 2:
        return np.zeros((0, 2), np.int64)
    if config.edges == "radius":
        d = np.linalg.norm(xy[:, None] - xy[None], axis=2) if n <= 4000 else None
        if d is None:
            return np.asarray(np.sort(cKDTree(xy).query_pairs(config.radius, output_type="ndarray"), axis=1), np.int64)
        i, j = np.nonzero(np.triu(d < config.radius, 1))
        return np.stack([i, j], axis=1).astype(np.int64)
    pairs = _delaunay_pairs(xy)
    keep = np.ones(len(pairs), bool)
    middle = 0.5 * (xy[pairs[:, 0]] + xy[pairs[:, 1]])
    half2 = 0.25 * np.sum((xy[pairs[:, 0]] - xy[pairs[:, 1]]) ** 2, axis=1)
    distance, _ = cKDTree(xy).query(middle)
    keep &= distance**2 >= half2 * (1 - 1e-9)
    pairs = pairs[keep]
    length = np.linalg.norm(xy[pairs[:, 0]] - xy[pairs[:, 1]], axis=1)
    local = _median_by(pairs.ravel(), np.repeat(length, 2), n)
    short = length <= 3.0 * np.maximum(np.minimum(local[pairs[:, 0]], local[pairs[:, 1]]), np.median(length))
    return np.asarray(pairs[short], np.int64)


def _median_by(node: NDArray[np.int64], value: Array, n: int) -> Array:
    """Median (n,) of the values (M,) at each node (M,); infinity where there are none."""
    order = np.lexsort((value, node))
    count = np.bincount(node, minlength=n)
    first = np.cumsum(count) - count
    ordered = np.append(value[order], np.inf)
    low, high = first + np.maximum(count - 1, 0) // 2, first + count // 2
    return np.where(count > 0, 0.5 * (ordered[low] + ordered[high]), np.inf)


def _delaunay_pairs(xy: Array) -> NDArray[np.int64]:
    n = len(xy)
    try:
        simplices = Delaunay(xy).simplices if n >= 4 else None
    except QhullError:  # all on one line
        simplices = None
    if simplices is None:
        if n <= 3:
            pairs = [(a, b) for a in range(n) for b in range(a + 1, n)]
        else:
            main = np.linalg.svd(xy - xy.mean(0), full_matrices=False)[2][0]
            order = np.argsort(xy @ main)
            pairs = [(min(a, b), max(a, b)) for a, b in pairwise(order.tolist())]
        return np.array(pairs, np.int64).reshape(-1, 2)
    edges = np.concatenate([simplices[:, [0, 1]], simplices[:, [1, 2]], simplices[:, [2, 0]]])
    return np.asarray(np.unique(np.sort(edges, axis=1), axis=0), np.int64)


def among(xy: Array, chosen: NDArray[np.bool_], config: TopomapConfig) -> NDArray[np.int64]:
    """Edges (E, 2), rows of `xy` (T, 2), between the `chosen` (T,) alone."""
    rows = np.flatnonzero(chosen)
    return np.asarray(rows[neighbours(xy[rows], config)], np.int64)
