"""Odometry + Imu -> Motion: where dead reckoning says the robot is, at any stamp. No map, no trunks."""

from topograph.motion.inertial import Inertial, align_imu, mount_turn
from topograph.motion.lidar import LidarOdometry
from topograph.motion.online import Leg, Reckoner
from topograph.motion.recent import RecentMotion
from topograph.motion.reckon import Motion, MotionConfig, dead_reckon
from topograph.motion.samples import in_radians, without_nonsense

__all__ = [
    "Inertial",
    "Leg",
    "LidarOdometry",
    "Motion",
    "MotionConfig",
    "RecentMotion",
    "Reckoner",
    "align_imu",
    "dead_reckon",
    "in_radians",
    "mount_turn",
    "without_nonsense",
]
