"""The IMU in the robot's frame: mounting, noise, bias at rest."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d
from scipy.spatial.transform import Rotation

from topograph.geometry import Array, Stamps, se3, yaw_of
from topograph.motion.rates import ALIKE, Agreement, compare, outside_rate, wheel_rate
from topograph.session import Streams

GRAVITY = 9.80665


@dataclass(frozen=True, slots=True, kw_only=True)
class Inertial:
    """Samples (I, 3) turned into the base's axes, and what they say of themselves.

    Attributes:
        robot_T_imu: (4, 4); the lever arm is its translation.
        gyro_bias: (3,) mean rate at rest, rad/s.
        gyro_density, accel_density: white noise, rad/s/√Hz and m/s²/√Hz, measured from the samples.
    """

    stamps_ns: Stamps
    gyro: Array
    accel: Array
    robot_T_imu: Array
    gyro_bias: Array
    gyro_density: float
    accel_density: float


UPSIDE = 0.6
"""Gravity further from the base's vertical than this, rad, is not a slope but a wrong mounting."""
SCALE, SCALES, TOLD = 0.04, (0.75, 1.33), 0.98
"""A gyro's scale that is off by more is corrected, within these, where its rates and the heading's correlate so well (clean: within
0.01 of 1, correlation from 0.994 on)."""
OUTSIDE = (0.5, 1.7)
"""Slope of a sound gyro on heading or course, whose rates are smoothed."""
LATE = 0.15
"""Clocks of gyro and wheels that differ by more are said and set right, s."""


def align_imu(streams: Streams, robot_T_imu: Array | None) -> tuple[Inertial | None, Streams, list[str]]:
    """The IMU's stream in the robot's axes (None where it cannot be used), the streams with clocks set right, and what to say.

    With no mounting given, the tilt is taken from the mean specific force and the turn about the vertical from the wheels'
    acceleration (forward: dv/dt, sideways: v·ω), where the wheels say enough. An IMU that contradicts gravity, or both the
    wheels and the heading, is left out: a wrong one costs more than none.
    """
    if len(streams.imu_ns) < 20:
        return None, streams, []
    notes: list[str] = []
    if robot_T_imu is None:
        R, note = _find_mounting(streams)
        robot_T_imu = se3(R, np.zeros(3))
        notes.append(note)
    R = robot_T_imu[:3, :3]
    gyro, accel = streams.gyro @ R.T, streams.accel @ R.T
    size = float(np.median(np.linalg.norm(accel, axis=1)))
    if 0.8 < size < 1.2:  # some drivers report g
        accel = accel * GRAVITY
        notes.append("IMU: specific force was in g")
    elif not 8.5 < size < 11.5:
        return (
            None,
            streams,
            [f"the IMU's specific force is {size:.2f} m/s² at the median, not gravity: the IMU is left out"],
        )
    mean = np.median(accel, axis=0)
    tilt = float(np.arccos(np.clip(mean[2] / np.linalg.norm(mean), -1, 1)))
    if tilt > UPSIDE:
        return (
            None,
            streams,
            [
                f"gravity is {np.degrees(tilt):.0f}° from where the IMU's mounting puts it: the IMU is left out (mend its transform, or its axes: z is up)"
            ],
        )
    outside = outside_rate(streams)
    by_outside = None if outside is None else compare(streams.imu_ns, gyro[:, 2], *outside)
    by = _gyro_scale(streams, by_outside)
    if by_outside is not None and by != 1.0:
        notes.append(f"the gyro turns by {by:.2f} of what the heading receiver does: corrected (calibrate it)")
        streams = replace(streams, gyro=streams.gyro / by)
        gyro = gyro / by
        by_outside = replace(by_outside, slope=by_outside.slope / by)
    streams, said, usable = _against_wheels(streams, gyro, by_outside)
    notes += said
    if not usable:
        return None, streams, notes
    dt = float(np.median(np.diff(streams.imu_ns))) * 1e-9
    bias = _bias(streams, gyro, dt)
    root = np.sqrt(dt)
    inertial = Inertial(
        stamps_ns=streams.imu_ns, gyro=gyro, accel=accel, robot_T_imu=robot_T_imu, gyro_bias=bias,
        gyro_density=max(_white(gyro) * root, 1e-4), accel_density=max(_white(accel) * root, 2e-3),
    )  # fmt: skip
    return inertial, streams, notes


def _gyro_scale(streams: Streams, found: Agreement | None) -> float:
    """What the gyro overstates turns by, where a heading receiver tells it surely; else 1. `found`: gyro against outside rates."""
    if found is None or len(streams.heading_ns) < 100:
        return 1.0
    if found.correlation < TOLD or not SCALES[0] < found.slope < SCALES[1] or abs(found.lag) > LATE:
        return 1.0
    return found.slope if abs(found.slope - 1.0) > SCALE else 1.0


