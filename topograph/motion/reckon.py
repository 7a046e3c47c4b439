"""Dead reckoning: wheels and gyro, integrated; attitude held to gravity by a complementary filter."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from scipy.ndimage import gaussian_filter1d

from topograph.geometry import (
    Array,
    Stamps,
    from_quaternion,
    interpolate,
    inverse,
    planar,
    wrap,
    yaw_of,
)
from topograph.motion.gravity_kernel import gravity_kernel
from topograph.motion.inertial import GRAVITY, Inertial
from topograph.motion.steps import jumps, levelled, quaternion_of, straightened
from topograph.motion.wheels import against_fixes
from topograph.ranges import Positive
from topograph.session import Streams


@dataclass(frozen=True, slots=True)
class MotionConfig:
    """How far dead reckoning is trusted; standard deviations of a step of `d` metres, `dt` seconds and turn `a`.

    Attributes:
        along, across, up: shares of the distance.
        step: of any step, m.
        yaw_gyro, yaw_wheels: share of the turn, by what measured it.
        yaw_rate: rad per √s with a gyro.
        yaw_distance: rad per √m without one.
        tilt_distance: rad per √m, roll and pitch without an IMU.
        tilt_time_s: time constant of the complementary filter that holds roll and pitch to gravity.
    """

    along: Positive = 0.02
    across: Positive = 0.02
    up: Positive = 0.02
    step: Positive = 0.003
    yaw_gyro: Positive = 0.004
    yaw_wheels: Positive = 0.08
    yaw_rate: Positive = 4e-4
    yaw_distance: Positive = 0.006
    tilt_distance: Positive = 0.012
    tilt_time_s: Positive = 4.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Motion:
    """Dead-reckoned poses `odom_T_robot` (M, 4, 4) at `stamps_ns` (M,), rising.

    Attributes:
        distance: (M,) metres driven.
        turned: (M,) radians turned, both ways counted as positive.
        gyro: the turn is the gyro's.
        wheels: the distance is the wheels'.
        doubt: (M,) m, what slips add to the deviation of the steps, summed up; () where there were none.
        broken: (M, 2) m and rad, what steps in which wheels and fixes part add to the deviation, summed up; (0, 2) where there were none.
        breaks: (B, 3) time of each (s since the first stamp), and by how much they part, m and rad.
        wheel_scale: what the wheels were multiplied with, since fixes told so.
        slips: (S, 3) from, to (s since the first stamp) and the robot's speed less the wheels', m/s.
        slips_by_trunks: trunks told of them, not fixes.
        unseen: (M,) rad, what was turned in gaps of the gyro, where the wheels tell it, summed up; () where there were none.
    """

    stamps_ns: Stamps
    odom_T_robot: Array
    distance: Array
    turned: Array
    gyro: bool
    wheels: bool
    doubt: Array = field(default_factory=lambda: np.zeros(0))
    broken: Array = field(default_factory=lambda: np.zeros((0, 2)))
    breaks: Array = field(default_factory=lambda: np.zeros((0, 3)))
    wheel_scale: float = 1.0
    slips: Array = field(default_factory=lambda: np.zeros((0, 3)))
    unseen: Array = field(default_factory=lambda: np.zeros(0))
    slips_by_trunks: bool = False

    def at(self, stamps_ns: Stamps) -> Array:
        """Poses (K, 4, 4) at any stamps; outside the recording the nearest end holds."""
        return interpolate(self.stamps_ns, self.odom_T_robot, stamps_ns)

    def distance_at(self, stamps_ns: Stamps) -> Array:
        """Metres driven (K,) until each stamp."""
        return np.interp(stamps_ns, self.stamps_ns, self.distance)

    def turned_at(self, stamps_ns: Stamps) -> Array:
        """Radians turned (K,) until each stamp."""
        return np.interp(stamps_ns, self.stamps_ns, self.turned)

    def sigma(self, config: MotionConfig, stamps_ns: Stamps) -> Array:
        """Standard deviations (K-1, 6), rotation then translation, of the steps between stamps (K,)."""
        d = np.diff(self.distance_at(stamps_ns))
        a = np.diff(self.turned_at(stamps_ns))
        dt = np.diff(stamps_ns) * 1e-9
        if self.gyro:
            yaw = np.hypot(config.yaw_gyro * a, config.yaw_rate * np.sqrt(dt)) + 2e-4
            tilt = 0.004 + 0.3 * config.tilt_distance * np.sqrt(d)
        else:
            yaw = np.hypot(config.yaw_wheels * a, config.yaw_distance * np.sqrt(d)) + 5e-4
            tilt = config.tilt_distance * np.sqrt(d) + 5e-4
        if len(self.unseen):
            yaw = np.hypot(yaw, config.yaw_wheels * np.diff(np.interp(stamps_ns, self.stamps_ns, self.unseen)))
        along, across, up = (k * d + config.step for k in (config.along, config.across, config.up))
        if not self.wheels:
            along = across = up = 0.5 * dt + 0.05
        if len(self.doubt):
            along = np.hypot(along, np.diff(np.interp(stamps_ns, self.stamps_ns, self.doubt)))
        if len(self.broken):
            apart, turned = (np.diff(np.interp(stamps_ns, self.stamps_ns, b)) for b in self.broken.T)
            along, across, yaw = np.hypot(along, apart), np.hypot(across, apart), np.hypot(yaw, turned)
        return np.stack([tilt, tilt, yaw, along, across, up], axis=1)


def dead_reckon(
    streams: Streams,
    inertial: Inertial | None,
    child_T_robot: Array,
    config: MotionConfig,
    robot_p_antenna: Array | None = None,
) -> Motion | None:
    """Motion of the base from what there is: wheels and IMU, wheels alone, or GNSS (with the gyro's turns, if any).

    Where good fixes contradict the wheels (`motion.wheels`), the fixes' speed stands in. `robot_p_antenna` (3,) m.
    None when nothing tells the distance: neither wheels nor at least ten fixes.
    """
    if len(streams.odometry_ns) < 2:
        return _from_fixes(streams, inertial, config)
    step = _steps(streams, child_T_robot)
    if _stands_still(streams, step):
        return _from_fixes(streams, inertial, config)
    overlap = inertial is not None and _overlap(inertial.stamps_ns, streams.odometry_ns) > 0.8
    gyro = inertial if overlap else None
    motion = _joined(streams, step, gyro, config)
    check = against_fixes(streams, motion.odom_T_robot, np.zeros(3) if robot_p_antenna is None else robot_p_antenna)
    if len(check.breaks):
        summed = np.concatenate([np.zeros((1, 2)), np.cumsum(check.broken, axis=0)])
        motion = replace(motion, broken=summed, breaks=check.breaks)
    if check.scale == 1.0 and not len(check.slips):
        return motion
    step[:, :3, 3] *= check.factor[:, None]
    step[:, 0, 3] += check.advance
    doubt = np.concatenate([[0.0], np.cumsum(check.doubt)])
    return replace(
        _joined(streams, step, gyro, config), doubt=doubt if check.doubt.any() else np.zeros(0), wheel_scale=check.scale,
        slips=check.slips, broken=motion.broken, breaks=motion.breaks,
    )  # fmt: skip


STANDS = (0.5, 5.0)
"""Wheels that never went further while the fixes went so far, m, are dead."""


def _stands_still(streams: Streams, step: Array) -> bool:
    """Wheels that stand while good fixes travel."""
    if len(streams.fix_ns) < 10 or float(np.linalg.norm(step[:, :3, 3], axis=1).sum()) > STANDS[0]:
        return False
    enu = streams.fixes_enu()[:, :2]
    reach = np.percentile(np.linalg.norm(enu - np.median(enu, axis=0), axis=1), 90)
    return bool(reach > STANDS[1])


def _steps(streams: Streams, child_T_robot: Array) -> Array:
    """Motion (O-1, 4, 4) of the base between odometry's messages."""
    odom_T_robot = streams.odom_T_child @ child_T_robot
    dt = np.diff(streams.odometry_ns) * 1e-9
    step = inverse(odom_T_robot[:-1]) @ odom_T_robot[1:]
    return _without_jumps(step, dt)


def _joined(streams: Streams, step: Array, inertial: Inertial | None, config: MotionConfig) -> Motion:
    """The wheels' steps, end to end; along the gyro's heading where there is one."""
    n = len(streams.odometry_ns)
    distance = np.concatenate([[0.0], np.cumsum(np.linalg.norm(step[:, :3, 3], axis=1))])
    if inertial is None:
        T = np.empty((n, 4, 4))
        T[0] = np.eye(4)
        for k in range(n - 1):
            T[k + 1] = T[k] @ step[k]
        turned = np.concatenate([[0.0], np.cumsum(np.abs(yaw_of(step)))])
        return Motion(
            stamps_ns=streams.odometry_ns, odom_T_robot=T, distance=distance, turned=turned, gyro=False, wheels=True
        )
    R_imu = _attitude(inertial, np.interp(inertial.stamps_ns, streams.odometry_ns, _speed(streams, distance)), config)
    imu_ns, R_imu, unseen = _over_gaps(inertial.stamps_ns, R_imu, streams.odometry_ns, yaw_of(step))
    pose = np.tile(np.eye(4), (len(R_imu), 1, 1))
    pose[:, :3, :3] = R_imu
    R = interpolate(imu_ns, pose, streams.odometry_ns)[:, :3, :3]
    middle = interpolate(imu_ns, pose, (streams.odometry_ns[:-1] + streams.odometry_ns[1:]) // 2)[:, :3, :3]
    moves = (middle @ straightened(step)[:, :, None])[..., 0]
    T = np.tile(np.eye(4), (n, 1, 1))
    T[:, :3, :3] = R
    T[1:, :3, 3] = np.cumsum(moves, axis=0)
    turned = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(np.unwrap(yaw_of(T)))))])
    return Motion(
        stamps_ns=streams.odometry_ns,
        odom_T_robot=T,
        distance=distance,
        turned=turned,
        gyro=True,
        wheels=True,
        unseen=unseen,
    )


