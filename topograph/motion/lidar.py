"""Odometry from the point clouds alone, for runs without wheels: KISS-ICP (Vizzo et al., IEEE RA-L 2023), if it is installed."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from topograph.bags import Odometry, Scan
from topograph.errors import InputError
from topograph.geometry import Array, inverse, log, to_quaternion

VOXEL = 0.5
"""Of KISS-ICP's map, m: trunks and the ground between them, not leaves."""
LEAST = 200
"""Returns of a sweep from which it is registered."""


class LidarOdometry:
    """Sweep -> how the base has moved, from the first sweep on.

    Args:
        mount: frame of a LiDAR -> base_T_lidar (4, 4), or an error; asked once a frame.
        base_frame: whose motion it is.

    Raises:
        InputError: KISS-ICP is not installed.
    """

    def __init__(self, mount: Callable[[str], Array], base_frame: str) -> None:
        self._mount, self._base_frame = mount, base_frame
        self._frame = ""
        self._base_T_lidar = np.eye(4)
        self._last: tuple[int, Array] | None = None
        self._kiss = _kiss()

    def step(self, scan: Scan) -> Odometry | None:
        """Pose of the base in `odom`, and its twist since the sweep before, at the end of the sweep; None where too little came back, or
        the sweep is of another LiDAR than the first.
        """
        if not self._frame:
            self._frame, self._base_T_lidar = scan.frame, self._mount(scan.frame)
        usable = np.isfinite(scan.xyz).all(axis=1)
        if scan.offset is not None:
            usable &= np.isfinite(scan.offset)
        if scan.frame != self._frame or usable.sum() < LEAST:
            return None
        offset = np.zeros(1) if scan.offset is None else scan.offset[usable].astype(float)
        last = float(offset.max())
        timed = offset.min() < last  # KISS-ICP ends the program where all times are one
        self._kiss.register_frame(scan.xyz[usable].astype(float), offset if timed else np.zeros(0))
        odom_T_base = self._base_T_lidar @ self._kiss.last_pose @ inverse(self._base_T_lidar)
        stamp = scan.stamp_ns + int(last * 1e9)
        twist = np.zeros(6)
        if self._last is not None and stamp > self._last[0]:
            twist = log(inverse(self._last[1]) @ odom_T_base) / ((stamp - self._last[0]) * 1e-9)
        self._last = (stamp, odom_T_base)
        return Odometry(
            stamp_ns=stamp,
            child_frame=self._base_frame,
            odom_T_child=np.concatenate([odom_T_base[:3, 3], to_quaternion(odom_T_base)]),
            twist=twist[[3, 4, 5, 0, 1, 2]],
        )


def _kiss() -> Any:
    try:
        from kiss_icp.config import KISSConfig
        from kiss_icp.kiss_icp import KissICP
    except ImportError as err:
        raise InputError(
            "the motion is to come from the point clouds, by KISS-ICP, and that is not installed: pip install 'topograph[lidar]'"
        ) from err
    config = KISSConfig()
    config.mapping.voxel_size = VOXEL
    config.registration.max_num_threads = 1
    return KissICP(config)
