"""Does the path go where dead reckoning went? A check of what trees alone have bent it to."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from topograph.audit.verdict import Finding
from topograph.estimate import Estimate, Problem
from topograph.trees import ASTRAY, SPAN, Way, astray


def way(problem: Problem, estimate: Estimate) -> Iterator[Finding]:
    """Is there a piece on which the path leaves dead reckoning by more than it drifts? By wheels only; where no fixes are near."""
    motion = problem.motion
    if not motion.wheels:
        return
    distance = motion.distance_at(estimate.stamps_ns)
    path, held = Way.of(distance, estimate.map_T_robot), distance[problem.fixes.keyframe]
    worst = astray(path, motion, motion.at(estimate.stamps_ns), problem.motion_config, held)
    if worst.distance2 > ASTRAY:
        yield Finding(
            name="way", value=worst.distance2, bound=ASTRAY, unit="",
            sentence=f"{worst.after:.0f} m after its start the path leaves dead reckoning by more than that drifts ({np.degrees(abs(worst.turned)):.0f}° within "
            f"{SPAN:.0f} m): trees were taken for others there, or the wheels slipped",
        )  # fmt: skip
