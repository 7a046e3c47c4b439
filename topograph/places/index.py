"""The map as the search sees it: nearest tree, pairs by length, irregularity. Below 1 kB a tree."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from topograph.geometry import Array
from topograph.places.search_kernels import Grid, Trees, fill_kernel

DIAMETER_NOISE = 0.02
"""Standard deviation of a mapped diameter, m: orchards whose diameters vary no more than this are all alike."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MapIndex:
    """Trees in the plane, and what answers the search's questions in constant time.

    Attributes:
        xy: (T, 2) m; `var` (T,) variance per axis, m²; `diameter` (T,) m or NaN.
        origin, cell: of the raster `nearest` (X, Y): the tree nearest to each cell's centre, -1: none near.
        bucket, start, member: coarse cells of `bucket` m (see `buckets`) and their trees (CSR); `place` (T,) the cell of a tree.
        buckets: (2,) number of coarse cells along x and y.
        length: (P,) rising; `a`, `b` (P,) the pairs of trees so far apart; `reach`, m, up to which all pairs are among them.
        density: trees per m² where there are trees.
        area: m² in which the robot may be.
        jitter: irregularity of the planting per axis, m, without the map's own error.
        trust: share (0-1) of the residuals' evidence that counts: none where all irregularity may be the map's own error
            (0.4: what an irregularity measured on 100 trees may be off by).
        diameter_mean, diameter_sd: of the population.
    """

    xy: Array
    var: Array
    diameter: Array
    origin: Array
    cell: float
    nearest: NDArray[np.int32]
    bucket: float
    buckets: NDArray[np.int64]
    start: NDArray[np.int32]
    member: NDArray[np.int32]
    place: NDArray[np.int32]
    length: NDArray[np.float32]
    a: NDArray[np.int32]
    b: NDArray[np.int32]
    reach: float
    density: float
    area: float
    jitter: float
    trust: float
    diameter_mean: float
    diameter_sd: float

    def __len__(self) -> int:
        return len(self.xy)

    @property
    def trees(self) -> Trees:
        """What kernels take of the trees."""
        return Trees(
            self.xy, self.var, self.diameter, self.diameter_mean, self.diameter_sd, self.origin, self.cell, self.nearest
        )

    @property
    def grid(self) -> Grid:
        """What kernels take of the coarse cells."""
        return Grid(self.origin, self.bucket, self.buckets, self.start, self.member)

    @property
    def bytes(self) -> int:
        """Memory of the index."""
        arrays = (
            self.xy,
            self.var,
            self.diameter,
            self.nearest,
            self.start,
            self.member,
            self.place,
            self.length,
            self.a,
            self.b,
        )
        return sum(x.nbytes for x in arrays)