IMU_GAP_S = 0.2
"""Without a sample of the gyro for longer, the wheels tell the turn."""


def _over_gaps(imu_ns: Stamps, R: Array, odometry_ns: Stamps, turn: Array) -> tuple[Stamps, Array, Array]:
    """Stamps (I,) and attitudes (I, 3, 3) in which the turn over each gap of the IMU is the wheels' (`turn` (O-1,) rad a step), and what
    the wheels turned within gaps, summed up at odometry's stamps, (O,) rad.
    """
    gaps = np.flatnonzero(np.diff(imu_ns) > IMU_GAP_S * 1e9)
    if not len(gaps):
        return imu_ns, R, np.zeros(0)
    unseen = np.zeros(len(odometry_ns))
    wheels = np.concatenate([[0.0], np.cumsum(turn)])
    moved = np.concatenate([[0.0], np.cumsum(np.abs(turn) + 0.01)])  # a step within a gap may hide a little more
    yaw = np.arctan2(R[:, 1, 0], R[:, 0, 0])
    add = np.zeros(len(imu_ns))
    stamps, poses = [imu_ns], []
    for k in gaps.tolist():
        begin, end = imu_ns[k], imu_ns[k + 1]
        inside = odometry_ns[(odometry_ns > begin) & (odometry_ns < end)]
        told = np.interp(np.append(inside, end), odometry_ns, wheels) - np.interp(begin, odometry_ns, wheels)
        stamps.append(inside)
        poses.append(_turned(add[k] + told[:-1]) @ R[k])
        add[k + 1 :] += told[-1] - float(wrap(yaw[k + 1] - yaw[k]))
        a, b = np.interp([begin, end], odometry_ns, moved)
        unseen += np.clip(moved, a, b) - a
    ns, all_R = np.concatenate(stamps), np.concatenate([_turned(add) @ R, *poses])
    order = np.argsort(ns, kind="stable")
    return ns[order], all_R[order], unseen


