"""Poses of wheels whose driver fills in the twist alone, or part of the pose: for a whole run, and message by message."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from topograph.geometry import Array, exp, inverse

SAME = 1e-6
"""Poses that differ by less are one, m and per unit of a rotation's matrix."""
MOVES = 0.05
"""Twists below so many m/s and rad/s are noise of wheels that stand, or the bias of a gyro in them."""
LONGEST_S = 0.5
"""A twist says nothing of what comes later; a stamp that is older by more is of a clock that was set back."""
TOLD = 0.02
"""So many m or rad by the twists, and the position (or the orientation) is what it was at first: it is not filled in."""


def driven(stamps_ns: NDArray[np.int64], odom_T_child: Array, twist: Array) -> Array:
    """Poses (N, 4, 4) as told, or as `Driven` makes them of the twists (N, 6), linear and angular."""
    if len(odom_T_child) < 2 or not _needed(stamps_ns, odom_T_child, twist):
        return odom_T_child
    live = Driven()
    return np.array([live(*m) for m in zip(stamps_ns.tolist(), odom_T_child, twist, strict=True)])


def _needed(stamps_ns: NDArray[np.int64], odom_T_child: Array, twist: Array) -> bool:
    """The twists tell of motion before the position, or the orientation, has changed for the first time."""
    apart = np.abs(odom_T_child[:, :3] - odom_T_child[0, :3])
    turns, travels = (_first(v >= SAME) for v in (apart[:, :, :3].max(axis=(1, 2)), apart[:, :, 3].max(axis=1)))
    n = max(turns, travels)
    steps = _steps(0.5 * (twist[: n - 1] + twist[1:n]), np.diff(stamps_ns[:n]) * 1e-9)
    turned, moved = _angle(steps[: turns - 1]), np.linalg.norm(steps[: travels - 1, :3, 3], axis=1)
    return bool(turned.sum() > TOLD or moved.sum() > TOLD)


def _first(true: NDArray[np.bool_]) -> int:
    """Index of the first one, and their number where there is none."""
    return int(true.argmax()) if true.any() else len(true)


class Driven:
    """The poses as the messages come. As long as the position has not changed, the twists' velocity is kept beside it, and stands in once
    that comes to `TOLD`; the same of the orientation. What does change is believed from then on, and goes on from where the robot was.
    """

    def __init__(self) -> None:
        self._first = np.eye(4)
        self._last: tuple[int, Array, Array] | None = None  # stamp, pose as told, twist
        self._made = np.eye(4)  # the pose with what is not filled in taken from the twists
        self._turned, self._moved = 0.0, 0.0  # by the twists, while orientation and position did not change: rad, m
        self._turns, self._travels = False, False  # they have changed
        self._stands_in = False
        self._offset: Array | None = None  # of told poses, once both have changed

    def __call__(self, stamp_ns: int, told: Array, twist: Array) -> Array:
        """Pose (4, 4) of a message with the pose `told` (4, 4) and a twist (6,), of a child frame that moves smoothly."""
        if self._offset is not None:
            return np.asarray(self._offset @ told)
        if self._last is None:
            self._first = self._made = told
            self._last = (stamp_ns, told, twist)
            return told
        last_ns, before, twist_before = self._last
        dt = (stamp_ns - last_ns) * 1e-9
        if -LONGEST_S < dt <= 0:  # overtaken on its way
            return self._made if self._stands_in else told
        self._last = (stamp_ns, told, twist)
        self._go(inverse(before) @ told, _steps(0.5 * (twist_before + twist)[None], np.array([max(dt, 0.0)]))[0], told)
        return self._made if self._stands_in else told

    def _go(self, told_step: Array, twist_step: Array, told: Array) -> None:
        self._turns = self._turns or bool(np.abs(told[:3, :3] - self._first[:3, :3]).max() >= SAME)
        self._travels = self._travels or bool(np.abs(told[:3, 3] - self._first[:3, 3]).max() >= SAME)
        step = told_step.copy()
        if not self._turns:
            self._turned += float(_angle(twist_step[None])[0])
            step[:3, :3] = twist_step[:3, :3]
        if not self._travels:
            self._moved += float(np.linalg.norm(twist_step[:3, 3]))
            step[:3, 3] = twist_step[:3, 3]
        self._made = self._made @ step
        self._stands_in = self._stands_in or self._turned > TOLD or self._moved > TOLD
        if self._turns and self._travels:
            self._offset = self._made @ inverse(told) if self._stands_in else np.eye(4)


def _steps(twist: Array, dt: Array) -> Array:
    """Motion (N, 4, 4) of mean twists (N, 6) over `dt` (N,) s; none where they are noise, or no numbers."""
    moves = (np.abs(twist).max(axis=1) > MOVES) & np.isfinite(twist).all(axis=1)
    return exp(np.where(moves[:, None], twist[:, [3, 4, 5, 0, 1, 2]], 0.0) * np.minimum(dt, LONGEST_S)[:, None])


def _angle(steps: Array) -> Array:
    """(N,) rad, of small rotations."""
    return np.asarray(np.linalg.norm(steps[:, :3, :3] - np.eye(3), axis=(1, 2)) / np.sqrt(2.0))
