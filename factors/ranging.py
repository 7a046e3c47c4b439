"""Range to a beacon, without bearing."""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np

from factors.noise import Kernel, robust, sigmas


def range_2d(pose_key: int, point_key: int, distance: float, sigma: float, kernel: Kernel) -> Any:
    """Distance (m) in the plane from a Pose2 to a Point2.

    Raises:
        ValueError: the distance is not finite or negative.
    """
    if not np.isfinite(distance) or distance < 0:
        raise ValueError(f"a range must be finite and not negative, not {distance}")
    return gtsam.RangeFactor2D(pose_key, point_key, distance, robust(sigmas([sigma]), kernel))
