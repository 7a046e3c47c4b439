"""Wheels that slip or are blocked, told by the trunks: what GNSS tells where there is any (`motion.wheels`), here without it.

From one scan to the next the same trunks say how the robot moved. Where, over a second, they contradict dead reckoning by far more than
their noise, the way that they tell stands in, with its deviation. The rule is `SlipWatch`'s, looking back and ahead.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from topograph.geometry import Array, Stamps, inverse, planar, transform, yaw_of
from topograph.motion import Leg, Motion
from topograph.trees.detections import Detections
from topograph.trees.slip import LONGEST_S, OFF, REACH, SHARE, SIGMAS, between

GAP_NS = 500_000_000
"""Scans further apart do not tell of a slip: trunks might be taken for their neighbours."""
LEGS = 5
"""Legs of a window, at least."""
WITNESSES = 3
"""Trunks in both scans, at least."""
WITHOUT_NS = 3_000_000_000
"""Fixes further apart than this leave the wheels unjudged between them."""
CELL, RIDES = 0.4, 0.12
"""A place of so many metres in the robot's frame where something is in so large a share of the scans."""
MOST = 0.3
"""Share of a run that may slip; beyond it, it is no slip but the mounting, the clock or the scale."""
PART = 0.25
"""A leg in a window that slips belongs to the slip when it is off by so much of the window's mean."""


def with_trunks_way(motion: Motion, d: Detections, fix_ns: Stamps) -> Motion:
    """The motion with the trunks' way where they contradict the wheels; itself where they do not. Where there are fixes, at `fix_ns` (F,),
    these have judged the wheels already, and trunks, some of which may be people, are not asked.
    """
    if not motion.wheels or len(d) == 0 or len(d.stamps_ns) < 3 * LEGS:
        return motion
    odom_T_robot = motion.at(d.stamps_ns)
    scans_ns = np.column_stack([d.stamps_ns[:-1], d.stamps_ns[1:]])
    near = _near(fix_ns, scans_ns)
    asked = _with_neighbours(~near, d.stamps_ns)
    seen = _Seen.of(odom_T_robot, d)
    rows, legs = _legs(odom_T_robot, d, asked, seen)
    if len(legs) < LEGS:
        return motion
    ns = scans_ns[rows]
    slipping = _slipping(ns, legs, rows, seen) & ~near[rows]
    driven = np.linalg.norm(np.diff(odom_T_robot[:, :2, 3], axis=0), axis=1) > 0.01
    # Of all that was driven, as much as trunks tell of where they are asked.
    told = driven.sum() * len(legs) / asked.sum()
    if not slipping.any() or slipping.sum() > MOST * max(told, 1.0):
        return motion
    return _corrected(motion, ns, legs, slipping)


def _with_neighbours(asked: NDArray[np.bool_], scans_ns: Stamps) -> NDArray[np.bool_]:
    """Legs (S-1,) between scans that some window with an `asked` one (S-1,) in it has in it too."""
    at = scans_ns[:-1][asked]
    if not len(at):
        return np.zeros(len(asked), bool)
    window = int(LONGEST_S * 1e9)
    first = np.searchsorted(at, scans_ns[:-1] - window)
    return np.asarray(np.searchsorted(at, scans_ns[:-1] + window, "right") > first)


