"""Relative motion between two poses."""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np
from numpy.typing import ArrayLike, NDArray

from factors.noise import sigmas
from factors.pose import to_pose3, to_pose3s


def odometry(key_a: int, key_b: int, a_T_b: ArrayLike, sigma: ArrayLike) -> Any:
    """Between-factor of a motion (4, 4) with standard deviations (6,): rotation (rad), translation (m)."""
    return gtsam.BetweenFactorPose3(key_a, key_b, to_pose3(a_T_b), sigmas(sigma))


def odometries(keys: list[int], steps: NDArray[np.float64], sigma: NDArray[np.float64]) -> list[Any]:
    """`odometry` along a chain of N+1 keys: steps (N, 4, 4), deviations (N, 6)."""
    if not (np.isfinite(sigma).all() and (sigma > 0).all()):
        raise ValueError("standard deviations must be finite and positive")
    create = gtsam.noiseModel.Diagonal.Sigmas
    return [
        gtsam.BetweenFactorPose3(a, b, T, create(s))
        for a, b, T, s in zip(keys[:-1], keys[1:], to_pose3s(steps), sigma, strict=True)
    ]


def odometry_2d(key_a: int, key_b: int, x: float, y: float, yaw: float, sigma: ArrayLike) -> Any:
    """Between-factor in the plane; standard deviations (3,): x, y (m), yaw (rad)."""
    return gtsam.BetweenFactorPose2(key_a, key_b, gtsam.Pose2(x, y, yaw), sigmas(sigma))