def _against_wheels(streams: Streams, gyro: Array, by_outside: Agreement | None) -> tuple[Streams, list[str], bool]:
    """Streams with gyro's or wheels' clock set right, what to say, and whether the gyro can be used.

    Which of the two is wrong is for a third to say: the heading, or the course of good fixes. Without one, clocks stay.
    """
    if len(streams.odometry_ns) < 50:
        return streams, [], True
    by_wheels = compare(streams.imu_ns, gyro[:, 2], *wheel_rate(streams))
    if by_wheels is None:
        return streams, [], True
    if by_outside is not None and by_outside.correlation > ALIKE and not OUTSIDE[0] < by_outside.slope < OUTSIDE[1]:
        return streams, [
            f"the gyro turns by {by_outside.slope:.2f} of what the heading does: the IMU is left out (check its units)"
        ], False  # fmt: skip
    if by_wheels.right:
        if abs(by_wheels.lag) < LATE:
            return streams, [], True
        if by_outside is None or not by_outside.right:
            late = f"gyro and wheels are {abs(by_wheels.lag):.2f} s apart: nobody says which clock is wrong; synchronise them"
            return streams, [late], True
        if abs(by_outside.lag) < 0.5 * abs(by_wheels.lag):
            moved = replace(streams, odometry_ns=streams.odometry_ns + int(1e9 * by_wheels.lag))
            return moved, [_late("wheels", -by_wheels.lag, "gyro and the heading")], True
        if abs(by_outside.lag - by_wheels.lag) < 0.5 * abs(by_wheels.lag):
            moved = replace(streams, imu_ns=streams.imu_ns - int(1e9 * by_wheels.lag))
            return moved, [_late("IMU", by_wheels.lag, "wheels and the heading")], True
        return streams, ["the clocks of gyro, wheels and heading are all apart: synchronise them"], True
    if by_outside is not None and by_outside.right:
        return streams, [], True  # it is the wheels that turn otherwise
    return streams, [
        f"gyro and wheels tell of different turns (correlation {by_wheels.correlation:.2f}, slope {by_wheels.slope:.2f}): the IMU is left out "
        "(check its mounting, its axes and its units)"
    ], False  # fmt: skip


def _late(what: str, lag: float, other: str) -> str:
    word = "late" if lag > 0 else "early"
    return f"the {what} clock is {abs(lag):.2f} s {word} against the {other}: set right (synchronise the clocks)"


def mount_turn(streams: Streams, robot_T_imu: Array) -> tuple[float, float]:
    """Turn about the vertical by which the IMU's accelerations want its mounting otherwise, rad, and its standard deviation."""
    R = robot_T_imu[:3, :3]
    return _turn_from_wheels(streams, streams.accel @ R.T, streams.gyro @ R.T)


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
        return _with_turn(streams, np.eye(3), "IMU frame unknown: taken as level")
    axis = np.cross(up, [0, 0, 1])
    n = float(np.linalg.norm(axis))
    axis = axis / n if n > 1e-9 else np.array([1.0, 0.0, 0.0])
    R = Rotation.from_rotvec(axis * tilt).as_matrix()
    return _with_turn(streams, R, f"IMU frame unknown: tilted by {np.degrees(tilt):.0f}° from gravity")


def _with_turn(streams: Streams, R: Array, note: str) -> tuple[NDArray[np.float64], str]:
    """A mounting (3, 3) turned about the vertical by the quarter that the wheels' accelerations tell, where they do."""
    turn, sigma = _turn_from_wheels(streams, streams.accel @ R.T, streams.gyro @ R.T)
    quarter = np.round(turn / (np.pi / 2)) * (np.pi / 2)
    if sigma > 0.35 or abs(turn - quarter) > 0.6:
        return R, f"{note}; its turn about the vertical could not be found: give it with --extrinsic"
    return Rotation.from_euler(
        "z", quarter
    ).as_matrix() @ R, f"{note}, turned by {np.degrees(quarter):.0f}° from the wheels"


def _turn_from_wheels(streams: Streams, accel: Array, gyro: Array) -> tuple[float, float]:
    """Turn (rad) that makes horizontal specific force agree with the wheels, and its standard deviation; (0, inf) unknown.

    Least squares over turn, slope of the ground and biases: on a slope gravity's share turns with the heading.
    """
    unknown = (0.0, float("inf"))
    if len(streams.odometry_ns) < 50:
        return unknown
    t = streams.odometry_ns[:: max(1, round(1e8 / max(float(np.median(np.diff(streams.odometry_ns))), 1.0)))]
    if len(t) < 50:
        return unknown
    s = float(np.median(np.diff(streams.imu_ns)))
    n = max(1, int(5e8 / max(s, 1.0)))
    ax, ay = (np.interp(t, streams.imu_ns, uniform_filter1d(accel[:, k], n)) for k in (0, 1))
    w = np.interp(t, streams.imu_ns, uniform_filter1d(gyro[:, 2], n))
    v = uniform_filter1d(np.interp(t, streams.odometry_ns, streams.twist[:, 0]), 5)
    yaw = np.interp(t, streams.odometry_ns, np.unwrap(yaw_of(streams.odom_T_child)))
    c, d, one, none = np.cos(yaw), np.sin(yaw), np.ones(len(t)), np.zeros(len(t))
    A = np.concatenate([np.stack([ax, -ay, -c, -d, -one, none], axis=1), np.stack([ay, ax, d, -c, none, -one], axis=1)])
    b = np.concatenate([np.gradient(v, (t - t[0]) * 1e-9), v * w])
    x = np.linalg.lstsq(A, b, rcond=None)[0]
    size = float(np.hypot(x[0], x[1]))
    if size < 0.05:
        return unknown
    r = b - A @ x
    alike = 2 * n * s / 1e8  # samples are averages, so neighbours are alike
    cov = np.linalg.pinv(A.T @ A) * float(r @ r) / len(b) * max(alike, 1.0)
    return float(np.arctan2(x[1], x[0])), float(np.sqrt(max(cov[0, 0], cov[1, 1]))) / size
