"""Does the path go where dead reckoning went? A check of what trees alone have bent it to."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from topograph.audit.verdict import Finding
from topograph.estimate import Estimate, Problem
from topograph.geometry import Array, wrap
from topograph.trees import Way, drift

SPAN = 6.0
"""m of the way that are looked at together: more than a slip, less than a headland and its alleys."""
HELD = 15.0
"""m around a fix in which the fixes judge the path, and wheels that slip do not."""
ASTRAY = 80.0
"""Squared Mahalanobis distance (3 dof) of the path's from dead reckoning's way (ten minutes without GNSS on poor wheels: right maps up to 35, wrong ones from 170 on)."""


def way(problem: Problem, estimate: Estimate) -> Iterator[Finding]:
    """Is there a piece of `SPAN` m on which the path leaves dead reckoning by more than it drifts? Wheels only; where no fixes are near."""
    motion = problem.motion
    if not motion.wheels:
        return
    distance = motion.distance_at(estimate.stamps_ns)
    path, reckoned = Way.of(distance, estimate.map_T_robot), Way.of(distance, motion.at(estimate.stamps_ns))
    fixed = distance[problem.fixes.keyframe]
    worst, where, turned = 0.0, 0.0, 0.0
    for begin in np.arange(distance[0], distance[-1] - SPAN, SPAN / 4):
        ends = np.array([begin, begin + SPAN])
        if len(fixed) and np.abs(fixed - begin - SPAN / 2).min() < HELD:
            continue
        a, b = path.at(ends), reckoned.at(ends)
        cov = drift(reckoned, begin, begin + SPAN, b[1, :2], motion, problem.motion_config)
        off = _turned(_step(a) - _step(b), b[0, 2])
        off[2] = wrap(off[2])
        distance2 = float(off @ np.linalg.solve(cov, off))
        if distance2 > worst:
            worst, where, turned = distance2, begin, float(np.degrees(abs(off[2])))
    if worst > ASTRAY:
        yield Finding(
            name="way", value=worst, bound=ASTRAY, unit="",
            sentence=f"{where:.0f} m after its start the path leaves dead reckoning by more than that drifts ({turned:.0f}° within {SPAN:.0f} m): trees were taken "
            "for others there, or the wheels slipped",
        )  # fmt: skip


def _step(pose: Array) -> Array:
    """From the first of two poses (2, 3) to the second, in the first's frame."""
    return _turned(pose[1] - pose[0], -pose[0, 2])


def _turned(x: Array, yaw: float) -> Array:
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([c * x[0] - s * x[1], s * x[0] + c * x[1], x[2]])
