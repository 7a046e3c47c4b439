"""Matrices <-> gtsam.Pose3."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import gtsam
import numpy as np
from numpy.typing import ArrayLike, NDArray


def to_pose3(pose: ArrayLike) -> Any:
    """gtsam.Pose3 of a matrix (4, 4).

    Raises:
        ValueError: it is not a rigid motion (GTSAM would take it and compute nonsense).
    """
    T = np.asarray(pose, float)
    R = T[:3, :3]
    if not np.isfinite(T).all() or not np.allclose(R @ R.T, np.eye(3), atol=1e-6) or np.linalg.det(R) < 0:
        raise ValueError("not a rigid motion")
    return gtsam.Pose3(gtsam.Rot3(R), T[:3, 3])


def to_pose3s(poses: NDArray[np.float64]) -> Iterator[Any]:
    """gtsam.Pose3 of matrices (N, 4, 4), checked in bulk, one by one: as Python's objects they are large.

    Raises:
        ValueError: as `to_pose3`.
    """
    R, t = poses[:, :3, :3], poses[:, :3, 3]
    if not np.isfinite(poses).all() or np.abs(R @ np.swapaxes(R, 1, 2) - np.eye(3)).max(initial=0.0) > 1e-6:
        raise ValueError("not rigid motions")
    if len(R) and np.linalg.det(R).min() < 0:
        raise ValueError("not rigid motions")
    return (gtsam.Pose3(gtsam.Rot3(a), b) for a, b in zip(R, t, strict=True))


def from_pose3(pose: Any) -> NDArray[np.float64]:
    """Matrix (4, 4) of a gtsam.Pose3."""
    return np.asarray(pose.matrix())
