"""Whether wheels and gyro tell how the robot went: two scans, one after the other, see the same trunks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from topograph.geometry import Array
from topograph.motion import Leg

REACH = 12.0
"""Trunks that are used, m: their place is known well."""
NEAR = 0.8
"""Farthest that a trunk may be from where the wheels expect it, m: half of a close spacing of trees."""
LEAST = 2
"""Pairs of trunks that tell of motion."""
OFF, SHARE, SIGMAS = 0.12, 0.35, 5.0
"""Trunks that put the robot further from the wheels' place than so many m, such a share of the way and so many deviations of their own."""
TURN, TURN_SHARE = 0.03, 0.1
"""The same of the gyro's turn, rad."""
MISSED = 10
"""Legs without trunks after which what was found of the wheels is forgotten."""
SPREAD = 0.05
"""Least deviation of a trunk between two scans, m."""
STANDS = 1.2
"""Way of the wheels, m, on which trunks that do not move are put down to spinning wheels, and not to a sensor that died."""
LONGEST_S = 1.5
"""Over longer, what odometry drifts adds up as well."""
LEGS = (3, 15)
FRESH = 0.3
"""Over so many legs it is judged: what is seen of the same trunks adds up, and their noise does not, but for such a share of the
trunks that are new in each scan."""
WIDER = 1.5
"""Steps and rates that are wrong are doubted by so much of what they are off by."""


class SlipWatch:
    """Held before a localizer: where the trunks contradict the wheels, steps are made wide, and turns are doubted (see `Leg`).

    Attributes:
        standing: m that the wheels went on while the trunks did not move.
        slips: the trunks contradict the wheels' way.
        stands: by the trunks the robot stands, by the wheels it goes, for longer than wheels spin: nobody here can tell who is right.
    """

    def __init__(self) -> None:
        self.slips = self.stands = False
        self._last: Array | None = None  # (N, 2) of the last scan, levelled robot frame
        self._missed = 0
        self.standing = 0.0
        # Of each leg: what trunks add to it (x, y m, yaw rad), its way (x, y) and turn, deviations of place and yaw, seconds.
        self._rows: list[Array] = []

    def check(self, flat: Array, leg: Leg) -> Leg:
        """The leg up to a scan whose trunks stand at `flat` (N, 2 or 3), m, in the levelled robot frame."""
        flat = flat[np.isfinite(flat).all(axis=1), :2]
        flat = flat[np.hypot(*flat.T) < REACH] if len(flat) else flat
        last, self._last = self._last, flat
        self.slips = self.stands = False
        if leg.seconds <= 0 or leg.blind > 0 or last is None:
            self._rows, self.standing = [], 0.0
            return leg
        found = between(last, flat, leg)
        if found is None:
            self._missed += 1
            if self._missed > MISSED:
                self._rows, self.standing = [], 0.0
        else:
            self._missed = 0
            told = np.array([*leg.step[:2], abs(leg.step[2]), *found[1], leg.seconds])
            self._rows = [*self._rows, np.concatenate([found[0], told])][-LEGS[1] :]
        return self._judged(leg, found is not None) if len(self._rows) >= LEGS[0] else leg

    def _judged(self, leg: Leg, seen: bool) -> Leg:
        # Suffixes of the last legs, from the third on.
        rows = np.array(self._rows)[::-1]
        recent = int(np.searchsorted(np.cumsum(rows[:, 8]), LONGEST_S)) + 1
        rows = rows[: max(recent, LEGS[0])]
        sums, least = np.cumsum(rows, axis=0)[LEGS[0] - 1 :], rows[LEGS[0] - 1 :]
        grown = SIGMAS * np.sqrt(1.0 + FRESH * np.arange(LEGS[0], len(rows) + 1))
        way = np.hypot(*sums[:, 3:5].T)
        place = np.maximum(np.maximum(OFF, SHARE * way), grown * np.maximum(rows[0, 6], least[:, 6]))
        turn = np.maximum(np.maximum(TURN, TURN_SHARE * sums[:, 5]), grown * np.maximum(rows[0, 7], least[:, 7]))
        slips, wrong = np.hypot(*sums[:, :2].T) > place, np.abs(sums[:, 2]) > turn
        if seen:
            still = slips & (np.hypot(*(sums[:, :2] + sums[:, 3:5]).T) < 0.2 * way)
            self.standing = self.standing + float(np.hypot(*leg.step[:2])) if still.any() else 0.0
        self.stands, self.slips = self.standing > STANDS, bool(slips.any())
        if self.slips:
            legs = np.arange(LEGS[0], len(rows) + 1)
            leg = replace(leg, slip=WIDER * float((np.hypot(*sums[:, :2].T) / legs)[slips].max()))
        if wrong.any():
            rate = float((np.abs(sums[wrong, 2]) / sums[wrong, 8]).max())
            leg = replace(leg, rate_sigma=max(leg.rate_sigma, WIDER * rate))
        return leg


def between(last: Array, now: Array, leg: Leg) -> tuple[Array, Array] | None:
    """By how much (x forward, y to the left, m, yaw, rad) the robot moved more than the leg says, and the deviations of place and
    yaw; None where trunks do not tell."""
    if len(last) < LEAST or len(now) < LEAST:
        return None
    c, s = np.cos(leg.step[2]), np.sin(leg.step[2])
    moved = now @ np.array([[c, s], [-s, c]]) + leg.step[:2]
    apart = np.hypot(*(moved[:, None, :] - last[None, :, :]).transpose(2, 0, 1))
    there, back = apart.argmin(axis=1), apart.argmin(axis=0)
    mutual = (back[there] == np.arange(len(now))) & (apart.min(axis=1) < NEAR)
    a, b = moved[mutual], last[there[mutual]]
    if len(a) >= 4:
        off = (b - a) - np.median(b - a, axis=0)
        size = np.hypot(*off.T)
        a, b = (
            a[size <= 3.0 * max(float(np.median(size)), SPREAD)],
            b[size <= 3.0 * max(float(np.median(size)), SPREAD)],
        )
    if len(a) < LEAST:
        return None
    ca, cb = a.mean(axis=0), b.mean(axis=0)
    u, v = a - ca, b - cb
    lever = float(np.sum(u**2))
    if lever < SHORT**2:
        return None
    yaw = float(np.arctan2(np.sum(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]), np.sum(u * v)))
    R = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    left = v - u @ R.T
    sigma = max(float(np.sqrt(np.sum(left**2) / max(2 * len(a) - 3, 1))), SPREAD)
    of_yaw = sigma / np.sqrt(lever)
    off = cb + R @ (leg.step[:2] - ca) - leg.step[:2]
    of_place = float(np.hypot(sigma / np.sqrt(len(a)), of_yaw * float(np.hypot(*(ca - leg.step[:2])))))
    return np.array([off[0], off[1], yaw]), np.array([of_place, of_yaw])


SHORT = 2.0
"""Trunks that stand closer together say nothing of turns, m."""
