"""What batch and live dead reckoning make of a step of the wheels and of gravity, alike."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from topograph.geometry import Array, exp, log

JUMP = (15.0, 0.5)
"""A step longer than so many m/s and m is a reset of the odometry."""


def jumps(step: Array, dt: ArrayLike) -> NDArray[np.bool_]:
    """(...,) steps (..., 4, 4) over `dt` (...,) s that no robot makes."""
    return np.asarray(np.linalg.norm(step[..., :3, 3], axis=-1) > JUMP[0] * np.maximum(dt, 0.02) + JUMP[1])


def straightened(step: Array) -> Array:
    """Translations (N, 3) of steps (N, 4, 4) in the axes that the robot has midway, m: half of a step's turn lies before its middle, so
    that the wheels' arc can be laid along somebody else's heading there.
    """
    half = exp(0.5 * log(step))[:, :3, :3]
    return np.asarray((np.swapaxes(half, 1, 2) @ step[:, :3, 3, None])[..., 0])


def levelled(force: Array) -> tuple[float, float]:
    """Roll and pitch, rad, of a body that feels gravity as `force` (3,), upwards."""
    return float(np.arctan2(force[1], force[2])), float(np.arctan2(-force[0], np.hypot(force[1], force[2])))


def quaternion_of(roll: float, pitch: float) -> Array:
    """Quaternion (4,) x, y, z, w of roll and pitch (rad) without a heading."""
    a, b = roll / 2, pitch / 2
    return np.array([np.sin(a) * np.cos(b), np.cos(a) * np.sin(b), -np.sin(a) * np.sin(b), np.cos(a) * np.cos(b)])