def build_index(
    xy: Array, var: Array, diameter: Array, view: float, longest: float, map_sigma: float = 0.03, jitter: float | None = None,
) -> MapIndex:  # fmt: skip
    """Index of trees (T, 2) with variances per axis (T,) and diameters (T,) or NaN. `jitter` (m) where it is known of a larger planting that these are of.

    `map_sigma` (m) is what the variances do not know of the map's error; `view` is the range of detections (m); pairs up to `longest` are listed, fewer where trees are dense, so that a
    tree has about 30.
    """
    tree = cKDTree(xy)
    n = len(xy)
    gap = spacing(tree)
    cell = float(np.clip(0.25 * gap, 0.25, 1.0))
    low, high = xy.min(0) - 2.0, xy.max(0) + 2.0
    while np.prod((high - low) / cell) > max(4e6, 100.0 * n):  # far islands of trees: a coarser raster
        cell *= 1.4
    shape = np.ceil((high - low) / cell).astype(int) + 1
    nearest = np.full(shape, -1, np.int32)
    fill_kernel(nearest, xy, low, cell, int(np.ceil(0.5 * gap / cell)) + 1)
    bucket = max(6.0, gap)
    while np.prod((high - low) / bucket) > max(1e5, 4.0 * n):
        bucket *= 1.5
    buckets = np.ceil((high - low) / bucket).astype(np.int64) + 1
    where = ((xy - low) / bucket).astype(np.int64)
    flat = where[:, 0] * buckets[1] + where[:, 1]
    order = np.argsort(flat, kind="stable").astype(np.int32)
    start = np.searchsorted(flat[order], np.arange(buckets[0] * buckets[1] + 1)).astype(np.int32)
    covered = np.unique(np.floor(xy / 10.0).astype(np.int64), axis=0)
    density = float(n / max(_covered_area(xy, gap), 1.0))
    # The neighbours within reach r number density * pi * r²; each pair stands once.
    reach = float(np.clip(np.sqrt(60.0 / (np.pi * density)), 2.2 * gap, min(longest, 1.8 * view)))
    pairs = tree.query_pairs(reach, output_type="ndarray")
    length = np.linalg.norm(xy[pairs[:, 0]] - xy[pairs[:, 1]], axis=1) if len(pairs) else np.zeros(0)
    by_length = np.argsort(length)
    ok = np.isfinite(diameter)
    jitter = _jitter(tree, xy, var + map_sigma**2, gap) if jitter is None else jitter
    area = (
        float(np.prod(high - low + 10.0)) if len(covered) * 100.0 > 0.3 * np.prod(high - low) else len(covered) * 400.0
    )
    return MapIndex(
        xy=xy,
        var=var,
        diameter=diameter,
        origin=low,
        cell=cell,
        nearest=nearest,
        bucket=bucket,
        buckets=buckets,
        start=start,
        member=order,
        place=flat.astype(np.int32),
        length=length[by_length].astype(np.float32),
        a=pairs[by_length, 0].astype(np.int32),
        b=pairs[by_length, 1].astype(np.int32),
        reach=reach if reach < np.hypot(*np.ptp(xy, axis=0)) else np.inf,
        density=density,
        area=area,
        jitter=jitter,
        trust=float(np.clip(jitter**2 / (map_sigma**2 + float(np.median(var))) - 0.4, 0.0, 1.0)),
        diameter_mean=float(np.mean(diameter[ok])) if ok.any() else np.nan,
        diameter_sd=_spread(diameter[ok]),
    )


def spacing(tree: cKDTree) -> float:
    """Usual distance of a tree to the next one, m."""
    xy, n = np.asarray(tree.data), int(tree.n)
    return float(np.median(np.asarray(tree.query(xy, 2)[0])[:, -1])) if n > 1 else 5.0


def irregularity(xy: Array, var: Array) -> tuple[float, float]:
    """Jitter per axis of a planting (T, 2) whose trees are known to `var` (T,) per axis, and its spacing, m."""
    tree = cKDTree(xy)
    gap = spacing(tree)
    return _jitter(tree, xy, var, gap), gap


def _covered_area(xy: Array, gap: float) -> float:
    """m² under trees: cells of twice the spacing that hold some, each wide enough for about four."""
    side = max(2.0 * gap, 2.0)
    cells, counts = np.unique(np.floor(xy / side).astype(np.int64), axis=0, return_counts=True)
    inner = counts >= 0.5 * np.median(counts)
    return float(len(cells[inner]) * side * side * len(xy) / max(counts[inner].sum(), 1))


def _spread(diameter: Array) -> float:
    """Standard deviation of the population's diameters, without what the map's own measurements add; 0: all alike."""
    if len(diameter) < 2:
        return 0.0
    return float(np.sqrt(max(float(np.var(diameter)) - DIAMETER_NOISE**2, 0.0)))


def _jitter(tree: cKDTree, xy: Array, var: Array, gap: float, sample: int = 2000) -> float:
    """Irregularity per axis, m: how far 2a - b, the mirror of neighbour b at tree a, is from the nearest tree.

    In a lattice with planting error s the mirror is off by sqrt(6) s (tree, neighbour and the third one); the map's own
    errors are taken out. Bounded by what scattered trees would give.
    """
    n = len(xy)
    if n < 5:
        return 0.25 * gap
    rows = np.random.default_rng(0).permutation(n)[:sample]
    near = np.asarray(tree.query(xy[rows], min(5, n))[1])
    mirror = (2 * xy[rows, None] - xy[near[:, 1:]]).reshape(-1, 2)
    d = np.asarray(tree.query(mirror)[0])
    inside = d < 0.45 * gap  # farther: a border or a gap, or no lattice at all
    if inside.mean() < 0.25:
        return 0.25 * gap
    d2 = np.median(d[inside] ** 2) / 1.386  # median of chi-square with 2 dof
    return float(np.sqrt(max(d2 - 6.0 * float(np.median(var)), 0.0) / 6.0))
