"""Follows trunks from scan to scan while dead reckoning is good: tracks, the pieces that trees are made of."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from topograph.geometry import Array, transform
from topograph.motion import Motion
from topograph.ranges import Chance, Count, NonNegative, Positive, Share
from topograph.trees.detections import Detections
from topograph.trees.gating import gated, seen_again


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

    A track's place follows the newest sightings, so that it drifts with dead reckoning and not against it. Tracks are named in the
    order of their birth; what has not been seen for `config.forget` m is forgotten.
    """

    def __init__(self, config: TreesConfig) -> None:
        self.config = config
        self.born = 0
        self._ids: NDArray[np.int64] = np.zeros(0, np.int64)
        self._place, self._spread = np.zeros((0, 2)), np.zeros((0, 2, 2))
        self._seen, self._hits = np.zeros(0), np.zeros(0)

    def step(self, p: Array, cov: Array, distance: float) -> NDArray[np.int64]:
        """Track (N,) of each trunk of one scan at `p` (N, 2) with `cov` (N, 2, 2), after `distance` m driven."""
        c = self.config
        keep = distance - self._seen < c.forget
        if not keep.all():
            self._ids, self._place, self._spread = self._ids[keep], self._place[keep], self._spread[keep]
            self._seen, self._hits = self._seen[keep], self._hits[keep]
        n = len(p)
        if n == 0:
            return np.zeros(0, np.int64)
        pairs, cost = gated(p, cov, self._place, self._spread, distance - self._seen, c.floor, c.drift, c.gate)
        match = assigned(pairs, cost, n, len(self._ids))
        seen_again(p, cov, match, self._place, self._spread, self._hits)
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


FAR = 1e6
"""Cost of a pair that is none."""


def follow(detections: Detections, motion: Motion, config: TreesConfig) -> NDArray[np.int64]:
    """Track (N,) of each detection, in the order of the scans."""
    if not len(detections):
        return np.zeros(0, np.int64)
    odom_T_robot = motion.at(detections.stamps_ns)
    distance = motion.distance_at(detections.stamps_ns).tolist()
    p = np.ascontiguousarray(transform(odom_T_robot[detections.scan], detections.p)[:, :2])
    cov = _planar_cov(detections, odom_T_robot)
    ends = np.searchsorted(detections.scan, np.arange(len(detections.stamps_ns) + 1)).tolist()
    tracker = Tracker(config)
    return np.concatenate(
        [tracker.step(p[a:b], cov[a:b], d) for a, b, d in zip(ends[:-1], ends[1:], distance, strict=True)]
    )


def _planar_cov(detections: Detections, odom_T_robot: Array) -> Array:
    R = odom_T_robot[detections.scan, :3, :3]
    return np.ascontiguousarray((R @ detections.cov @ np.swapaxes(R, 1, 2))[:, :2, :2])
