"""What wheels and IMU said of the last seconds: how the robot moved during one sweep, and which way was up. The same live and in replay."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from topograph.bags import Imu, Odometry
from topograph.geometry import Array
from topograph.motion.turning import mean_turned

MARGIN_NS = 50_000_000
"""Samples so long before and after a sweep are of it as well: wheels may speak less often than a sweep lasts."""
UP_NS = 1_000_000_000
"""Time over which specific force is averaged: long enough for the vibration, short enough for the gyro's bias."""
WHEELS_NS = 100_000_000
"""The wheels' velocity at the ends of that time is told by messages up to so long outside of it."""
LEAST = 20
"""Samples below which the mean is no better than the trunks' own lean."""
G = 9.80665
IN_G = 2.0
"""An accelerometer whose mean is below this speaks in g, m/s²."""
MOST = 1000.0
"""A value beyond is of a broken message, in whatever unit: it is passed over here, and counted where streams are read."""
ROWS = 8192
"""Messages that are kept, at least: two seconds of the fastest sensors."""


class _Columns:
    """The last messages of one stream, as they came: stamps (N,) and values (N, W)."""

    def __init__(self, width: int) -> None:
        self._ns = np.zeros(2 * ROWS, np.int64)
        self._values = np.zeros((2 * ROWS, width))
        self._n = 0

    def add(self, stamp_ns: int, *values: Array) -> None:
        if self._n == len(self._ns):
            self._ns[:ROWS], self._values[:ROWS] = self._ns[ROWS:], self._values[ROWS:]
            self._n = ROWS
        self._ns[self._n] = stamp_ns
        self._values[self._n] = values[0] if len(values) == 1 else np.concatenate(values)
        self._n += 1

    def between(self, low: int, high: int) -> tuple[NDArray[np.int64], Array]:
        """Stamps and values of `low` to `high` ns, both included, in order of time."""
        # Arrival is nearly the order of time: from the last message that may matter on, everything is looked at.
        ns = self._ns[: self._n]
        first = self._n
        while first > 0 and (ns[max(first - 256, 0) : first] >= low - UP_NS).any():
            first = max(first - 256, 0)
        rows = first + np.flatnonzero((ns[first:] >= low) & (ns[first:] <= high))
        rows = rows[np.argsort(ns[rows], kind="stable")]
        return ns[rows], self._values[rows]


class RecentMotion:
    """Feed it odometry and IMU messages as they come; `robot_R_imu` (3, 3) turns IMU samples into the base's axes, None: the IMU is
    not used.
    """

    def __init__(self, robot_R_imu: Array | None = None) -> None:
        self.robot_R_imu = robot_R_imu
        self._wheels, self._imu = _Columns(6), _Columns(6)

    def add(self, message: Odometry | Imu) -> None:
        """One message; older ones than came before are welcome."""
        if isinstance(message, Imu):
            if np.abs(message.gyro).max() < MOST and np.abs(message.accel).max() < MOST:  # False for NaN
                self._imu.add(message.stamp_ns, message.gyro, message.accel)
        elif np.abs(message.twist).max() < MOST:
            self._wheels.add(message.stamp_ns, message.twist)

    def twist(self, start_ns: int, end_ns: int) -> tuple[Array, str]:
        """Mean twist (6,) linear (m/s) and angular (rad/s) in the base's frame between two stamps, and its source.

        Only samples within 50 ms of that time count, so the answer does not depend on where reading began.
        """
        low, high = start_ns - MARGIN_NS, end_ns + MARGIN_NS
        twist = np.zeros(6)
        source = []
        _, wheels = self._wheels.between(low, high)
        if len(wheels):
            twist[:] = wheels.mean(axis=0)
            source.append("wheels")
        if self.robot_R_imu is not None:
            _, imu = self._imu.between(low, high)
            if len(imu):
                twist[3:] = self.robot_R_imu @ imu[:, :3].mean(axis=0)
                source.append("gyro")
        return twist, "+".join(source) or "none"

    def up(self, stamp_ns: int) -> Array | None:
        """The vertical (2,) in the base's frame at a stamp, horizontal metres per metre of height; None where unknown.

        The mean of specific force over a second, each sample turned to the stamp by the gyro, less the change of the wheels'
        velocity over that second (which holds the centripetal part too). Only samples of that second count, so the
        answer does not depend on where reading began.
        """
        if self.robot_R_imu is None:
            return None
        low, high = stamp_ns - UP_NS, stamp_ns + UP_NS // 20
        ns, imu = self._imu.between(low, high)
        if len(ns) < LEAST or not np.isfinite(imu).all():
            return None
        t = (ns - stamp_ns) * 1e-9
        R = self.robot_R_imu
        up, first, last = mean_turned(t, imu[:, :3] @ R.T, imu[:, 3:] @ R.T)
        if np.linalg.norm(up) < IN_G:
            up = up * G
        ns, wheels = self._wheels.between(low - WHEELS_NS, high + WHEELS_NS)
        if len(ns) > 1 and t[-1] > t[0]:
            s = (ns - stamp_ns) * 1e-9
            ends = np.array([[np.interp(at, s, wheels[:, k]) for k in range(3)] for at in (t[0], t[-1])])
            up = up - (last @ ends[1] - first @ ends[0]) / (t[-1] - t[0])
        if not 0.7 * G < np.linalg.norm(up) < 1.3 * G or up[2] < 0.5 * G:
            return None  # upside down, in free fall or broken: nothing to hold on to
        return np.asarray(up[:2] / up[2])
