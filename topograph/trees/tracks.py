"""Follows trunks from scan to scan while dead reckoning is good: tracks, the pieces that trees are made of."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from topograph.geometry import Array, transform
from topograph.motion import Motion
from topograph.trees.detections import Detections


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
        margin: log-odds by which a loop must beat its rivals and the absence of a loop.
        merge: two trees nearer than this are one (stems of one tree), m.
        min_sightings, min_ratio: of a tree that exists; ratio of sightings to scans that should show it (recorded detections);
        passed: scans that saw through its place, for each that saw it, that a tree survives;
        usual_score: share of the run's median score of trees that is enough (less existence.DOUBTFUL);
        min_share: of the sightings that trees of the same run have at the median.
    """

    gate: float = 11.8
    floor: float = 0.06
    drift: float = 0.03
    forget: float = 8.0
    window: float = 4.0
    recent: float = 25.0
    mapped: float = 0.6
    margin: float = 7.0
    merge: float = 0.5
    min_sightings: int = 6
    min_ratio: float = 0.15
    passed: float = 0.1
    usual_score: float = 0.27
    min_share: float = 0.03


def follow(detections: Detections, motion: Motion, config: TreesConfig) -> NDArray[np.int64]:
    """Track (N,) of each detection, by gated optimal assignment in the odometry frame.

    A track's place follows the newest sightings, so that it drifts with dead reckoning and not against it.
    """
    odom_T_robot = motion.at(detections.stamps_ns)
    distance = motion.distance_at(detections.stamps_ns)
    p = transform(odom_T_robot[detections.scan], detections.p)[:, :2] if len(detections) else np.zeros((0, 2))
    cov = _planar_cov(detections, odom_T_robot)
    track = np.full(len(detections), -1, np.int64)
    ends = np.searchsorted(detections.scan, np.arange(len(detections.stamps_ns) + 1))
    ids: NDArray[np.int64] = np.zeros(0, np.int64)
    place, spread = np.zeros((0, 2)), np.zeros((0, 2, 2))
    seen, hits = np.zeros(0), np.zeros(0)
    born = 0
    for s in range(len(detections.stamps_ns)):
        here = slice(ends[s], ends[s + 1])
        n = ends[s + 1] - ends[s]
        keep = distance[s] - seen < config.forget
        ids, place, spread, seen, hits = ids[keep], place[keep], spread[keep], seen[keep], hits[keep]
        if n == 0:
            continue
        match = _match(p[here], cov[here], place, spread, distance[s] - seen, config)
        for i, j in match:
            k = ends[s] + i
            gain = max(1.0 / (hits[j] + 1), 0.1)
            place[j] += gain * (p[k] - place[j])
            spread[j] = (1 - gain) * spread[j] + gain * gain * cov[k]
            seen[j] = distance[s]
            hits[j] += 1
            track[k] = ids[j]
        new = np.flatnonzero(track[here] < 0) + ends[s]
        track[new] = born + np.arange(len(new))
        born += len(new)
        ids = np.concatenate([ids, track[new]])
        place, spread = np.concatenate([place, p[new]]), np.concatenate([spread, cov[new]])
        seen, hits = (
            np.concatenate([seen, np.full(len(new), distance[s])]),
            np.concatenate([hits, np.ones(len(new))]),
        )
    return track


def _planar_cov(detections: Detections, odom_T_robot: Array) -> Array:
    if not len(detections):
        return np.zeros((0, 2, 2))
    R = odom_T_robot[detections.scan, :3, :3]
    return np.asarray((R @ detections.cov @ np.swapaxes(R, 1, 2))[:, :2, :2])


def _match(
    p: Array, cov: Array, place: Array, spread: Array, since: Array, config: TreesConfig
) -> list[tuple[int, int]]:
    if len(place) == 0:
        return []
    d = p[:, None] - place[None]
    slack = config.floor**2 + (config.drift * since) ** 2
    S = cov[:, None] + spread[None] + slack[None, :, None, None] * np.eye(2)
    det = S[..., 0, 0] * S[..., 1, 1] - S[..., 0, 1] ** 2
    m2 = (
        d[..., 0] ** 2 * S[..., 1, 1] - 2 * d[..., 0] * d[..., 1] * S[..., 0, 1] + d[..., 1] ** 2 * S[..., 0, 0]
    ) / np.maximum(det, 1e-12)
    cost = np.minimum(m2 + np.log(np.maximum(det, 1e-12)), 1e3)
    cost[m2 > config.gate] = 1e6
    rows, columns = linear_sum_assignment(cost)
    return [(int(i), int(j)) for i, j in zip(rows, columns, strict=True) if cost[i, j] < 1e5]
