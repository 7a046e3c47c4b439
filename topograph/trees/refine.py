"""Association once the path is known: tracks that are one tree, tracks that are not, stems of one tree."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from topograph.geometry import Array
from topograph.trees.loops import TrackTable
from topograph.trees.robust import weighted_median
from topograph.trees.tracks import TreesConfig
from topograph.trunks.fit import NOT_ONE

AT_HOME = 0.2
"""A tree of one stem that an earlier map knows is seen within this of its place, m, and three deviations. Where hardly a sighting is, what stands
further away is something else: the tree may have been felled, and another planted beside its stump."""
HARDLY = 0.25
"""Share of the sightings of what is joined to such a tree."""
TOLD = 1.0
"""Log-odds from which a track is surely of one kind."""


def refine(
    tracks: TrackTable, tree: NDArray[np.int64], config: TreesConfig, patience: float = 0.0
) -> NDArray[np.int64]:
    """Tree (T,) of each track, renumbered from 0, given the tracks as the solved map has them.

    A track that does not fit its tree leaves it, when it is also farther than `patience` m from it: a map that has
    just closed its loops is still bent. Then trees that lie within each other's gate, or whose feet or points are nearer
    than `config.merge` (a thick trunk's pieces: than its radius), become one, but for a post beside a tree. Rare tracks join a tree when they fit and are trees of their own otherwise.
    Two trees of an earlier map are two, and what joins one of them has seen it where it stands, or is a piece of what has (once `patience` is over).
    """
    place, sigma, hits = tracks.place, tracks.sigma, tracks.hits
    tree = _leave(tracks, _apart(tracks, tree.copy()), config, patience)
    for _ in range(4):
        ids, index = np.unique(tree, return_inverse=True)
        w = hits / np.maximum(sigma, config.floor) ** 2
        total = np.bincount(index, w)
        centre = np.stack([np.bincount(index, w * place[:, k]) / total for k in range(2)], axis=1)
        spread = np.bincount(index, w * sigma) / total
        foot = np.stack([np.bincount(index, w * tracks.foot[:, k]) / total for k in range(2)], axis=1)
        width = np.bincount(index, w * tracks.width) / total
        post = np.bincount(index, w * tracks.post) / total
        pairs = cKDTree(centre).query_pairs(max(3.0 * config.merge, 1.0), output_type="ndarray")
        a, b = pairs.T
        apart = np.linalg.norm(centre[a] - centre[b], axis=1)
        d = np.minimum(apart, np.linalg.norm(foot[a] - foot[b], axis=1))
        variance = spread[a] ** 2 + spread[b] ** 2 + 2 * config.floor**2
        fits = (d < _near(np.maximum(width[a], width[b]), config)) | (d**2 < 0.5 * config.gate * variance)
        fits &= _allowed(tracks, index, a, b, centre, patience)
        fits &= ~((post[a] * post[b] < 0) & (np.minimum(abs(post[a]), abs(post[b])) > TOLD) & (apart > NOT_ONE))
        if not fits.any():
            break
        name = np.arange(len(ids))
        joined: set[int] = set()
        for k in np.argsort(d):
            i, j = pairs[k].tolist()
            if fits[k] and i not in joined and j not in joined:  # one merge a round: centres move
                name[j] = i
                joined |= {i, j}
        tree = ids[name[index]]
    return np.asarray(np.unique(tree, return_inverse=True)[1])


def _apart(tracks: TrackTable, tree: NDArray[np.int64]) -> NDArray[np.int64]:
    """Tree (T,) of each track where no two trees of an earlier map are one: what was theirs goes to the nearest of them."""
    fresh = int(tree.max(initial=0)) + 1
    ids, count = np.unique(tree[tracks.known], return_counts=True)
    for k in ids[count > 1].tolist():
        members = np.flatnonzero(tree == k)
        known = members[tracks.known[members]]
        to = np.linalg.norm(tracks.place[members, None] - tracks.place[None, known], axis=2).argmin(axis=1)
        to[tracks.known[members]] = np.arange(len(known))
        tree[members] = np.where(to == 0, k, fresh + to - 1)
        fresh += len(known) - 1
    return tree


def _home(tracks: TrackTable, known: NDArray[np.int64]) -> Array:
    """How far (Q,) from the places of `known` tracks they are seen, m."""
    return np.asarray(AT_HOME + 3.0 * tracks.sigma[known])


def _allowed(
    tracks: TrackTable,
    index: NDArray[np.int64],
    a: NDArray[np.int64],
    b: NDArray[np.int64],
    centre: Array,
    patience: float,
) -> NDArray[np.bool_]:
    """Which of the pairs of trees `a`, `b` (P,), of `index` (T,) of each track, may be one, with an earlier map's among them; `centre` of each."""
    n = len(centre)
    row = np.full(n, -1)  # of the known tree that a tree is
    known = np.flatnonzero(tracks.known)
    row[index[known]] = known
    out = ~((row[a] >= 0) & (row[b] >= 0))
    if patience > 0.0 or not len(known):
        return out
    own = row[index]  # (T,) the known tree of each track's tree
    seen = np.flatnonzero((own >= 0) & ~tracks.known)
    close = np.linalg.norm(tracks.place[seen] - tracks.place[own[seen]], axis=1) < _home(tracks, own[seen])
    there = np.bincount(index[seen[close]], tracks.hits[seen[close]], n)
    total = np.bincount(index, np.where(tracks.known, 0, tracks.hits), n)
    for one, other in ((a, b), (b, a)):
        lonely = (row[one] >= 0) & (there[one] < HARDLY * (total[one] + total[other]))
        lonely[lonely] &= tracks.single[row[one[lonely]]]
        apart = np.linalg.norm(tracks.place[row[one[lonely]]] - centre[other[lonely]], axis=1)
        out[lonely] &= apart < _home(tracks, row[one[lonely]])
    return np.asarray(out)


def _near(width: Array, config: TreesConfig) -> Array:
    """Distance, m, within which pieces of trunks of this `width` are of one."""
    return np.asarray(config.merge + 0.4 * np.maximum(width - 0.2, 0.0))


def _at_home(tracks: TrackTable, group: NDArray[np.int64], bound: Array) -> Array:
    """The `bound` (G,) within which the tracks of a `group` stay: where it is a single tree of an earlier map, and hardly any of them has seen
    that where it stands, the others are not it."""
    known = group[tracks.known[group] & tracks.single[group]]
    if not len(known):
        return bound
    off = np.linalg.norm(tracks.place[group] - tracks.place[known[0]], axis=1)
    home = float(_home(tracks, known[:1])[0])
    hits = np.where(tracks.known[group], 0, tracks.hits[group])
    if hits[off < home].sum() >= HARDLY * hits.sum():
        return bound
    return np.where(off < home, bound, 0.0)


def _leave(tracks: TrackTable, tree: NDArray[np.int64], config: TreesConfig, patience: float) -> NDArray[np.int64]:
    fresh = int(tree.max(initial=0)) + 1
    order = np.argsort(tree, kind="stable")
    for group in np.split(order, np.flatnonzero(np.diff(tree[order])) + 1):
        if len(group) < 2:
            continue
        # Weighted median: a wrong track must not drag the tree towards itself.
        d = np.full(len(group), np.inf)
        for at in (tracks.place[group], tracks.foot[group]):  # stems of one tree are near each other at one of them
            centre = np.array([weighted_median(at[:, k], tracks.hits[group]) for k in range(2)])
            d = np.minimum(d, np.linalg.norm(at - centre, axis=1))
        bound = np.sqrt(config.gate * (tracks.sigma[group] ** 2 + 2 * config.floor**2))
        width = np.maximum(tracks.width[group], np.average(tracks.width[group], weights=tracks.hits[group]))
        # What would be joined again does not leave: else it went to and fro from round to round.
        bound = np.maximum(bound, _near(width, config))
        bound = np.maximum(_at_home(tracks, group, bound) if patience == 0.0 else bound, patience)
        bound[tracks.known[group]] = np.inf
        for g in group[d > bound]:
            tree[g] = fresh
            fresh += 1
    return tree
