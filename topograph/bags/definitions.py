"""Messages beyond ROS's own: recordings of ROS 2 before Iron do not hold their definitions."""

from __future__ import annotations

from functools import cache

from rosbags.interfaces.typing import Typesdict
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

_DEFINITIONS = {
    "tf2_msgs/msg/TFMessage": "geometry_msgs/TransformStamped[] transforms",
    "vision_msgs/msg/ObjectHypothesis": "string class_id\nfloat64 score",
    "vision_msgs/msg/ObjectHypothesisWithPose": "vision_msgs/ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose",
    "vision_msgs/msg/BoundingBox3D": "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size",
    "vision_msgs/msg/Detection3D": (
        "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\n"
        "vision_msgs/BoundingBox3D bbox\nstring id"
    ),
    "vision_msgs/msg/Detection3DArray": "std_msgs/Header header\nvision_msgs/Detection3D[] detections",
    "pcl_processing/msg/Cluster": "uint32 num_points\ngeometry_msgs/Point centroid\nsensor_msgs/PointCloud2 cloud",
    "pcl_processing/msg/ClusterArray": "std_msgs/Header header\npcl_processing/Cluster[] clusters",
    "gps_msgs/msg/GPSStatus": (
        "std_msgs/Header header\nuint16 satellites_used\nint32[] satellite_used_prn\nuint16 satellites_visible\n"
        "int32[] satellite_visible_prn\nint32[] satellite_visible_z\nint32[] satellite_visible_azimuth\n"
        "int32[] satellite_visible_snr\nint16 status\nuint16 motion_source\nuint16 orientation_source\nuint16 position_source"
    ),
    "gps_msgs/msg/GPSFix": "\n".join(
        [
            "std_msgs/Header header",
            "gps_msgs/GPSStatus status",
            *(
                f"float64 {name}"
                for name in (
                    *("latitude", "longitude", "altitude", "track", "speed", "climb", "pitch", "roll", "dip", "time"),
                    *("gdop", "pdop", "hdop", "vdop", "tdop", "err", "err_horz", "err_vert", "err_track", "err_speed"),
                    *("err_climb", "err_time", "err_pitch", "err_roll", "err_dip"),
                )
            ),
            "float64[9] position_covariance",
            "uint8 position_covariance_type",
        ]
    ),
}


def typestore(*, ros1: bool) -> Typestore:
    """ROS's own messages (Noetic's, Humble's) and those above."""
    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    store.register({name: fields for name, fields in _parsed().items() if name not in store.types})
    return store


@cache
def _parsed() -> Typesdict:
    return {k: v for name, text in _DEFINITIONS.items() for k, v in get_types_from_msg(text, name).items()}
