"""Closes loops: the trees around the robot now, laid as one piece onto those mapped long ago.

Single nearest neighbours are not enough where dead reckoning has drifted by more than half a row. The piece must fit better than at any
other place, and better than not being on old ground at all; otherwise the decision waits for more trees.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from topograph.geometry import Array, planar, transform, wrap
from topograph.motion import Motion, MotionConfig
from topograph.places import (
    Landmarks,
    PlacesConfig,
    Prior,
    build_index,
    irregularity,
    placements,
    search,
    spread,
)
from topograph.trees.detections import Detections
from topograph.trees.drift import Way, bent, bounded, deviation, drift
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
        known: a tree of an earlier map, and no track of this run; `single`: it is known to have one stem.
    """

    place: Array
    foot: Array
    width: Array
    post: Array
    sigma: Array
    first: Array
    last: Array
    hits: NDArray[np.int64]
    known: NDArray[np.bool_]
    single: NDArray[np.bool_]


@dataclass(frozen=True, slots=True, kw_only=True)
class Loops:
    """A run's loops.

    Attributes:
        closed: how many.
        slid: the largest move of one in a regular planting, in spacings.
    """

    closed: int = 0
    slid: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Closed:
    """A loop: what was seen `before` is seen again `now`; dead reckoning has gone astray `since` (distances driven, m). The new piece turns about
    `centre` (2,) and shifts by `move` (x, y, yaw)."""

    before: float
    since: float
    now: float
    centre: Array
    move: Array

    def bent(self, distance: Array, map_T_robot: Array, motion: Motion, noise: MotionConfig) -> Array:
        """Poses (K, 4, 4) after `distance` (K,) m with the loop shut: what went astray is spread over the way since."""
        way = Way.of(distance, map_T_robot)
        new = bent(way, self.since, self.now, self.centre, self.move, motion, noise)
        out = planar(0.0, 0.0, new.pose[:, 2] - way.pose[:, 2]) @ map_T_robot
        out[:, :2, 3] = new.pose[:, :2]
        return np.asarray(out)


class LoopCloser:
    """Walks along the run once; `advance` goes on until a loop moves the map, then waits for a new estimate.

    Attributes:
        tree: (T,) tree of each track; equal numbers are one tree.
        anchored: distance driven when old ground was last recognised, or in view, m.
        loops: loops closed so far; `slid`: the largest move of one in a regular planting, in spacings.
        closed: the last loop, None where it moved nothing by much.
    """

    def __init__(self, tracks: int, motion: Motion, config: TreesConfig, noise: MotionConfig) -> None:
        self.tree = np.arange(tracks)
        self.config, self.motion, self.noise = config, motion, noise
        self.at = 0.0
        self.anchored = 0.0
        self.loops = 0
        self.slid = 0.0
        self.closed: Closed | None = None

    def advance(self, table: TrackTable, way: Way, end: float, cap: float) -> bool:
        """Go on along the `way` towards distance `end`; True: a loop was closed that moves the estimate, solve before the next call.

        `cap` bounds the drift where GNSS holds the path, m.
        """
        while self.at < end:
            self.at += self.config.window
            if self._close(table, way, min(cap, 1e6)):
                return True
        return False

    def _close(self, t: TrackTable, way: Way, cap: float) -> bool:
        c = self.config
        mature = (t.hits >= 3) & (t.first <= self.at)
        now = mature & (t.last > self.at - c.recent)
        if now.sum() < 2:
            return False
        recent_trees = np.unique(self.tree[now])
        is_recent = np.isin(self.tree, recent_trees)
        known = np.unique(self.tree[is_recent & mature & (t.last < self.at - 2 * c.recent)])
        if len(np.intersect1d(known, self.tree[mature & (t.last > self.at - c.window)])) >= HOLDING:
            self.anchored = self.at
        old = mature & ~is_recent & (t.last < self.at - c.recent)
        if not old.any():
            return False
        here, there = _piece(t, self.tree, now, self.at - c.recent), _piece(t, self.tree, old)
        centre = here.place.mean(0)
        off = bounded(drift(way, min(self.anchored, self.at - c.window), self.at, centre, self.motion, self.noise), cap)
        # The piece itself is not quite rigid.
        within = drift(way, self.at - 0.5 * c.recent, self.at, centre, self.motion, self.noise)
        bend = min(0.5 * deviation(within), 0.3 * cap)
        weight = c.mapped * (1.0 - np.exp(-here.hits / 6.0))
        apart = np.abs(here.seen[:, None] - here.seen) / (0.5 * c.recent)
        here_cov = np.diag(here.sigma**2) + bend**2 * np.exp(-apart)
        found = recognise(here.place, here_cov, there.place, there.sigma, off, c.margin, weight)
        if found is None:
            return False
        seen_again = np.isin(self.tree, there.ids[[j for _, j in found.pairs]]) & old
        self.closed = None  # a small step the solver takes by itself
        if found.moved > 0.8:
            before = float(np.median(t.last[seen_again]))
            since = min(max(self.anchored, before), self.at - c.window)
            self.closed = Closed(before=before, since=since, now=self.at, centre=found.centre, move=found.move)
        for i, j in found.pairs:
            self.tree[self.tree == here.ids[i]] = there.ids[j]
        self.anchored = self.at
        self.loops += 1
        self.slid = max(self.slid, found.slid)
        return found.moved > 0.4

    @property
    def result(self) -> Loops:
        """What became of it."""
        return Loops(closed=self.loops, slid=self.slid)


