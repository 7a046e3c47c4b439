"""What an IMU cannot have measured is taken out of its samples, and counted."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from topograph.geometry import Array
from topograph.motion.rates import wheel_rate
from topograph.session import Streams

RANGE = (35.0, 160.0)
"""Full scale of MEMS sensors: 2000 °/s and 16 g, rad/s and m/s²."""
SPIKE = (4.0, 80.0)
"""A sample so far from the median of the five around it is none: no robot turns or brakes so within a hundredth of a second."""
TURNING = 0.1
"""Wheels that turn faster tell the unit of a gyro, rad/s."""
DEGREES = (40.0, 80.0)
"""Ratio of a gyro in degrees to wheels in radians."""
FROZEN = 50
"""So many samples alike to the last bit are not measured."""


def in_radians(streams: Streams) -> tuple[Streams, list[str]]:
    """The streams with the gyro in rad/s, and what to say: some drivers speak in degrees, which the wheels' turns show."""
    if len(streams.imu_ns) < FROZEN or len(streams.odometry_ns) < FROZEN:
        return streams, []
    at, rate = wheel_rate(streams)
    told = np.interp(at, streams.imu_ns, np.linalg.norm(np.nan_to_num(streams.gyro), axis=1))
    turning = np.abs(rate) > TURNING
    if turning.sum() < 20:
        return streams, []
    ratio = float(np.median(told[turning] / np.abs(rate[turning])))
    if not DEGREES[0] < ratio < DEGREES[1]:
        return streams, []
    return replace(streams, gyro=np.radians(streams.gyro)), ["the gyro speaks in degrees per second: converted"]


def without_nonsense(streams: Streams, skipped: Counter[str]) -> Streams:
    """The streams without IMU samples that are out of range, lone spikes, or repeated by a sensor that died."""
    n = len(streams.imu_ns)
    if n < FROZEN:
        return streams
    keep = np.ones(n, bool)
    for name, x, limit, spike in (
        ("rate", streams.gyro, RANGE[0], SPIKE[0]),
        ("force", streams.accel, RANGE[1], SPIKE[1]),
    ):
        beyond = np.abs(x).max(axis=1) > limit
        bounded = np.clip(x, -limit, limit)
        calm = np.asarray(median_filter(bounded, size=(5, 1), mode="nearest"), float)
        lone = ~beyond & (np.abs(bounded - calm).max(axis=1) > spike)
        # Vibration is no spike: where many stand out, none does.
        lone &= lone.mean() < 0.01
        dead = ~beyond & _repeated(x)
        for what, rows in (
            (f"{name} beyond any sensor's range", beyond),
            (f"{name} stands out alone", lone),
            (f"{name} frozen", dead),
        ):
            fresh = rows & keep
            if fresh.any():
                skipped[f"imu: {what}"] += int(fresh.sum())
            keep &= ~rows
    if keep.all():
        return streams
    return replace(streams, imu_ns=streams.imu_ns[keep], gyro=streams.gyro[keep], accel=streams.accel[keep])


def _repeated(x: Array) -> NDArray[np.bool_]:
    """Rows (N,) that are part of a run of FROZEN or more equal rows."""
    change = np.concatenate([[True], (np.diff(x, axis=0) != 0).any(axis=1)])
    group = np.cumsum(change) - 1
    return np.asarray(np.bincount(group)[group] >= FROZEN)