@dataclass(frozen=True, slots=True)
class _Seen:
    """Trunks (M, 2) near the robot in its levelled frame, scan by scan; where those of each of S scans begin, `ends` (S + 1,); and the scans' places
    (S, 2) and headings (S,) by dead reckoning."""

    flat: Array
    ends: NDArray[np.int64]
    place: Array
    yaw: Array

    @staticmethod
    def of(odom_T_robot: Array, d: Detections) -> _Seen:
        yaw = yaw_of(odom_T_robot)
        up = planar(odom_T_robot[:, 0, 3], odom_T_robot[:, 1, 3], yaw)
        up[:, 2, 3] = odom_T_robot[:, 2, 3]
        flat = transform((inverse(up) @ odom_T_robot)[d.scan], d.p)[:, :2]
        use = (np.hypot(*flat.T) < REACH) & (d.score >= 0) & ~_rides(flat, d)
        rows = np.flatnonzero(use)[np.argsort(d.scan[use], kind="stable")]
        ends = np.searchsorted(d.scan[rows], np.arange(len(d.stamps_ns) + 1))
        return _Seen(flat[rows], ends, odom_T_robot[:, :2, 3], yaw)

    def at(self, k: int) -> Array:
        """Trunks (N, 2) of scan `k` in the robot's frame."""
        return self.flat[self.ends[k] : self.ends[k + 1]]

    def turned(self, k: int, v: Array) -> Array:
        """Vectors (N, 2) of the robot's frame of scan `k` in dead reckoning's axes."""
        c, s = np.cos(self.yaw[k]), np.sin(self.yaw[k])
        return np.asarray(v @ np.array([[c, s], [-s, c]]))

    def standing(self, a: int, b: int, moved: Array, tolerance: float) -> int:
        """Trunks of scan `b` where one of scan `a` is when the robot went `moved` (2,) further than dead reckoning has it, m."""
        first = self.place[a] + self.turned(a, self.at(a))
        second = self.place[b] + moved + self.turned(b, self.at(b))
        if not len(first) or not len(second):
            return 0
        apart = np.hypot(*(second[:, None] - first[None]).transpose(2, 0, 1)).min(axis=1)
        return int((apart < tolerance).sum())


def _legs(odom_T_robot: Array, d: Detections, asked: NDArray[np.bool_], seen: _Seen) -> tuple[NDArray[np.int64], Array]:
    """Rows (L,) of the legs between scans that trunks tell of, among those `asked` for (S-1,), and (L, 5): what the trunks add to the leg (x, y, m, in
    the robot's frame), its way (x, y, m), their sigma."""
    yaw = seen.yaw
    told, legs = [], []
    for a in np.flatnonzero(asked).tolist():
        b = a + 1
        if not 0 < d.stamps_ns[b] - d.stamps_ns[a] < GAP_NS:
            continue
        last, now = seen.at(a), seen.at(b)
        way = odom_T_robot[b, :2, 3] - odom_T_robot[a, :2, 3]
        c, s = np.cos(yaw[a]), np.sin(yaw[a])
        step = np.array([c * way[0] + s * way[1], -s * way[0] + c * way[1], yaw[b] - yaw[a]])
        found = between(last, now, Leg(step=step, distance=0.0, turned=0.0, seconds=0.0))
        if found is not None and min(len(last), len(now)) >= WITNESSES:
            told.append(a)
            legs.append((*found[0][:2], *step[:2], found[1][0]))
    return np.array(told, np.int64), np.array(legs).reshape(-1, 5)


def _near(fix_ns: Stamps, ns: NDArray[np.int64]) -> NDArray[np.bool_]:
    """(L,) legs with a fix before and after them that is not far."""
    if len(fix_ns) < 2:
        return np.zeros(len(ns), bool)
    after = np.clip(np.searchsorted(fix_ns, ns[:, 1]), 1, len(fix_ns) - 1)
    inside = (ns[:, 0] >= fix_ns[0]) & (ns[:, 1] <= fix_ns[-1])
    return np.asarray(inside & (fix_ns[after] - fix_ns[after - 1] < WITHOUT_NS))


def _rides(flat: Array, d: Detections) -> NDArray[np.bool_]:
    """(N,) detections at places beside the robot where nearly always something is: what rides along says that the robot stands."""
    cell = np.floor(flat / CELL).astype(np.int64)
    _, of = np.unique(cell, axis=0, return_inverse=True)
    scans = np.unique(np.column_stack([of.ravel(), d.scan]), axis=0)
    often = np.bincount(scans[:, 0], minlength=int(of.max(initial=0)) + 1) > RIDES * len(d.stamps_ns)
    return np.asarray(often[of.ravel()])


