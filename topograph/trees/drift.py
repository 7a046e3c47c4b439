"""How far dead reckoning may be off between two places of a run: a covariance that knows the way in between."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from topograph.geometry import Array, yaw_of
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


def drift(way: Way, since: float, until: float, centre: Array, motion: Motion, noise: MotionConfig) -> Array:
    """Covariance (3, 3) of x, y, yaw (m, rad) of a piece about `centre` (2,) that is seen after `until` m, against what was seen after `since` m.

    Scales of wheels and turns stay the same over a run: their errors are as large as the way there is long, or the turn wide, whatever
    lies between. An error of yaw shifts the piece by its distance from where it arose. What changes (slips, a gyro's bias) adds up in variance.
    """
    inside = way.distance[(way.distance > since) & (way.distance < until)]
    knots = np.concatenate([[since], inside[:: len(inside) // KNOTS + 1], [until]])
    pose = way.at(knots)
    step, turn, d = np.diff(pose[:, :2], axis=0), np.diff(pose[:, 2]), np.diff(knots)
    arm = centre - 0.5 * (pose[1:, :2] + pose[:-1, :2])
    # What an error of yaw of each step does to the piece.
    by_yaw = np.column_stack([-arm[:, 1], arm[:, 0], np.ones(len(d))])
    longer = np.append(step.sum(axis=0), 0.0)
    turned, curved = turn @ by_yaw, d @ by_yaw
    share = noise.yaw_gyro if motion.gyro else noise.yaw_wheels
    per_metre = (GYRO if motion.gyro else 1.0) * noise.yaw_distance
    cov = (SLACK * noise.along) ** 2 * np.outer(longer, longer) + share**2 * np.outer(turned, turned)
    cov += (STRAIGHT * (0.1 if motion.gyro else 1.0)) ** 2 * np.outer(curved, curved)
    cov += per_metre**2 * (by_yaw.T * d) @ by_yaw
    if len(motion.unseen):  # turned in gaps of the gyro
        blind = noise.yaw_wheels * np.diff(np.interp(knots, motion.distance, motion.unseen))
        cov += (by_yaw.T * blind**2) @ by_yaw
    slips = (SLACK * noise.along) ** 2 * LASTS * (until - since)
    if len(motion.doubt):
        slips += float(np.diff(np.interp([since, until], motion.distance, motion.doubt))[0]) ** 2
    return np.asarray(cov + np.diag([slips + LEAST[0] ** 2, slips + LEAST[0] ** 2, LEAST[1] ** 2]))


def bounded(cov: Array, cap: float) -> Array:
    """A drift (3, 3) that something else holds to `cap` m as well, and to a fiftieth of that in rad."""
    held = np.diag(np.array([cap, cap, max(0.02, cap / 50.0)]) ** 2)
    both = cov @ np.linalg.solve(cov + held, held)
    return np.asarray(0.5 * (both + both.T))


def deviation(cov: Array) -> float:
    """Standard deviation of the place along the worst direction, m."""
    return float(np.sqrt(np.linalg.eigvalsh(cov[:2, :2])[-1]))
