"""How far dead reckoning may be off between two places of a run: a covariance that knows the way in between."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from topograph.geometry import Array, planar, wrap, yaw_of
from topograph.motion import Motion, MotionConfig

LEAST = (0.05, 1e-3)
"""m and rad that two places are off at least: of tracks that are no points."""
LASTS = 10.0
"""Errors of the wheels are alike for so many metres: what slips, slips for a while."""
SLACK = 2.0
"""Of the wheels' share of the distance: a slope, soft ground, a tyre."""
STRAIGHT = 1e-3
"""rad per m, of wheels whose radii differ or a steering that is not straight; a tenth of it with a gyro."""
KNOTS = 500
"""Of a way, at most: the drift is asked for every few metres, and may reach back to the run's beginning."""
SPAN = 6.0
"""m of a way that are looked at together: more than a slip, less than a headland and its alleys."""
BIAS = 5e-4
"""rad/s that a gyro's bias may be from its mean."""
HELD = 15.0
"""m around a fix in which the fixes judge the path, and wheels that slip do not."""
ASTRAY = 80.0
"""Squared Mahalanobis distance (3 dof) of a path's from dead reckoning's way, over `SPAN` (ten minutes without GNSS on poor wheels: right maps up to 35,
wrong ones from 170 on; Victoria Park 8, a recorded forest 3)."""
BENDS = 3
"""Times a way is bent, each by what the last has left: turns are no small ones."""
GYRO = 0.3
"""Of the yaw that wheels gather per root metre, with a gyro."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Way:
    """The path as it is estimated: after `distance` (K,) m, rising, at `pose` (K, 3) x, y, yaw (continuous)."""

    distance: Array
    pose: Array

    @staticmethod
    def of(distance: Array, map_T_robot: Array) -> Way:
        """Of poses (K, 4, 4) after `distance` (K,) m."""
        return Way(distance=distance, pose=np.column_stack([map_T_robot[:, :2, 3], np.unwrap(yaw_of(map_T_robot))]))

    def at(self, distance: Array) -> Array:
        """Poses (N, 3) after distances (N,)."""
        return np.stack([np.interp(distance, self.distance, self.pose[:, k]) for k in range(3)], axis=1)


class _Sources(NamedTuple):
    """What makes dead reckoning drift over a way, as unit normals: scales that last, then each step's own error of yaw.

    Attributes:
        knots: (K+1,) m driven; `step` (K, 2) and `turn` (K,) between them.
        yaw: (K, S) what each source that lasts turns each step by, rad; `own` (K,) what each step does by itself.
        scale: of the steps, the first source's.
        arms: (K, 3) what a turn of each step does to the piece, per rad.
        slips: (K,) m², per axis, that each step adds.
    """

    knots: Array
    step: Array
    turn: Array
    yaw: Array
    own: Array
    scale: float
    arms: Array
    slips: Array

    def effect(self) -> Array:
        """(3, S) what each source that lasts does to the piece."""
        out = self.arms.T @ self.yaw
        out[:2, 0] = self.scale * self.step.sum(axis=0)
        return out

    def cov(self) -> Array:
        """(3, 3) of the piece."""
        J, slips = self.effect(), self.slips.sum() + LEAST[0] ** 2
        own = (self.arms.T * self.own**2) @ self.arms
        return np.asarray(J @ J.T + own + np.diag([slips, slips, LEAST[1] ** 2]))


def _sources(way: Way, since: float, until: float, centre: Array, motion: Motion, noise: MotionConfig) -> _Sources:
    inside = way.distance[(way.distance > since) & (way.distance < until)]
    knots = np.concatenate([[since], inside[:: len(inside) // KNOTS + 1], [until]])
    pose = way.at(knots)
    step, turn, d = np.diff(pose[:, :2], axis=0), np.diff(pose[:, 2]), np.diff(knots)
    arm = centre - 0.5 * (pose[1:, :2] + pose[:-1, :2])
    share = noise.yaw_gyro if motion.gyro else noise.yaw_wheels
    straight = STRAIGHT * (0.1 if motion.gyro else 1.0)
    own = ((GYRO if motion.gyro else 1.0) * noise.yaw_distance) ** 2 * d
    slips = (SLACK * noise.along) ** 2 * LASTS * d
    if len(motion.unseen):  # turned in gaps of the gyro
        own += (noise.yaw_wheels * np.diff(np.interp(knots, motion.distance, motion.unseen))) ** 2
    if len(motion.doubt):
        doubt = np.diff(np.interp(knots, motion.distance, motion.doubt))
        slips += doubt.sum() * doubt  # one slip, however finely it is looked at
    return _Sources(
        knots=knots, step=step, turn=turn, scale=SLACK * noise.along, slips=slips,
        yaw=np.column_stack([np.zeros(len(d)), share * turn, straight * d]), own=np.sqrt(own),
        arms=np.column_stack([-arm[:, 1], arm[:, 0], np.ones(len(d))]),
    )  # fmt: skip


def drift(way: Way, since: float, until: float, centre: Array, motion: Motion, noise: MotionConfig) -> Array:
    """Covariance (3, 3) of x, y, yaw (m, rad) of a piece about `centre` (2,) that is seen after `until` m, against what was seen after `since` m.

    Scales of wheels and turns stay the same over a run: their errors are as large as the way there is long, or the turn wide, whatever
    lies between. An error of yaw shifts the piece by its distance from where it arose. What changes (slips, a gyro's bias) adds up in variance.
    """
    return _sources(way, since, until, centre, motion, noise).cov()


def bent(way: Way, since: float, until: float, centre: Array, move: Array, motion: Motion, noise: MotionConfig) -> Way:
    """The way with its end moved: what is seen about `centre` (2,) after `until` m by `move` (x, y, yaw), what was passed before `since` not at all.

    In between where dead reckoning is most likely to have gone astray: most of an error of yaw by wheels arose where they turned.
    """
    left, at = move, centre
    for _ in range(BENDS):
        end = way.at(np.array([until]))[0]
        way = _bent(way, since, until, at, left, motion, noise)
        now = way.at(np.array([until]))[0]
        turned = now[2] - end[2]
        at = now[:2] + planar(0.0, 0.0, turned)[:2, :2] @ (at - end[:2])
        left = np.append(centre + move[:2] - at, left[2] - turned)
    return way


def _bent(way: Way, since: float, until: float, centre: Array, move: Array, motion: Motion, noise: MotionConfig) -> Way:
    """As `bent`, exact for small moves."""
    s = _sources(way, since, until, centre, motion, noise)
    pull = np.linalg.solve(s.cov(), move)
    z = s.effect().T @ pull
    turned = np.concatenate([[0.0], np.cumsum(s.yaw @ z + s.own**2 * (s.arms @ pull))])
    middle = planar(0.0, 0.0, 0.5 * (turned[1:] + turned[:-1]))[:, :2, :2]
    step = np.einsum("kij,kj->ki", middle, s.step * (1.0 + s.scale * z[0])) + s.slips[:, None] * pull[:2]
    old = way.at(s.knots)[:, :2]
    new = old[0] + np.concatenate([np.zeros((1, 2)), np.cumsum(step, axis=0)])
    # Between two knots, and beyond the last one, stiff.
    yaw = np.interp(way.distance, s.knots, turned)
    at = np.clip(np.searchsorted(s.knots, way.distance, side="right") - 1, 0, len(s.knots) - 1)
    arm = np.einsum("kij,kj->ki", planar(0.0, 0.0, yaw)[:, :2, :2], way.pose[:, :2] - old[at])
    xy = np.where((way.distance > since)[:, None], new[at] + arm, way.pose[:, :2])
    return Way(distance=way.distance, pose=np.column_stack([xy, way.pose[:, 2] + yaw]))


class Astray(NamedTuple):
    """Where a path leaves dead reckoning the most: squared Mahalanobis distance (3 dof), m driven, and the turn that it makes more, rad."""

    distance2: float = 0.0
    after: float = 0.0
    turned: float = 0.0


def astray(path: Way, motion: Motion, odom_T_robot: Array, noise: MotionConfig, held: Array) -> Astray:
    """How a path contradicts its dead reckoning `odom_T_robot` (K, 4, 4) the most, over `SPAN` m, not nearer than `HELD` to what holds it, `held` (F,) m driven."""
    reckoned = Way.of(path.distance, odom_T_robot)
    worst = Astray()
    for begin in np.arange(path.distance[0], path.distance[-1] - SPAN, SPAN / 4):
        if len(held) and np.abs(held - begin - SPAN / 2).min() < HELD:
            continue
        a, b = (w.at(np.array([begin, begin + SPAN])) for w in (path, reckoned))
        cov = drift(reckoned, begin, begin + SPAN, b[1, :2], motion, noise)
        if motion.gyro:  # whose bias turns it by seconds, also where the robot stands
            lasted = (
                float(np.ptp(np.interp([begin, begin + SPAN], motion.distance, motion.stamps_ns - motion.stamps_ns[0])))
                * 1e-9
            )
            swing = np.array([-0.5 * SPAN, 0.5 * SPAN, 1.0])
            cov = cov + (noise.yaw_rate**2 * lasted + (BIAS * lasted) ** 2) * np.diag(swing**2)
        off = _turned(_step(a) - _step(b), b[0, 2])
        off[2] = wrap(off[2])
        distance2 = float(off @ np.linalg.solve(cov, off))
        if distance2 > worst.distance2:
            worst = Astray(distance2, float(begin), float(off[2]))
    return worst


def _step(pose: Array) -> Array:
    """From the first of two poses (2, 3) to the second, in the first's frame."""
    return _turned(pose[1] - pose[0], -pose[0, 2])


def _turned(x: Array, yaw: float) -> Array:
    return np.append(planar(0.0, 0.0, yaw)[:2, :2] @ x[:2], x[2])


def bounded(cov: Array, cap: float) -> Array:
    """A drift (3, 3) that something else holds to `cap` m as well, and to a fiftieth of that in rad."""
    held = np.diag(np.array([cap, cap, max(0.02, cap / 50.0)]) ** 2)
    both = cov @ np.linalg.solve(cov + held, held)
    return np.asarray(0.5 * (both + both.T))


def deviation(cov: Array) -> float:
    """Standard deviation of the place along the worst direction, m."""
    return float(np.sqrt(np.linalg.eigvalsh(cov[:2, :2])[-1]))