def _turned(yaw: Array) -> Array:
    """Rotations (K, 3, 3) about the vertical."""
    return np.asarray(planar(0.0, 0.0, yaw)[:, :3, :3])


def _from_fixes(streams: Streams, inertial: Inertial | None, config: MotionConfig) -> Motion | None:
    """Without wheels: the fixes, smoothed, say where the robot was; the gyro, or the course, which way it looked."""
    if len(streams.fix_ns) < 10:
        return None
    enu = gaussian_filter1d(streams.fixes_enu(), 1.5, axis=0, mode="nearest")
    stamps = streams.fix_ns
    step = np.linalg.norm(np.diff(enu[:, :2], axis=0), axis=1)
    distance = np.concatenate([[0.0], np.cumsum(step)])
    ahead = np.gradient(enu[:, :2], axis=0)
    moving = np.linalg.norm(ahead, axis=1) > 0.5 * np.median(step)
    course = np.unwrap(np.interp(distance, distance[moving], np.unwrap(np.arctan2(ahead[moving, 1], ahead[moving, 0]))))
    T = planar(enu[:, 0], enu[:, 1], course)
    T[:, 2, 3] = enu[:, 2]
    gyro = inertial is not None and _overlap(inertial.stamps_ns, stamps) > 0.8
    if gyro and inertial is not None:
        pose = np.tile(np.eye(4), (len(inertial.stamps_ns), 1, 1))
        pose[:, :3, :3] = _attitude(inertial, None, config)
        R = interpolate(inertial.stamps_ns, pose, stamps)
        turn = float(np.angle(np.mean(np.exp(1j * (course - yaw_of(R))[moving]))))
        T[:, :3, :3] = (planar(0.0, 0.0, turn) @ R)[:, :3, :3]
    turned = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(np.unwrap(yaw_of(T)))))])
    return Motion(stamps_ns=stamps, odom_T_robot=T, distance=distance, turned=turned, gyro=gyro, wheels=False)


