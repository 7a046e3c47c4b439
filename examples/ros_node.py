"""A ROS 2 node around the localizer; topograph itself does not need ROS. Run: python ros_node.py orchard.gpkg"""

import sys
from pathlib import Path

import numpy as np
import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry as OdometryMessage
from sensor_msgs.msg import PointCloud2

from topograph import store
from topograph.bags import Odometry, decode_scan
from topograph.geometry import from_xyz_rpy, to_quaternion
from topograph.localize import Localizer
from topograph.trunks.frontend import FrontEnd

rclpy.init()
node = rclpy.create_node("topograph")
base_T_lidar = from_xyz_rpy(0.3, 0.0, 0.8, 0.0, 0.0, 0.0)  # yours
front_end = FrontEnd(mount=lambda frame: base_T_lidar, find=lambda frame: None)
localizer = Localizer(store.load(Path(sys.argv[1])), front_end=front_end)
poses = node.create_publisher(PoseWithCovarianceStamped, "map_pose", 10)
waiting: list[Odometry] = []


def stamp_of(header):
    return header.stamp.sec * 10**9 + header.stamp.nanosec


def on_odometry(m: OdometryMessage) -> None:
    p, q, v, w = m.pose.pose.position, m.pose.pose.orientation, m.twist.twist.linear, m.twist.twist.angular
    pose, twist = np.array([p.x, p.y, p.z, q.x, q.y, q.z, q.w]), np.array([v.x, v.y, v.z, w.x, w.y, w.z])
    waiting.append(Odometry(stamp_of(m.header), m.child_frame_id, pose, twist))


def on_scan(m: PointCloud2) -> None:
    fix = localizer.update(decode_scan(m, stamp_of(m.header)), waiting)
    waiting.clear()
    if fix is None:
        node.get_logger().info(f"{localizer.report.state}: {localizer.report.hypotheses} places")
        return
    out = PoseWithCovarianceStamped(header=m.header)
    out.header.frame_id = "map"
    p, q = out.pose.pose.position, out.pose.pose.orientation
    p.x, p.y, p.z = fix.map_T_robot[:3, 3]
    q.x, q.y, q.z, q.w = to_quaternion(fix.map_T_robot)
    order = [3, 4, 5, 0, 1, 2]  # ROS wants position first
    out.pose.covariance = fix.cov[np.ix_(order, order)].ravel().tolist()
    poses.publish(out)


node.create_subscription(OdometryMessage, "odom", on_odometry, 50)
node.create_subscription(PointCloud2, "points", on_scan, 5)
rclpy.spin(node)
