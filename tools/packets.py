"""A ROS 1 recording of VLP-16 clouds as a driver would have recorded it before clouds were made: packets, or a Livox driver's messages.

    python tools/packets.py run.bag packets.bag [--as livox]

Written with rosbags and by the sensors' manuals alone, so that tests read back what the program itself did not write.
"""

from __future__ import annotations

import argparse
import struct
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from rosbags import rosbag1
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from topograph.bags.scan import Scan, decode

DEFINITIONS = {
    "velodyne_msgs/msg/VelodynePacket": "builtin_interfaces/Time stamp\nuint8[1206] data",
    "velodyne_msgs/msg/VelodyneScan": "std_msgs/Header header\nvelodyne_msgs/VelodynePacket[] packets",
    **{
        f"{package}/msg/{name}": text.replace("PACKAGE", package)
        for package in ("livox_ros_driver", "livox_ros_driver2")
        for name, text in (
            ("CustomPoint", "uint32 offset_time\nfloat32 x\nfloat32 y\nfloat32 z\nuint8 reflectivity\nuint8 tag\nuint8 line"),
            (
                "CustomMsg",
                "std_msgs/Header header\nuint64 timebase\nuint32 point_num\nuint8 lidar_id\nuint8[3] rsvd\n"
                "PACKAGE/CustomPoint[] points",
            ),
        )
    },
}  # fmt: skip
FIRING_S, LASER_S = 55.296e-6, 2.304e-6
"""Between two firings of all lasers, and between two lasers of a firing (VLP-16 user manual, 9.3)."""
LASERS, FIRINGS, BLOCKS = 16, 2, 12
"""Of a firing, of a block, of a packet."""
TURN_S = 0.1
HOUR_US = 3_600_000_000


@cache
def store_of(ros1: bool) -> Typestore:
    """ROS's messages and the drivers'."""
    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    for name, text in DEFINITIONS.items():
        store.register(get_types_from_msg(text.replace("builtin_interfaces/Time", "time") if ros1 else text, name))
    return store


def packets_of(scan: Scan) -> list[tuple[int, bytes]]:
    """(time of its first firing in ns, 1206 bytes) of each packet of a VLP-16's sweep; rings count from the lowest."""
    assert scan.ring is not None
    assert scan.offset is not None
    ring, at = scan.ring.astype(int), scan.offset.astype(float)
    laser = np.where(ring < LASERS // 2, 2 * ring, 2 * (ring - LASERS // 2) + 1)
    first = at - laser * LASER_S
    start = first.min()
    firing = np.round((first - start) / FIRING_S).astype(int)
    step = float(
        np.dot(firing, first - start) / max(np.dot(firing, firing), 1)
    )  # of the sensor, which turns a little slower or faster
    n = (firing.max() // (FIRINGS * BLOCKS) + 1) * FIRINGS * BLOCKS
    distance = np.zeros((n, LASERS))
    distance[firing, laser] = np.linalg.norm(scan.xyz, axis=1)
    turned = -np.degrees(np.arctan2(scan.xyz[:, 1], scan.xyz[:, 0])) - 360.0 * (at - start) / TURN_S
    zero = np.degrees(np.angle(np.exp(1j * np.radians(turned)).mean()))
    out = []
    for k in range(0, n, FIRINGS * BLOCKS):
        data = b""
        for j in range(k, k + FIRINGS * BLOCKS, FIRINGS):
            azimuth = round((zero + 360.0 * j * step / TURN_S) * 100.0) % 36000
            returns = b"".join(struct.pack("<HB", round(d / 0.002), 100) for d in distance[j : j + FIRINGS].ravel())
            data += struct.pack("<HH", 0xEEFF, azimuth) + returns
        stamp = scan.stamp_ns + round((start + k * step) * 1e9)
        out.append((stamp, data + struct.pack("<IBB", stamp // 1000 % HOUR_US, 0x37, 0x22)))  # strongest return, VLP-16
    return out


def _time(store: Typestore, ns: int) -> Any:
    return store.types["builtin_interfaces/msg/Time"](sec=ns // 10**9, nanosec=ns % 10**9)


def velodyne_message(store: Typestore, header: Any, scan: Scan) -> Any:
    """VelodyneScan of a sweep."""
    packet = store.types["velodyne_msgs/msg/VelodynePacket"]
    packets = [packet(stamp=_time(store, ns), data=np.frombuffer(data, np.uint8)) for ns, data in packets_of(scan)]
    return store.types["velodyne_msgs/msg/VelodyneScan"](header=header, packets=packets)


def livox_message(
    store: Typestore, header: Any, scan: Scan, package: str = "livox_ros_driver", base_ns: int | None = None
) -> Any:
    """CustomMsg of a sweep, its times from the first point on."""
    assert scan.ring is not None
    assert scan.offset is not None
    start = float(scan.offset.min())
    point = store.types[f"{package}/msg/CustomPoint"]
    rows = zip(scan.xyz.tolist(), scan.ring.tolist(), scan.offset.tolist(), strict=True)
    points = [
        point(offset_time=round((t - start) * 1e9), x=p[0], y=p[1], z=p[2], reflectivity=10, tag=0, line=r)
        for p, r, t in rows
    ]
    return store.types[f"{package}/msg/CustomMsg"](
        header=header, timebase=scan.stamp_ns + round(start * 1e9) if base_ns is None else base_ns, point_num=len(points),
        lidar_id=0, rsvd=np.zeros(3, np.uint8), points=points,
    )  # fmt: skip


MESSAGES = {
    "velodyne": ("velodyne_msgs/msg/VelodyneScan", "/velodyne_packets", velodyne_message),
    "livox": ("livox_ros_driver/msg/CustomMsg", "/livox/lidar", livox_message),
}


def convert(source: Path, target: Path, kind: str) -> int:
    """Copy a .bag; its clouds become messages of a driver. Returns how many did."""
    store = store_of(ros1=True)
    typ, topic, make = MESSAGES[kind]
    n = 0
    with rosbag1.Reader(source) as reader, rosbag1.Writer(target) as writer:
        connections: dict[int, Any] = {}
        for c, log_ns, raw in reader.messages():
            cloud = c.msgtype == "sensor_msgs/msg/PointCloud2"
            if c.id not in connections:
                connections[c.id] = (
                    writer.add_connection(topic, typ, typestore=store)
                    if cloud
                    else writer.add_connection(c.topic, c.msgtype, msgdef=c.msgdef.data, md5sum=c.digest)
                )
            if cloud:
                message: Any = store.deserialize_ros1(raw, c.msgtype)
                stamp = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
                scan = decode(message, stamp)
                writer.write(
                    connections[c.id], log_ns, bytes(store.serialize_ros1(make(store, message.header, scan), typ))
                )
                n += 1
            else:
                writer.write(connections[c.id], log_ns, raw)
    return n


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", type=Path)
    parser.add_argument("target", type=Path)
    parser.add_argument("--as", dest="kind", choices=sorted(MESSAGES), default="velodyne")
    a = parser.parse_args()
    print(f"{convert(a.source, a.target, a.kind)} clouds")


if __name__ == "__main__":
    main()
