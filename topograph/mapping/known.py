"""A map that a run is put into: its trees as landmarks, and where the run was found in it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from topograph.estimate import Fixes, Headings, KnownTrees, Problem
from topograph.geometry import Array, Datum, Stamps, above_ground, inverse, transform, yaw_of
from topograph.trees import Detections
from topograph.trees.sightings import nearest_keyframe

UNKNOWN = 1.0
"""Variance of a tree whose covariance nobody knows, m²."""


@dataclass(frozen=True, slots=True)
class KnownMap:
    """Feet (Q, 3) of the trees of a map, m, their covariances (Q, 3, 3), their axes (Q, 3), how well and where these are known (Q,) (see
    `geometry.above_ground`), their stems (Q,), and the map's datum."""

    p: Array
    cov: Array
    axis: Array
    lean_sigma: Array
    known_at: Array
    stems: NDArray[np.int64]
    datum: Datum | None

    def at(self, detections: Detections) -> KnownTrees:
        """The trees as landmarks: on their axes, at the height where the detections state theirs."""
        above = detections.height[np.isfinite(detections.height)]
        height = float(np.median(above)) if len(above) else 0.0
        unknown = np.isnan(self.cov.sum(axis=(1, 2))).reshape(-1, 1, 1)
        cov = np.where(unknown, UNKNOWN * np.eye(3), self.cov)
        p, cov = above_ground(self.p, cov, self.axis, self.lean_sigma, self.known_at, height)
        cov[:, [0, 1, 2], [0, 1, 2]] = np.maximum(cov[:, [0, 1, 2], [0, 1, 2]], 1e-5)
        return KnownTrees(p, cov, np.full(len(p), -1, np.int64), self.stems == 1)


SIGMA, SIGMA_YAW = 0.5, 0.1
"""Of such a place, m and rad, for the same reason: the known trees say it better, once they are recognised."""


@dataclass(frozen=True, slots=True)
class Placed:
    """Where the localizer found a run in a map: stamps (F,) and `map_T_robot` (F, 4, 4)."""

    stamps_ns: Stamps
    map_T_robot: Array


def put(problem: Problem, placed: Placed, datum: Datum | None) -> Problem:
    """The problem of a run in the frame of a map: it starts where it was found, and is loosely held there."""
    ns = problem.stamps_ns
    motion = problem.motion
    k = nearest_keyframe(placed.stamps_ns, ns)
    keyframe_T_robot = inverse(problem.odom_T_robot[k]) @ motion.at(placed.stamps_ns)
    found = placed.map_T_robot @ inverse(keyframe_T_robot)  # map_T_keyframe
    # Each keyframe from the place found next to it, by dead reckoning between the two.
    near = nearest_keyframe(ns, placed.stamps_ns)
    start = found[near] @ inverse(problem.odom_T_robot[k[near]]) @ problem.odom_T_robot
    n = len(k)
    fixes = Fixes(
        keyframe=k,
        keyframe_p_antenna=keyframe_T_robot[:, :3, 3],
        map_p_antenna=placed.map_T_robot[:, :3, 3],
        cov=np.tile(SIGMA**2 * np.eye(3), (n, 1, 1)),
        late=np.zeros((n, 3)),
    )
    forward = transform(keyframe_T_robot, np.array([1.0, 0.0, 0.0])) - keyframe_T_robot[:, :3, 3]
    headings = Headings(k, forward, yaw_of(placed.map_T_robot), np.full(n, SIGMA_YAW))
    return replace(problem, start=start, fixes=fixes, headings=headings, datum=datum, placed=True)
