"""Association once the path is known: tracks that are one tree, tracks that are not, stems of one tree."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from topograph.geometry import Array
from topograph.trees.tracks import TreesConfig


def refine(
    place: Array,
    sigma: Array,
    hits: NDArray[np.int64],
    tree: NDArray[np.int64],
    config: TreesConfig,
    patience: float = 0.0,
) -> NDArray[np.int64]:
    """Tree (T,) of each track, renumbered from 0, given the tracks' places (T, 2), sigmas and hits in the solved map.

    A track that does not fit its tree leaves it, when it is also farther than `patience` m from it: a map that has
    just closed its loops is still bent. Then trees that lie within each other's gate, or nearer than
    `config.merge`, become one. Rare tracks join a tree when they fit and are trees of their own otherwise.
    """
    tree = _leave(place, sigma, hits, tree.copy(), config, max(patience, config.merge))
    for _ in range(4):
        ids, index = np.unique(tree, return_inverse=True)
        w = hits / np.maximum(sigma, config.floor) ** 2
        total = np.bincount(index, w)
        centre = np.stack([np.bincount(index, w * place[:, k]) / total for k in range(2)], axis=1)
        spread = np.bincount(index, w * sigma) / total
        pairs = cKDTree(centre).query_pairs(max(3.0 * config.merge, 1.0), output_type="ndarray")
        d = np.linalg.norm(centre[pairs[:, 0]] - centre[pairs[:, 1]], axis=1)
        variance = spread[pairs[:, 0]] ** 2 + spread[pairs[:, 1]] ** 2 + 2 * config.floor**2
        fits = (d < config.merge) | (d**2 < 0.5 * config.gate * variance)
        if not fits.any():
            break
        name = np.arange(len(ids))
        joined: set[int] = set()
        for k in np.argsort(d):
            a, b = pairs[k].tolist()
            if fits[k] and a not in joined and b not in joined:  # one merge a round: centres move
                name[b] = a
                joined |= {a, b}
        tree = ids[name[index]]
    return np.asarray(np.unique(tree, return_inverse=True)[1])


def _leave(
    place: Array,
    sigma: Array,
    hits: NDArray[np.int64],
    tree: NDArray[np.int64],
    config: TreesConfig,
    patience: float,
) -> NDArray[np.int64]:
    fresh = int(tree.max(initial=0)) + 1
    order = np.argsort(tree, kind="stable")
    for group in np.split(order, np.flatnonzero(np.diff(tree[order])) + 1):
        if len(group) < 2:
            continue
        # Weighted median: a wrong track must not drag the tree towards itself.
        centre = np.array([_weighted_median(place[group, k], hits[group]) for k in range(2)])
        d = np.linalg.norm(place[group] - centre, axis=1)
        bound = np.sqrt(config.gate * (sigma[group] ** 2 + 2 * config.floor**2))
        for g in group[d > np.maximum(bound, patience)]:
            tree[g] = fresh
            fresh += 1
    return tree


def _weighted_median(x: Array, w: NDArray[np.int64]) -> float:
    order = np.argsort(x)
    total = np.cumsum(w[order])
    return float(x[order][np.searchsorted(total, 0.5 * total[-1])])
