"""What of a recording is read."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True, slots=True)
class BagsConfig:
    """Topics (empty: found by type), frames and stamps of a recording.

    Attributes:
        topic_points, topic_trunks, topic_odometry, topic_imu, topic_fix, topic_heading: topic of the stream; "" finds it by its type,
            "none" ignores the stream; `topic_odometry: lidar` takes the motion from the point clouds (KISS-ICP).
        base_frame: the frame whose poses are estimated.
        extrinsics: frame -> (x, y, z, roll, pitch, yaw) of the sensor in `base_frame`, metres and radians;
            overrules TF.
        strict: refuse a recording that is truncated or damaged, instead of reading what is whole.
    """

    topic_points: str = ""
    topic_trunks: str = ""
    topic_odometry: str = ""
    topic_imu: str = ""
    topic_fix: str = ""
    topic_heading: str = ""
    base_frame: str = "base_link"
    extrinsics: dict[str, tuple[float, float, float, float, float, float]] = field(default_factory=dict)
    strict: bool = False
