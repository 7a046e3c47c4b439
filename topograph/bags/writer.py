"""Writes real bags: ROS 1 `.bag`, or a ROS 2 folder with an mcap file. Used by the simulator and in tests."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import fields as fields_of
from pathlib import Path
from types import TracebackType
from typing import Any, Self, cast

import numpy as np
from numpy.typing import NDArray
from rosbags import rosbag1, rosbag2

from topograph.bags.definitions import typestore
from topograph.errors import InputError
from topograph.geometry import Array, to_quaternion

CYLINDER, LINE_LIST, TEXT = 3, 5, 9
"""Of visualization_msgs/Marker."""


def _upright(axis: Array) -> Array:
    """Quaternion (4,) x y z w that turns the vertical onto an axis (3,)."""
    x, y, z = np.asarray(axis, float)
    q = np.array([-y, x, 0.0, 1.0 + z])
    n = float(np.linalg.norm(q))
    return q / n if n > 1e-9 else np.array([1.0, 0.0, 0.0, 0.0])


class BagWriter:
    """A bag being written; the suffix decides: `.bag` is ROS 1, anything else a ROS 2 folder with mcap.

    The file appears under its name only when the writer closes without an error.
    """

    def __init__(self, path: Path, compression: str = "none") -> None:
        self.path = path
        self._ros1 = path.suffix == ".bag"
        self._part = path.with_name(path.name + ".part")
        if path.exists():
            raise InputError(f"{path}: exists already; remove it or choose another name")
        self._remove()
        self._part.parent.mkdir(parents=True, exist_ok=True)
        self._store = typestore(ros1=self._ros1)
        if self._ros1:
            self._writer: Any = rosbag1.Writer(self._part)
            if compression == "lz4":
                self._writer.set_compression(rosbag1.Writer.CompressionFormat.LZ4)
        else:
            self._writer = rosbag2.Writer(self._part, version=9, storage_plugin=rosbag2.StoragePlugin.MCAP)
            if compression == "zstd":
                self._writer.set_compression(rosbag2.CompressionMode.STORAGE, rosbag2.CompressionFormat.ZSTD)
        self._connections: dict[str, Any] = {}
        self._seq = 0

    def _remove(self) -> None:
        if self._part.is_dir():
            shutil.rmtree(self._part)
        else:
            self._part.unlink(missing_ok=True)

    def __enter__(self) -> Self:
        self._writer.open()
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None, tb: TracebackType | None) -> None:
        self._writer.close()
        if kind is not None:
            self._remove()
            return
        if not self._ros1:  # files inside carry the folder's name
            inner = self._part / f"{self._part.name}.mcap"
            inner.rename(self._part / f"{self.path.name}.mcap")
            meta = self._part / "metadata.yaml"
            meta.write_text(meta.read_text().replace(f"{self._part.name}.mcap", f"{self.path.name}.mcap"))
        self._part.rename(self.path)

    def _msg(self, typ: str, **fields: Any) -> Any:
        return self._store.types[typ](**fields)

    def _header(self, stamp_ns: int, frame: str) -> Any:
        stamp = self._msg(
            "builtin_interfaces/msg/Time",
            sec=int(stamp_ns // 1_000_000_000),
            nanosec=int(stamp_ns % 1_000_000_000),
        )
        self._seq += 1
        extra = {"seq": self._seq} if self._ros1 else {}
        return self._msg("std_msgs/msg/Header", stamp=stamp, frame_id=frame, **extra)

    def _write(self, topic: str, typ: str, log_ns: int, message: Any) -> None:
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(topic, typ, typestore=self._store)
        serialize = self._store.serialize_ros1 if self._ros1 else self._store.serialize_cdr
        self._writer.write(self._connections[topic], log_ns, serialize(message, typ))

    def _vector(self, v: Any) -> Any:
        return self._msg("geometry_msgs/msg/Vector3", x=float(v[0]), y=float(v[1]), z=float(v[2]))

    def _point(self, v: Any) -> Any:
        return self._msg("geometry_msgs/msg/Point", x=float(v[0]), y=float(v[1]), z=float(v[2]))

    def _quaternion(self, q: Any) -> Any:
        return self._msg("geometry_msgs/msg/Quaternion", x=float(q[0]), y=float(q[1]), z=float(q[2]), w=float(q[3]))

    def _pose(self, T: Array) -> Any:
        return self._msg(
            "geometry_msgs/msg/Pose",
            position=self._point(T[:3, 3]),
            orientation=self._quaternion(to_quaternion(T)),
        )

    def tf_static(self, log_ns: int, transforms: dict[tuple[str, str], Array], topic: str = "/tf_static") -> None:
        """(parent, child) -> parent_T_child (4, 4): mounts, or on `/tf` what moves."""
        stamped = [
            self._msg(
                "geometry_msgs/msg/TransformStamped",
                header=self._header(log_ns, parent),
                child_frame_id=child,
                transform=self._msg(
                    "geometry_msgs/msg/Transform",
                    translation=self._vector(T[:3, 3]),
                    rotation=self._quaternion(to_quaternion(T)),
                ),
            )
            for (parent, child), T in transforms.items()
        ]
        self._write(topic, "tf2_msgs/msg/TFMessage", log_ns, self._msg("tf2_msgs/msg/TFMessage", transforms=stamped))

    def points(
        self, topic: str, log_ns: int, stamp_ns: int, frame: str, view: NDArray[Any], *, height: int = 1,
        big_endian: bool = False, pad: int = 0,
    ) -> None:  # fmt: skip
        """A PointCloud2 of a structured array (N,); `pad` bytes are added behind each row."""
        kinds = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
        fields = []
        for name in view.dtype.names or ():
            sub, offset = view.dtype.fields[name][:2]  # type: ignore[index]  # a structured dtype has fields
            fields.append(
                self._msg(
                    "sensor_msgs/msg/PointField",
                    name=name,
                    offset=int(offset),
                    datatype=kinds[sub.str[1:]],
                    count=1,
                )
            )
        width = len(view) // height
        data = np.frombuffer(view.tobytes(), np.uint8)
        if pad:
            rows = data.reshape(height, -1)
            data = np.concatenate([rows, np.zeros((height, pad), np.uint8)], axis=1).ravel()
        message = self._msg(
            "sensor_msgs/msg/PointCloud2", header=self._header(stamp_ns, frame), height=height, width=width,
            fields=fields, is_bigendian=big_endian, point_step=view.dtype.itemsize,
            row_step=view.dtype.itemsize * width + pad, data=data, is_dense=True,
        )  # fmt: skip
        self._write(topic, "sensor_msgs/msg/PointCloud2", log_ns, message)

    def imu(
        self, topic: str, log_ns: int, stamp_ns: int, frame: str, gyro: Array, accel: Array,
        quaternion: Array | None = None, yaw_sigma: float = 0.0,
    ) -> None:  # fmt: skip
        """An Imu; without `quaternion` the orientation is marked as not measured."""
        orientation_cov = np.zeros(9)
        orientation_cov[0] = -1.0 if quaternion is None else yaw_sigma**2
        orientation_cov[8] = yaw_sigma**2
        message = self._msg(
            "sensor_msgs/msg/Imu", header=self._header(stamp_ns, frame),
            orientation=self._quaternion((0, 0, 0, 1) if quaternion is None else quaternion),
            orientation_covariance=orientation_cov, angular_velocity=self._vector(gyro),
            angular_velocity_covariance=np.zeros(9), linear_acceleration=self._vector(accel),
            linear_acceleration_covariance=np.zeros(9),
        )  # fmt: skip
        self._write(topic, "sensor_msgs/msg/Imu", log_ns, message)

    def odometry(self, topic: str, log_ns: int, stamp_ns: int, frames: tuple[str, str], T: Array, twist: Array) -> None:
        """An Odometry: pose `odom_T_base` (4, 4) and twist (6,) linear, angular in the child frame."""
        message = self._msg(
            "nav_msgs/msg/Odometry", header=self._header(stamp_ns, frames[0]), child_frame_id=frames[1],
            pose=self._msg("geometry_msgs/msg/PoseWithCovariance", pose=self._pose(T), covariance=np.zeros(36)),
            twist=self._msg(
                "geometry_msgs/msg/TwistWithCovariance",
                twist=self._msg("geometry_msgs/msg/Twist", linear=self._vector(twist[:3]), angular=self._vector(twist[3:])),
                covariance=np.zeros(36),
            ),
        )  # fmt: skip
        self._write(topic, "nav_msgs/msg/Odometry", log_ns, message)

    def fix(
        self, topic: str, log_ns: int, stamp_ns: int, frame: str, lat_lon_h: Array, cov: Array, status: int
    ) -> None:
        """A NavSatFix: degrees, degrees, m; ENU covariance (3, 3) in m²."""
        message = self._msg(
            "sensor_msgs/msg/NavSatFix", header=self._header(stamp_ns, frame),
            status=self._msg("sensor_msgs/msg/NavSatStatus", status=status, service=1),
            latitude=float(lat_lon_h[0]), longitude=float(lat_lon_h[1]), altitude=float(lat_lon_h[2]),
            position_covariance=np.asarray(cov, float).ravel(), position_covariance_type=2,
        )  # fmt: skip
        self._write(topic, "sensor_msgs/msg/NavSatFix", log_ns, message)

    def heading(self, topic: str, log_ns: int, stamp_ns: int, frame: str, quaternion: Array) -> None:
        """A heading as QuaternionStamped."""
        message = self._msg(
            "geometry_msgs/msg/QuaternionStamped",
            header=self._header(stamp_ns, frame),
            quaternion=self._quaternion(quaternion),
        )
        self._write(topic, "geometry_msgs/msg/QuaternionStamped", log_ns, message)

    def trajectory(self, topic: str, log_ns: int, frame: str, stamps_ns: NDArray[np.int64], poses: Array) -> None:
        """A Path of poses (N, 4, 4)."""
        stamped = [
            self._msg("geometry_msgs/msg/PoseStamped", header=self._header(int(s), frame), pose=self._pose(T))
            for s, T in zip(stamps_ns, poses, strict=True)
        ]
        message = self._msg("nav_msgs/msg/Path", header=self._header(log_ns, frame), poses=stamped)
        self._write(topic, "nav_msgs/msg/Path", log_ns, message)

    def pose_array(self, topic: str, stamp_ns: int, frame: str, poses: Array) -> None:
        """A PoseArray of poses (N, 4, 4)."""
        message = self._msg(
            "geometry_msgs/msg/PoseArray", header=self._header(stamp_ns, frame), poses=[self._pose(T) for T in poses]
        )
        self._write(topic, "geometry_msgs/msg/PoseArray", stamp_ns, message)

    def markers(
        self, topic: str, log_ns: int, frame: str, trunks: Sequence[tuple[Array, Array, float, tuple[float, ...]]],
        lines: Array, names: Sequence[tuple[Array, str]],
    ) -> None:  # fmt: skip
        """A MarkerArray: a cylinder for each trunk (middle, axis, diameter, colour), `lines` (2E, 3) from each second point to the next, and
        texts at places.
        """
        out = [
            self._marker(log_ns, frame, "trees", k, CYLINDER, (d, d, 1.5), color, middle, _upright(axis))
            for k, (middle, axis, d, color) in enumerate(trunks)
        ]
        ends = [self._point(p) for p in lines]
        out.append(
            self._marker(log_ns, frame, "edges", 0, LINE_LIST, (0.03, 0.0, 0.0), (0.6, 0.65, 0.6, 1.0), points=ends)
        )
        out += [
            self._marker(log_ns, frame, "names", k, TEXT, (0.0, 0.0, 0.35), (0.1, 0.1, 0.1, 1.0), at, text=text)
            for k, (at, text) in enumerate(names)
        ]
        message = self._msg("visualization_msgs/msg/MarkerArray", markers=out)
        self._write(topic, "visualization_msgs/msg/MarkerArray", log_ns, message)

    def _marker(
        self, stamp_ns: int, frame: str, ns: str, number: int, kind: int, scale: Sequence[float], color: Sequence[float],
        at: Any = (0.0, 0.0, 0.0), turn: Any = (0.0, 0.0, 0.0, 1.0), points: Sequence[Any] = (), text: str = "",
    ) -> Any:  # fmt: skip
        pose = self._msg("geometry_msgs/msg/Pose", position=self._point(at), orientation=self._quaternion(turn))
        tint = self._msg("std_msgs/msg/ColorRGBA", **dict(zip("rgba", map(float, color), strict=True)))
        fields = {
            "header": self._header(stamp_ns, frame), "ns": ns, "id": number, "type": kind, "action": 0, "pose": pose,
            "scale": self._vector(scale), "color": tint,
            "lifetime": self._msg("builtin_interfaces/msg/Duration", sec=0, nanosec=0), "frame_locked": False,
            "points": list(points), "colors": [], "text": text, "mesh_resource": "", "mesh_use_embedded_materials": False,
        }  # fmt: skip
        typ = "visualization_msgs/msg/Marker"
        known = {f.name for f in fields_of(cast(Any, self._store.types[typ]))}
        for name in known:  # later ROS 2 has textures, and they are empty
            if name not in fields and name != "__msgtype__":
                fields[name] = self._empty(name)
        return self._msg(typ, **{k: v for k, v in fields.items() if k in known})

    def _empty(self, name: str) -> Any:
        if name == "texture":
            header = self._header(0, "")
            return self._msg("sensor_msgs/msg/CompressedImage", header=header, format="", data=np.zeros(0, np.uint8))
        if name == "mesh_file":
            return self._msg("visualization_msgs/msg/MeshFile", filename="", data=np.zeros(0, np.uint8))
        return [] if name == "uv_coordinates" else ""

    def trunks(
        self, topic: str, log_ns: int, stamp_ns: int, frame: str, p: Array, diameter: Array, quaternion: Array
    ) -> None:
        """Trunk detections as Detection3DArray: p (N, 3), diameter (N,), quaternion (N, 4) whose z is the axis."""
        detections = []
        for i in range(len(p)):
            T = self._msg(
                "geometry_msgs/msg/Pose",
                position=self._point(p[i]),
                orientation=self._quaternion(quaternion[i]),
            )
            box = self._msg(
                "vision_msgs/msg/BoundingBox3D", center=T, size=self._vector((diameter[i], diameter[i], 0.0))
            )
            detections.append(
                self._msg(
                    "vision_msgs/msg/Detection3D",
                    header=self._header(stamp_ns, frame),
                    results=[],
                    bbox=box,
                    id="",
                )
            )
        message = self._msg(
            "vision_msgs/msg/Detection3DArray", header=self._header(stamp_ns, frame), detections=detections
        )
        self._write(topic, "vision_msgs/msg/Detection3DArray", log_ns, message)

    def clusters(self, topic: str, log_ns: int, stamp_ns: int, frame: str, clouds: list[NDArray[np.float32]]) -> None:
        """The thesis's ClusterArray (5.2): one cloud (M, 3) per cluster."""
        found = []
        for cloud in clouds:
            view = np.zeros(len(cloud), np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4")]))
            for k, a in enumerate("xyz"):
                view[a] = cloud[:, k]
            fields = [
                self._msg("sensor_msgs/msg/PointField", name=a, offset=4 * k, datatype=7, count=1)
                for k, a in enumerate("xyz")
            ]
            message = self._msg(
                "sensor_msgs/msg/PointCloud2", header=self._header(stamp_ns, frame), height=1, width=len(cloud), fields=fields,
                is_bigendian=False, point_step=12, row_step=12 * len(cloud),
                data=np.frombuffer(view.tobytes(), np.uint8), is_dense=True,
            )  # fmt: skip
            found.append(
                self._msg(
                    "pcl_processing/msg/Cluster",
                    num_points=len(cloud),
                    centroid=self._point(cloud.mean(0)),
                    cloud=message,
                )
            )
        array = self._msg("pcl_processing/msg/ClusterArray", header=self._header(stamp_ns, frame), clusters=found)
        self._write(topic, "pcl_processing/msg/ClusterArray", log_ns, array)
