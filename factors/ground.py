"""What the ground says of the attitude."""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np

from factors.noise import sigmas


def level(key: int, sigma: float) -> Any:
    """The robot's z axis points up within `sigma` (rad): robots do not roll over."""
    up = gtsam.Unit3(np.array([0.0, 0.0, 1.0]))
    return gtsam.AttitudeFactorPose3(key, up, sigmas([sigma, sigma]), up)
