"""Raw bytes and deserialised messages -> products. Fixed layouts are unpacked directly: they come at 400 Hz."""

from __future__ import annotations

from typing import Any

import numpy as np

from topograph.bags import raw as layout
from topograph.bags.messages import Array, Fix, Heading, Imu, Odometry, Trunks
from topograph.bags.scan import decode as decode_scan
from topograph.geometry import from_quaternion

SHORTEST, LONGEST = 1e-6, 1e3
"""Components of a quaternion that is meant."""
FARTHEST = 1e5
"""Of a trunk from its sensor, m: beyond, the number is none."""


def stamp_of(header: Any) -> int:
    """Nanoseconds of a header stamp."""
    return int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec)


def unpack_imu(raw: bytes | memoryview, ros2: bool) -> Imu:
    """Imu from the bytes of a sensor_msgs/Imu (ROS 1, or little-endian CDR).

    Raises:
        ValueError, struct.error: the bytes are of another layout.
    """
    view = memoryview(raw)
    stamp, frame, at = layout.header(view, ros2)
    v = np.frombuffer(view, "<f8", 37, layout.aligned(at, 8, ros2))
    return Imu(stamp, frame, v[13:16].copy(), v[25:28].copy())


def unpack_odometry(raw: bytes | memoryview, ros2: bool) -> Odometry:
    """Odometry from the bytes of a nav_msgs/Odometry (ROS 1, or little-endian CDR).

    Raises:
        ValueError, struct.error: the bytes are of another layout.
    """
    view = memoryview(raw)
    stamp, _, at = layout.header(view, ros2)
    child, at = layout.string(view, layout.aligned(at, 4, ros2))
    v = np.frombuffer(view, "<f8", 85, layout.aligned(at, 8, ros2))
    pose, twist = v[:7].copy(), v[43:49].copy()
    if not pose.any():  # ROS 1's default: not filled in
        pose[6] = 1.0
    twist[1:5][np.isnan(twist[1:5])] = 0.0  # nobody drives sideways, and few tell
    return Odometry(stamp, child.lstrip("/"), pose, twist)


def decode_fix(m: Any) -> Fix:
    """Fix of a sensor_msgs/NavSatFix or a GPSFix (gps_common, gps_msgs); an unknown covariance becomes (5 m)², 10 m up."""
    cov = np.asarray(m.position_covariance, float).reshape(3, 3).copy()
    status = int(m.status.status)
    if int(m.position_covariance_type) == 0:
        cov = np.diag([25.0, 25.0, 100.0])
        across, up = getattr(m, "err_horz", 0.0), getattr(m, "err_vert", 0.0)  # of a GPSFix, at 95 %
        if across > 0:  # False for NaN
            cov = np.diag([across, across, up if up > 0 else 2.0 * across]) ** 2 / 4.0
    position = np.array([m.latitude, m.longitude, m.altitude], float)
    return Fix(stamp_of(m.header), m.header.frame_id.lstrip("/"), position, cov, _GPS_STATUS.get(status, status))


_GPS_STATUS = {18: 2, 19: 2, 20: 0, 33: 1}
"""What GPSStatus has beyond NavSatStatus (differential, RTK fixed, RTK float, WAAS) -> what other receivers say in NavSatStatus."""


def decode_twist(m: Any) -> Odometry:
    """Odometry of a TwistStamped or TwistWithCovarianceStamped in the robot's frame: a pose that never changes, and the twist."""
    twist = m.twist.twist if hasattr(m.twist, "twist") else m.twist
    v, w = twist.linear, twist.angular
    still = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
    return Odometry(
        stamp_of(m.header), m.header.frame_id.lstrip("/"), still, np.array([v.x, v.y, v.z, w.x, w.y, w.z], float)
    )


def decode_heading(m: Any) -> Heading:
    """Heading of an Imu, QuaternionStamped, PoseStamped or PoseWithCovarianceStamped."""
    sigma = float("nan")
    if hasattr(m, "orientation"):
        q = m.orientation
        variance = float(np.asarray(m.orientation_covariance)[8])
        sigma = float(np.sqrt(variance)) if variance > 0 else sigma
    elif hasattr(m, "quaternion"):
        q = m.quaternion
    elif hasattr(m.pose, "covariance"):
        q = m.pose.pose.orientation
        variance = float(np.asarray(m.pose.covariance)[35])
        sigma = float(np.sqrt(variance)) if variance > 0 else sigma
    else:
        q = m.pose.orientation
    yaw = float(np.arctan2(2.0 * (q.w * q.z + q.x * q.y), 1.0 - 2.0 * (q.y * q.y + q.z * q.z)))
    return Heading(stamp_of(m.header), m.header.frame_id.lstrip("/"), yaw, sigma)


def decode_trunks(m: Any) -> Trunks:
    """Trunks of a vision_msgs/Detection3DArray or of the thesis's pcl_processing/ClusterArray (5.2)."""
    if hasattr(m, "clusters"):
        return _clusters(m)
    n = len(m.detections)
    p, quaternion = np.zeros((n, 3)), np.zeros((n, 4))
    diameter, score = np.full(n, np.nan), np.zeros(n)
    for i, d in enumerate(m.detections):
        c = d.bbox.center
        p[i] = c.position.x, c.position.y, c.position.z
        quaternion[i] = c.orientation.x, c.orientation.y, c.orientation.z, c.orientation.w
        if d.bbox.size.x > 0:
            diameter[i] = d.bbox.size.x
        if d.results:
            score[i] = _log_odds(d.results[0])
    none = ~(np.abs(quaternion).max(axis=1, initial=0.0) < LONGEST)  # True for NaN
    quaternion[none | (np.abs(quaternion).max(axis=1, initial=0.0) < SHORTEST)] = (0, 0, 0, 1)
    axis = from_quaternion(np.zeros((n, 3)), quaternion)[:, :3, 2] if n else np.zeros((0, 3))
    axis[axis[:, 2] < 0] *= -1.0
    return _trunks(m, p, axis, diameter, score)


def _log_odds(result: Any) -> float:
    hypothesis = getattr(result, "hypothesis", result)
    s = float(np.clip(hypothesis.score, 1e-3, 1 - 1e-3)) if hypothesis.score > 0 else 0.5
    return float(np.log(s / (1 - s)))


def _clusters(m: Any) -> Trunks:
    n = len(m.clusters)
    p = np.array([[c.centroid.x, c.centroid.y, c.centroid.z] for c in m.clusters], float).reshape(n, 3)
    clouds = tuple(
        decode_scan(c.cloud, 0).xyz if len(c.cloud.fields) else np.zeros((0, 3), np.float32) for c in m.clusters
    )
    axis = np.tile([0.0, 0.0, 1.0], (n, 1))
    return _trunks(m, p, axis, np.full(n, np.nan), np.zeros(n), clouds, surface=True)


def _trunks(
    m: Any,
    p: Array,
    axis: Array,
    diameter: Array,
    score: Array,
    clouds: tuple[Any, ...] = (),
    surface: bool = False,
) -> Trunks:
    keep = np.asarray((np.abs(p) < FARTHEST).all(axis=1) & np.isfinite(axis).all(axis=1))  # False for NaN
    n = int(keep.sum())
    return Trunks(
        stamp_ns=stamp_of(m.header),
        frame=m.header.frame_id.lstrip("/"),
        p=p[keep],
        axis=axis[keep],
        diameter=diameter[keep],
        cov=np.full((n, 3, 3), np.nan),
        height=np.full(n, np.nan),
        score=score[keep],
        clouds=tuple(c for c, k in zip(clouds, keep, strict=True) if k) if clouds else (),
        surface=surface,
    )
