"""The small messages of a recording, one frozen product each."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

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


@dataclass(frozen=True, slots=True, kw_only=True)
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
        kinds: (N, 3) log-probabilities of tree, post, other; or (0, 3).
        measured: (N, 6) what was measured, without a prior: height of `p` above the mean return (m), slope of the axis
            (x and y per z) and its information, width (m) and its sigma; or (0, 6).
        stems: (N,) stems joined into one trunk; or (0,).
        free: (360,) words of what the scan saw through (trunks/passage.py), about `eye` (3,) in `frame`; or (0,).
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
    kinds: Array = field(default_factory=lambda: np.zeros((0, 3)))
    measured: Array = field(default_factory=lambda: np.zeros((0, 6)))
    stems: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    free: NDArray[np.uint32] = field(default_factory=lambda: np.zeros(0, np.uint32))
    eye: Array = field(default_factory=lambda: np.zeros(3))

    def __len__(self) -> int:
        return len(self.p)

    @property
    def likely(self) -> NDArray[np.bool_]:
        """(N,) rows that are rather a tree or a post than anything else; all, where the source tells no kinds."""
        if len(self.kinds) != len(self.p):
            return np.ones(len(self.p), bool)
        return np.asarray(np.logaddexp(self.kinds[:, 0], self.kinds[:, 1]) > self.kinds[:, 2])

    def select(self, keep: NDArray[np.bool_]) -> Trunks:
        """The rows where `keep` (N,); what holds for the whole scan stays."""
        rows = {
            k: getattr(self, k)
            for k in ("p", "axis", "diameter", "cov", "height", "score", "kinds", "measured", "stems")
        }
        clouds = tuple(c for c, k in zip(self.clouds, keep, strict=True) if k) if self.clouds else ()
        return replace(self, clouds=clouds, **{k: v[keep] if len(v) == len(keep) else v for k, v in rows.items()})
