"""Heading of a direction fixed to the robot, such as the baseline of two antennas."""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np
from numpy.typing import ArrayLike, NDArray

from factors.noise import Kernel, gaussians
from factors.trunk import bearing_basis

Array = NDArray[np.float64]


def heading(
    key: int, yaw: float, robot_direction: ArrayLike, sigma: float, kernel: Kernel, *, steepest: float = 0.5
) -> Any:
    """`robot_direction` (3,) points to azimuth `yaw` (rad, from map x) with `sigma`; its elevation is free.

    GTSAM compares two directions on the sphere; the part that is elevation gets the deviation `steepest` (rad).

    Raises:
        ValueError: not finite, or sigma not positive.
    """
    direction = np.asarray(robot_direction, float)[None]
    return headings([key], np.array([yaw]), direction, np.array([sigma]), kernel, steepest=steepest)[0]


def headings(
    keys: list[int], yaw: Array, robot_direction: Array, sigma: Array, kernel: Kernel, *, steepest: float = 0.5
) -> list[Any]:
    """`heading` for N headings at once: azimuths and deviations (N,), directions (N, 3); checked in bulk.

    Raises:
        ValueError: as `heading`.
    """
    if not (np.isfinite(yaw).all() and np.isfinite(sigma).all() and (sigma > 0).all()):
        raise ValueError("a heading must be finite and its sigma positive")
    c, s, zero = np.cos(yaw), np.sin(yaw), np.zeros(len(yaw))
    reference = np.stack([c, s, zero], axis=1)
    basis = bearing_basis(reference)
    sideways, upwards = (basis * np.stack([-s, c, zero], axis=1)[:, :, None]).sum(axis=1), basis[:, 2]
    cov = sigma[:, None, None] ** 2 * sideways[:, :, None] * sideways[:, None, :]
    cov += steepest**2 * upwards[:, :, None] * upwards[:, None, :]
    unit, factor = gtsam.Unit3, gtsam.AttitudeFactorPose3
    return [
        factor(k, unit(z), noise, unit(d))
        for k, z, d, noise in zip(keys, reference, robot_direction, gaussians(cov, kernel), strict=True)
    ]
