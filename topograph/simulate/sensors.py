"""Wheel odometry, IMU, GNSS and heading of a drive, with the faults that field data have."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from topograph.geometry import Array, Stamps, from_xyz_rpy, interpolate, planar, se3, yaw_of
from topograph.simulate.config import SensorConfig
from topograph.simulate.drive import STEP_S, Drive

GRAVITY = 9.80665

MOUNTS: dict[str, Array] = {
    "velodyne": from_xyz_rpy(0.22, 0.0, 0.84, 0.012, -0.009, 0.02),
    "imu_link": from_xyz_rpy(0.05, -0.08, 0.35, 0.0, 0.0, np.pi / 2),
    "gnss": from_xyz_rpy(-0.32, 0.24, 1.15, 0.0, 0.0, 0.0),
    "gnss_baseline": from_xyz_rpy(-0.32, 0.24, 1.15, 0.0, 0.0, -np.pi / 2),
}
"""base_T_sensor of each sensor."""


@dataclass(frozen=True, slots=True)
class Wheels:
    """odom_T_robot (K, 4, 4) and twist (K, 6) linear, angular."""

    stamps_ns: Stamps
    odom_T_robot: Array
    twist: Array


@dataclass(frozen=True, slots=True)
class Fixes:
    """Antenna positions (K, 3) in the world frame as the receiver reports them, covariance (K, 3, 3), status (K,)."""

    stamps_ns: Stamps
    world_p_antenna: Array
    cov: Array
    status: NDArray[np.int64]


def _every(drive: Drive, hz: float) -> NDArray[np.int64]:
    return np.arange(0, len(drive.stamps_ns), max(1, round(1.0 / (hz * STEP_S))))


def wheels(drive: Drive, config: SensorConfig, rng: np.random.Generator) -> Wheels:
    """Skid-steer odometry: scale errors, noise, slip events; integrated in the plane as a driver does."""
    T = drive.world_T_robot
    i = _every(drive, config.wheel_hz)
    step = np.linalg.inv(T[i[:-1]]) @ T[i[1:]]
    dt = 1.0 / config.wheel_hz
    scale = 1 + rng.normal(0, config.wheel_scale)
    yaw_scale = 1 + rng.normal(0, config.yaw_scale)
    forward = scale * step[:, 0, 3]
    turn = yaw_scale * yaw_of(step)
    moving = np.abs(forward) > 1e-4
    forward = forward + rng.normal(0, 0.02, len(forward)) * np.abs(forward) + rng.normal(0, 2e-4, len(forward)) * moving
    turn = turn + rng.normal(0, 8e-4, len(turn)) * moving
    for start in np.flatnonzero(rng.random(len(turn)) < config.slip / 60 * dt):
        n = int(rng.uniform(0.3, 1.0) / dt)
        forward[start : start + n] *= rng.uniform(1.05, 1.35)
        turn[start : start + n] += rng.normal(0, 0.03) * dt * moving[start : start + n]
    pose = np.zeros((len(i), 3))
    for k in range(len(forward)):
        x, y, a = pose[k]
        pose[k + 1] = (
            x + forward[k] * np.cos(a + turn[k] / 2),
            y + forward[k] * np.sin(a + turn[k] / 2),
            a + turn[k],
        )
    twist = np.zeros((len(i), 6))
    twist[1:, 0], twist[1:, 5] = forward / dt, turn / dt
    return Wheels(drive.stamps_ns[i], planar(*pose.T), twist)


def imu(drive: Drive, config: SensorConfig, rng: np.random.Generator) -> tuple[Stamps, Array, Array]:
    """Stamps (K,), angular velocity (K, 3) and specific force (K, 3) in `imu_link`."""
    T = drive.world_T_robot @ MOUNTS["imu_link"]
    R = T[:, :3, :3]
    gyro = np.zeros((len(T), 3))
    gyro[:-1] = Rotation.from_matrix(np.swapaxes(R[:-1], 1, 2) @ R[1:]).as_rotvec() / STEP_S
    p = gaussian_filter1d(T[:, :3, 3], 2, axis=0, mode="nearest")
    accel_world = np.gradient(np.gradient(p, STEP_S, axis=0), STEP_S, axis=0) + [0, 0, GRAVITY]
    accel = (np.swapaxes(R, 1, 2) @ accel_world[:, :, None])[..., 0]
    i = _every(drive, config.imu_hz)
    moving = np.concatenate([[0.0], np.diff(drive.distance)]) > 1e-4
    root = np.sqrt(config.imu_hz)
    n = len(i)

    def walk(sigma: float) -> Array:  # in-run instability: a slow random walk
        return np.cumsum(rng.normal(0, sigma / np.sqrt(100 * config.imu_hz), (n, 3)), axis=0)

    gyro_i = (
        gyro[i] + rng.normal(0, config.gyro_bias, 3) + walk(5e-5) + rng.normal(0, config.gyro_density * root, (n, 3))
    )
    accel_i = (
        accel[i]
        + rng.normal(0, config.accel_bias, 3)
        + walk(1.5e-4)
        + rng.normal(0, config.accel_density * root, (n, 3))
    )
    shake = moving[i][:, None]
    gyro_i += shake * rng.normal(0, 0.02 * config.vibration, (n, 3))
    accel_i += shake * rng.normal(0, config.vibration, (n, 3))
    return drive.stamps_ns[i], gyro_i, accel_i


def _drift(n: int, dt: float, tau: float, sigma: Array, rng: np.random.Generator) -> Array:
    """First-order Gauss-Markov noise (n, len(sigma))."""
    phi = np.exp(-dt / tau)
    out = np.zeros((n, len(sigma)))
    out[0] = rng.normal(0, sigma)
    steps = rng.normal(size=(n, len(sigma))) * sigma * np.sqrt(1 - phi**2)
    for k in range(1, n):
        out[k] = phi * out[k - 1] + steps[k]
    return out


def gnss(drive: Drive, config: SensorConfig, rng: np.random.Generator) -> Fixes:
    """RTK, float, or degraded: float stretches, multipath with optimistic covariance, outages of 60 s."""
    i = _every(drive, config.gnss_hz)
    n, dt = len(i), 1.0 / config.gnss_hz
    antenna = (drive.world_T_robot[i] @ MOUNTS["gnss"])[:, :3, 3]
    white = np.array([0.008, 0.008, 0.015])
    error = rng.normal(0, white, (n, 3)) + _drift(n, dt, 120.0, np.array([0.005, 0.005, 0.01]), rng)
    sigma = np.tile([0.01, 0.01, 0.02], (n, 1))
    status = np.full(n, 2)
    keep = np.ones(n, bool)
    floating = np.zeros(n, bool)
    t = np.arange(n) * dt
    if config.gnss == "float":
        floating[:] = True
    if config.gnss == "degraded":
        at = rng.uniform(0, 30)
        while at < t[-1]:
            kind, length = rng.integers(3), rng.uniform(15, 40)
            span = (t >= at) & (t < at + length)
            if kind == 0:
                floating |= span
            elif kind == 1:  # a reflection: metres off, and the receiver does not know
                error[span] += rng.normal(0, [0.8, 0.8, 1.5]) + _drift(int(span.sum()), dt, 8.0, np.full(3, 0.3), rng)
            else:
                length = 60.0
                keep &= ~((t >= at) & (t < at + length))
            at += length + rng.uniform(15, 45)
        keep |= t < 5.0
    error[floating] += _drift(n, dt, 40.0, np.array([0.25, 0.25, 0.5]), rng)[floating]
    sigma[floating] = [0.3, 0.3, 0.6]
    status[floating] = 1
    cov = np.zeros((n, 3, 3))
    cov[:, [0, 1, 2], [0, 1, 2]] = sigma**2
    if config.gnss == "none":
        keep[:] = False
    return Fixes(drive.stamps_ns[i][keep], (antenna + error)[keep], cov[keep], status[keep])


def heading(drive: Drive, config: SensorConfig, fixes: Fixes, rng: np.random.Generator) -> tuple[Stamps, Array]:
    """Stamps (K,) and heading (K,) in rad of the baseline between the antennas, at the fixes' stamps."""
    T = drive.at(fixes.stamps_ns) @ MOUNTS["gnss_baseline"] if len(fixes.stamps_ns) else np.zeros((0, 4, 4))
    sigma = np.where(fixes.status == 2, config.heading_sigma, 5 * config.heading_sigma)
    yaw = yaw_of(T) + rng.normal(size=len(T)) * sigma
    return fixes.stamps_ns, np.asarray(yaw)


def columns(drive: Drive, config: SensorConfig, start_ns: int) -> Array:
    """world_T_lidar (columns, 4, 4) at each firing of the sweep that begins at `start_ns`."""
    span_ns = int(1e9 * config.sweep_s)
    knots = start_ns + np.linspace(0, span_ns, 11).astype(np.int64)
    fine = start_ns + (np.arange(config.columns) * (span_ns / config.columns)).astype(np.int64)
    return interpolate(knots, drive.at(knots) @ mounting(config), fine)


def mounting(config: SensorConfig) -> Array:
    """base_T_lidar (4, 4)."""
    return MOUNTS["velodyne"] if config.mount is None else from_xyz_rpy(*config.mount)


def level(yaw: Array) -> Array:
    """Poses (K, 4, 4) that only turn."""
    return se3(planar(0, 0, yaw)[..., :3, :3], np.zeros((len(yaw), 3)))
