"""What is believed after a scan, and why nothing is where nothing is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from topograph.geometry import Array, planar, yaw_of
from topograph.localize.posterior import Posterior

LITTLE, COARSE, SEVERAL, ALIKE, ELSEWHERE, CONTRADICTED = REASONS = (
    "too few trees were seen to tell places apart",
    "trees are known too badly for how densely they stand",
    "several places of the map fit",
    "the planting is so regular that another one of its design would fit as well: drive on",
    "nothing on this map fits what was seen well enough",
    "wheels or gyro contradict the trees for so long that nobody is believed",
)
SET_ASIDE = 1e-5
"""Of the prior of another orchard of this design, what is left where somebody says that it cannot be (`ALIKE`)."""
STATES = ("searching", "ambiguous", "tracking", "degraded", "lost")
SHOWN = 200
"""Places that are told at most."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Belief:
    """What is believed after a scan.

    Attributes:
        state: one of `STATES`.
        pose: (3,) x, y, yaw of the robot in the map when committed, else None; `cov` (3, 3) m², m rad, rad².
        hypotheses: places that together hold 99 % of what is on the map; 1 when committed.
        risk: chance that the pose (or the best place) is wrong.
        places: (H, 3) the robot's poses of those hypotheses, most probable first, and `weights` (H,).
        pairs: (K, 2) rows of the sweep's trunks and of the mapped trees that they are.
        why: while nothing is committed, what stands against it: one of `REASONS`; else "".
    """

    state: str
    pose: Array | None
    cov: Array
    hypotheses: int
    risk: float
    places: Array
    weights: Array
    pairs: NDArray[np.int64]
    why: str = ""

    @property
    def committed(self) -> bool:
        return self.pose is not None


def held(state: str, pose: Array, cov: Array, risk: float, pairs: NDArray[np.int64]) -> Belief:
    """Of one place, that is tracked."""
    return Belief(
        state=state, pose=pose, cov=cov, hypotheses=1, risk=risk, places=pose[None], weights=np.ones(1), pairs=pairs
    )


def open_among(state: str, p: Posterior, frame_pose: Array, pairs: NDArray[np.int64], why: str) -> Belief:
    """Of the places of a posterior, where the robot is at `frame_pose` (3,) in the submap's frame."""
    n = likely(p)
    shown = p.pose[: min(n, SHOWN)]
    map_T_robot = planar(*shown.T) @ planar(*frame_pose)
    places = np.column_stack([map_T_robot[:, :2, 3], yaw_of(map_T_robot)])
    return Belief(
        state=state, pose=None, cov=np.full((3, 3), np.nan), hypotheses=n, risk=p.risk, places=places,
        weights=p.p[: len(places)], pairs=pairs, why=why,
    )  # fmt: skip


def likely(p: Posterior) -> int:
    """How many places together hold 99 % of what is on the map."""
    if not len(p.p) or p.p.sum() <= 0:
        return 0
    return int(np.searchsorted(np.cumsum(p.p) / p.p.sum(), 0.99) + 1)


def against(p: Posterior, *, informed: bool, tried: bool) -> str:
    """What stands against a commit: whether the landmarks tell enough to be searched with (`informed`), and whether any place was `tried`."""
    if not len(p.p):
        return LITTLE if not informed else ELSEWHERE if tried else COARSE
    if p.unknown < 0.5 and p.alike < 0.5 * p.risk:
        return SEVERAL
    aside = SET_ASIDE * p.alike
    rest = 1.0 - p.alike + aside
    return ALIKE if (rest - p.p[0]) < 0.01 * rest else SEVERAL if p.unknown < 0.5 else ELSEWHERE
