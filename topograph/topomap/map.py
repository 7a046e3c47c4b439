"""The topological map M = {N, E} (thesis 4.2, eqs. 4.1-4.8)."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from topograph.geometry import Array, Datum, Stamps, above_ground
from topograph.topomap.addresses import blocks_of, places_of
from topograph.topomap.sessions import Seen, SessionRecord
from topograph.trunks.score import KINDS, OTHER, TREE

__all__ = ["KINDS", "OTHER", "TREE", "TopoMap", "Viewpoint"]


CHI2_95 = 5.991
"""95 % of a chi-square with two degrees of freedom."""


@dataclass(frozen=True, slots=True)
class Viewpoint:
    """What node `tree` (row of the map's arrays) looks like from `direction` (3,), unit, node to robot, map frame.

    `cloud` (M, 3) float32 is about the node's position, in the map's axes, m. `session` is a row of the map's sessions.
    """

    tree: int
    direction: Array
    cloud: NDArray[np.float32]
    session: int = 0


@dataclass(frozen=True, slots=True, repr=False, kw_only=True)
class TopoMap:
    """Nodes, edges and the path that saw them, in the `map` frame (ENU at `datum`, or local when that is None).

    Attributes:
        ids: (T,) tree ids, stable when the map is extended.
        p: (T, 3) where the trunk's axis meets the ground, m; `cov` (T, 3, 3) m².
        lean_sigma: (T,) of the axis that `cov` rests on, rad per horizontal axis, and the height `known_at` (T,) above ground at which its place is known best, m: what
            is stated of the foot was brought down from there. NaN where nobody says.
        axis: (T, 3) unit vectors, up; `diameter` (T,) m or NaN; `first_branch` (T,) m above ground or NaN.
        sightings, score, row: (T,); row -1 where there are no rows.
        kind: (T,) index into KINDS; `kind_probability` (T,) or NaN; `stems` (T,). Edges and rows are of trees alone.
        edges: (E, 2) rows of the arrays; `lengths` (E,) m.
        viewpoints: clouds by viewpoint.
        stamps_ns, map_T_robot: (K,), (K, 4, 4).
        datum_cov: (3, 3) covariance of the ENU transform, m²; contained in `cov`.
        sessions: the runs that it was made of; `session` (K,) of each pose; `seen`: which tree was seen in which.
        meta: further facts as text: configuration, input hashes, versions.
    """

    datum: Datum | None
    ids: NDArray[np.int64]
    p: Array
    cov: Array
    axis: Array
    lean_sigma: Array
    known_at: Array
    diameter: Array
    first_branch: Array
    sightings: NDArray[np.int64]
    score: Array
    row: NDArray[np.int64]
    kind: NDArray[np.int64]
    kind_probability: Array
    stems: NDArray[np.int64]
    edges: NDArray[np.int64]
    lengths: Array
    viewpoints: tuple[Viewpoint, ...]
    stamps_ns: Stamps
    map_T_robot: Array
    datum_cov: Array
    meta: dict[str, str] = field(default_factory=dict)
    sessions: tuple[SessionRecord, ...] = ()
    session: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    seen: Seen = field(default_factory=Seen.none)

    def __len__(self) -> int:
        return len(self.ids)

    def __repr__(self) -> str:
        where = "local" if self.datum is None else f"at {self.datum.lat:.5f}, {self.datum.lon:.5f}"
        return (
            f"<TopoMap {where}: {int(self.is_tree.sum())} trees, {int((~self.is_tree).sum())} other landmarks, {len(self.edges)} edges, "
            f"{len(self.viewpoints)} viewpoints, {len(self.sessions)} sessions>"
        )

    @staticmethod
    def of_points(xy: Array, sigma: float = 0.01) -> TopoMap:
        """A local map of bare trees at `xy` (T, 2), known to `sigma` m: no path, no edges.

        >>> TopoMap.of_points(np.array([[0.0, 0.0], [4.0, 0.0]]))
        <TopoMap local: 2 trees, 0 other landmarks, 0 edges, 0 viewpoints, 0 sessions>
        """
        n = len(xy)
        unknown = np.full(n, np.nan)
        return TopoMap(
            datum=None,
            ids=np.arange(1, n + 1),
            p=np.column_stack([xy, np.zeros(n)]),
            cov=np.tile(sigma**2 * np.eye(3), (n, 1, 1)),
            axis=np.tile([0.0, 0.0, 1.0], (n, 1)),
            lean_sigma=unknown,
            known_at=unknown,
            diameter=unknown,
            first_branch=unknown,
            sightings=np.ones(n, np.int64),
            score=np.zeros(n),
            row=np.full(n, -1),
            kind=np.full(n, TREE),
            kind_probability=unknown,
            stems=np.ones(n, np.int64),
            edges=np.zeros((0, 2), np.int64),
            lengths=np.zeros(0),
            viewpoints=(),
            stamps_ns=np.zeros(0, np.int64),
            map_T_robot=np.zeros((0, 4, 4)),
            datum_cov=np.zeros((3, 3)),
        )

    @property
    def is_tree(self) -> NDArray[np.bool_]:
        """(T,) landmarks that are trees."""
        return np.asarray(self.kind == TREE)

    @property
    def state(self) -> list[str]:
        """State of each landmark, "standing" or "missing": what the last session says that looked for it."""
        return self.seen.states(len(self))

    @property
    def block(self) -> NDArray[np.int64]:
        """(T,) block of each tree, from 1: what edges join; 0 for what is no tree."""
        return blocks_of(len(self), self.edges, self.is_tree)

    @property
    def place(self) -> list[str]:
        """Address of each tree: block, row, and number along the row."""
        return places_of(self.p[:, :2], self.block, self.row, self.is_tree)

    def above_ground(self, height: float) -> tuple[Array, Array]:
        """Where the axes are `height` m above ground (T, 3), m, and with what covariance (T, 3, 3), m²."""
        return above_ground(self.p, self.cov, self.axis, self.lean_sigma, self.known_at, height)

    def ellipses(self) -> tuple[Array, Array]:
        """What holds 95 % of each tree's position: half axes (T, 2), the larger first, m, and the larger one's angle from east (T,), rad; NaN
        where the covariance is not known.
        """
        radii, angle = np.full((len(self), 2), np.nan), np.full(len(self), np.nan)
        known = np.isfinite(self.cov[:, :2, :2]).all(axis=(1, 2))
        values, vectors = np.linalg.eigh(self.cov[known, :2, :2])
        radii[known] = np.sqrt(CHI2_95 * np.maximum(values[:, ::-1], 0.0))
        angle[known] = np.arctan2(vectors[:, 1, 1], vectors[:, 0, 1])
        return radii, angle

    def trees(self) -> TopoMap:
        """The map without its landmarks that are no trees; itself where there are none."""
        keep = self.is_tree
        if keep.all():
            return self
        row = np.cumsum(keep) - 1
        per_row = (
            "ids",
            "p",
            "cov",
            "axis",
            "lean_sigma",
            "known_at",
            "diameter",
            "first_branch",
            "sightings",
            "score",
            "row",
            "kind",
            "kind_probability",
            "stems",
        )
        views = tuple(replace(v, tree=int(row[v.tree])) for v in self.viewpoints if keep[v.tree])
        seen = self.seen.moved(np.where(keep, row, -1), 0)
        return replace(
            self, edges=row[self.edges], viewpoints=views, seen=seen, **{k: getattr(self, k)[keep] for k in per_row}
        )

    def geodetic(self) -> Array:
        """(T, 3) latitude, longitude (degrees) and height (m) of the nodes; NaN when not georeferenced."""
        return np.full((len(self), 3), np.nan) if self.datum is None else self.datum.to_geodetic(self.p)
