"""Which topic is which stream: found by type, or named."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

from topograph.bags.config import BagsConfig
from topograph.bags.packets import LIVOX, VELODYNE
from topograph.errors import TopicError


@dataclass(frozen=True, slots=True)
class Accepted:
    """Message types of a stream.

    Attributes:
        found: a topic of these is taken for the stream.
        instead: where there is none of `found`, or as one of the options where it is not clear that they come from one sensor.
        named: taken only when the topic is named: they may be something else (a command, a velocity in another frame).
    """

    found: tuple[str, ...]
    instead: tuple[str, ...] = ()
    named: tuple[str, ...] = ()

    @property
    def all(self) -> tuple[str, ...]:
        """Every type that the stream can be read from."""
        return (*self.found, *self.instead, *self.named)


KINDS: dict[str, Accepted] = {
    "points": Accepted(("sensor_msgs/msg/PointCloud2",), instead=(VELODYNE, *LIVOX)),
    "trunks": Accepted(("vision_msgs/msg/Detection3DArray", "pcl_processing/msg/ClusterArray")),
    "odometry": Accepted(
        ("nav_msgs/msg/Odometry",),
        named=("geometry_msgs/msg/TwistStamped", "geometry_msgs/msg/TwistWithCovarianceStamped"),
    ),
    "imu": Accepted(("sensor_msgs/msg/Imu",)),
    "fix": Accepted(("sensor_msgs/msg/NavSatFix",), instead=("gps_common/msg/GPSFix", "gps_msgs/msg/GPSFix")),
    "heading": Accepted(
        (
            "sensor_msgs/msg/Imu",
            "geometry_msgs/msg/QuaternionStamped",
            "geometry_msgs/msg/PoseStamped",
            "geometry_msgs/msg/PoseWithCovarianceStamped",
        )
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
            chosen[kind] = _named(kind, wanted, accepted.all, types)
            continue
        fitting, instead = (_fitting(kind, those, types) for those in (accepted.found, accepted.instead))
        if fitting and not all(_of_one_sensor(kind, fitting, t) for t in instead):
            fitting = [*fitting, *instead]  # a depth camera's cloud, or the map of a program that had the LiDAR
        fitting = fitting or instead
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


def _fitting(kind: str, accepted: tuple[str, ...], types: Mapping[str, str]) -> list[str]:
    return sorted(t for t, typ in types.items() if typ in accepted and _fits(kind, t, typ))


def _of_one_sensor(kind: str, topics: list[str], other: str) -> bool:
    """The topics are of the sensor of the `other`, only further processed: /velodyne_points and /velodyne_packets. One receiver publishes its
    fixes in several messages, whatever they are called."""
    return kind == "fix" or any(_first_word(t) == _first_word(other) for t in topics)


def _first_word(topic: str) -> str:
    return re.split(r"[/_]", topic.lstrip("/"), maxsplit=1)[0].lower()


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
