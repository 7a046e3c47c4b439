"""Dead reckoning message by message: what a live robot knows of its motion between two scans."""

from __future__ import annotations

from bisect import insort
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from topograph.bags import Imu, Odometry
from topograph.geometry import Array, exp, from_quaternion, inverse, log, wrap
from topograph.motion.against import Against
from topograph.motion.gravity_kernel import gravity_kernel
from topograph.motion.inertial import GRAVITY
from topograph.motion.samples import RANGE
from topograph.motion.steps import jumps, levelled, quaternion_of, straightened
from topograph.session import Driven

AHEAD_NS = 2_000_000_000
"""A message that is further ahead of its stream waits for one that agrees: then there was a gap, or the clock was set."""
SET_BACK = 20
"""So many messages in a row that are older than the last one used: their clock was set back."""
CARRY_NS = 100_000_000
"""Where no message has come yet, the last step's velocity holds so long (or one and a half periods of the wheels)."""
GAP_NS = 300_000_000
"""Wheels silent for longer (or for three periods) do not cover the time, and what they say of it later is not used."""
GYRO_GAP_NS = 200_000_000
"""The same of the gyro: a rate says nothing of what comes so much later."""
FARTHEST = 1e7
"""Of odometry from its origin, m."""
REST = (0.005, 0.001)
"""Slower than so many m/s and rad/s between two messages of the wheels is standing."""
SETTLE_NS = 200_000_000
"""The frame still rocks after the wheels have stopped."""
BIAS_SIGMA = 0.02
"""What a gyro's bias may be before anything is known, rad/s: consumer MEMS."""
USUAL_BIAS = 0.005
"""What it mostly is, rad/s."""
BIAS_WALK = 1e-4
"""rad/s per √s."""
BIAS_NOISE = 1e-3
"""Noise of a mean rate at rest, rad/s per √Hz: a running engine shakes."""
HALF_TURN = 3.0
HEADING_WALK = 1e-3
"""How far gyro and map may part by noise alone, rad/√s."""
LEVEL_SIGMA = 0.01
"""Roll and pitch as gravity holds them over time, rad."""
MOVING_SIGMA = 0.06
"""The same from less than a second of a drive, rad: the suspension's own accelerations."""
FASTEST_TURN = 3.0
"""No robot that drives in an orchard turns faster, rad/s; a gyro that says so speaks in degrees, or is broken."""
LEVEL_NS = 1_500_000_000
"""So long after the last IMU sample the attitude is still worth something: a robot turns around at the end of a row within seconds."""


_M = TypeVar("_M", tuple[int, Array], tuple[int, Array, Array])


@dataclass(frozen=True, slots=True, kw_only=True)
class Leg:
    """Motion of the base between two stamps.

    Attributes:
        step: (3,) x, y (m) and yaw (rad) in the levelled frame of the first pose; `up` m.
        roll, pitch: of the base at the second stamp, rad; zero without an IMU; `tilt_sigma` their deviation.
        distance, turned: m, rad, as driven.
        seconds: between the stamps; `blind` of them that no wheels cover.
        slip: deviation of the step that somebody else has seen of the wheels, m.
        rate_sigma: of the gyro's bias, rad/s: unlike noise it does not average out within the leg.
        gyro, level: the turn is the gyro's; roll and pitch are held to gravity.
    """

    step: Array
    up: float = 0.0
    roll: float = 0.0
    pitch: float = 0.0
    tilt_sigma: float = LEVEL_SIGMA
    distance: float
    turned: float
    seconds: float
    blind: float = 0.0
    slip: float = 0.0
    rate_sigma: float = 0.0
    gyro: bool = True
    level: bool = True


@dataclass(slots=True)
class _Attitude:
    """The gyro's rotation at a stamp, with roll and pitch held to gravity."""

    ns: int
    q: Array
    age: float
    sigma: float


