"""The truth's frame in the map's: through WGS84, by the path, or by the trees."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from topograph.errors import InputError
from topograph.evaluate.truth import Truth
from topograph.geometry import Array, Datum, align_se3, fit_rigid_2d, interpolate, planar, transform
from topograph.topomap import TopoMap


@dataclass(frozen=True, slots=True)
class WorldInMap:
    """How a truth is brought into a map's frame.

    Attributes:
        how: "WGS84" (nothing is fitted), "path" (SE(3) on the mapping path) or "trees" (in the plane, on the trees): the last two take a
            common shift and turn of the map out of every error.
    """

    how: str
    map_T_world: Array
    world: Datum | None = None
    map: Datum | None = None

    def points(self, p: Array) -> Array:
        """Points (N, 3) of the world in the map, m."""
        if self.how == "WGS84" and self.world is not None and self.map is not None:
            return self.map.to_enu(self.world.to_geodetic(p)) if len(p) else np.zeros((0, 3))
        return transform(self.map_T_world, p) if len(p) else np.zeros((0, 3))

    @property
    def turn(self) -> float:
        """What is added to a heading of the world, rad. Two ENU frames in one orchard are parallel."""
        return float(np.arctan2(self.map_T_world[1, 0], self.map_T_world[0, 0]))


def world_in_map(topo: TopoMap, truth: Truth) -> WorldInMap:
    """The way from a truth's frame into a map's.

    Raises:
        InputError: the two have neither a datum, nor time, nor trees in common.
    """
    if topo.datum is not None and truth.datum is not None:
        return WorldInMap("WGS84", np.eye(4), truth.datum, topo.datum)
    if len(truth.stamps_ns) and len(topo.stamps_ns):
        inside = (topo.stamps_ns >= truth.stamps_ns[0]) & (topo.stamps_ns <= truth.stamps_ns[-1])
        if inside.sum() >= 3:
            true = interpolate(truth.stamps_ns, truth.world_T_robot, topo.stamps_ns[inside])[:, :3, 3]
            found = topo.map_T_robot[inside, :3, 3]
            T = align_se3(true, found)
            off = float(np.sqrt(np.mean(np.sum((transform(T, true) - found)[:, :2] ** 2, axis=1))))
            if off < SAME_RUN[0] + SAME_RUN[1] * float(
                np.ptp(true[:, :2], axis=0).max()
            ):  # else it is another run of the same hours
                return WorldInMap("path", T)
    fitted = fit_points(truth.trees[:, :2], topo.trees().p[:, :2])
    if fitted is None:
        raise InputError(
            "the truth has no frame in common with the map: give it latitude and longitude (and the map GNSS), a path of the same "
            "clock as the recording, or at least four of the same trees"
        )
    return WorldInMap("trees", fitted)


SAME_RUN = (1.0, 0.08)
"""A path that is that of the map lies no further from it after alignment, m and share of its extent: what drift may have bent."""
ALIKE, CLOSE = 0.25, 1.0
"""Distances between two trees that may be the same, m; trees that are one after the fit, m."""
TRIED = 4000


def fit_points(source: Array, target: Array) -> Array | None:
    """The rigid motion (4, 4) in the plane that lays most of `source` (N, 2) onto `target` (M, 2), m; None where it is not told.

    Pairs of equal length propose a motion each, and the one with most points in place is refined by least squares.
    """
    if len(source) < 4 or len(target) < 4:
        return None
    tree = cKDTree(target)
    best: tuple[int, float, Array] = (0, 0.0, np.eye(4))
    for a, b, i, j in _proposals(source, target):
        x, y, yaw = fit_rigid_2d(source[[a, b]], target[[i, j]])
        moved = _moved(source, x, y, yaw)
        d = np.asarray(tree.query(moved)[0])
        inside = d < CLOSE
        score = (int(inside.sum()), -float(d[inside].sum()))
        if score > best[:2]:
            best = (*score, np.array([x, y, yaw]))
    if best[0] < 4:
        return None
    x, y, yaw = best[2]
    for _ in range(5):
        d, near = map(np.asarray, tree.query(_moved(source, x, y, yaw)))
        ok = d < CLOSE
        x, y, yaw = fit_rigid_2d(source[ok], target[near[ok]])
    return np.asarray(planar(x, y, yaw))


def _proposals(source: Array, target: Array) -> NDArray[np.int64]:
    """Rows (P, 4): a pair of `source` and a pair of `target` of the same length; long pairs first, for they turn the least."""
    rng = np.random.default_rng(0)
    of_source, of_target = (np.array(np.triu_indices(len(p), 1)).T for p in (source, target))
    long = np.linalg.norm(source[of_source[:, 0]] - source[of_source[:, 1]], axis=1)
    far = np.linalg.norm(target[of_target[:, 0]] - target[of_target[:, 1]], axis=1)
    order = np.argsort(far)
    far, of_target = far[order], of_target[order]
    out: list[tuple[int, int, int, int]] = []
    for k in np.argsort(-long):
        low, high = np.searchsorted(far, [long[k] - ALIKE, long[k] + ALIKE])
        for i, j in of_target[low:high].tolist():
            a, b = of_source[k].tolist()
            out += [(a, b, i, j), (a, b, j, i)]
        if len(out) > 50 * TRIED:
            break
    rows = np.array(out, np.int64).reshape(-1, 4)
    return rows[np.sort(rng.permutation(len(rows))[:TRIED])]


def _moved(p: Array, x: float, y: float, yaw: float) -> Array:
    c, s = np.cos(yaw), np.sin(yaw)
    return np.stack([c * p[:, 0] - s * p[:, 1] + x, s * p[:, 0] + c * p[:, 1] + y], axis=1)
