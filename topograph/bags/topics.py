"""Which topic is which stream: found by type, or named."""

from __future__ import annotations

from collections.abc import Mapping

from topograph.bags.config import BagsConfig
from topograph.errors import TopicError

KINDS: dict[str, tuple[str, ...]] = {
    "points": ("sensor_msgs/msg/PointCloud2",),
    "trunks": ("vision_msgs/msg/Detection3DArray", "pcl_processing/msg/ClusterArray"),
    "odometry": ("nav_msgs/msg/Odometry",),
    "imu": ("sensor_msgs/msg/Imu",),
    "fix": ("sensor_msgs/msg/NavSatFix",),
    "heading": (
        "sensor_msgs/msg/Imu",
        "geometry_msgs/msg/QuaternionStamped",
        "geometry_msgs/msg/PoseStamped",
        "geometry_msgs/msg/PoseWithCovarianceStamped",
    ),
}


FROM_LIDAR = "lidar"
"""In place of odometry's topic: the motion is that of the point clouds."""


def choose(types: Mapping[str, str], config: BagsConfig) -> dict[str, str]:
    """Stream kind -> topic, of the topics -> types of a recording. Kinds without a topic are left out.

    Raises:
        TopicError: a named topic is missing or of the wrong type, or several topics fit.
    """
    chosen: dict[str, str] = {}
    for kind, accepted in KINDS.items():
        wanted = getattr(config, f"topic_{kind}")
        if wanted == "none" or (kind == "odometry" and wanted == FROM_LIDAR):
            continue
        if wanted:
            chosen[kind] = _named(kind, wanted, accepted, types)
            continue
        fitting = sorted(t for t, typ in types.items() if typ in accepted and _fits(kind, t, typ))
        if kind == "trunks" and "points" in chosen:
            continue  # clouds are the better source; a recorded trunk topic is taken when it is named
        if len(fitting) > 1:
            options = "\n  ".join(f"--topic-{kind} {t}" for t in [*fitting, "none"])
            raise TopicError(f"{len(fitting)} topics could be {kind}; add one of\n  {options}")
        if fitting:
            chosen[kind] = fitting[0]
    if config.topic_trunks not in ("", "none") and not config.topic_points:
        chosen.pop("points", None)
    return chosen


def _fits(kind: str, topic: str, typ: str) -> bool:
    if typ != "sensor_msgs/msg/Imu":
        return True
    return ("heading" in topic.lower()) == (kind == "heading")  # ublox and others send the heading as an Imu


def _named(kind: str, wanted: str, accepted: tuple[str, ...], types: Mapping[str, str]) -> str:
    topic = wanted if wanted in types else "/" + wanted.lstrip("/")
    if topic not in types:
        have = ", ".join(f"{t} ({typ})" for t, typ in sorted(types.items()))
        raise TopicError(f"--topic-{kind} {wanted}: no such topic; the recording has {have or 'none'}")
    if types[topic] not in accepted:
        raise TopicError(f"--topic-{kind} {wanted} is a {types[topic]}; wanted is {' or '.join(accepted)}")
    return topic
