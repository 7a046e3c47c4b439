"""The one door from a scan to its trunks, live and in replay: how the robot moved during the sweep, which way was up, one of the rivals."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Protocol

import numpy as np

from topograph.bags import Imu, Odometry, Scan, Trunks
from topograph.geometry import Array
from topograph.motion import RecentMotion
from topograph.trunks.config import TrunksConfig
from topograph.trunks.detector import Detector
from topograph.trunks.origin import LEAST, in_rings, lidar_of, moved_back
from topograph.trunks.smear import smeared
from topograph.trunks.thesis import ThesisDetector, ThesisTrunksConfig


class Detect(Protocol):
    """A rival: the trunks of a scan in `base_link` at its stamp."""

    def __call__(self, scan: Scan, twist: Array, up: Array | None = None) -> Trunks:
        """`twist` (6,) of the base during the sweep, m/s and rad/s; `up` (2,) the vertical in its frame, or None."""


RIVALS: dict[str, Callable[[Array, TrunksConfig, ThesisTrunksConfig], Detect]] = {
    "organised": lambda base_T_lidar, ours, _: Detector(base_T_lidar, ours),
    "thesis": lambda base_T_lidar, _, thesis: ThesisDetector(base_T_lidar, thesis),
}
"""The front ends by the name that `TrunksConfig.front_end` gives them."""


class FrontEnd:
    """Scan -> trunks, with what `hear` was told of the robot's motion.

    Args:
        mount: frame of a LiDAR -> base_T_lidar (4, 4), or an error; asked once a frame.
        find: frame of an IMU -> its mounting (4, 4) or None.
        frames: all frames whose place on the robot is known, with their mountings (4, 4): one of them may be the LiDAR's, where clouds were moved out of it.

    Attributes:
        untimed: sweeps whose points had no time.
        notes: what was found out about the clouds' frames.
    """

    def __init__(
        self,
        mount: Callable[[str], Array],
        find: Callable[[str], Array | None],
        config: TrunksConfig | None = None,
        thesis: ThesisTrunksConfig | None = None,
        frames: Callable[[], Mapping[str, Array]] = dict,
    ) -> None:
        self.config, self.thesis = config or TrunksConfig(), thesis or ThesisTrunksConfig()
        self.untimed = 0
        self.notes: list[str] = []
        self._mount, self._find, self._frames = mount, find, frames
        self._frame_T_lidar: dict[str, Array | None] = {}
        self._motion = RecentMotion()
        self._imu_frame: str | None = None
        self._detect: dict[str, Detect] = {}

    def hear(self, message: Odometry | Imu) -> None:
        """One message of wheels or IMU."""
        if isinstance(message, Imu) and message.frame != self._imu_frame:
            self._imu_frame = message.frame
            found = self._find(message.frame)
            self._motion.robot_R_imu = None if found is None else found[:3, :3]
        self._motion.add(message)

    def see(self, scan: Scan) -> Trunks:
        """The trunks of one scan in `base_link`, deskewed to its stamp.

        Where no point has a time, or nothing is known of the motion, the stated covariance is the wider for it.
        """
        undecided = scan.frame not in self._frame_T_lidar and len(scan.xyz) >= LEAST
        if undecided or scan.frame not in self._detect:
            self._place(scan)
        moved = self._frame_T_lidar.get(scan.frame)
        if moved is not None:
            scan = moved_back(scan, moved)
        first = last = scan.stamp_ns
        timed = scan.offset is not None and bool(np.isfinite(scan.offset).any())
        if timed and scan.offset is not None:  # the sweep may lie before its stamp, after it, or around it
            first += int(np.nanmin(scan.offset) * 1e9)
            last += int(np.nanmax(scan.offset) * 1e9)
        else:
            self.untimed += 1
        twist, source = self._motion.twist(first, last)
        trunks = self._detect[scan.frame](scan, twist, self._motion.up(scan.stamp_ns))
        return trunks if timed and source != "none" else smeared(trunks, twist, source != "none")

    def _place(self, scan: Scan) -> None:
        """Where the scan's points were seen from: its frame, or another one about which they lie in rings. A scan of few points does not decide."""
        base_T_lidar = self._mount(scan.frame)
        lidar = lidar_of(scan, base_T_lidar, self._frames())
        if lidar is not None:
            base_T_lidar = base_T_lidar @ lidar[1]
            self.notes.append(
                f"the clouds are in {scan.frame!r} and lie in rings about {lidar[0]!r}: taken as seen from there"
            )
        elif scan.ring is None and np.allclose(base_T_lidar, np.eye(4)) and not in_rings(scan.xyz):
            self.notes.append(
                f"the clouds are in {scan.frame!r}, tell no rings and lie in none about it: if they were moved there from the LiDAR's frame, say where "
                "that is: --extrinsic lidar=X,Y,Z,ROLL,PITCH,YAW (metres, radians)"
            )
        if len(scan.xyz) >= LEAST:
            self._frame_T_lidar[scan.frame] = None if lidar is None else lidar[1]
        self._detect[scan.frame] = RIVALS[self.config.front_end](base_T_lidar, self.config, self.thesis)