class Reckoner:
    """Feed it odometry and IMU messages as they come; `advance` gives the motion up to a stamp.

    How often it is asked makes no difference: attitude and wheels are joined message by message.
    `child_T_robot` (4, 4) takes odometry's child frame to the base; `robot_R_imu` (3, 3) turns IMU samples into the base's
    axes, None: the tilt is taken from gravity at the start, which is enough for turns.
    """

    def __init__(
        self, child_T_robot: Array | None = None, robot_R_imu: Array | None = None, tilt_time_s: float = 4.0
    ) -> None:
        self.child_T_robot = np.eye(4) if child_T_robot is None else child_T_robot
        self.robot_R_imu = robot_R_imu
        self.tilt_time_s = tilt_time_s
        self.bias = np.zeros(3)
        self._wheels: list[tuple[int, Array]] = []  # poses not yet passed
        self._imu: list[tuple[int, Array, Array]] = []  # samples not yet integrated
        self._resting: list[tuple[int, Array]] = []  # rates since the last wheel message that was passed
        self._rest_since: int | None = None
        self._speeds: list[tuple[int, float]] = []  # of the last second, at the middle of each step
        self._last: tuple[int, Array] | None = None  # the wheels' pose up to which motion has been told
        self._velocity: Array | None = None  # (6,) per second, of the last step
        self._heard: tuple[int, Array] | None = None  # the last message of the wheels that was passed
        self._period_ns = 0  # of these messages
        self._attitude: _Attitude | None = None
        self._unit, self._rate_unit = 1.0, 1.0
        self._told, self._held_ns = 0.0, 0  # the gyro's heading so far, and the stamp of the last heading from outside
        self._drift, self._drift_cov = np.zeros(2), np.diag([HALF_TURN**2, BIAS_SIGMA**2])  # rad and rad/s
        self._sample: tuple[int, Array, Array] | None = None  # the last one integrated
        self._at_ns: int | None = None
        self._against = Against()
        self._driven = Driven()
        self._late: dict[str, int] = {}
        self._ahead: dict[str, Any] = {}
        self._newest: dict[str, int] = {}

    def add(self, message: Odometry | Imu) -> None:
        """One message. Older ones than were used already are passed over, and so is what is not finite or beyond what anything
        measures."""
        if isinstance(message, Imu):
            sound = (
                np.abs(message.gyro).max() * self._rate_unit < RANGE[0] and np.abs(message.accel).max() < RANGE[1]
            )  # False for NaN
            if sound:
                for sample in self._in_time("imu", (message.stamp_ns, message.gyro, message.accel), self._sample):
                    insort(self._imu, sample, key=_stamp)
        elif np.abs(message.odom_T_child).max() < FARTHEST and np.linalg.norm(message.odom_T_child[3:]) > 0.5:
            pose = from_quaternion(message.odom_T_child[:3], message.odom_T_child[3:])
            for stamp_ns, odom_T_child, twist in self._in_time(
                "wheels", (message.stamp_ns, pose, message.twist), self._heard
            ):
                odom_T_robot = self._driven(stamp_ns, odom_T_child, twist) @ self.child_T_robot
                insort(self._wheels, (stamp_ns, odom_T_robot), key=_stamp)

    def _in_time(self, kind: str, message: _M, last: tuple[int, Any] | tuple[int, Any, Any] | None) -> list[_M]:
        """The message, if it is newer than the last one that was used and not far ahead of those that came; many older ones in a row
        are a clock that was set back. One that waited comes with the next that agrees."""
        stamp_ns = message[0]
        newest = self._newest.get(kind, stamp_ns)
        if last is not None and stamp_ns <= last[0]:
            self._late[kind] = self._late.get(kind, 0) + 1
            if self._late[kind] <= SET_BACK:
                return []
            self._newest[kind] = stamp_ns
            return [message]
        self._late[kind] = 0
        if stamp_ns <= newest + AHEAD_NS:
            self._newest[kind] = max(newest, stamp_ns)
            self._ahead.pop(kind, None)
            return [message]
        waited = self._ahead.get(kind)
        self._ahead[kind] = message
        if waited is None or not 0 < stamp_ns - waited[0] < AHEAD_NS:
            return []
        self._newest[kind] = stamp_ns
        del self._ahead[kind]
        return [waited, message]

    def advance(self, stamp_ns: int) -> Leg:
        """Motion since the last call, with all messages up to `stamp_ns`; nothing moves when the stamp does not rise."""
        first = self._at_ns is None
        begin_ns = stamp_ns if self._at_ns is None else self._at_ns
        stamp_ns = max(stamp_ns, begin_ns)
        self._at_ns = stamp_ns
        seconds = (stamp_ns - begin_ns) * 1e-9
        steps, blind = self._steps(begin_ns, stamp_ns)
        times, rotations, gyro = self._turn(stamp_ns)
        if first:  # what came before the first scan only says how the robot stands and moves
            steps, blind, gyro = [], 0.0, False
        tilt = {}
        if self._attitude is not None:
            R = rotations[-1]
            tilt = {
                "roll": float(np.arctan2(R[2, 1], R[2, 2])),
                "pitch": float(np.arcsin(np.clip(-R[2, 0], -1, 1))),
                "tilt_sigma": self._attitude.sigma,
            }
        by_wheels = _along_wheels(steps)
        step, up, distance, turned = _along_gyro(steps, times, rotations) if gyro else by_wheels
        told = float(by_wheels[0][2])
        doubt = self._against.take(
            float(step[2]), told, self._against.scale * step[:2], 0.0 if blind or first else seconds
        )
        too_fast = not blind and abs(float(step[2])) > FASTEST_TURN * max(seconds, 0.1)
        if gyro and (self._against.gyro_is_wrong or too_fast):
            gyro, (step, up, distance, turned) = False, by_wheels
        scale = np.array([self._against.scale, self._against.scale, 1.0])
        step, up, distance = step * scale, up * scale[0], distance * scale[0]
        self._told += float(step[2])
        if not gyro:
            self._drift_cov[:] = np.diag([HALF_TURN**2, self._drift_cov[1, 1]])
        return Leg(
            step=step, up=up, distance=distance, turned=turned, seconds=seconds, blind=blind, gyro=gyro,
            rate_sigma=float(np.hypot(min(np.sqrt(self._drift_cov[1, 1]), USUAL_BIAS), doubt)), level=self._is_level(stamp_ns), **tilt,
        )  # fmt: skip

    def _is_level(self, stamp_ns: int) -> bool:
        """Roll and pitch are known: the IMU still speaks."""
        return self._attitude is not None and self._sample is not None and stamp_ns - self._sample[0] < LEVEL_NS

    def restart(self, stamp_ns: int) -> None:
        """All clocks were set back: motion begins anew at `stamp_ns`; what was learnt of the sensors stays."""
        self._wheels, self._imu, self._resting, self._speeds, self._late, self._ahead = [], [], [], [], {}, {}
        self._last = self._heard = self._velocity = self._rest_since = self._sample = self._attitude = None
        self._at_ns, self._held_ns, self._newest = stamp_ns, 0, {}
        self._drift_cov[:] = np.diag([HALF_TURN**2, self._drift_cov[1, 1]])
        self._against.forget()

    def forget_stretch(self) -> None:
        """The last leg was contradicted by what was seen: wheels and gyro are not judged by it."""
        self._against.forget()

    def hold(self, pose: Array, sigma: float) -> None:
        """The pose (3,) at the last stamp as a map has it, x, y (m) and heading (rad, ± `sigma`): what the gyro steadily drifts away
        from the heading is bias.

        A Kalman filter over the offset of the two headings and its rate; a robot that never stands learns its bias so.
        """
        self._against.see(pose)
        if self._attitude is None or self._at_ns is None:
            return
        yaw = float(pose[2])
        dt = (self._at_ns - self._held_ns) * 1e-9 if self._held_ns else 0.0
        self._held_ns = self._at_ns
        F = np.array([[1.0, dt], [0.0, 1.0]])
        P = F @ self._drift_cov @ F.T + np.diag([HEADING_WALK**2, BIAS_WALK**2]) * dt
        x = F @ self._drift
        off = float(wrap(yaw - self._told - x[0]))
        S = P[0, 0] + sigma**2
        if off**2 > 25.0 * S:  # found again elsewhere
            x[0], P = x[0] + off, np.diag([sigma**2, P[1, 1]])
        else:
            K = P[:, 0] / S
            x, P = x + K * off, P - np.outer(K, P[0])
        self.bias[2] -= x[1]
        self._drift, self._drift_cov = np.array([x[0], 0.0]), P

    # -- wheels ---------------------------------------------------------------------------------------------------

    def _steps(self, begin_ns: int, stamp_ns: int) -> tuple[list[tuple[int, int, Array]], float]:
        """Steps (from, to, motion (4, 4)) of the wheels between the stamps, and the seconds that they do not cover."""
        carry, gap = max(CARRY_NS, 3 * self._period_ns // 2), max(GAP_NS, 3 * self._period_ns)
        passed = [w for w in self._wheels if w[0] <= stamp_ns]
        self._wheels = [w for w in self._wheels if w[0] > stamp_ns]
        steps: list[tuple[int, int, Array]] = []
        for heard in passed:
            if self._heard is None or self._last is None or not self._joined(self._heard, heard, gap, begin_ns):
                self._velocity = None
            else:
                steps.append((self._last[0], heard[0], inverse(self._last[1]) @ heard[1]))
            self._last = self._heard = heard
        if self._last is not None and self._heard is not None and stamp_ns > self._last[0]:
            last_ns, pose = self._last
            move = None
            if self._wheels:
                ahead_ns, ahead = self._wheels[0]
                if ahead_ns - self._heard[0] <= gap:
                    move = exp((stamp_ns - last_ns) / (ahead_ns - last_ns) * log(inverse(pose) @ ahead))
            elif self._velocity is not None and stamp_ns - self._heard[0] <= carry:
                move = exp(self._velocity * (stamp_ns - last_ns) * 1e-9)
            if move is not None and not jumps(move, (stamp_ns - last_ns) * 1e-9):
                steps.append((last_ns, stamp_ns, move))
                self._last = (stamp_ns, pose @ move)
        covered = sum(max(b - max(a, begin_ns), 0) for a, b, _ in steps) * 1e-9
        blind = (stamp_ns - begin_ns) * 1e-9 - covered
        return steps, blind if blind > 0.02 else 0.0

    def _joined(self, heard: tuple[int, Array], now: tuple[int, Array], gap_ns: int, begin_ns: int) -> bool:
        """Take in one message of the wheels; False where it does not go on from the last one: a reset of the odometry, or
        a gap of which a part has been told already."""
        assert self._last is not None
        dt_ns = now[0] - heard[0]
        if dt_ns <= 0:
            return False
        move = inverse(heard[1]) @ now[1]
        dt = dt_ns * 1e-9
        usual = self._period_ns or dt_ns
        self._period_ns = usual + (min(dt_ns, 4 * usual) - usual) // 10
        if jumps(move, dt) or (dt_ns > gap_ns and heard[0] < begin_ns):
            return False
        self._velocity = log(move) / dt
        self._speeds.append((heard[0] + dt_ns // 2, float(np.sign(move[0, 3]) * np.linalg.norm(move[:3, 3])) / dt))
        self._learn(heard[0], now[0], move)
        return True

    def _learn(self, from_ns: int, to_ns: int, move: Array) -> None:
        """What the gyro says between two messages of standing wheels is bias."""
        dt = (to_ns - from_ns) * 1e-9
        still = 0 < dt < 0.5 and float(np.linalg.norm(move[:3, 3])) < REST[0] * dt
        still = still and abs(float(np.arctan2(move[1, 0], move[0, 0]))) < REST[1] * dt
        if not still:
            self._rest_since = None
            return
        self._rest_since = from_ns if self._rest_since is None else self._rest_since
        if from_ns < self._rest_since + SETTLE_NS or self.robot_R_imu is None:
            return
        rates = [g for ns, g, _ in self._imu if from_ns < ns <= to_ns]
        rates += [g for ns, g in self._resting if from_ns < ns <= to_ns]
        if not rates:
            return
        off = self.robot_R_imu @ np.mean(rates, axis=0) * self._rate_unit - self.bias
        noise = BIAS_NOISE**2 / dt
        P = self._drift_cov
        P[1, 1] += BIAS_WALK**2 * dt
        if float(np.abs(off).max()) > 4.0 * np.sqrt(P[1, 1] + noise):
            return  # wheels that are blocked while the robot turns
        gain = P[1, 1] / (P[1, 1] + noise)
        self.bias = self.bias + gain * off
        P[1] *= 1.0 - gain
        P[:, 1] = P[1]
        P[1, 1] = max(P[1, 1], BIAS_WALK**2)

    def _drive(self, stamps_ns: NDArray[np.int64]) -> tuple[Array, Array]:
        """Speed and its change (N,) at stamps, as the wheels have it."""
        if len(self._speeds) < 2:
            return np.full(len(stamps_ns), self._speeds[0][1] if self._speeds else 0.0), np.zeros(len(stamps_ns))
        t = np.array([ns for ns, _ in self._speeds])
        v = np.array([speed for _, speed in self._speeds])
        near = [np.interp(stamps_ns + shift, t, v) for shift in (-100_000_000, 100_000_000)]
        span = np.clip(stamps_ns + 100_000_000, t[0], t[-1]) - np.clip(stamps_ns - 100_000_000, t[0], t[-1])
        change = np.where(span > 50_000_000, (near[1] - near[0]) / np.maximum(span * 1e-9, 0.05), 0.0)
        return np.interp(stamps_ns, t, v), change

    # -- attitude -------------------------------------------------------------------------------------------------

    def _turn(self, stamp_ns: int) -> tuple[NDArray[np.int64], Array, bool]:
        """Stamps (N,) and rotations (N, 3, 3) of the attitude from the last stamp to this one, and whether the gyro covers
        them; none where the attitude is unknown."""
        ready = [m for m in self._imu if m[0] <= stamp_ns]
        if self._attitude is None and not self._level(ready):
            return np.zeros(0, np.int64), np.zeros((0, 3, 3)), False
        a, R = self._attitude, self.robot_R_imu
        assert a is not None
        assert R is not None
        ahead = [m for m in self._imu if m[0] > stamp_ns]
        self._imu = ahead
        used = [m for m in ready if m[0] > a.ns]
        before = self._sample or ready[0]
        last = used[-1] if used else before
        end = last
        if ahead and ahead[0][0] - last[0] <= GYRO_GAP_NS:
            share = (stamp_ns - last[0]) / (ahead[0][0] - last[0])
            end = (stamp_ns, last[1] + share * (ahead[0][1] - last[1]), last[2])
        seen = np.array([before[0], *(m[0] for m in used), ahead[0][0] if ahead else stamp_ns])
        covered = bool(np.diff(seen).max() <= GYRO_GAP_NS)
        stamps = np.array([a.ns, *(m[0] for m in used), stamp_ns], np.int64)
        rows = [before, *used, end]
        if self._against.degrees and self._rate_unit == 1.0:
            self._rate_unit, self.bias = np.pi / 180.0, np.zeros(3)
        rate = np.array([m[1] for m in rows]) @ R.T * self._rate_unit - self.bias
        force = np.array([m[2] for m in rows]) @ R.T * self._unit
        speed, change = self._drive(stamps)
        force[:, 0] -= change
        force[:, 1] -= speed * rate[:, 2]
        dt = np.diff(stamps) * 1e-9
        tau = np.clip(a.age + np.cumsum(dt), 0.5, self.tilt_time_s)
        q = gravity_kernel(a.q, rate, force, np.minimum(dt, 1e-9 * GYRO_GAP_NS), tau, GRAVITY)
        fade = float(np.exp(-np.sum(dt / tau)))
        # Gravity's own deviation stays, however often it is asked; what is beyond it fades.
        beyond = fade**2 * max(a.sigma**2 - LEVEL_SIGMA**2, 0.0)
        sigma = float(np.sqrt(LEVEL_SIGMA**2 + beyond)) if covered else MOVING_SIGMA
        self._attitude = _Attitude(stamp_ns, q[-1], a.age + float(dt.sum()), sigma)
        self._sample = last
        self._resting = [m[:2] for m in used[-200:]]
        del self._speeds[:-100]
        return stamps, from_quaternion(np.zeros((len(q), 3)), q)[:, :3, :3], covered

    def _level(self, ready: list[tuple[int, Array, Array]]) -> bool:
        """The first roll and pitch, from specific force less what the wheels explain; whether there is enough of it."""
        if len(ready) < 3:
            return False
        stamps = np.array([m[0] for m in ready])
        ready = [m for m in ready if m[0] <= stamps[0] + 1_000_000_000]
        mean = np.mean([m[2] for m in ready], axis=0)
        size = float(np.linalg.norm(mean))
        self._unit = GRAVITY if 0.8 < size < 1.2 else 1.0  # some drivers report g
        if not 0.7 < size * self._unit / GRAVITY < 1.3:
            del self._imu[:-100]  # no gravity: nothing says how it hangs
            return False
        if self.robot_R_imu is None:
            self.robot_R_imu = _upright(mean / max(size, 1e-6))
        speed, change = self._drive(stamps[: len(ready)])
        rate = np.array([m[1] for m in ready]) @ self.robot_R_imu.T
        force = np.array([m[2] for m in ready]) @ self.robot_R_imu.T * self._unit
        force[:, 0] -= change
        force[:, 1] -= speed * rate[:, 2]
        f = force.mean(0)
        still = bool(np.abs(speed).max(initial=0.0) < REST[0]) and bool(np.abs(rate).max() < 0.1)
        sigma = 2 * LEVEL_SIGMA if still else MOVING_SIGMA
        self._attitude = _Attitude(int(stamps[0]), quaternion_of(*levelled(f)), 0.0, sigma)
        return True


def _stamp(message: tuple[int, Array] | tuple[int, Array, Array]) -> int:
    return message[0]


def _along_wheels(steps: list[tuple[int, int, Array]]) -> tuple[Array, float, float, float]:
    """Planar step (3,), rise, distance and turn of steps whose turns are the wheels'."""
    x, distance, turned, up = np.zeros(3), 0.0, 0.0, 0.0
    for _, _, move in steps:
        turn = float(np.arctan2(move[1, 0], move[0, 0]))
        c, s = np.cos(x[2]), np.sin(x[2])
        x += [c * move[0, 3] - s * move[1, 3], s * move[0, 3] + c * move[1, 3], turn]
        distance += float(np.linalg.norm(move[:3, 3]))
        turned += abs(turn)
        up += float(move[2, 3])
    return x, up, distance, turned


def _along_gyro(
    steps: list[tuple[int, int, Array]], times: NDArray[np.int64], rotations: Array
) -> tuple[Array, float, float, float]:
    """The same with each step's arc laid along the attitude at its middle."""
    yaw = np.unwrap(np.arctan2(rotations[:, 1, 0], rotations[:, 0, 0]))
    turn, turned = float(yaw[-1] - yaw[0]), float(np.abs(np.diff(yaw)).sum())
    if not steps:
        return np.array([0.0, 0.0, turn]), 0.0, 0.0, turned
    straight = straightened(np.array([m for _, _, m in steps]))
    middle = np.array([a + (b - a) // 2 for a, b, _ in steps])
    k = np.clip(np.searchsorted(times, middle), 1, len(times) - 1)
    share = np.clip((middle - times[k - 1]) / np.maximum(times[k] - times[k - 1], 1), 0.0, 1.0)
    between = Rotation.from_matrix(np.swapaxes(rotations[k - 1], 1, 2) @ rotations[k]).as_rotvec() * share[:, None]
    R = rotations[k - 1] @ Rotation.from_rotvec(between).as_matrix()
    p = np.sum((R @ straight[..., None])[..., 0], axis=0)
    c, s = np.cos(yaw[0]), np.sin(yaw[0])
    return (
        np.array([c * p[0] + s * p[1], -s * p[0] + c * p[1], turn]), float(p[2]),
        float(np.linalg.norm(straight, axis=1).sum()), turned,
    )  # fmt: skip


def _upright(up: Array) -> Array:
    """The smallest rotation that takes a direction to the vertical."""
    axis = np.cross(up, [0.0, 0.0, 1.0])
    n = float(np.linalg.norm(axis))
    if n < 1e-6:
        return np.eye(3) if up[2] > 0 else np.diag([1.0, -1.0, -1.0])
    return np.asarray(Rotation.from_rotvec(axis / n * np.arccos(np.clip(up[2], -1, 1))).as_matrix())
