"""Viewpoint clouds: what a tree looks like from each side, registered into one cloud per viewpoint (thesis 4.3.3)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from topograph.geometry import Array
from topograph.trunks.open3d_door import open3d


def register(clouds: list[NDArray[np.float32]], voxel: float, reach: float = 0.12) -> NDArray[np.float32]:
    """One cloud (M, 3) of several of the same side of a tree: ICP of each onto those before, then thinned.

    A registration that moves a cloud by more than `reach`, or matches less than half of it, is not believed; the
    cloud then stays where the poses put it.
    """
    o3d = open3d()
    whole = clouds[0].astype(float)
    for cloud in clouds[1:]:
        source = _cloud(o3d, cloud)
        result = o3d.pipelines.registration.registration_icp(
            source, _cloud(o3d, whole), reach, np.eye(4),
            o3d.pipelines.registration.TransformationEstimationPointToPoint(),
            o3d.pipelines.registration.ICPConvergenceCriteria(max_iteration=15),
        )  # fmt: skip
        T = np.asarray(result.transformation)
        centre = cloud.astype(float).mean(0)
        shift = float(np.linalg.norm(T[:3, :3] @ centre + T[:3, 3] - centre))
        moved = cloud.astype(float)
        if result.fitness > 0.5 and shift < reach:
            moved = moved @ T[:3, :3].T + T[:3, 3]
        whole = np.concatenate([whole, moved])
    return thin(whole, voxel)


def _cloud(o3d: Any, points: Array | NDArray[np.float32]) -> Any:
    return o3d.geometry.PointCloud(o3d.utility.Vector3dVector(np.asarray(points, float)))


def thin(points: Array, voxel: float) -> NDArray[np.float32]:
    """The mean of the points in each voxel (M, 3)."""
    key = np.floor(points / voxel).astype(np.int64)
    _, index, count = np.unique(key, axis=0, return_inverse=True, return_counts=True)
    total = np.zeros((len(count), 3))
    np.add.at(total, index.ravel(), points)
    return (total / count[:, None]).astype(np.float32)
