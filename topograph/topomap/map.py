"""The topological map M = {N, E} (thesis 4.2, eqs. 4.1-4.8)."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from topograph.geometry import Array, Datum, Stamps


@dataclass(frozen=True, slots=True)
class Viewpoint:
    """What node `tree` (row of the map's arrays) looks like from `direction` (3,), unit, node to robot, map frame.

    `cloud` (M, 3) float32 is about the node's position, in the map's axes, m.
    """

    tree: int
    direction: Array
    cloud: NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class TopoMap:
    """Nodes, edges and the path that saw them, in the `map` frame (ENU at `datum`, or local when that is None).

    Attributes:
        ids: (T,) tree ids, stable when the map is extended.
        p: (T, 3) where the trunk's axis meets the ground, m; `cov` (T, 3, 3) m².
        axis: (T, 3) unit vectors, up; `diameter` (T,) m or NaN; `first_branch` (T,) m above ground or NaN.
        sightings, score, row: (T,); row -1 where there are no rows.
        edges: (E, 2) rows of the arrays; `lengths` (E,) m.
        viewpoints: clouds by viewpoint.
        stamps_ns, map_T_robot: (K,), (K, 4, 4).
        datum_cov: (3, 3) covariance of the ENU transform, m²; contained in `cov`.
        meta: further facts as text: configuration, input hashes, versions.
    """

    datum: Datum | None
    ids: NDArray[np.int64]
    p: Array
    cov: Array
    axis: Array
    diameter: Array
    first_branch: Array
    sightings: NDArray[np.int64]
    score: Array
    row: NDArray[np.int64]
    edges: NDArray[np.int64]
    lengths: Array
    viewpoints: tuple[Viewpoint, ...]
    stamps_ns: Stamps
    map_T_robot: Array
    datum_cov: Array
    meta: dict[str, str] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.ids)

    def geodetic(self) -> Array:
        """(T, 3) latitude, longitude (degrees) and height (m) of the nodes; NaN when not georeferenced."""
        return np.full((len(self), 3), np.nan) if self.datum is None else self.datum.to_geodetic(self.p)
