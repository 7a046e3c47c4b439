"""The small messages of a recording, one frozen product each."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Odometry:
    """One wheel-odometry message.

    Attributes:
        odom_T_child: (7,) x, y, z (m) and quaternion x, y, z, w.
        twist: (6,) linear (m/s) and angular (rad/s) velocity in the child frame.
    """

    stamp_ns: int
    child_frame: str
    odom_T_child: Array
    twist: Array


@dataclass(frozen=True, slots=True)
class Imu:
    """One inertial sample: angular velocity (3,) rad/s and specific force (3,) m/s², in `frame`."""

    stamp_ns: int
    frame: str
    gyro: Array
    accel: Array


@dataclass(frozen=True, slots=True)
class Fix:
    """One GNSS fix: latitude and longitude in degrees, height in m, ENU covariance (3, 3) in m².

    `status` is NavSatStatus: -1 none, 0 single, 1 SBAS, 2 ground-based augmentation (RTK).
    """

    stamp_ns: int
    frame: str
    lat_lon_h: Array
    cov: Array
    status: int


@dataclass(frozen=True, slots=True)
class Heading:
    """Heading of `frame`'s x axis from east, counter-clockwise, rad; `sigma` NaN when not stated."""

    stamp_ns: int
    frame: str
    yaw: float
    sigma: float


@dataclass(frozen=True, slots=True)
class Trunks:
    """The trunks of one scan, N rows, in `frame`.

    Attributes:
        p: (N, 3) point on the trunk's axis, m.
        axis: (N, 3) unit vector along the trunk, up.
        diameter: (N,) m; NaN unknown.
        cov: (N, 3, 3) covariance of `p`, m²; NaN unknown.
        height: (N,) of `p` above the ground at the trunk, m; NaN unknown.
        score: (N,) log-odds that it is a tree.
        clouds: N arrays (M, 3) of the trunk's points, or empty.
        surface: `p` is the centroid of the visible surface, not yet on the axis.
    """

    stamp_ns: int
    frame: str
    p: Array
    axis: Array
    diameter: Array
    cov: Array
    height: Array
    score: Array
    clouds: tuple[NDArray[np.float32], ...] = ()
    surface: bool = False

    def __len__(self) -> int:
        return len(self.p)
