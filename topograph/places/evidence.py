"""How well placements explain what was seen: closed-form evidence with the full joint covariance.

A placement explains each landmark as a mapped tree (density around it, chance of having been seen, diameter) or as
something else (a density over the plane), and each mapped tree in view that was not seen as missed. The three degrees of
freedom of the placement are integrated out (Laplace); the common noise scale is marginalised over a few values.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from topograph.geometry import Array
from topograph.places.config import PlacesConfig
from topograph.places.evidence_kernels import evidence_kernel, unlike_kernel
from topograph.places.index import MapIndex
from topograph.places.search import Landmarks


@dataclass(frozen=True, slots=True, kw_only=True)
class Placements:
    """Placements that differ, the best first.

    Attributes:
        pose: (M, 3) x, y, yaw of the landmarks' frame in the map, aligned by what it matches.
        log: (M,) log evidence when every pose is equally probable beforehand, per m² rad.
        information: (M, 3, 3) of the pose in the landmarks' frame, without a prior.
        tree: (M, n) mapped tree of each landmark, -1 none.
        scale: (M,) most probable noise scale.
        alike: largest log evidence of an orchard of the same design; -inf none.
    """

    pose: Array
    log: Array
    information: Array
    tree: NDArray[np.int64]
    scale: Array
    alike: float

    def __len__(self) -> int:
        return len(self.pose)


def placements(
    poses: Array, marks: Landmarks, raster: Array, origin: Array, index: MapIndex, config: PlacesConfig
) -> Placements:
    """Those of `poses` (P, 3) that a search found, aligned and weighed. `raster` (X, Y) holds, per cell of 1 m about `origin` (2,) in the landmarks'
    frame, looks as the sum of -ln(1 - chance of detection)."""
    c = config
    prior = np.log(np.array(c.scale_prior) / np.sum(c.scale_prior))
    log, pose, information, tree, scale, alike = evidence_kernel(
        poses, marks.bundle, marks.cov, index.trees, index.grid, raster, origin, c.felled, c.map_sigma**2,
        index.trust, 2.0 * index.jitter**2, np.array(c.scales), prior,
    )  # fmt: skip
    order = np.argsort(-log)
    order = order[np.isfinite(log[order])]
    order = order[unlike_kernel(pose[order], marks.m.mean(0))]
    design = float(alike[np.isfinite(alike)].max(initial=-np.inf))
    return Placements(
        pose=pose[order], log=log[order], information=information[order], tree=tree[order], scale=scale[order], alike=design
    )  # fmt: skip
