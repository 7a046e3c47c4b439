"""Odometry + Imu -> Motion: where dead reckoning says the robot is, at any stamp. No map, no trunks."""

from topograph.motion.gravity import up_at
from topograph.motion.inertial import Inertial, align_imu, mount_turn
from topograph.motion.online import Leg, Reckoner
from topograph.motion.reckon import Motion, MotionConfig, dead_reckon
from topograph.motion.samples import in_radians, without_nonsense
from topograph.motion.streams import Streams, StreamsBuilder
from topograph.motion.twist import twist_during

__all__ = [
    "Inertial",
    "Leg",
    "Motion",
    "MotionConfig",
    "Reckoner",
    "Streams",
    "StreamsBuilder",
    "align_imu",
    "dead_reckon",
    "in_radians",
    "mount_turn",
    "twist_during",
    "up_at",
    "without_nonsense",
]
