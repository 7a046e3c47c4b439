"""What the ground says of the attitude."""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np
from numpy.typing import ArrayLike

from factors.noise import sigmas


def level(key: int, sigma: float, robot_up: ArrayLike = (0.0, 0.0, 1.0)) -> Any:
    """`robot_up` (3,), by default the robot's z axis, points up within `sigma` (rad): robots do not roll over.

    Raises:
        ValueError: `robot_up` has no length, or sigma is not positive.
    """
    d = np.asarray(robot_up, float)
    if not np.isfinite(d).all() or np.linalg.norm(d) < 1e-6:
        raise ValueError("a direction must be finite and have a length")
    return gtsam.AttitudeFactorPose3(
        key, gtsam.Unit3(np.array([0.0, 0.0, 1.0])), sigmas([sigma, sigma]), gtsam.Unit3(d)
    )
