"""Viewpoint clouds: what a tree looks like from each side, registered into one cloud per viewpoint (thesis 4.3.3)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from topograph.geometry import Array

REACH = 0.12
"""Points further from each other are none of one spot of bark, m; a registration that moves a cloud by more is not believed."""
ITERATIONS = 15
MOST = 60
"""Points of a cloud, at least, that say where it lies; more say the same."""
LEAST = 12
"""Points that fix where a cloud lies; small_gicp warns below that."""


def register(clouds: list[NDArray[np.float32]], voxel: float) -> NDArray[np.float32]:
    """One cloud (M, 3) of several of the same side of a tree: ICP of each onto those before, then thinned.

    A registration that moves a cloud by more than `REACH`, or matches less than half of it, is not believed; the
    cloud then stays where the poses put it.
    """
    if len(clouds) == 1:
        return thin(clouds[0].astype(float), voxel)
    from small_gicp import KdTree, PointCloud, align

    parts = [c.astype(float) for c in clouds]
    whole = parts[0]
    for cloud in parts[1:]:
        if min(len(whole), len(cloud)) < LEAST:
            whole = np.concatenate([whole, cloud])
            continue
        target, some = PointCloud(whole), cloud[:: max(len(cloud) // MOST, 1)]
        r = align(
            target, PointCloud(some), KdTree(target), registration_type="ICP",
            max_correspondence_distance=REACH, max_iterations=ITERATIONS,
        )  # fmt: skip
        R, t = r.T_target_source[:3, :3], r.T_target_source[:3, 3]
        centre = cloud.mean(0)
        if r.num_inliers > 0.5 * len(some) and float(np.linalg.norm(R @ centre + t - centre)) < REACH:
            cloud = cloud @ R.T + t
        whole = np.concatenate([whole, cloud])
    return thin(whole, voxel)


class Query:
    """A cloud (N, 3) that is registered onto others, from its centroid on (thesis 3.2, Algorithm 5)."""

    def __init__(self, cloud: NDArray[np.float32]) -> None:
        from small_gicp import PointCloud

        some = np.asarray(cloud, float)[:: max(len(cloud) // MOST, 1)]
        self.points = some - some.mean(0)
        self.cloud = PointCloud(self.points)

    def fitness(self, target: Target, turn: float = 0.0) -> float:
        """Mean squared distance to the target's cloud after registration that begins `turn` rad about the vertical, m²."""
        from small_gicp import align

        begin = np.eye(4)
        begin[:2, :2] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]

        r = align(
            target.cloud, self.cloud, target.tree, begin, registration_type="ICP",
            max_correspondence_distance=APART, max_iterations=ITERATIONS,
        )  # fmt: skip
        T = r.T_target_source
        _, squared = target.tree.batch_nearest_neighbor_search(self.points @ T[:3, :3].T + T[:3, 3])
        return float(np.mean(squared))


class Target:
    """A cloud (N, 3) about its centroid that others are registered onto."""

    def __init__(self, cloud: NDArray[np.float32]) -> None:
        from small_gicp import KdTree, PointCloud

        self.cloud = PointCloud(np.asarray(cloud, float) - cloud.mean(0))
        self.tree = KdTree(self.cloud)


APART = 1.0
"""Farther points of two trunks about their centroids do not belong together, m."""


def thin(points: Array, voxel: float) -> NDArray[np.float32]:
    """The mean of the points in each voxel (M, 3)."""
    key = np.floor(points / voxel).astype(np.int64)
    key -= key.min(axis=0)
    key = (key[:, 0] << 42) + (key[:, 1] << 21) + key[:, 2]  # a tree is smaller than two million voxels
    order = np.argsort(key)
    first = np.flatnonzero(np.diff(key[order], prepend=-1))
    total = np.add.reduceat(points[order], first)
    return (total / np.diff(first, append=len(key))[:, None]).astype(np.float32)
