"""Follows trunks from scan to scan while dead reckoning is good: tracks, the pieces that trees are made of."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from topograph.geometry import Array, planar, transform
from topograph.motion import Motion, MotionConfig
from topograph.ranges import Chance, Count, NonNegative, Positive, Share
from topograph.trees.detections import Detections
from topograph.trees.gating import gated, seen_again
from topograph.trees.whole import misstep


@dataclass(frozen=True, slots=True)
class TreesConfig:
    """Association and existence.

    Attributes:
        gate: chi-square bound (2 dof) of a match.
        floor: least standard deviation of a track's position, m (bark, lean, a centre that depends on the view).
        drift: share of the distance driven since a track was last seen that its place may be off.
        forget: distance after which an unseen track ends, m.
        window: distance between two attempts to close a loop, m.
        recent: distance driven that counts as "here and now", m.
        mapped: chance that a trunk seen on old ground is already in the map.
        margin: log-odds by which a loop must beat the absence of a loop; its rivals by half as much again.
        merge: two trees nearer than this are one (stems of one tree), m.
        min_sightings: of a tree that exists.
        min_ratio: least ratio of its sightings to the scans that should show it (recorded detections).
        passed: scans that saw through its place, for each that saw it, that a tree survives.
        usual_score: share of the run's median score of trees that is enough (less existence.DOUBTFUL).
        reassociate: association and solve go on until neither changes; else trees are as they were first joined (an ablation).
        min_share: of the sightings that trees of the same run have at the median.
    """

    gate: Positive = 11.8
    floor: Positive = 0.06
    drift: NonNegative = 0.03
    forget: Positive = 8.0
    window: Positive = 4.0
    recent: Positive = 25.0
    mapped: Chance = 0.6
    margin: NonNegative = 7.0
    merge: Positive = 0.5
    min_sightings: Count = 6
    min_ratio: Share = 0.15
    passed: NonNegative = 0.1
    usual_score: NonNegative = 0.27
    min_share: Share = 0.03
    reassociate: bool = True


class Tracker:
    """Follows trunks from scan to scan in the odometry frame, by gated optimal assignment; fed forwards, live and in batch.

    A track's place follows the newest sightings, so that it drifts with dead reckoning and not against it; where a step was off by more than
    trees are known, all tracks are moved with it, and `held_T_odom` (4, 4), which starts as identity, adds up what it was. Tracks are named in the
    order of their birth; what has not been seen for `config.forget` m is forgotten.
    """

    def __init__(self, config: TreesConfig) -> None:
        self.config = config
        self.born = 0
        self.held_T_odom = np.eye(4)
        self._off = np.zeros(3)  # since the tracks were last moved
        self._ids: NDArray[np.int64] = np.zeros(0, np.int64)
        self._place, self._spread = np.zeros((0, 2)), np.zeros((0, 2, 2))
        self._seen, self._hits = np.zeros(0), np.zeros(0)

    def step(self, p: Array, cov: Array, var: Array, distance: float, at: Array, off: Array) -> NDArray[np.int64]:
        """Track (N,) of each trunk of one scan at `p` (N, 2) with `cov` (N, 2, 2), after `distance` m driven, seen from `at` (2,). `var` (N,) is what
        is known of each at its own height, m² per axis; a leaning one may be looked for further away. `off` (3,) is how far
        dead reckoning may be off since the last scan: x, y, m, and yaw, rad, standard deviations.
        """
        c = self.config
        keep = distance - self._seen < c.forget
        if not keep.all():
            self._ids, self._place, self._spread = self._ids[keep], self._place[keep], self._spread[keep]
            self._seen, self._hits = self._seen[keep], self._hits[keep]
        self._off += off  # an error of scale is alike from scan to scan
        n = len(p)
        if n == 0:
            return np.zeros(0, np.int64)
        self._keep_step(p, cov, var, distance, at)
        pairs, cost = gated(p, cov, self._place, self._spread, distance - self._seen, c.floor, c.drift, c.gate)
        match = assigned(pairs, cost, n, len(self._ids))
        seen_again(p, cov, match, self._place, self._spread, self._hits)
        if (match >= 0).any():
            self._off *= 1.0 - ABSORBED
        old, new = np.flatnonzero(match >= 0), np.flatnonzero(match < 0)
        self._seen[match[old]] = distance
        track = np.empty(n, np.int64)
        track[old] = self._ids[match[old]]
        track[new] = self.born + np.arange(len(new))
        self.born += len(new)
        self._ids = np.concatenate([self._ids, track[new]])
        self._place, self._spread = np.concatenate([self._place, p[new]]), np.concatenate([self._spread, cov[new]])
        self._seen = np.concatenate([self._seen, np.full(len(new), distance)])
        self._hits = np.concatenate([self._hits, np.ones(len(new))])
        return track

    def _keep_step(self, p: Array, cov: Array, var: Array, distance: float, at: Array) -> None:
        """Move the tracks with steps of dead reckoning that were off."""
        c, arm, off = self.config, p - at, np.clip(self._off, 1e-6, FARTHEST_OFF)
        if max(off[0], off[1], off[2] * float(np.abs(arm).max())) < c.floor or not len(self._ids):
            return
        turned = np.stack([-arm[:, 1], arm[:, 0]], axis=1)
        wide = cov + np.diag(off[:2] ** 2) + off[2] ** 2 * turned[:, :, None] * turned[:, None, :]
        pairs, _ = gated(p, wide, self._place, self._spread, distance - self._seen, c.floor, c.drift, c.gate)
        if len(pairs) < 2:
            return
        i, j = pairs[:, 0], pairs[:, 1]
        step = misstep(self._place[j] - p[i], arm[i], 2.0 * var[i] + c.floor**2, i, off, c.gate)
        if step is not None:
            to, back = planar(at[0] + step[0], at[1] + step[1], step[2]), planar(-at[0], -at[1], 0.0)
            self.held_T_odom = self.held_T_odom @ to @ back
            R = planar(0.0, 0.0, -step[2])[:2, :2]
            self._place = np.ascontiguousarray((self._place - at - step[:2]) @ R.T + at)
            self._off = np.zeros(3)


def assigned(pairs: NDArray[np.int64], cost: Array, rows: int, columns: int) -> NDArray[np.int64]:
    """Column (rows,) of each row, or -1: the cheapest assignment of as many as possible of the `pairs` (K, 2) with their `cost` (K,).

    Where a row and a column have nobody else, they are each other's; only the rest is a problem.
    """
    match = np.full(rows, -1, np.int64)
    i, j = pairs[:, 0], pairs[:, 1]
    alone = (np.bincount(i, minlength=rows)[i] == 1) & (np.bincount(j, minlength=columns)[j] == 1)
    match[i[alone]] = j[alone]
    if alone.all():
        return match
    i, j, cost = i[~alone], j[~alone], cost[~alone]
    r, a = np.unique(i, return_inverse=True)
    c, b = np.unique(j, return_inverse=True)
    table = np.full((len(r), len(c)), FAR)
    table[a, b] = cost
    a, b = linear_sum_assignment(table)
    near = table[a, b] < 0.1 * FAR
    match[r[a[near]]] = c[b[near]]
    return match


ABSORBED = 0.1
"""Of what dead reckoning has gone off, that tracks take up with each scan: they follow the newest sightings (`seen_again`'s gain)."""
FARTHEST_OFF = np.array([2.0, 2.0, 0.5])
"""m and rad beyond which a scan is not laid onto tracks: another tree would do as well."""
FAR = 1e6
"""Cost of a pair that is none."""


def follow(
    detections: Detections, motion: Motion, config: TreesConfig, noise: MotionConfig
) -> tuple[NDArray[np.int64], Array]:
    """Track (N,) of each detection, in the order of the scans, and `held_T_robot` (S, 4, 4): dead reckoning at the scans without the steps that the
    trunks say it did not do.
    """
    if not len(detections):
        return np.zeros(0, np.int64), motion.at(detections.stamps_ns)
    odom_T_robot = motion.at(detections.stamps_ns)
    distance = motion.distance_at(detections.stamps_ns).tolist()
    p = np.ascontiguousarray(transform(odom_T_robot[detections.scan], detections.p)[:, :2])
    R = odom_T_robot[detections.scan, :3, :3]
    cov = np.ascontiguousarray((R @ detections.cov @ np.swapaxes(R, 1, 2))[:, :2, :2])
    var = detections.sigma**2
    ends = np.searchsorted(detections.scan, np.arange(len(detections.stamps_ns) + 1)).tolist()
    at = odom_T_robot[:, :2, 3]
    sigma = motion.sigma(noise, detections.stamps_ns)
    along = np.maximum(sigma[:, 3], sigma[:, 4])
    off = np.concatenate([np.zeros((1, 3)), np.stack([along, along, sigma[:, 2]], axis=1)])
    tracker, track, held_T_odom = Tracker(config), [], []
    for a, b, d, *step in zip(ends[:-1], ends[1:], distance, at, off, strict=True):
        track.append(tracker.step(p[a:b], cov[a:b], var[a:b], d, *step))
        held_T_odom.append(tracker.held_T_odom)
    held = np.array(held_T_odom) @ odom_T_robot if motion.wheels else odom_T_robot
    return np.concatenate(track), held
