"""The IMU in the robot's frame: mounting, noise, bias at rest."""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d
from scipy.spatial.transform import Rotation

from topograph.geometry import Array, Stamps, se3
from topograph.motion.streams import Streams

log = logging.getLogger(__name__)

GRAVITY = 9.80665


@dataclass(frozen=True, slots=True)
class Inertial:
    """Samples (I, 3) turned into the base's axes, and what they say of themselves.

    Attributes:
        robot_T_imu: (4, 4); the lever arm is its translation.
        gyro_bias: (3,) mean rate at rest, rad/s.
        gyro_density, accel_density: white noise, rad/s/√Hz and m/s²/√Hz, measured from the samples.
        note: how the mounting was found, "" when it was given.
    """

    stamps_ns: Stamps
    gyro: Array
    accel: Array
    robot_T_imu: Array
    gyro_bias: Array
    gyro_density: float
    accel_density: float
    note: str


def align_imu(streams: Streams, robot_T_imu: Array | None) -> Inertial | None:
    """The IMU's stream in the robot's axes; None when there are too few samples to use.

    With no mounting given, the tilt is taken from the mean specific force and the turn about the vertical from
    the wheels' acceleration (forward: dv/dt, sideways: v·ω), where the wheels say enough.
    """
    if len(streams.imu_ns) < 20:
        return None
    note = ""
    if robot_T_imu is None:
        R, note = _find_mounting(streams)
        robot_T_imu = se3(R, np.zeros(3))
    R = robot_T_imu[:3, :3]
    gyro, accel = streams.gyro @ R.T, streams.accel @ R.T
    size = float(np.median(np.linalg.norm(accel, axis=1)))
    if 0.8 < size < 1.2:  # some drivers report g
        accel = accel * GRAVITY
        note += "; specific force was in g"
    elif not 8.5 < size < 11.5:
        log.warning("the IMU's specific force is %.2f m/s² at the median, not gravity: it is left out", size)
        return None
    dt = float(np.median(np.diff(streams.imu_ns))) * 1e-9
    bias = _bias(streams, gyro, dt)
    root = np.sqrt(dt)
    return Inertial(
        streams.imu_ns, gyro, accel, robot_T_imu, bias,
        max(_white(gyro) * root, 1e-4), max(_white(accel) * root, 2e-3), note.strip("; "),
    )  # fmt: skip


def _white(x: Array) -> float:
    """Standard deviation of the fast part of a signal (N, 3), m.a.d. of its second differences."""
    d = x[2:] - 2 * x[1:-1] + x[:-2]
    d = d[np.abs(d).max(axis=1) > 0]
    if len(d) < 10:
        return 0.0
    return float(np.sqrt(np.mean(np.square(d.clip(*np.percentile(d, [1, 99])))) / 6.0))


def _bias(streams: Streams, gyro: Array, dt: float) -> Array:
    """Mean rate while the wheels stand still, or where the gyro is quietest, or zero."""
    if len(streams.odometry_ns) > 1:
        speed = np.abs(streams.twist[:, 0]) + np.abs(streams.twist[:, 5])
        if speed.max() > 0:
            moving = np.interp(streams.imu_ns, streams.odometry_ns, speed) > 1e-3
            still = uniform_filter1d(moving.astype(float), max(3, int(0.6 / dt))) == 0
            if still.sum() * dt > 1.0:
                return np.asarray(gyro[still].mean(0))
    n = max(3, int(1.0 / dt))
    spread = uniform_filter1d(np.sum((gyro - uniform_filter1d(gyro, n, axis=0)) ** 2, axis=1), n)
    quiet = spread < 0.02 * np.median(spread)
    if quiet.sum() * dt > 1.0 and np.linalg.norm(gyro[quiet].mean(0)) < 0.03:
        return np.asarray(gyro[quiet].mean(0))
    return np.zeros(3)


def _find_mounting(streams: Streams) -> tuple[NDArray[np.float64], str]:
    mean = np.median(streams.accel, axis=0)
    up = mean / np.linalg.norm(mean)
    tilt = float(np.arccos(np.clip(up[2], -1, 1)))
    if tilt < 0.17:
        return np.eye(3), "IMU frame unknown: taken as parallel to the base"
    axis = np.cross(up, [0, 0, 1])
    n = float(np.linalg.norm(axis))
    axis = axis / n if n > 1e-9 else np.array([1.0, 0.0, 0.0])
    R = Rotation.from_rotvec(axis * tilt).as_matrix()
    turn, trust = _turn_from_wheels(streams, streams.accel @ R.T, streams.gyro @ R.T)
    note = f"IMU frame unknown: tilted by {np.degrees(tilt):.0f}° from gravity"
    if trust > 0.15:
        R = Rotation.from_euler("z", turn).as_matrix() @ R
        return R, f"{note}, turned by {np.degrees(turn):.0f}° from the wheels (correlation {trust:.2f})"
    return R, f"{note}; its turn about the vertical could not be found"


def _turn_from_wheels(streams: Streams, accel: Array, gyro: Array) -> tuple[float, float]:
    """Turn (rad) that makes horizontal specific force agree with the wheels, and the correlation reached."""
    if len(streams.odometry_ns) < 50:
        return 0.0, 0.0
    t = np.arange(streams.odometry_ns[0], streams.odometry_ns[-1], 100_000_000)
    if len(t) < 50:
        return 0.0, 0.0
    s = (streams.imu_ns[-1] - streams.imu_ns[0]) / max(len(streams.imu_ns) - 1, 1)
    n = max(1, int(5e8 / s))
    ax, ay = (np.interp(t, streams.imu_ns, uniform_filter1d(accel[:, k], n)) for k in (0, 1))
    w = np.interp(t, streams.imu_ns, uniform_filter1d(gyro[:, 2], n))
    v = uniform_filter1d(np.interp(t, streams.odometry_ns, streams.twist[:, 0]), 5)
    forward, sideways = np.gradient(v, 0.1), v * w
    ax, ay = ax - ax.mean(), ay - ay.mean()
    # Rotating (ax, ay) by `turn` should give (forward, sideways).
    c, d = np.sum(ax * forward + ay * sideways), np.sum(ax * sideways - ay * forward)
    size = np.sqrt(np.sum(ax**2 + ay**2) * np.sum(forward**2 + sideways**2))
    return float(np.arctan2(d, c)), float(np.hypot(c, d) / max(size, 1e-12))