def moved_pose(pose: Array, centre: Array, move: Array) -> Array:
    """A pose (4, 4) turned about `centre` (2,) and shifted by `move` (x, y, yaw) in the plane."""
    out = planar(0.0, 0.0, move[2]) @ pose
    c, s = np.cos(move[2]), np.sin(move[2])
    arm = pose[:2, 3] - centre
    out[:2, 3] = np.array([c * arm[0] - s * arm[1], s * arm[0] + c * arm[1]]) + centre + move[:2]
    return np.asarray(out)


class _Piece(NamedTuple):
    """Trees as their tracks have them: `place` (K, 2), `ids` (K,), `sigma` (K,) m, `hits` (K,) sightings, `seen` (K,) the middle of when they were, m driven."""

    place: Array
    ids: NDArray[np.int64]
    sigma: Array
    hits: Array
    seen: Array


def _piece(t: TrackTable, tree: NDArray[np.int64], chosen: NDArray[np.bool_], since: float = -np.inf) -> _Piece:
    """The trees that the chosen tracks belong to, their means by sightings; what was seen earlier counts as seen `since`."""
    ids, index = np.unique(tree[chosen], return_inverse=True)
    w = t.hits[chosen].astype(float)
    total = np.bincount(index, w)

    def mean(x: Array) -> Array:
        return np.asarray(np.bincount(index, w * x[chosen]) / total)

    place = np.stack([mean(t.place[:, k]) for k in range(2)], axis=1)
    return _Piece(
        place, ids, mean(t.sigma), np.asarray(total, float), mean(np.maximum(0.5 * (t.first + t.last), since))
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Recognised:
    """Old ground: `pairs` (i, j) of recent and old trees that are one, the `move` (x, y, yaw) of the recent ones about their `centre` (2,), and how far it moves
    one of them at most (`moved`, m); `slid` its shift in spacings where the planting is regular, else 0: what turns by as much fits another row no better."""

    pairs: list[tuple[int, int]]
    move: Array
    centre: Array
    moved: float
    slid: float


PLACES = PlacesConfig(
    map_sigma=0.1, anchors=1e-3, bound=25.0, modes=60, felled=0.04, scales=(1.0, 1.5, 2.2), scale_prior=(0.9, 0.07, 0.03)
)  # fmt: skip
"""Trees of a map that is still being made lie 0.1 m beside their place, more where it is bent."""
RIVAL = 1.5
"""Of the margin over new ground, that over another place on old ground: a wrong row bends the map, and wheels may be worse than they are said to be."""
HOLDING = 3
"""Trees of old ground that are in view hold the path: fewer leave its heading open."""
AROUND, SHOWN = 2.0, 0.5
"""m about a recent tree where an old one would have been seen again, and the chance of that."""
SAFE = 0.25
"""Of the spacing: what dead reckoning knows to this is the same tree, however regular the planting."""
ENOUGH = 9
"""Trees from which the planting's irregularity is measured."""
STRAYED = 30.0
"""Squared Mahalanobis distance from where dead reckoning and GNSS have it (3 dof; by chance once in a million): however well a lattice fits there, it is
another place. A vineyard driven with RTK was laid onto itself three vines further on. (Where trees stand at random, wheels that are worse than they are said to
be are likelier than a chance fit.)"""
REGULAR = 1.0
"""Squares of the jitter, in variances of where trees are, below which a lattice looks the same from every row: a row beside costs twice that per tree, in nats."""
SCATTERED = 5
"""Sightings from which a track's scatter tells its noise."""
PAIR = 25.0
"""Longest pair of trees that a search begins with, m."""
APART = 0.8
"""Placements that put a corner of the piece further from each other are rivals, m."""


def recognise(
    here: Array, here_cov: Array, there: Array, there_sigma: Array, off: Array, margin: float, mapped: Array
) -> Recognised | None:  # fmt: skip
    """Are the trees `here` (N, 2) among those `there` (M, 2), given how far dead reckoning may be `off` (3, 3)? None: no, or undecided.

    `here_cov` (N, N) is joint, per axis: the piece is not quite rigid, what was seen together hangs together. `mapped` (N,) is the chance of each recent
    tree to be in the map if this is old ground. The place search proposes; what the drift makes of it, how it compares
    with new ground, where all trees are new, is decided here, by `margin` nats; against its rivals by `RIVAL` times that.
    """
    centre = here.mean(0)
    arm = float(np.sqrt(np.mean(np.sum((here - centre) ** 2, axis=1)))) + 1.0
    reach = 3.0 * deviation(off) + 3.0 * float(np.sqrt(off[2, 2])) * arm + 1.0
    apart = np.asarray(cKDTree(here).query(there)[0])
    near = np.flatnonzero(apart < reach)
    if len(near) < 2:
        return None
    # How regular the planting is, few trees cannot tell.
    most, their = (there, there_sigma**2) if len(there) >= ENOUGH else (here, np.diag(here_cov))
    jitter, gap = irregularity(most, their + PLACES.map_sigma**2)
    nan = np.full(len(near), np.nan)
    index = build_index(there[near], there_sigma[near] ** 2, nan, PAIR, PAIR, PLACES.map_sigma, jitter)
    unknown = np.full(len(here), np.nan)
    area = float(np.prod(np.ptp(np.concatenate([here, there[near]]), axis=0) + 10.0))
    density = max(len(near) / area, 1e-4)  # of things, trees or not, that turn up anywhere
    cov = np.asarray(np.kron(here_cov, np.eye(2)), float)
    marks = Landmarks(
        m=here - centre, cov=cov, var=spread(here - centre, cov), diameter=unknown, diameter_var=unknown,
        tree=np.log(mapped / SHOWN), other=np.log((1.0 - mapped) * density), lasting=mapped,
    )  # fmt: skip
    # In a lattice a new tree stands where one of another place stands: to fit more trees there tells little.
    variance = float(np.median(marks.var) + np.median(there_sigma[near] ** 2)) + PLACES.map_sigma**2
    alike = max(0.0, float(np.log(np.median(mapped) / (2 * np.pi * (variance + 2.0 * jitter**2)) / density)))
    prior = Prior(np.array([*centre, 0.0]), np.ascontiguousarray(off[:2, :2]), float(np.sqrt(off[2, 2])))
    found = search(replace(marks, tree=marks.tree - alike), index, PLACES, prior)
    tried = np.concatenate([[[*centre, 0.0]], found.pose])  # dead reckoning's own place too
    placed = placements(tried, marks, *_looked_at(marks.m), index, PLACES)
    if not len(placed):
        return None
    # Integrated over the pose: a normal of what the trees leave open and of the drift.
    away = placed.pose - [*centre, 0.0]
    away[:, 2] = wrap(away[:, 2])
    total = off + _in_map(np.asarray(np.linalg.inv(placed.information)), placed.pose[:, 2])
    strayed = np.einsum("mi,mij,mj->m", away, np.linalg.inv(total), away)
    log = placed.log - 0.5 * strayed - 0.5 * np.linalg.slogdet(2 * np.pi * total)[1]
    among = log - alike * (placed.tree >= 0).sum(axis=1)
    best = int(np.argmax(among))
    corners = np.array([[0, 0], [arm, 0], [0, arm]])
    ends = np.stack([_moved(pose, corners) for pose in placed.pose])
    rivals = among[np.abs(ends - ends[best]).max(axis=(1, 2)) > APART]
    rest = among[best] + found.loss[0] - found.loss[-1] + np.log(found.rest) if found.rest > 0 else -np.inf
    new_ground = float(len(here) * np.log(density))
    beyond = -np.inf
    if deviation(off) + arm * np.sqrt(off[2, 2]) > SAFE * gap:  # else what lies on each other is the same tree
        beside = int((apart[near] < AROUND).sum())
        beyond = float(marks.other.sum()) + beside * np.log(1.0 - SHOWN)
    surer = float(among[best] - np.logaddexp.reduce([*rivals, rest, beyond]))
    regular = jitter**2 < REGULAR * variance
    if log[best] - new_ground < margin or surer < RIVAL * margin or (regular and strayed[best] > STRAYED):
        return None
    move = off @ np.linalg.solve(total[best], away[best])  # as far as the drift allows
    moved = float(np.abs(_moved(move, here - centre) - (here - centre)).max())
    rows = np.flatnonzero(placed.tree[best] >= 0)
    pairs = [(int(i), int(near[placed.tree[best, i]])) for i in rows]
    slid = float(np.hypot(*move[:2])) / gap if regular else 0.0
    return Recognised(pairs=pairs, move=move, centre=centre, moved=moved, slid=slid)


def _in_map(cov: Array, yaw: Array) -> Array:
    """Covariances (M, 3, 3) of poses in their own frames, turned into the map's."""
    R = planar(0.0, 0.0, yaw)[:, :3, :3]  # the third is the yaw, which stays
    return np.asarray(R @ cov @ R.swapaxes(1, 2))


def _moved(pose: Array, points: Array) -> Array:
    """Points (N, 2) turned and shifted by a pose (3,) x, y, yaw."""
    return np.asarray(points @ planar(*pose)[:2, :2].T + pose[:2])


def _looked_at(m: Array) -> tuple[Array, Array]:
    """Raster of looks (X, Y) and its origin (2,), as `places.placements` takes them: around the recent trees old ones would have been seen."""
    low = np.floor(m.min(0) - AROUND - 1.0)
    shape = np.ceil(m.max(0) + AROUND + 1.0 - low).astype(int)
    x, y = np.meshgrid(low[0] + np.arange(shape[0]) + 0.5, low[1] + np.arange(shape[1]) + 0.5, indexing="ij")
    away, _ = cKDTree(m).query(np.stack([x.ravel(), y.ravel()], axis=1))
    looks = -np.log(1.0 - SHOWN / (1.0 - PLACES.felled))
    return np.where(np.asarray(away).reshape(x.shape) < AROUND, looks, 0.0), low


def tabulate(
    detections: Detections, track: NDArray[np.int64], map_T_scan: Array, distance: Array, foot: Array | None = None
) -> TrackTable:
    """Table of tracks 0..T-1 from their detections, seen from map_T_scan (S, 4, 4) after `distance` (S,) driven, m. `foot` (N, 2) in the map where
    something better is known than each scan's own axis tells.
    """
    d, n = detections, int(track.max(initial=-1)) + 1
    T, driven = map_T_scan[d.scan], distance[d.scan]
    xy = transform(T, d.p)[:, :2]
    if foot is None:
        above = np.where(np.isfinite(d.height), d.height, 0.0) / np.maximum(d.axis[:, 2], 0.3)
        foot = transform(T, d.p - above[:, None] * d.axis)[:, :2]
    hits = np.bincount(track, minlength=n)
    total = np.maximum(hits, 1)

    def mean(x: Array) -> Array:
        return np.asarray(np.bincount(track, x, minlength=n) / total)

    place = np.stack([mean(xy[:, k]) for k in range(2)], axis=1)
    # The noise of recorded detections is a guess (they tell no kinds either); the track's own scatter is none.
    scatter = mean(0.5 * np.sum((xy - place[track]) ** 2, axis=1)) * total / np.maximum(total - 1, 1)
    guessed = (mean(np.isnan(d.kinds[:, TREE]).astype(float)) > 0.5) & (total >= SCATTERED)
    variance = np.maximum(mean(d.sigma**2), np.where(guessed, scatter, 0.0))
    first, last = np.full(n, np.inf), np.full(n, -np.inf)
    np.minimum.at(first, track, driven)
    np.maximum.at(last, track, driven)
    return TrackTable(
        place=place,
        foot=np.stack([mean(foot[:, k]) for k in range(2)], axis=1),
        width=mean(np.nan_to_num(d.diameter)),
        post=mean(d.believed * np.nan_to_num(d.kinds[:, POST] - d.kinds[:, TREE])),
        sigma=np.sqrt(variance / np.sqrt(total)),
        first=first,
        last=last,
        hits=hits,
        known=np.zeros(n, bool),
        single=np.zeros(n, bool),
    )
