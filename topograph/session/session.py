"""A run that was read."""

from __future__ import annotations

import hashlib
from collections import Counter
from dataclasses import dataclass, field
from datetime import UTC, datetime

from topograph.geometry import Array
from topograph.session.scans import Scans
from topograph.session.streams import Streams


def unknown_mounts(streams: Streams, mounts: dict[str, Array | None]) -> list[str]:
    """What to say of antennas whose place nobody knows."""
    return [
        f"{name} frame {streams.frames[k]!r} is not in TF: taken at the base; add --extrinsic {streams.frames[k]}=X,Y,Z,ROLL,PITCH,YAW"
        for k, name in (("fix", "antenna"), ("heading", "heading"))
        if k in mounts and mounts[k] is None
    ]


@dataclass(frozen=True, slots=True, kw_only=True)
class Session:
    """What was read of a recording.

    Attributes:
        streams: the small streams.
        trunks: trunks of each scan in `base_link`, as they came.
        mounts: "imu", "fix", "heading" -> robot_T_sensor, or None where no transform is known.
        chosen: stream kind -> topic.
        skipped: reason -> count.
        notes: what had to be assumed.
        scans, seconds, duration_s: counted, spent reading and detecting, recorded.
        start_ns: when the recording began.
        announced: stream kind -> messages that there were; those not among `skipped` were used.
    """

    streams: Streams
    trunks: Scans
    mounts: dict[str, Array | None]
    child_T_robot: Array
    chosen: dict[str, str]
    skipped: Counter[str]
    notes: list[str]
    scans: int
    seconds: float
    duration_s: float
    start_ns: int
    announced: dict[str, int] = field(default_factory=dict)

    @property
    def id(self) -> str:
        """What the run is called: when it began, and six digits of what it holds. The same recording is always called the same, whatever
        its files are."""
        h = hashlib.sha256()
        s = self.streams
        for column in (s.odometry_ns, s.odom_T_child, s.imu_ns, s.gyro, s.fix_ns, s.lat_lon_h, s.heading_ns, s.heading):
            h.update(column.tobytes())
        ends = self.trunks.ends.tolist()
        for k, ns in enumerate(self.trunks.stamps_ns.tolist()):
            h.update(ns.to_bytes(8, "big", signed=True))
            h.update(self.trunks.p[ends[k] : ends[k + 1]].tobytes())
        began = datetime.fromtimestamp(self.start_ns * 1e-9, UTC)
        return f"{began:%Y%m%dT%H%M%S}Z-{h.hexdigest()[:6]}"
