"""Heading of a direction fixed to the robot, such as the baseline of two antennas."""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np
from numpy.typing import ArrayLike

from factors.noise import Kernel, gaussian, robust


def heading(
    key: int, yaw: float, robot_direction: ArrayLike, sigma: float, kernel: Kernel, *, steepest: float = 0.5
) -> Any:
    """`robot_direction` (3,) points to azimuth `yaw` (rad, from map x) with `sigma`; its elevation is free.

    GTSAM compares two directions on the sphere; the part that is elevation gets the deviation `steepest` (rad).

    Raises:
        ValueError: not finite, or sigma not positive.
    """
    if not (np.isfinite(yaw) and np.isfinite(sigma) and sigma > 0):
        raise ValueError("a heading must be finite and its sigma positive")
    reference = gtsam.Unit3(np.array([np.cos(yaw), np.sin(yaw), 0.0]))
    basis = np.asarray(reference.basis())  # (3, 2)
    sideways = basis.T @ np.array([-np.sin(yaw), np.cos(yaw), 0.0])
    upwards = basis.T @ np.array([0.0, 0.0, 1.0])
    cov = sigma**2 * np.outer(sideways, sideways) + steepest**2 * np.outer(upwards, upwards)
    direction = gtsam.Unit3(np.asarray(robot_direction, float))
    return gtsam.AttitudeFactorPose3(key, reference, robust(gaussian(cov), kernel), direction)
