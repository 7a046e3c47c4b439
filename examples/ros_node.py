"""A ROS 2 node around the localizer; topograph itself does not need ROS.

    python ros_node.py --ros-args -p map:=orchard.gpkg -r points:=/velodyne_points -r odom:=/odom -r imu:=/imu/data

Mountings come from TF. It publishes `map_pose` (PoseWithCovarianceStamped), the transform map -> odom, and `topograph_state` (String), which says why
there is no pose where there is none.
"""

from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np

from topograph import Localizer, load_map
from topograph.bags import Imu, Odometry, Scan, decode_scan
from topograph.geometry import from_quaternion, interpolate, inverse, to_quaternion
from topograph.localize import Fix
from topograph.trunks.frontend import FrontEnd

WAIT_NS = 150_000_000
"""A scan waits so long for the wheels and the IMU of its own time, which drivers send later."""


def stamp_of(header: Any) -> int:
    return int(header.stamp.sec) * 10**9 + int(header.stamp.nanosec)


def vector(v: Any) -> np.ndarray:
    return np.array([v.x, v.y, v.z])


class Bridge:
    """Messages in, poses out; knows no ROS.

    Args:
        lookup: frame -> base_T_frame (4, 4), or None where TF does not know it.
        found: called with each pose and odom_T_base at its stamp (4, 4).
        said: called with a line where there is no pose.
    """

    def __init__(
        self, map_file: str, lookup: Callable[[str], np.ndarray | None], found: Callable[[Fix, np.ndarray], None], said: Callable[[str], None]
    ) -> None:  # fmt: skip
        self.topo = load_map(map_file, clouds=False)
        self.lookup, self.found, self.said = lookup, found, said
        self.localizer: Localizer | None = None
        self.heard: list[Odometry | Imu] = []
        self.scans: list[Scan] = []
        self.driven: deque[tuple[int, np.ndarray]] = deque(maxlen=500)  # stamps and odom_T_child
        self.child_T_base = np.eye(4)
        self.front_end = FrontEnd(mount=self._mount, find=lookup)

    def _mount(self, frame: str) -> np.ndarray:
        mount = self.lookup(frame)
        if mount is None:
            raise ValueError(f"TF does not know {frame!r}")
        return mount

    def odometry(self, m: Any) -> None:
        """nav_msgs/Odometry."""
        q = m.pose.pose.orientation
        pose = np.array([*vector(m.pose.pose.position), q.x, q.y, q.z, q.w])
        self.driven.append((stamp_of(m.header), pose))
        twist = np.concatenate([vector(m.twist.twist.linear), vector(m.twist.twist.angular)])
        self._hear(Odometry(stamp_of(m.header), m.child_frame_id, pose, twist))

    def imu(self, m: Any) -> None:
        """sensor_msgs/Imu."""
        gyro, accel = vector(m.angular_velocity), vector(m.linear_acceleration)
        self._hear(Imu(stamp_of(m.header), m.header.frame_id, gyro, accel))

    def points(self, m: Any) -> None:
        """sensor_msgs/PointCloud2."""
        self.scans.append(decode_scan(m, stamp_of(m.header)))

    def _hear(self, m: Odometry | Imu) -> None:
        self.heard.append(m)
        self.front_end.hear(m)
        while self.scans and m.stamp_ns > self.scans[0].stamp_ns + WAIT_NS:
            self._see(self.scans.pop(0))

    def _see(self, scan: Scan) -> None:
        if self.lookup(scan.frame) is None:
            self.said(f"TF does not know the LiDAR's frame {scan.frame!r}")
            return
        if self.localizer is None:
            imu = next((self.lookup(m.frame) for m in self.heard if isinstance(m, Imu)), None)
            child = next((self.lookup(m.child_frame) for m in self.heard if isinstance(m, Odometry)), None)
            self.child_T_base = np.eye(4) if child is None else inverse(child)
            self.localizer = Localizer(
                self.topo,
                child_T_robot=self.child_T_base,
                robot_R_imu=None if imu is None else imu[:3, :3],
            )
        fix = self.localizer.update(self.front_end.see(scan), self.heard)
        self.heard = []
        report = self.localizer.report
        if fix is None:
            self.said("searching" if report is None else f"{report.state}: {report.why}")
        else:
            self.found(fix, self.odom_T_base(fix.stamp_ns))

    def odom_T_base(self, stamp_ns: int) -> np.ndarray:
        """Where the odometry had the robot at a stamp, (4, 4)."""
        stamps, poses = (np.array(v) for v in zip(*self.driven, strict=True))
        at = interpolate(stamps, from_quaternion(poses[:, :3], poses[:, 3:]), np.array([stamp_ns]))[0]
        return at @ self.child_T_base


