"""Closes loops: the trees around the robot now, laid as one rigid piece onto those mapped long ago.

Single nearest neighbours are not enough where dead reckoning has drifted by more than half a row. All recent trees
must fit together (joint compatibility, Neira & Tardós 2001), better than any other placement and better than not
being on old ground at all; otherwise the decision waits for more trees.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from topograph.geometry import Array, fit_rigid_2d, planar, transform
from topograph.motion import MotionConfig
from topograph.trees.detections import Detections
from topograph.trees.tracks import TreesConfig
from topograph.trunks.score import POST, TREE


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackTable:
    """Tracks as loop closing sees them; all (T,) unless stated.

    Attributes:
        place: (T, 2) mean position in the current map estimate, m; `foot` (T, 2) where its axis meets the ground.
        width: diameter, m, 0 unknown.
        post: mean log-odds of post against tree, of what was a column, 0 unknown.
        sigma: of `place`, m.
        first, last: distance driven at the first and last sighting, m.
        hits: sightings.
    """

    place: Array
    foot: Array
    width: Array
    post: Array
    sigma: Array
    first: Array
    last: Array
    hits: NDArray[np.int64]


class LoopCloser:
    """Walks along the run once; `advance` goes on until a loop moves the map, then waits for a new estimate.

    Attributes:
        tree: (T,) tree of each track; equal numbers are one tree.
        anchored: distance driven when old ground was last recognised, m.
        loops: loops closed so far.
        link: the last loop: distances driven when the old and the new piece were seen, the centre (2,) about which
            the new piece turns, and its move (x, y, yaw); see `moved_pose`.
    """

    def __init__(self, tracks: int, gyro: bool, config: TreesConfig, motion: MotionConfig) -> None:
        self.tree = np.arange(tracks)
        self.config, self.motion, self.gyro = config, motion, gyro
        self.at = 0.0
        self.anchored = 0.0
        self.loops = 0
        self.link: tuple[float, float, Array, Array] | None = None

    def drift(self, d: float) -> tuple[float, float]:
        """Standard deviations of position (m) and heading (rad) after `d` metres of dead reckoning."""
        yaw = (0.3 if self.gyro else 1.0) * self.motion.yaw_distance * np.sqrt(d) + 1e-3
        return float(np.hypot(2.0 * self.motion.along * d, yaw * d / np.sqrt(3)) + 0.05), float(yaw)

    def advance(self, table: TrackTable, end: float, cap: float) -> bool:
        """Go on towards distance `end`; True: a loop was closed that moves the estimate, solve before the next call.

        `cap` bounds the drift where GNSS holds the path, m.
        """
        while self.at < end:
            self.at += self.config.window
            if self._close(table, min(cap, 1e9)):
                return True
        return False

    def _close(self, t: TrackTable, cap: float) -> bool:
        c = self.config
        mature = (t.hits >= 3) & (t.first <= self.at)
        now = mature & (t.last > self.at - c.recent)
        if now.sum() < 2:
            return False
        recent_trees = np.unique(self.tree[now])
        is_recent = np.isin(self.tree, recent_trees)
        held = is_recent & mature & (t.last < self.at - 2 * c.recent)
        if held.any():
            self.anchored = self.at
        old = mature & ~is_recent & (t.last < self.at - c.recent)
        if not old.any():
            return False
        sigma, yaw_sigma = self.drift(max(self.at - self.anchored, c.window))
        if sigma > cap:
            sigma, yaw_sigma = cap, min(yaw_sigma, max(0.02, cap / 50.0))
        here, here_id, here_sigma = _centres(t, self.tree, now)
        there, there_id, there_sigma = _centres(t, self.tree, old)
        bend = min(0.5 * self.drift(0.5 * c.recent)[0], 0.3 * cap)  # the piece itself is not quite rigid
        weight = c.mapped * (1.0 - np.exp(-_hits(t, self.tree, now) / 6.0))
        result = lay(here, np.hypot(here_sigma, bend), there, there_sigma, sigma, yaw_sigma, c, weight)
        if result is None:
            return False
        pairs, moved, move, centre = result
        seen_again = np.isin(self.tree, there_id[[j for _, j in pairs]]) & old
        # A small step the solver takes by itself.
        self.link = (float(np.median(t.last[seen_again])), self.at, centre, move) if moved > 0.8 else None
        for i, j in pairs:
            self.tree[self.tree == here_id[i]] = there_id[j]
        self.anchored = self.at
        self.loops += 1
        return moved > 0.4


def moved_pose(pose: Array, centre: Array, move: Array) -> Array:
    """A pose (4, 4) turned about `centre` (2,) and shifted by `move` (x, y, yaw) in the plane."""
    out = planar(0.0, 0.0, move[2]) @ pose
    c, s = np.cos(move[2]), np.sin(move[2])
    arm = pose[:2, 3] - centre
    out[:2, 3] = np.array([c * arm[0] - s * arm[1], s * arm[0] + c * arm[1]]) + centre + move[:2]
    return np.asarray(out)


def _centres(
    t: TrackTable, tree: NDArray[np.int64], chosen: NDArray[np.bool_]
) -> tuple[Array, NDArray[np.int64], Array]:
    """Place (K, 2), id (K,) and sigma (K,) of the trees that the chosen tracks belong to."""
    ids, index = np.unique(tree[chosen], return_inverse=True)
    w = t.hits[chosen].astype(float)
    total = np.bincount(index, w)
    place = np.stack([np.bincount(index, w * t.place[chosen, k]) / total for k in range(2)], axis=1)
    return place, ids, np.bincount(index, w * t.sigma[chosen]) / total


def _hits(t: TrackTable, tree: NDArray[np.int64], chosen: NDArray[np.bool_]) -> Array:
    """Sightings (K,) of the trees that the chosen tracks belong to, in the order of `_centres`."""
    return np.bincount(np.unique(tree[chosen], return_inverse=True)[1], t.hits[chosen]).astype(float)


def lay(
    here: Array, here_sigma: Array, there: Array, there_sigma: Array, sigma: float, yaw_sigma: float, config: TreesConfig,
    mapped: Array,
) -> tuple[list[tuple[int, int]], float, Array, Array] | None:  # fmt: skip
    """Pairs (i, j) of recent (N, 2) and old (M, 2) trees that are one, how far `here` moves (m), the move (x, y, yaw) and
    the centre (2,) that it turns about; None: undecided.

    `mapped` (N,) is the chance of each recent tree to be in the map if this is old ground.
    """
    centre = here.mean(0)
    arm = float(np.sqrt(np.mean(np.sum((here - centre) ** 2, axis=1)))) + 1.0
    reach = 3.0 * sigma + 3.0 * yaw_sigma * arm + 1.0
    near = np.flatnonzero(cKDTree(here).query(there)[0] < reach)
    if len(near) == 0:
        return None
    target, target_sigma = there[near], there_sigma[near]
    # Where dead reckoning is better than the trees are apart, there is one place to try.
    moves = np.zeros((1, 3)) if sigma < 0.6 else _seeds(here, target, centre, sigma, yaw_sigma)
    tree = cKDTree(target)
    area = np.prod(np.ptp(np.concatenate([here, target]), axis=0) + 10.0)
    density = max(len(target) / area, 1e-4)
    scores = np.empty(len(moves))
    found: list[list[tuple[int, int]]] = []
    for k in range(len(moves)):
        moves[k], scores[k], pairs = _settle(
            moves[k], here, here_sigma, tree, target_sigma, centre, sigma, yaw_sigma, density, mapped
        )
        found.append(pairs)
    best = int(np.argmax(scores))
    if len(found[best]) == 0 or scores[best] < config.margin:
        return None
    corners = np.array([[0, 0], [arm, 0], [0, arm]]) + centre
    ends = np.stack([_apply(m, corners, centre) for m in moves])
    other = np.abs(ends - ends[best]).max(axis=(1, 2)) > 0.8
    rival = max(float(scores[other].max(initial=-np.inf)), 0.0)
    if scores[best] - rival < config.margin:
        return None
    moved = float(np.abs(_apply(moves[best], here, centre) - here).max())
    return [(i, int(near[j])) for i, j in found[best]], moved, moves[best], centre


def _apply(move: Array, points: Array, centre: Array) -> Array:
    c, s = np.cos(move[2]), np.sin(move[2])
    d = points - centre
    return np.asarray(np.stack([c * d[:, 0] - s * d[:, 1], s * d[:, 0] + c * d[:, 1]], axis=1) + centre + move[:2])


def _seeds(here: Array, there: Array, centre: Array, sigma: float, yaw_sigma: float, most: int = 600) -> Array:
    """Moves (K, 3): none, and those that lay a pair of recent trees onto a pair of old ones."""
    moves = [np.zeros(3)]
    n = len(here)
    d = np.linalg.norm(here[:, None] - here[None], axis=2)
    order = np.dstack(np.unravel_index(np.argsort(-d, axis=None), d.shape))[0]
    order = order[(order[:, 0] < order[:, 1])]
    useful = order[(d[order[:, 0], order[:, 1]] < 40.0)][:: max(1, len(order) // 24)][:24] if n > 1 else order[:0]
    between = np.linalg.norm(there[:, None] - there[None], axis=2)
    reach = 3.0 * sigma + 1.0
    for a, b in useful:
        length = d[a, b]
        ja, jb = np.nonzero(np.abs(between - length) < 0.25 + 0.01 * length)
        lever = 3.0 * yaw_sigma
        close = (np.linalg.norm(there[ja] - here[a], axis=1) < reach + lever * np.linalg.norm(here[a] - centre)) & (
            np.linalg.norm(there[jb] - here[b], axis=1) < reach + lever * np.linalg.norm(here[b] - centre)
        )
        for i, j in zip(ja[close].tolist(), jb[close].tolist(), strict=True):
            u, v = here[b] - here[a], there[j] - there[i]
            turn = float(np.arctan2(u[0] * v[1] - u[1] * v[0], u @ v))
            if abs(turn) > 3.0 * yaw_sigma + 0.3 / length:
                continue
            middle = 0.5 * (here[a] + here[b])
            c, s = np.cos(turn), np.sin(turn)
            m = middle - centre
            moved = np.array([c * m[0] - s * m[1], s * m[0] + c * m[1]]) + centre
            moves.append(np.array([*(0.5 * (there[i] + there[j]) - moved), turn]))
    out = np.array(moves)
    inside = np.linalg.norm(out[:, :2], axis=1) < reach
    out = out[inside]
    # Many pairs vote for the same place: keep one of each, the most voted first.
    if len(out) > 1:
        keys = np.round(out / [0.5, 0.5, 0.03]).astype(int)
        _, first, votes = np.unique(keys, axis=0, return_index=True, return_counts=True)
        out = np.concatenate([out[:1], out[first[np.argsort(-votes)][:most]]])
    return out


def _settle(
    move: Array, here: Array, here_sigma: Array, tree: cKDTree, there_sigma: Array, centre: Array, sigma: float,
    yaw_sigma: float, density: float, mapped: Array,
) -> tuple[Array, float, list[tuple[int, int]]]:  # fmt: skip
    """Refine a move by its own matches and weigh it: log-odds against clutter, and the prior of the drift."""
    pairs: list[tuple[int, int]] = []
    target = np.asarray(tree.data)
    for gate in (1.5, 0.8, 0.5):
        moved = _apply(move, here, centre)
        distance, j = _nearest(tree, moved, gate)
        pairs = _one_to_one(distance, j)
        if len(pairs) < 2:
            break
        i_, j_ = np.array(pairs).T
        x, y, turn = fit_rigid_2d(here[i_] - centre, target[j_] - centre)
        move = np.array([x, y, turn])
    moved = _apply(move, here, centre)
    distance, j = _nearest(tree, moved, 1.5)
    pairs = _one_to_one(distance, j)
    score = -0.5 * float(move[:2] @ move[:2]) / sigma**2 - 0.5 * float(move[2] / yaw_sigma) ** 2
    kept = []
    for i, k in pairs:
        variance = here_sigma[i] ** 2 + there_sigma[k] ** 2 + 0.1**2
        gain = np.log(mapped[i] / (2 * np.pi * variance * density)) - 0.5 * distance[i] ** 2 / variance
        if gain > np.log(1 - mapped[i]):
            score += gain - np.log(1 - mapped[i])
            kept.append((i, k))
    score += float(np.log(1 - mapped).sum())
    return move, score, kept


def _nearest(tree: cKDTree, points: Array, most: float) -> tuple[Array, NDArray[np.intp]]:
    distance, j = tree.query(points, distance_upper_bound=most)
    return np.asarray(distance, float), np.asarray(j, np.intp)


def _one_to_one(distance: Array, j: NDArray[np.intp]) -> list[tuple[int, int]]:
    taken: dict[int, int] = {}
    for i in np.argsort(distance).tolist():
        if np.isfinite(distance[i]) and int(j[i]) not in taken:
            taken[int(j[i])] = i
    return [(i, k) for k, i in taken.items()]


def tabulate(detections: Detections, track: NDArray[np.int64], map_T_scan: Array, distance: Array) -> TrackTable:
    """Table of tracks 0..T-1 from their detections, seen from map_T_scan (S, 4, 4) after `distance` (S,) driven, m."""
    d, n = detections, int(track.max(initial=-1)) + 1
    T, driven = map_T_scan[d.scan], distance[d.scan]
    xy = transform(T, d.p)[:, :2]
    above = np.where(np.isfinite(d.height), d.height, 0.0) / np.maximum(d.axis[:, 2], 0.3)
    foot = transform(T, d.p - above[:, None] * d.axis)[:, :2]
    hits = np.bincount(track, minlength=n)
    total = np.maximum(hits, 1)

    def mean(x: Array) -> Array:
        return np.asarray(np.bincount(track, x, minlength=n) / total)

    first, last = np.full(n, np.inf), np.full(n, -np.inf)
    np.minimum.at(first, track, driven)
    np.maximum.at(last, track, driven)
    return TrackTable(
        place=np.stack([mean(xy[:, k]) for k in range(2)], axis=1),
        foot=np.stack([mean(foot[:, k]) for k in range(2)], axis=1),
        width=mean(np.nan_to_num(d.diameter)),
        post=mean(d.believed * np.nan_to_num(d.kinds[:, POST] - d.kinds[:, TREE])),
        sigma=np.sqrt(mean(0.5 * (d.cov[:, 0, 0] + d.cov[:, 1, 1])) / np.sqrt(total)),
        first=first,
        last=last,
        hits=hits,
    )
