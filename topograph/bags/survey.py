"""What a recording says of itself: rates, gaps, clocks, layouts. Read once; of the clouds only a few are decoded."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from topograph.bags.clocks import Clocks, Message
from topograph.bags.messages import Fix, Heading, Imu, Odometry, Trunks
from topograph.bags.recording import Recording
from topograph.bags.scan import Scan
from topograph.geometry import Array

CLOUDS = 5
"""Of a recording are decoded, spread over it."""
RAW = {
    "ouster_ros/msg/PacketMsg": "ouster_ros's replay launch file",
    "ouster_sensor_msgs/msg/PacketMsg": "ouster_ros's replay launch file",
    "hesai_ros_driver/msg/UdpFrame": "hesai_ros_driver with its packet topic as source",
    "pandar_msgs/msg/PandarScan": "hesai's pandar_pointcloud",
    "rslidar_msg/msg/RslidarPacket": "rslidar_sdk with its packet topic as source",
}
"""Packets of LiDARs that are not read (bags/packets.py has those that are) -> what makes PointCloud2 of them."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StreamSurvey:
    """One stream of a recording.

    Attributes:
        kind, topic, msgtype: what it is taken for, and from where.
        logged_s: (N,) time of recording after the recording's start, s.
        offset_s: (M,) header stamp less time of recording, s, of the messages that were decoded.
        frame: the sensor's; "" unknown.
    """

    kind: str
    topic: str
    msgtype: str
    logged_s: Array
    offset_s: Array
    frame: str

    @property
    def rate_hz(self) -> float:
        """By the median step."""
        steps = np.diff(self.logged_s)
        return float(1.0 / np.median(steps)) if len(steps) and np.median(steps) > 0 else 0.0

    def longest_gap(self, duration_s: float) -> tuple[float, float]:
        """Length of the longest silence and when it begins, s; those before the first and after the last message count."""
        at = np.concatenate([[0.0], self.logged_s, [duration_s]])
        k = int(np.argmax(np.diff(at)))
        return float(at[k + 1] - at[k]), float(at[k])


@dataclass(frozen=True, slots=True, kw_only=True)
class Survey:
    """Streams of a recording, its small messages with their stamps set right, some clouds, and what was found of clocks."""

    streams: dict[str, StreamSurvey]
    products: Sequence[Odometry | Imu | Fix | Heading | Trunks]
    clouds: Sequence[Scan]
    fields: tuple[str, ...]
    notes: Sequence[str]
    raw: dict[str, str]


def survey(recording: Recording) -> Survey:
    """Read an open recording once. `raw` of the answer is topic -> what to do with its packets; `fields` those of the cloud."""
    logged: dict[str, list[int]] = {k: [] for k in recording.chosen}
    offset: dict[str, list[int]] = {k: [] for k in recording.chosen}
    frames: dict[str, str] = {}
    small: list[Message] = []
    clouds: list[Scan] = []
    points = recording.chosen.get("points", "")
    every = max(1, recording.counts[points] // CLOUDS)
    fields: tuple[str, ...] = ()
    for kind, log_ns, product, layout in recording.survey(every):
        logged[kind].append(log_ns)
        fields = fields or layout
        if product is None:
            continue
        offset[kind].append(product.stamp_ns - log_ns)
        frames.setdefault(kind, product.child_frame if isinstance(product, Odometry) else product.frame)
        if isinstance(product, Scan):
            clouds.append(product)
        else:
            small.append(Message(kind, log_ns, product))
    clocks = Clocks(recording.skipped)
    products = [m.product for m in clocks.pass_on(small)]
    assert all(isinstance(p, Odometry | Imu | Fix | Heading | Trunks) for p in products)
    seconds = {k: np.array([t - recording.start_ns for t in v], float) * 1e-9 for k, v in logged.items()}
    return Survey(
        streams={
            k: StreamSurvey(
                kind=k,
                topic=t,
                msgtype=recording.types[t],
                logged_s=seconds[k],
                offset_s=np.array(offset[k], float) * 1e-9,
                frame=frames.get(k, ""),
            )
            for k, t in recording.chosen.items()
        },
        products=products,  # type: ignore[arg-type]  # asserted above
        clouds=clouds,
        fields=fields,
        notes=[*recording.notes, *clocks.notes],
        raw={t: RAW[typ] for t, typ in recording.types.items() if typ in RAW and recording.counts[t]},
    )
