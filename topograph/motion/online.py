"""Dead reckoning message by message: what a live robot knows of its motion between two scans."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from topograph.bags import Imu, Odometry
from topograph.geometry import Array, exp, from_quaternion, inverse, log
from topograph.motion.inertial import GRAVITY
from topograph.motion.reckon import _filter, _quaternion_of


@dataclass(frozen=True, slots=True)
class Leg:
    """Motion of the base between two stamps.

    Attributes:
        step: (3,) x, y (m) and yaw (rad) in the levelled frame of the first pose; `up` m.
        roll, pitch: of the base at the second stamp, rad; zero without an IMU.
        distance, turned: m, rad, as driven.
        seconds: between the stamps.
        gyro, level: the turn is the gyro's; roll and pitch are held to gravity.
        wheels: odometry came in at all.
    """

    step: Array
    up: float
    roll: float
    pitch: float
    distance: float
    turned: float
    seconds: float
    gyro: bool
    level: bool
    wheels: bool


class Reckoner:
    """Feed it odometry and IMU messages as they come; `advance` gives the motion up to a stamp.

    `child_T_robot` (4, 4) takes odometry's child frame to the base; `robot_R_imu` (3, 3) turns IMU samples into the base's
    axes, None: the tilt is taken from gravity at the start, which is enough for turns.
    """

    def __init__(
        self, child_T_robot: Array | None = None, robot_R_imu: Array | None = None, tilt_time_s: float = 4.0
    ) -> None:
        self.child_T_robot = np.eye(4) if child_T_robot is None else child_T_robot
        self.robot_R_imu = robot_R_imu
        self.tilt_time_s = tilt_time_s
        self._wheels: list[tuple[int, Array]] = []
        self._imu: list[tuple[int, Array, Array]] = []
        self._q: Array | None = None
        self._q_ns = 0
        self._R = np.eye(3)
        self._yaw = 0.0
        self._last: tuple[int, Array] | None = None
        self._speed = 0.0
        self._bias = np.zeros(3)
        self._still = 0
        self._at_ns: int | None = None
        self._scale = 1.0

    def add(self, message: Odometry | Imu) -> None:
        """One message; stamps rise within each kind."""
        if isinstance(message, Imu):
            if np.isfinite(message.gyro).all() and np.isfinite(message.accel).all():
                self._imu.append((message.stamp_ns, message.gyro, message.accel))
        elif np.isfinite(message.odom_T_child).all():
            pose = from_quaternion(message.odom_T_child[:3], message.odom_T_child[3:])
            self._wheels.append((message.stamp_ns, pose @ self.child_T_robot))

    def advance(self, stamp_ns: int) -> Leg:
        """Motion since the last call, with all messages up to `stamp_ns`."""
        first = self._at_ns is None
        seconds = 0.0 if first or self._at_ns is None else (stamp_ns - self._at_ns) * 1e-9
        self._at_ns = stamp_ns
        yaw_before = self._yaw
        gyro = self._turn(stamp_ns)
        steps = [w for w in self._wheels if w[0] <= stamp_ns]
        ahead = [w for w in self._wheels if w[0] > stamp_ns]
        poses = list(steps)
        if ahead and (poses or self._last is not None):  # part of the step that reaches beyond the stamp
            before = poses[-1] if poses else self._last
            assert before is not None
            share = (stamp_ns - before[0]) / max(ahead[0][0] - before[0], 1)
            poses.append((stamp_ns, before[1] @ exp(share * log(inverse(before[1]) @ ahead[0][1]))))
        self._wheels = ahead
        planar, up, distance, turned = np.zeros(3), 0.0, 0.0, 0.0
        yaw_rate = 0.0 if seconds <= 0 else (self._yaw - yaw_before) / max(seconds, 1e-3)
        heading = 0.0
        for ns, pose in poses:
            if self._last is None:
                self._last = (ns, pose)
                continue
            dt = (ns - self._last[0]) * 1e-9
            move = inverse(self._last[1]) @ pose
            self._last = (ns, pose)
            length = float(np.linalg.norm(move[:3, 3]))
            if length > 15.0 * max(dt, 0.02) + 0.5:
                continue  # a reset of the odometry
            turn = yaw_rate * dt if gyro else float(np.arctan2(move[1, 0], move[0, 0]))
            wheel_turn = float(np.arctan2(move[1, 0], move[0, 0]))
            local = exp(0.5 * log(move))[:3, :3].T @ move[:3, 3]
            world = self._R @ local if gyro else local
            flat = world[:2] if gyro else local[:2]
            if gyro:  # into the levelled frame of the robot's present heading
                c, s = np.cos(self._yaw), np.sin(self._yaw)
                flat = np.array([c * world[0] + s * world[1], -s * world[0] + c * world[1]])
            up += float(world[2])
            middle = heading + 0.5 * turn
            c, s = np.cos(middle), np.sin(middle)
            planar[:2] += [c * flat[0] - s * flat[1], s * flat[0] + c * flat[1]]
            heading += turn
            distance += length
            turned += abs(turn)
            if dt > 1e-4:
                self._speed += 0.5 * (np.sign(move[0, 3]) * length / dt - self._speed)
                still = length / dt < 0.005 and abs(wheel_turn) / dt < 0.003
                self._still = self._still + 1 if still else 0
        planar[2] = self._yaw - yaw_before if gyro else heading
        if gyro:
            turned = max(turned, abs(float(planar[2])))
        roll, pitch = 0.0, 0.0
        if self._q is not None:
            roll = float(np.arctan2(self._R[2, 1], self._R[2, 2]))
            pitch = float(np.arcsin(np.clip(-self._R[2, 0], -1, 1)))
        return Leg(
            planar, up, roll, pitch, distance, turned, seconds, gyro, self._q is not None, self._last is not None
        )  # fmt: skip

    def _turn(self, stamp_ns: int) -> bool:
        """Bring the attitude to a stamp; whether the gyro covers it."""
        ready = [m for m in self._imu if m[0] <= stamp_ns]
        self._imu = [m for m in self._imu if m[0] > stamp_ns]
        if not ready:
            return self._q is not None and stamp_ns - self._q_ns < 200_000_000
        if self._q is None:
            if len(ready) < 3:
                self._imu = ready + self._imu
                return False
            mean = np.mean([a for _, _, a in ready], axis=0)
            size = float(np.linalg.norm(mean))
            self._scale = GRAVITY if 0.8 < size < 1.2 else 1.0  # some drivers report g
            if self.robot_R_imu is None:
                self.robot_R_imu = _upright(mean / max(size, 1e-6))
            force = self.robot_R_imu @ mean
            self._q = _quaternion_of(
                float(np.arctan2(force[1], force[2])), float(np.arctan2(-force[0], np.hypot(force[1], force[2])))
            )
            self._q_ns = ready[0][0]
        R = self.robot_R_imu
        assert R is not None
        rate = np.array([g for _, g, _ in ready]) @ R.T
        force = np.array([a for _, _, a in ready]) @ R.T * self._scale
        if self._still >= 5:  # the wheels stand still: what the gyro says is bias
            gain = min(1.0, 0.05 * len(rate) / 10)
            self._bias += gain * (rate.mean(0) - self._bias)
        rate = rate - self._bias
        force[:, 1] -= self._speed * rate[:, 2]
        stamps = np.array([s for s, _, _ in ready])
        dt = np.diff(np.concatenate([[self._q_ns], stamps])).clip(0, 200_000_000) * 1e-9
        rates = np.concatenate([rate[:1], rate])
        forces = np.concatenate([force[:1], force])
        q = _filter(self._q, rates, forces, dt, self.tilt_time_s, GRAVITY)
        self._q, self._q_ns = q[-1], int(stamps[-1])
        poses = from_quaternion(np.zeros((len(q), 3)), q)[:, :3, :3]
        yaw = np.unwrap(np.arctan2(poses[:, 1, 0], poses[:, 0, 0]))
        self._yaw += float(yaw[-1] - yaw[0])
        self._R = poses[-1]
        # The filter's own yaw and the sum of its steps agree up to full turns; rotations use the filter's.
        self._yaw = float(yaw[-1] + 2 * np.pi * np.round((self._yaw - yaw[-1]) / (2 * np.pi)))
        return True


def _upright(up: Array) -> Array:
    """The smallest rotation that takes a direction to the vertical."""
    from scipy.spatial.transform import Rotation

    axis = np.cross(up, [0.0, 0.0, 1.0])
    n = float(np.linalg.norm(axis))
    if n < 1e-6:
        return np.eye(3)
    return np.asarray(Rotation.from_rotvec(axis / n * np.arccos(np.clip(up[2], -1, 1))).as_matrix())
