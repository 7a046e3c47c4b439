"""Sweeps as LiDARs' drivers record them before clouds are made: Velodyne's packets, Livox's own messages.

Both are read from the message's bytes: recordings of ROS 2 Humble hold no definitions of these types, and a sweep of Livox
is twenty thousand objects for a general reader.
"""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from topograph.bags import raw as layout
from topograph.bags.scan import Scan
from topograph.errors import InputError

VELODYNE = "velodyne_msgs/msg/VelodyneScan"
LIVOX = (
    "livox_ros_driver/msg/CustomMsg",
    "livox_ros_driver2/msg/CustomMsg",
    "livox_interfaces/msg/CustomMsg",
)

FIELDS = {
    VELODYNE: ("x", "y", "z", "intensity", "ring", "time"),
    **dict.fromkeys(LIVOX, ("x", "y", "z", "reflectivity", "tag", "line", "offset_time")),
}
"""What a point of theirs has."""

FARTHEST_M = 300.0
"""Of a Velodyne's return: none of its models sees further."""
LONGEST_S = 2.0
"""From a message's stamp to a point of it: beyond, the clocks have nothing to do with each other."""
_PACKET = np.dtype([("sec", "<u4"), ("nanosec", "<u4"), ("data", "u1", 1206)])
_POINT = np.dtype(
    [
        ("offset_ns", "<u4"),
        ("x", "<f4"),
        ("y", "<f4"),
        ("z", "<f4"),
        ("reflectivity", "u1"),
        ("tag", "u1"),
        ("line", "u1"),
    ]
)
_NOISE = np.uint8(0b01)
"""In bits 0-1 (by position) or 2-3 (by intensity) of a Livox tag: noise, with high confidence."""


class Velodyne:
    """Decoder of one sensor's `velodyne_msgs/VelodyneScan` messages, each a turn of it; the packets tell the model.

    Angles, firing times and beams' corrections are those of the package velodyne_decoder.
    """

    def __init__(self) -> None:
        import velodyne_decoder  # at need: most recordings have clouds

        self._library: Any = velodyne_decoder
        self._decoder: Any = velodyne_decoder.ScanDecoder(velodyne_decoder.Config(max_range=FARTHEST_M))

    def __call__(self, raw: bytes | memoryview, ros2: bool) -> Scan:
        """The sweep of a message.

        Raises:
            InputError: no packets, or of a model that they do not tell (HDL-64E, VLP-32A and B).
            ValueError, struct.error: the bytes are of another layout.
        """
        stamp, frame, at = layout.header(memoryview(raw), ros2)
        packets = _rows(memoryview(raw), at, _PACKET, ros2)
        if not len(packets):
            raise InputError("a VelodyneScan without packets")
        vector = self._library.PacketVector()
        stamps = packets["sec"].astype(np.int64) * 1_000_000_000 + packets["nanosec"].astype(np.int64)
        for received, data in zip(stamps.tolist(), packets["data"], strict=True):
            vector.append(self._library.VelodynePacket(received * 1e-9, data.tobytes()))
        try:
            _, points = self._decoder.decode(vector, True)
        except RuntimeError as err:
            raise InputError(
                f"{str(err).rstrip('.')}. HDL-64E, VLP-32A and VLP-32B do not tell their model: make clouds of the packets with "
                "velodyne_pointcloud's transform node"
            ) from err
        xyz = np.stack([points[a] for a in "xyz"], axis=1)
        after = (
            int(stamps[-1]) - stamp
        ) * 1e-9  # times are told from the last packet's; the header may have the first's
        return Scan(
            stamp_ns=stamp,
            frame=frame,
            xyz=xyz,
            ring=points["ring"].astype(np.int32),
            offset=_within(points["time"] + np.float32(after if abs(after) < LONGEST_S else 0.0)),
            intensity=points["intensity"].copy(),
        )


def unpack_livox(raw: bytes | memoryview, ros2: bool) -> tuple[Scan, int]:
    """Scan of a Livox driver's CustomMsg, and which of the driver's LiDARs took it. What the sensor itself calls noise with high
    confidence, and beams without a return, are left out.

    Raises:
        ValueError, struct.error: the bytes are of another layout.
    """
    view = memoryview(raw)
    stamp, frame, at = layout.header(view, ros2)
    at = layout.aligned(at, 8, ros2)
    base, _, lidar = struct.unpack_from("<QIB", view, at)
    points = _rows(view, at + 16, _POINT, ros2)  # behind point_num (4), lidar_id (1) and a reserve (3)
    noise = ((points["tag"] & 3) == _NOISE) | ((points["tag"] >> 2 & 3) == _NOISE)
    hit = (points["x"] != 0) | (points["y"] != 0) | (points["z"] != 0)
    points = points[hit & ~noise]
    shift = (int(base) - stamp) * 1e-9
    if abs(shift) > LONGEST_S:  # the sensor's own clock, since it was switched on
        shift = 0.0
    scan = Scan(
        stamp_ns=stamp,
        frame=frame,
        xyz=np.stack([points[a] for a in "xyz"], axis=1),
        ring=None,  # a line of it wanders over the whole view
        offset=_within((points["offset_ns"] * 1e-9 + shift).astype(np.float32)),
        intensity=points["reflectivity"].astype(np.float32),
    )
    return scan, lidar


def _within(offset: NDArray[np.float32]) -> NDArray[np.float32] | None:
    """Times of points, s after the stamp, unless one of them is none."""
    return offset if len(offset) > 1 and np.abs(offset).max() < LONGEST_S else None


def _rows(view: memoryview, at: int, dtype: np.dtype[Any], ros2: bool) -> NDArray[Any]:
    """A sequence's elements, whose first field has four bytes; no copy.

    Raises:
        ValueError, struct.error: fewer bytes than announced.
    """
    at = layout.aligned(at, 4, ros2)
    (n,) = struct.unpack_from("<I", view, at)
    stride = (dtype.itemsize + 3) // 4 * 4 if ros2 else dtype.itemsize
    if n and at + 4 + (n - 1) * stride + dtype.itemsize > len(view):
        raise ValueError(f"{n} elements are announced, and the message ends before them: it is truncated")
    return np.ndarray((n,), dtype, view, at + 4, (stride,)) if n else np.zeros(0, dtype)
