"""A landmark in the plane: its range, its bearing, or both (thesis 4.5 uses ranges alone)."""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np
from numpy.typing import ArrayLike

from factors.noise import Kernel, robust, sigmas
from factors.trunk import trunk_2d

MEASURES = ("both", "ranges", "bearings")


def range_2d(pose_key: int, point_key: int, distance: float, sigma: float, kernel: Kernel) -> Any:
    """Distance (m) in the plane from a Pose2 to a Point2.

    Raises:
        ValueError: the distance is not finite or negative.
    """
    if not np.isfinite(distance) or distance < 0:
        raise ValueError(f"a range must be finite and not negative, not {distance}")
    return gtsam.RangeFactor2D(pose_key, point_key, distance, robust(sigmas([sigma]), kernel))


def sighting_2d(
    pose_key: int, point_key: int, robot_p_point: ArrayLike, cov: ArrayLike, kernel: Kernel, measure: str = "both"
) -> Any:
    """Of a Point2 seen from a Pose2 at (2,) m with covariance (2, 2): "both" range and bearing, "ranges" or "bearings" alone.

    Range and bearing are taken as independent: a trunk's covariance lies along and across the line of sight.

    Raises:
        ValueError: another `measure`, not finite, nearer than 1 cm, or a covariance that is not positive along the line and across.
    """
    p, C = np.asarray(robot_p_point, float), np.asarray(cov, float)
    reach = float(np.hypot(*p))
    if not 0.01 <= reach < np.inf:
        raise ValueError("a landmark must be finite and not inside the sensor")
    line = p / reach
    side = np.array([-line[1], line[0]])
    of_bearing, of_range = float(np.sqrt(side @ C @ side)) / reach, float(np.sqrt(line @ C @ line))
    bearing = gtsam.Rot2(float(np.arctan2(p[1], p[0])))
    if measure == "both":
        return trunk_2d(pose_key, point_key, bearing.theta(), reach, [of_bearing, of_range], kernel)
    if measure == "ranges":
        return range_2d(pose_key, point_key, reach, of_range, kernel)
    if measure == "bearings":
        return gtsam.BearingFactor2D(pose_key, point_key, bearing, robust(sigmas([of_bearing]), kernel))
    raise ValueError(f"measure {measure!r}: one of {', '.join(MEASURES)}")