def _overlap(a: Stamps, b: Stamps) -> float:
    return float(min(a[-1], b[-1]) - max(a[0], b[0])) / max(float(b[-1] - b[0]), 1.0)


def _speed(streams: Streams, distance: Array) -> Array:
    dt = np.gradient(streams.odometry_ns * 1e-9)
    speed = np.gradient(distance) / np.maximum(dt, 1e-6)
    return np.asarray(speed * np.where(streams.twist[:, 0] < 0, -1.0, 1.0))


def _without_jumps(step: Array, dt: Array) -> Array:
    """Steps with resets of the odometry taken out."""
    step[jumps(step, dt)] = np.eye(4)
    return step


def _attitude(inertial: Inertial, speed: Array | None, config: MotionConfig) -> Array:
    """Rotations odom_R_robot (I, 3, 3): gyro integrated, roll and pitch drawn to gravity."""
    dt = np.diff(inertial.stamps_ns) * 1e-9
    rate = inertial.gyro - inertial.gyro_bias
    force = inertial.accel.copy()
    if speed is not None:  # take out what the drive itself explains
        seconds = inertial.stamps_ns * 1e-9
        force[:, 0] -= np.gradient(speed, seconds - seconds[0])
        force[:, 1] -= speed * rate[:, 2]
    first = np.mean(force[: max(5, int(1.0 / max(float(np.median(dt)), 1e-3)))], axis=0)
    q = gravity_kernel(
        quaternion_of(*levelled(first)), rate, force, dt.clip(0, 0.2), np.full(len(dt), config.tilt_time_s), GRAVITY
    )
    return from_quaternion(np.zeros((len(q), 3)), q)[:, :3, :3]
