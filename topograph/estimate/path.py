"""The robot between keyframes: the estimate's poses, joined by dead reckoning."""

from __future__ import annotations

import numpy as np

from topograph.geometry import Array, Stamps, exp, inverse, log
from topograph.motion import Motion


def path_at(keyframes_ns: Stamps, map_T_keyframe: Array, motion: Motion, stamps_ns: Stamps) -> Array:
    """Poses `map_T_robot` (S, 4, 4) at any stamps.

    Dead reckoning runs from the keyframe before; the misfit at the keyframe behind is spread over the interval.
    """
    q = np.asarray(stamps_ns, np.int64)
    if len(q) == 0:
        return np.zeros((0, 4, 4))
    odom_T_keyframe, odom_T_robot = motion.at(keyframes_ns), motion.at(q)
    map_T_odom = map_T_keyframe @ inverse(odom_T_keyframe)
    if len(keyframes_ns) == 1:
        return np.asarray(map_T_odom[0] @ odom_T_robot)
    i = np.clip(np.searchsorted(keyframes_ns, q, side="right") - 1, 0, len(keyframes_ns) - 2)
    u = np.clip((q - keyframes_ns[i]) / (keyframes_ns[i + 1] - keyframes_ns[i]), 0.0, 1.0)
    forward = map_T_odom[i] @ odom_T_robot
    backward = map_T_odom[i + 1] @ odom_T_robot
    return np.asarray(forward @ exp(u[:, None] * log(inverse(forward) @ backward)))
