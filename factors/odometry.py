"""Relative motion between two poses."""

from __future__ import annotations

from typing import Any

import gtsam
from numpy.typing import ArrayLike

from factors.noise import sigmas
from factors.pose import to_pose3


def odometry(key_a: int, key_b: int, a_T_b: ArrayLike, sigma: ArrayLike) -> Any:
    """Between-factor of a motion (4, 4) with standard deviations (6,): rotation (rad), translation (m)."""
    return gtsam.BetweenFactorPose3(key_a, key_b, to_pose3(a_T_b), sigmas(sigma))


def odometry_2d(key_a: int, key_b: int, x: float, y: float, yaw: float, sigma: ArrayLike) -> Any:
    """Between-factor in the plane; standard deviations (3,): x, y (m), yaw (rad)."""
    return gtsam.BetweenFactorPose2(key_a, key_b, gtsam.Pose2(x, y, yaw), sigmas(sigma))
