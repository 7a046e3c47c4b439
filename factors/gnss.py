"""Position of the antenna."""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np
from numpy.typing import ArrayLike

from factors.noise import Kernel, gaussian, robust


def fix(key: int, map_p_antenna: ArrayLike, robot_p_antenna: ArrayLike, cov: ArrayLike, kernel: Kernel) -> Any:
    """The antenna, `robot_p_antenna` (3,) on the robot, is at `map_p_antenna` (3,) with covariance (3, 3), m.

    Raises:
        ValueError: not finite.
    """
    z, lever = np.asarray(map_p_antenna, float), np.asarray(robot_p_antenna, float)
    if not (np.isfinite(z).all() and np.isfinite(lever).all()):
        raise ValueError("a fix and its lever arm must be finite")
    return gtsam.GPSFactorArm(key, z, lever, robust(gaussian(cov), kernel))
