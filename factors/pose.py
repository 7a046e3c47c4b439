"""Matrices <-> gtsam.Pose3."""

from __future__ import annotations

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


def from_pose3(pose: Any) -> NDArray[np.float64]:
    """Matrix (4, 4) of a gtsam.Pose3."""
    return np.asarray(pose.matrix())
