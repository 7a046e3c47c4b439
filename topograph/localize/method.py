"""What every localization method takes and gives: a scan's trunks and a leg of motion in, a report out."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from topograph.bags import Trunks
from topograph.geometry import Array
from topograph.motion import Leg


@dataclass(frozen=True, slots=True)
class Fix:
    """A committed pose.

    Attributes:
        map_T_robot: (4, 4) of `base_link` at `stamp_ns`.
        cov: (6, 6) of roll, pitch, yaw (rad) and x, y, z (m) about the map's axes.
        risk: chance that it is wrong.
    """

    stamp_ns: int
    map_T_robot: Array
    cov: Array
    risk: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Report:
    """What is believed after one scan.

    Attributes:
        state: searching, ambiguous, tracking, degraded or lost.
        fix: the pose when committed.
        hypotheses: how many places are left.
        risk: chance that the best of them is wrong.
        places: (H, 3) x, y, yaw of the robot at the hypotheses, the most probable first.
        weights: (H,) their probabilities, or empty where the method has none.
        trees: ids of the mapped trees seen.
        pairs: (K, 2) rows of the scan's trunks and of the map's trees.
        why: while there is no pose, what stands against one, in words; else "".
        along, across: standard deviations of the position in the map, along and across the rows (east and north without rows), m.
    """

    stamp_ns: int
    state: str
    fix: Fix | None
    hypotheses: int
    risk: float
    places: Array
    trees: NDArray[np.int64]
    pairs: NDArray[np.int64]
    along: float
    across: float
    weights: Array = field(default_factory=lambda: np.zeros(0))
    why: str = ""

    @property
    def apart(self) -> float:
        """Largest distance of a hypothesis from the most probable one, m."""
        if len(self.places) < 2:
            return 0.0
        return float(np.hypot(*(self.places[1:, :2] - self.places[0, :2]).T).max())


class Method(Protocol):
    """One way to localize."""

    def step(self, trunks: Trunks, leg: Leg) -> Report:
        """One scan further."""
