"""Velocity of the robot while one sweep was taken, for deskewing."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import numpy as np

from topograph.bags import Imu, Odometry
from topograph.geometry import Array


def twist_during(
    start_ns: int, end_ns: int, odometry: Sequence[Odometry], imu: Sequence[Imu], robot_R_imu: Array | None
) -> tuple[Array, str]:
    """Mean twist (6,) linear (m/s) and angular (rad/s) in the base's frame, and its source.

    Only samples within 50 ms of the sweep count, so the answer does not depend on where reading began.
    `robot_R_imu` (3, 3) turns rates into the base's axes; None leaves the gyro out.
    """
    margin = 50_000_000
    low, high = start_ns - margin, end_ns + margin
    twist = np.zeros(6)
    wheels = [o.twist for o in newest(odometry, low) if low <= o.stamp_ns <= high]
    rates = [i.gyro for i in newest(imu, low) if low <= i.stamp_ns <= high] if robot_R_imu is not None else []
    source = []
    if wheels:
        twist[:] = np.mean(wheels, axis=0)
        source.append("wheels")
    if rates and robot_R_imu is not None:
        twist[3:] = robot_R_imu @ np.mean(rates, axis=0)
        source.append("gyro")
    return twist, "+".join(source) or "none"


_P = TypeVar("_P", Odometry, Imu)


def newest(messages: Sequence[_P], low: int) -> list[_P]:
    """The last messages in time order backwards, back to the first that is older than `low` by a second."""
    out: list[_P] = []
    for m in reversed(messages):
        if m.stamp_ns < low - 1_000_000_000:
            break
        out.append(m)
    return out
