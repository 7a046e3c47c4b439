"""All rigid placements of a submap on the map, seeded by pairs of landmarks, best first.

Every pair of trees as far apart as an anchor pair of landmarks is a seed: linear in the size of the map. A seed is
scored landmark by landmark and dropped once it is `bound` nats behind the best.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from topograph.geometry import Array
from topograph.places.config import PlacesConfig
from topograph.places.index import MapIndex
from topograph.places.search_kernels import Marks, Prior, distinct_kernel, seed_kernel


@dataclass(frozen=True, slots=True, kw_only=True)
class Landmarks:
    """A submap's landmarks as the search sees them.

    Attributes:
        m: (n, 2) in the submap's frame, m; `cov` (2n, 2n) joint.
        var: (n,) per axis with the rigid motion of the whole taken out (S-transform, Baarda 1973), m².
        diameter, diameter_var: (n,) m or NaN, m².
        tree: (n,) log chance of its hits and misses if it is a mapped tree that was seen.
        other: (n,) log density, 1/m², of things with its hits and misses that are not in the map.
        lasting: (n,) chance that it is a mapped tree, before any search.
    """

    m: Array
    cov: Array
    var: Array
    diameter: Array
    diameter_var: Array
    tree: Array
    other: Array
    lasting: Array

    def __len__(self) -> int:
        return len(self.m)

    @property
    def bundle(self) -> Marks:
        """What kernels take of them."""
        return Marks(self.m, self.var, self.diameter, self.diameter_var, self.tree, self.other)


@dataclass(frozen=True, slots=True)
class Found:
    """Placements by rising loss: `pose` (M, 3) x, y, yaw of the submap's frame in the map, `loss` (M,) nats; `rest`, how many
    more were as good as the last one, and `seeds` tried."""

    pose: Array
    loss: Array
    rest: float
    seeds: int


def spread(m: Array, cov: Array) -> Array:
    """Variances (n,) per axis of landmarks (n, 2) when the submap may be moved rigidly to fit best (S-transform)."""
    n = len(m)
    J = np.zeros((2 * n, 3))
    d = m - m.mean(0)
    J[0::2, 0] = J[1::2, 1] = 1.0
    J[0::2, 2], J[1::2, 2] = -d[:, 1], d[:, 0]
    w = 1.0 / np.maximum(np.diag(cov), 1e-8)
    S = np.eye(2 * n) - J @ np.linalg.solve((J.T * w) @ J + 1e-9 * np.eye(3), J.T * w)
    v = np.sum((S @ cov) * S, axis=1)
    return np.asarray(np.maximum(0.5 * (v[0::2] + v[1::2]), 1e-6))


ANYWHERE = Prior(np.zeros(3), np.zeros((2, 2)), 1e12)
"""Nothing is known of the place beforehand."""
SLICE = 4_000
"""Pairs of trees that are tried at once while tracking: some five milliseconds."""
MOST_ANCHORS = 12
"""Pairs of landmarks that a search begins with."""
FEWER = 40
"""Placements that are weighed with their full covariance while tracking; those beyond count as rivals all the same."""


def search(marks: Landmarks, index: MapIndex, config: PlacesConfig, prior: Prior = ANYWHERE) -> Found:
    """Placements within `config.bound` nats of the best, those far off the `prior` left out."""
    for found in searching(marks, index, config, len(index.length) + 1, config.modes, prior):
        if found is not None:
            return found
    raise AssertionError("a search ends with what it found")


def searching(
    marks: Landmarks, index: MapIndex, config: PlacesConfig, size: int = SLICE, modes: int = FEWER, prior: Prior = ANYWHERE,
) -> Iterator[Found | None]:  # fmt: skip
    """`search` in slices of so many pairs of trees: None while it goes on, then what it found."""
    pairs = _anchors(marks, index, config)
    poses: list[Array] = []
    losses: list[Array] = []
    best, seeds, tried, missed = np.inf, 0, 0, 1.0
    order_all = np.argsort(marks.var - 0.02 * marks.lasting)
    bundle = marks.bundle._replace(other=marks.other - marks.tree)
    alone = marks.tree - marks.other  # what a landmark costs that is no mapped tree
    typical = float(np.sum(np.maximum(alone - np.log(2 * np.pi * (marks.var + config.map_sigma**2)), 0.0)))
    for used, (i, j, p_both, low, high) in enumerate(pairs):
        if missed < config.anchors and (best < 0.5 * typical or used >= 6):
            break
        order = np.concatenate([[i, j], order_all[(order_all != i) & (order_all != j)]]).astype(np.int64)
        for at in range(low, high, size):
            a, b = index.a[at : min(at + size, high)], index.b[at : min(at + size, high)]
            if len(a) > 5000:  # neighbours after each other: the raster's cells are still in the processor's cache
                near = np.argsort(index.place[a], kind="stable")
                a, b = a[near], b[near]
            pose, loss, best = seed_kernel(
                bundle, order, a, b, index.trees, best, config.bound, config.map_sigma, prior
            )
            poses.append(pose)
            losses.append(loss)
            tried += len(a)
            if tried >= size:
                tried = 0
                yield None
        seeds += 2 * (high - low)
        missed *= 1.0 - p_both
    if not poses:
        yield Found(np.zeros((0, 3)), np.zeros(0), 0.0, 0)
        return
    pose, loss = np.concatenate(poses), np.concatenate(losses)
    good = loss < best + config.bound
    pose, loss = pose[good], loss[good]
    rows = np.argsort(loss)
    if len(rows) > 20000:
        rows = rows[:20000]
    kept, rest = distinct_kernel(pose[rows], loss[rows], marks.m.mean(0), modes)
    yield Found(pose[rows][kept], loss[rows][kept], rest * (len(loss) / max(len(rows), 1)), seeds)


def _anchors(marks: Landmarks, index: MapIndex, config: PlacesConfig) -> list[tuple[int, int, float, int, int]]:
    """Pairs (i, j) of landmarks, the chance that both are mapped trees, and the range of tree pairs as far apart.

    First pairs of disjoint landmarks, the surest first: never those with the fewest candidates, for an odd distance is
    the mark of a false detection.
    """
    n = len(marks)
    if n < 2 or not len(index.length):
        return []
    a, b = np.triu_indices(n, 1)
    d = marks.m[a] - marks.m[b]
    length = np.hypot(d[:, 0], d[:, 1])
    u = d / np.maximum(length, 1e-6)[:, None]
    block = marks.cov.reshape(n, 2, n, 2)
    V = block[a, :, a] + block[b, :, b] - block[a, :, b] - block[b, :, a]
    var = np.einsum("pi,pij,pj->p", u, V, u) + 2 * (config.map_sigma**2 + float(np.median(index.var)))
    slack = 3.6 * 1.4 * np.sqrt(np.maximum(var, 1e-8))
    low = np.searchsorted(index.length, (length - slack).astype(np.float32))
    high = np.searchsorted(index.length, (length + slack).astype(np.float32))
    # In a lattice all pairs of one length may lie just beyond what is listed: what cannot be found must not be looked for.
    usable = (length > 1.0) & (high > low) & (length + slack < index.reach)
    # A landmark whose distances to the others the map hardly knows is likely none of its trees.
    known = np.zeros(n)
    total = np.zeros(n)
    np.add.at(known, a, usable)
    np.add.at(known, b, usable)
    within = length < index.reach
    np.add.at(total, a, within)
    np.add.at(total, b, within)
    q = marks.lasting * np.clip((known + 1) / (total + 1), 0.05, 1.0)
    both = q[a] * q[b]
    # Long pairs hold the heading; many candidates cost time.
    value = np.log(np.maximum(both, 1e-9)) + 0.1 * np.log(length + 1) - 0.08 * np.log(high - low + 1.0)
    best = [k for k in np.argsort(-value).tolist() if usable[k]]
    chosen: dict[int, None] = {}  # in the order in which they were chosen
    busy = np.zeros(n, np.int64)
    for limit in (1, 2, 4):
        for k in best:
            if len(chosen) == MOST_ANCHORS:
                break
            if k not in chosen and max(busy[a[k]], busy[b[k]]) < limit:
                busy[a[k]] += 1
                busy[b[k]] += 1
                chosen[k] = None
    return [(int(a[k]), int(b[k]), float(both[k]), int(low[k]), int(high[k])) for k in chosen]
