"""A detector of one's own, live: trunks go into a Localizer as they are found, poses come out.

`find_trunks` stands for whatever finds trunks in your sensor's data: points in the robot's frame (base_link), metres.
"""

import numpy as np

from topograph import Localizer, load_map
from topograph.bags import Imu, Odometry, Trunks
from topograph.trunks import TrunksConfig, from_recorded


def trunks_of(stamp_ns: int, points: np.ndarray, diameters: np.ndarray) -> Trunks:
    """Points (N, 3) on trunks, in base_link, and diameters (N,), NaN where they are not known, as the localizer takes them."""
    n = len(points)
    up, none = np.tile([0.0, 0.0, 1.0], (n, 1)), np.full(n, np.nan)
    bare = Trunks(
        stamp_ns=stamp_ns,
        frame="base_link",
        p=points,
        axis=up,
        diameter=diameters,
        cov=np.full((n, 3, 3), np.nan),
        height=none,
        score=np.zeros(n),
    )
    return from_recorded(bare, np.eye(4), TrunksConfig())


class Node:
    """Call these from your callbacks. In regular plantations it is diameters, and the IMU's vertical, that tell one place from another."""

    def __init__(self, map_file: str, robot_R_imu: np.ndarray | None = None) -> None:
        self.localizer = Localizer(load_map(map_file, clouds=False), robot_R_imu=robot_R_imu)
        self.heard: list[Odometry | Imu] = []

    def odometry(self, stamp_ns: int, pose: np.ndarray, twist: np.ndarray) -> None:
        """`pose` (7,) x y z qx qy qz qw in the odometry's frame, `twist` (6,) linear, angular."""
        self.heard.append(Odometry(stamp_ns, "base_link", pose, twist))

    def imu(self, stamp_ns: int, gyro: np.ndarray, accel: np.ndarray) -> None:
        """Rates (3,) rad/s and specific force (3,) m/s², in the IMU's axes."""
        self.heard.append(Imu(stamp_ns, "imu", gyro, accel))

    def scan(self, stamp_ns: int, points: np.ndarray, diameters: np.ndarray | None = None) -> np.ndarray | None:
        """The pose (4, 4) in the map, or None while it is not sure; `localizer.report` says why."""
        none = np.full(len(points), np.nan)
        fix = self.localizer.update(trunks_of(stamp_ns, points, none if diameters is None else diameters), self.heard)
        self.heard = []
        return None if fix is None else fix.map_T_robot
