"""Addresses of trees: block, row, and number in the row."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from topograph.geometry import Array


def blocks_of(n: int, edges: NDArray[np.int64], chosen: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Block (n,) of each of the `chosen` (n,) nodes, from 1, the largest first: what edges (E, 2) join; 0 for the others."""
    out = np.zeros(n, np.int64)
    if not chosen.any():
        return out
    graph = coo_matrix((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(n, n))
    label = connected_components(graph, directed=False)[1]
    size = np.bincount(label[chosen], minlength=int(label.max()) + 1)
    first = np.full(len(size), n)
    np.minimum.at(first, label, np.arange(n))
    rank = np.empty(len(size), np.int64)
    rank[np.lexsort((first, -size))] = 1 + np.arange(len(size))
    out[chosen] = rank[label[chosen]]
    return out


def places_of(xy: Array, block: NDArray[np.int64], row: NDArray[np.int64], chosen: NDArray[np.bool_]) -> list[str]:
    """Address of each node at `xy` (n, 2): "B1 R03 T07", block, row and number along the row; without rows "B1 T07"; "" for others.

    Rows keep the number that `find_rows` gave them, from 1. Trees are counted along the rows from the end that lies further to the south
    (then west).
    """
    out = [""] * len(xy)
    for b in np.unique(block[chosen]).tolist():
        mine = np.flatnonzero(chosen & (block == b))
        along = _along(xy[mine], row[mine])
        for r in np.unique(row[mine]).tolist():
            here = mine[row[mine] == r]
            order = here[np.argsort(xy[here] @ along, kind="stable")]
            name = f"B{b} R{r + 1:02d}" if r >= 0 else f"B{b}"
            for k, i in enumerate(order.tolist()):
                out[i] = f"{name} T{k + 1:02d}"
    return out


def _along(xy: Array, row: NDArray[np.int64]) -> Array:
    """Unit vector (2,) along the rows, to the north (then east); to the north without rows."""
    total = np.zeros((2, 2))
    for r in np.unique(row[row >= 0]).tolist():
        d = xy[row == r] - xy[row == r].mean(axis=0)
        total += d.T @ d
    if not total.any():
        return np.array([0.0, 1.0])
    main = np.linalg.eigh(total)[1][:, 1]
    return np.asarray(main if (round(float(main[1]), 9), main[0]) > (0.0, 0.0) else -main)