def main() -> None:
    """The node."""
    import rclpy
    import tf2_ros
    from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
    from nav_msgs.msg import Odometry as OdometryMessage
    from rclpy.qos import QoSProfile, ReliabilityPolicy
    from sensor_msgs.msg import Imu as ImuMessage
    from sensor_msgs.msg import PointCloud2
    from std_msgs.msg import String

    rclpy.init()
    node = rclpy.create_node("topograph")
    map_file = node.declare_parameter("map", "orchard.gpkg").value
    base = node.declare_parameter("base_frame", "base_link").value
    odom = node.declare_parameter("odom_frame", "odom").value
    buffer = tf2_ros.Buffer()
    tf2_ros.TransformListener(buffer, node)
    broadcaster = tf2_ros.TransformBroadcaster(node)
    poses = node.create_publisher(PoseWithCovarianceStamped, "map_pose", 10)
    states = node.create_publisher(String, "topograph_state", 10)

    def lookup(frame: str) -> np.ndarray | None:
        try:
            t = buffer.lookup_transform(base, frame, rclpy.time.Time(), timeout=rclpy.duration.Duration()).transform
        except tf2_ros.TransformException:
            return None
        return from_quaternion(
            vector(t.translation), np.array([t.rotation.x, t.rotation.y, t.rotation.z, t.rotation.w])
        )

    def found(fix: Fix, odom_T_base: np.ndarray) -> None:
        stamp = rclpy.time.Time(nanoseconds=fix.stamp_ns).to_msg()
        out = PoseWithCovarianceStamped()
        out.header.stamp, out.header.frame_id = stamp, "map"
        p, q = out.pose.pose.position, out.pose.pose.orientation
        p.x, p.y, p.z = fix.map_T_robot[:3, 3].tolist()
        q.x, q.y, q.z, q.w = to_quaternion(fix.map_T_robot).tolist()
        order = [3, 4, 5, 0, 1, 2]  # ROS wants position first
        out.pose.covariance = fix.cov[np.ix_(order, order)].ravel().tolist()
        poses.publish(out)
        t = TransformStamped()
        t.header.stamp, t.header.frame_id, t.child_frame_id = stamp, "map", odom
        map_T_odom = fix.map_T_robot @ inverse(odom_T_base)
        a, b = t.transform.translation, t.transform.rotation
        a.x, a.y, a.z = map_T_odom[:3, 3].tolist()
        b.x, b.y, b.z, b.w = to_quaternion(map_T_odom).tolist()
        broadcaster.sendTransform(t)

    bridge = Bridge(map_file, lookup, found, lambda line: states.publish(String(data=line)))
    # Best effort: reliable subscribers hear nothing of best-effort drivers. Deep: while a scan is worked on, wheels and IMU go on.
    small = QoSProfile(depth=1000, reliability=ReliabilityPolicy.BEST_EFFORT)
    node.create_subscription(OdometryMessage, "odom", bridge.odometry, small)
    node.create_subscription(ImuMessage, "imu", bridge.imu, small)
    node.create_subscription(
        PointCloud2, "points", bridge.points, QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
    )
    rclpy.spin(node)


if __name__ == "__main__":
    main()
