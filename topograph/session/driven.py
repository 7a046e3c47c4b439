"""Poses of wheels whose driver fills in the twist alone: for a whole run, and message by message."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from topograph.bags import Odometry
from topograph.geometry import Array, exp, from_quaternion, inverse

SAME = 1e-6
"""Poses that differ by less are one, m and per unit of a rotation's matrix."""
MOVES = 0.05
"""Faster than so many m/s or rad/s is moving."""
LONGEST_S = 0.5
"""A twist says nothing of what comes later."""
TOLD = 0.02
"""So many m or rad by the twists, and the pose has not changed: it never will."""


def driven(stamps_ns: NDArray[np.int64], odom_T_child: Array, twist: Array) -> Array:
    """Poses (N, 4, 4) as told; integrated from the twists (N, 6), linear and angular, where the poses never change and the twists do."""
    if not len(odom_T_child) or np.abs(odom_T_child - odom_T_child[0]).max() >= SAME or np.abs(twist).max() <= MOVES:
        return odom_T_child
    steps = _steps(0.5 * (twist[:-1] + twist[1:]), np.diff(stamps_ns) * 1e-9)
    out = np.empty_like(odom_T_child)
    out[0] = odom_T_child[0]
    for k, step in enumerate(steps):
        out[k + 1] = out[k] @ step
    return out


class Driven:
    """The same as the messages come. Until a pose has changed, what the twists say is kept; a pose that does change is believed from then
    on, and goes on from where the robot was."""

    def __init__(self) -> None:
        self._first: Array | None = None
        self._last: tuple[int, Array] | None = None  # stamp and twist
        self._by_twist = np.eye(4)  # since the first message
        self._told: Array | None = None  # what takes told poses to those given; None: they have not changed yet

    def __call__(self, m: Odometry) -> Array:
        """Pose (4, 4) of a message, of a child frame that moves smoothly."""
        pose = from_quaternion(m.odom_T_child[:3], m.odom_T_child[3:])
        if self._told is not None:
            return np.asarray(self._told @ pose)
        if self._first is None:
            self._first = pose
        if self._last is not None and m.stamp_ns > self._last[0]:
            mean, dt = 0.5 * (self._last[1] + m.twist), (m.stamp_ns - self._last[0]) * 1e-9
            if np.isfinite(mean).all():
                self._by_twist = self._by_twist @ _steps(mean[None], np.array([dt]))[0]
        self._last = (m.stamp_ns, m.twist)
        moved = float(np.abs(self._by_twist - np.eye(4)).max()) > TOLD
        given = self._first @ self._by_twist if moved else self._first
        if np.abs(pose - self._first).max() >= SAME:
            self._told = given @ inverse(pose) if moved else np.eye(4)
            return np.asarray(self._told @ pose)
        return np.asarray(given)


def _steps(twist: Array, dt: Array) -> Array:
    return exp(twist[:, [3, 4, 5, 0, 1, 2]] * np.minimum(dt, LONGEST_S)[:, None])
