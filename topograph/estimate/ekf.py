"""A filter like ROS's `robot_localization`: odometry increments, GNSS positions, headings; forward only, no rejection."""

from __future__ import annotations

from typing import Literal

import numpy as np

from topograph.estimate.initial import initial_path
from topograph.estimate.problem import Problem
from topograph.geometry import Array, Stamps, inverse, planar, wrap, yaw_of


def filtered_path(problem: Problem, stamps_ns: Stamps, begin: Literal["batch", "first"] = "batch") -> Array:
    """Poses (S, 4, 4) at `stamps_ns`, each from what was known until then.

    It begins where a fit of the whole run has it ("batch", which knows what comes), or at the "first" fix with the first heading, as
    `robot_localization` would.

    State x, y, z, yaw; roll and pitch are dead reckoning's (the IMU's attitude), as in the thesis's setup.
    """
    motion, f, h = problem.motion, problem.fixes, problem.headings
    events = sorted(
        [(int(problem.stamps_ns[k]), 1, i) for i, k in enumerate(f.keyframe.tolist())]
        + [(int(problem.stamps_ns[k]), 2, i) for i, k in enumerate(h.keyframe.tolist())]
        + [(int(s), 3, i) for i, s in enumerate(stamps_ns.tolist())]
    )
    times = np.array([e[0] for e in events], np.int64)
    odom = motion.at(times)
    sigma = motion.sigma(problem.motion_config, times) if len(times) > 1 else np.zeros((0, 6))
    start = initial_path(problem)[0] if begin == "batch" else _first_pose(problem)
    x = np.array([*start[:3, 3], float(yaw_of(start))])
    first = motion.at(problem.stamps_ns[:1])[0]
    P = np.diag([1.0, 1.0, 1.0, 0.05])
    out = np.empty((len(stamps_ns), 4, 4))
    previous = first
    for n, (_, kind, i) in enumerate(events):
        x, P = _predict(x, P, previous, odom[n], sigma[n - 1] if n else np.full(6, 1e-3))
        previous = odom[n]
        if kind == 3:
            out[i] = _pose(x, odom[n])
        elif kind == 1:
            lever = (_pose(x, odom[n])[:3, :3] @ f.keyframe_p_antenna[i][:, None])[:, 0]
            H = np.zeros((3, 4))
            H[:, :3] = np.eye(3)
            H[0, 3], H[1, 3] = -lever[1], lever[0]
            x, P = _update(x, P, f.map_p_antenna[i] - x[:3] - lever, H, f.cov[i] + 1e-6 * np.eye(3))
        else:
            d = _pose(x, odom[n])[:3, :3] @ h.direction[i]
            e = wrap([h.yaw[i] - np.arctan2(d[1], d[0])])
            x, P = _update(x, P, e, np.array([[0.0, 0.0, 0.0, 1.0]]), np.array([[max(h.sigma[i], 2e-3) ** 2]]))
    return out


def _first_pose(problem: Problem) -> Array:
    """Pose (4, 4) of the first keyframe: turned by the first heading, at the first fix; the batch's where there are none."""
    f, h = problem.fixes, problem.headings
    if not len(f.keyframe):
        return np.asarray(initial_path(problem)[0])
    turn = 0.0
    if len(h.keyframe):
        d = problem.odom_T_robot[h.keyframe[0]][:3, :3] @ h.direction[0]
        turn = float(h.yaw[0] - np.arctan2(d[1], d[0]))
    else:
        turn = float(yaw_of(initial_path(problem)[0]) - yaw_of(problem.odom_T_robot[0]))
    first = planar(0.0, 0.0, turn) @ problem.odom_T_robot
    at = first[f.keyframe[0]]
    first[0, :3, 3] += f.map_p_antenna[0] - (at[:3, :3] @ f.keyframe_p_antenna[0] + at[:3, 3])
    return np.asarray(first[0])


def _pose(x: Array, odom_T_robot: Array) -> Array:
    """The state's position and yaw with dead reckoning's roll and pitch."""
    T = planar(0.0, 0.0, x[3] - float(yaw_of(odom_T_robot))) @ odom_T_robot
    T[:3, 3] = x[:3]
    return np.asarray(T)


def _predict(x: Array, P: Array, odom_T_a: Array, odom_T_b: Array, sigma: Array) -> tuple[Array, Array]:
    a_T_b = inverse(odom_T_a) @ odom_T_b
    map_T_a = _pose(x, odom_T_a)
    moved = map_T_a @ a_T_b
    d = moved[:3, 3] - x[:3]
    F = np.eye(4)
    F[0, 3], F[1, 3] = -d[1], d[0]
    R = map_T_a[:3, :3]
    Q = np.zeros((4, 4))
    Q[:3, :3] = R @ np.diag(sigma[3:] ** 2) @ R.T
    Q[3, 3] = sigma[2] ** 2
    return np.array([*moved[:3, 3], float(yaw_of(moved))]), F @ P @ F.T + Q


def _update(x: Array, P: Array, e: Array, H: Array, R: Array) -> tuple[Array, Array]:
    K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
    return x + K @ e, (np.eye(len(x)) - K @ H) @ P
