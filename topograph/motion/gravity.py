"""Which way is up during one scan, from the accelerometer and what the wheels say of acceleration."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from topograph.bags import Imu, Odometry
from topograph.geometry import Array
from topograph.motion.twist import newest

WINDOW_NS = 1_000_000_000
"""Time over which specific force is averaged: long enough for the vibration, short enough for the gyro's bias."""
LEAST = 20
"""Samples below which the mean is no better than the trunks' own lean."""
G = 9.80665
IN_G = 2.0
"""An accelerometer whose mean is below this speaks in g, m/s²."""


def up_at(stamp_ns: int, odometry: Sequence[Odometry], imu: Sequence[Imu], robot_R_imu: Array | None) -> Array | None:
    """The vertical (2,) in the base's frame at a stamp, horizontal metres per metre of height; None where unknown.

    The mean of specific force over a second, each sample turned to the stamp by the gyro, less the change of the wheels'
    velocity over that second (which holds the centripetal part too). Only samples of that second count, so the
    answer does not depend on where reading began.
    """
    if robot_R_imu is None:
        return None
    low, high = stamp_ns - WINDOW_NS, stamp_ns + WINDOW_NS // 20
    samples = [m for m in newest(imu, low) if low <= m.stamp_ns <= high]
    if len(samples) < LEAST:
        return None
    t = np.array([m.stamp_ns - stamp_ns for m in samples]) * 1e-9
    order = np.argsort(t, kind="stable")
    t = t[order]
    gyro = np.array([samples[k].gyro for k in order]) @ robot_R_imu.T
    force = np.array([samples[k].accel for k in order]) @ robot_R_imu.T
    if not (np.isfinite(gyro).all() and np.isfinite(force).all()):
        return None
    angle = np.concatenate([np.zeros((1, 3)), np.cumsum(0.5 * (gyro[1:] + gyro[:-1]) * np.diff(t)[:, None], axis=0)])
    angle -= np.array([np.interp(0.0, t, angle[:, k]) for k in range(3)])
    turn = Rotation.from_rotvec(angle)  # small angles over one second: their order does not matter
    up = np.mean(turn.apply(force), axis=0)
    if np.linalg.norm(up) < IN_G:
        up = up * G
    wheels = [o for o in newest(odometry, low) if low - 100_000_000 <= o.stamp_ns <= high + 100_000_000]
    if len(wheels) > 1 and t[-1] > t[0]:
        s = np.array([o.stamp_ns - stamp_ns for o in wheels]) * 1e-9
        by = np.argsort(s, kind="stable")
        v = np.array([wheels[k].twist[:3] for k in by])
        ends = np.array([[np.interp(at, s[by], v[:, k]) for k in range(3)] for at in (t[0], t[-1])])
        up = up - (turn[-1].apply(ends[1]) - turn[0].apply(ends[0])) / (t[-1] - t[0])
    if not 0.7 * G < np.linalg.norm(up) < 1.3 * G or up[2] < 0.5 * G:
        return None  # upside down, in free fall or broken: nothing to hold on to
    return np.asarray(up[:2] / up[2])