def _slipping(ns: NDArray[np.int64], legs: Array, rows: NDArray[np.int64], seen: _Seen) -> NDArray[np.bool_]:
    """(L,) legs, those after the scans `rows`, on which the wheels are contradicted: over a window the trunks went elsewhere, and from its first
    scans to its last more of them stand still for it."""
    out = np.zeros(len(legs), bool)
    total = np.concatenate([np.zeros((1, 5)), np.cumsum(np.column_stack([legs[:, :4], legs[:, 4] ** 2]), axis=0)])
    j = np.searchsorted(ns[:, 0], ns[:, 0] + int(LONGEST_S * 1e9))
    for i in range(len(legs)):
        k = int(j[i])
        if k - i < LEGS:
            continue
        whole = total[k] - total[i]
        off, way = float(np.hypot(*whole[:2])), float(np.hypot(*whole[2:4]))
        # Neighbouring scans share trunks: their noise cancels but at the ends.
        noise = float(np.sqrt(whole[4] / (k - i)))
        if off > max(OFF, SHARE * way, SIGMAS * noise * 2.0) and _stands_better(legs[i:k], rows[i:k], seen, off):
            along = legs[i:k, :2] @ whole[:2] / off
            out[i:k] |= along > PART * off / (k - i)
    return out


def _stands_better(legs: Array, rows: NDArray[np.int64], seen: _Seen, off: float) -> bool:
    """Whether more trunks stand still from the beginning of a window of `legs` (W, 5) to its end when the robot went as they add up to than by the
    wheels. From scan to scan trunks that come and go may be taken for their neighbours, all the way along a row of stakes.
    """
    tolerance = float(np.clip(0.5 * off, *STILL))
    moved = np.cumsum([seen.turned(a, leg[:2]) for a, leg in zip(rows.tolist(), legs, strict=True)], axis=0)
    by_trunks = by_wheels = 0
    for i in range(ENDS):
        for j in range(len(legs) - ENDS, len(legs)):
            if j >= i:
                a, b = int(rows[i]), int(rows[j]) + 1
                by_trunks += seen.standing(a, b, moved[j] - (moved[i - 1] if i else 0.0), tolerance)
                by_wheels += seen.standing(a, b, np.zeros(2), tolerance)
    return by_trunks > BETTER * by_wheels


ENDS = 3
"""Scans at either end of a window that are laid onto each other."""
STILL = (0.06, 0.15)
"""Least and most that a trunk is off in both and stands still, m; half of what is in question, between."""
BETTER = 2.0
"""Times as many trunks must stand still by the trunks' way as by the wheels'."""


def _corrected(motion: Motion, ns: NDArray[np.int64], legs: Array, slipping: NDArray[np.bool_]) -> Motion:
    """The motion with what the trunks add on the legs that slip."""
    yaw = yaw_of(motion.at(ns[:, 0]))
    c, s = np.cos(yaw), np.sin(yaw)
    add = np.column_stack([c * legs[:, 0] - s * legs[:, 1], s * legs[:, 0] + c * legs[:, 1]]) * slipping[:, None]
    times = ns.ravel()
    t = motion.stamps_ns
    moved = motion.odom_T_robot.copy()
    for axis in range(2):
        steps = np.column_stack([np.zeros(len(add)), add[:, axis]]).ravel()
        moved[:, axis, 3] += np.interp(t, times, np.cumsum(steps))
    doubt = np.interp(t, times, np.cumsum(np.column_stack([np.zeros(len(legs)), legs[:, 4] * slipping]).ravel()))
    if len(motion.doubt):
        doubt = doubt + motion.doubt
    way = np.linalg.norm(np.diff(moved[:, :3, 3], axis=0), axis=1)
    return replace(
        motion, odom_T_robot=moved, distance=np.concatenate([[0.0], np.cumsum(way)]), doubt=doubt,
        slips=np.concatenate([motion.slips, _intervals(motion, ns, legs, slipping)]), slips_by_trunks=True,
    )  # fmt: skip


def _intervals(motion: Motion, ns: NDArray[np.int64], legs: Array, slipping: NDArray[np.bool_]) -> Array:
    """(S, 3) from, to (s since the first stamp) and the robot's speed less the wheels', m/s."""
    rows = np.flatnonzero(slipping)
    parts = np.split(rows, np.flatnonzero(ns[rows[1:], 0] - ns[rows[:-1], 1] > GAP_NS) + 1)
    out = []
    for part in parts:
        begin, end = ns[part[0], 0], ns[part[-1], 1]
        ahead = float(np.sum(legs[part, 0])) / max((end - begin) * 1e-9, 0.1)
        out.append(((begin - motion.stamps_ns[0]) * 1e-9, (end - motion.stamps_ns[0]) * 1e-9, ahead))
    return np.array(out).reshape(-1, 3)
