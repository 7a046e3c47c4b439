"""The one loop: associate <-> solve."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from topograph.estimate import Estimate, Link, Problem, graph, path_at
from topograph.geometry import Array, inverse, transform
from topograph.mapping.config import MappingConfig
from topograph.mapping.progress import Progress
from topograph.trees import (
    AtKeyframes,
    Closed,
    Existence,
    LoopCloser,
    Loops,
    Shapes,
    TrackTable,
    Way,
    deviation,
    drift,
    exists,
    feet,
    gather,
    moved_pose,
    refine,
    relevelled,
    shapes,
    tabulate,
)


@dataclass(frozen=True, slots=True)
class Decided:
    """Tree (N,) of each detection, the problem of the trees that exist with their own axes, what was decided of them, their
    shapes, and how many do not exist.
    """

    tree: NDArray[np.int64]
    problem: Problem
    existence: Existence
    shapes: Shapes
    rejected: int


class Association:
    """The state of associate <-> solve: tracks, their trees, and the problem that follows from them."""

    def __init__(self, problem: Problem, track: NDArray[np.int64], config: MappingConfig) -> None:
        self.problem, self.config = problem, config
        self.track = track
        self.seen = AtKeyframes.of(problem.detections, problem.stamps_ns, problem.motion)
        self.tracks = int(self.track.max(initial=-1)) + 1
        self.known = len(problem.known.p) if problem.known is not None else 0
        self.closer = LoopCloser(self.tracks + self.known, problem.motion, config.trees, config.motion)
        self.tree_of_track = self.closer.tree

    def poses(self, e: Estimate) -> Array:
        """map_T_scan (S, 4, 4)."""
        return path_at(e.stamps_ns, e.map_T_robot, self.problem.motion, self.problem.detections.stamps_ns)

    def table(self, map_T_scan: Array, *, settled: bool = False) -> TrackTable:
        """Tracks in the map as seen from map_T_scan (S, 4, 4), with their feet along their own axes where the path has `settled`; trees of an earlier
        map are tracks seen long ago."""
        d = self.problem.detections
        foot = feet(d, self.track, map_T_scan) if settled else None
        t = tabulate(d, self.track, map_T_scan, self.problem.motion.distance_at(d.stamps_ns), foot)
        k = self.problem.known
        if k is None:
            return t
        long_ago = np.full(self.known, -1e9)
        return TrackTable(
            place=np.concatenate([t.place, k.p[:, :2]]),
            foot=np.concatenate([t.foot, k.p[:, :2]]),
            width=np.concatenate([t.width, np.zeros(self.known)]),
            post=np.concatenate([t.post, np.zeros(self.known)]),
            sigma=np.concatenate([t.sigma, np.sqrt(0.5 * (k.cov[:, 0, 0] + k.cov[:, 1, 1]))]),
            first=np.concatenate([t.first, long_ago]),
            last=np.concatenate([t.last, long_ago]),
            hits=np.concatenate([t.hits, np.full(self.known, 1000)]),
            known=np.concatenate([t.known, np.ones(self.known, bool)]),
            single=np.concatenate([t.single, k.single]),
        )

    def way(self, e: Estimate) -> Way:
        """The path as estimated."""
        return Way.of(self.problem.motion.distance_at(e.stamps_ns), e.map_T_robot)

    def shut(self, e: Estimate) -> Estimate:
        """An estimate with the loop that was just closed."""
        loop = self.closer.closed
        if loop is None:
            return self.solve(e)
        motion = self.problem.motion
        start = loop.bent(motion.distance_at(e.stamps_ns), e.map_T_robot, motion, self.config.motion)
        return self.solve(replace(e, map_T_robot=start), link=_link(self.problem, e, loop))

    def solve(self, e: Estimate, *, least: int = 3, patient: bool = False, link: Link | None = None) -> Estimate:
        """An estimate without covariances of the trees as they are now; `patient`: until it has converged."""
        if link is not None:  # pull the loop shut with the trees as they were, then join them
            e = graph.quick(replace(self.problem, start=e.map_T_robot, link=link), self.config.estimate)
        tree, ids = self.trees(self.tree_of_track, least)
        self.problem = replace(self.of_trees(ids), sightings=self.seen.gather(tree), start=e.map_T_robot)
        return graph.quick(self.problem, self.config.estimate, patient=patient)

    def named(self, tree: NDArray[np.int64]) -> NDArray[np.int64]:
        """The trees of the tracks, called by the first of their tracks, or by the known tree that they are: a name lasts from pass to
        pass, whatever joins it later.
        """
        index = np.unique(tree, return_inverse=True)[1]
        order = np.roll(
            np.arange(len(tree)), self.known
        )  # known trees come last among the tracks, and first among the names
        first = np.full(int(index.max(initial=-1)) + 1, len(tree))
        np.minimum.at(first, index, order)
        return np.asarray(np.argsort(order)[first[index]])

    def decide(self, e: Estimate) -> Decided:
        """What there is, given an estimate."""
        c, d = self.config.trees, self.problem.detections
        map_T_scan = self.poses(e)
        self.tree_of_track = self.named(refine(self.table(map_T_scan, settled=True), self.tree_of_track, c))
        tree, ids = self.trees(self.tree_of_track, 1)
        seen = transform(map_T_scan[d.scan], d.p)
        count = np.maximum(np.bincount(tree, minlength=len(ids)), 1)
        places = np.stack([np.bincount(tree, seen[:, k], minlength=len(ids)) / count for k in range(3)], axis=1)
        found = exists(d, tree, map_T_scan, places, c)
        keep = np.zeros(int(self.tree_of_track.max(initial=-1)) + 1, bool)
        keep[ids[found.ok]] = True
        if self.problem.known is not None:  # what the map knows exists, however rarely this run saw it
            keep[self.tree_of_track[self.tracks :]] = True
        tree, final = self.trees(self.tree_of_track, 1, keep)
        problem = self.of_trees(final)
        shape = self.shapes(problem, tree, map_T_scan)
        own = relevelled(d, tree, map_T_scan, shape)
        sightings = gather(own, tree, problem.stamps_ns, problem.motion)
        problem = replace(problem, start=e.map_T_robot, detections=own, sightings=sightings)
        return Decided(tree, problem, found.select(np.searchsorted(ids, final)), shape, int((~found.ok).sum()))

    def shapes(self, problem: Problem, tree: NDArray[np.int64], map_T_scan: Array) -> Shapes:
        """Of the trees of a problem, seen from map_T_scan (S, 4, 4)."""
        # A known map states its trees at one height, whatever their stems.
        whole = None if problem.known is None else problem.known.tree[problem.known.tree >= 0]
        return shapes(self.problem.detections, tree, map_T_scan, problem.n_trees, whole)

    def trees(
        self, tree_of_track: NDArray[np.int64], least: int, keep: NDArray[np.bool_] | None = None
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Tree (N,) of each detection, -1 none, and the name (T,) of each tree, for trees of `least` detections."""
        tree = tree_of_track[self.track]
        size = int(tree_of_track.max(initial=-1)) + 1
        hits = np.bincount(tree, minlength=size)
        exists_ = hits >= max(least, 1)
        if keep is not None:
            exists_ &= keep
        ids = np.flatnonzero(exists_)
        return _row(ids, size)[tree], ids

    def of_trees(self, ids: NDArray[np.int64]) -> Problem:
        """The problem of the trees (T,) of these names, with sightings still of others."""
        p = self.problem
        known = p.known
        if known is not None:
            row = _row(ids, int(self.tree_of_track.max(initial=-1)) + 1)
            known = replace(known, tree=row[self.tree_of_track[self.tracks :]])
        return replace(p, n_trees=len(ids), tree_ids=ids, known=known)


def _row(ids: NDArray[np.int64], size: int) -> NDArray[np.int64]:
    """Where each of 0..size-1 stands among `ids`; -1 nowhere."""
    row = np.full(size, -1, np.int64)
    row[ids] = np.arange(len(ids))
    return row


def associate_and_solve(
    problem: Problem, track: NDArray[np.int64], guess: Array | None, config: MappingConfig, progress: Progress
) -> tuple[Decided, Estimate, Loops]:
    d = problem.detections
    estimate = graph.quick(problem, config.estimate)
    if not len(d):
        problem = replace(problem, start=estimate.map_T_robot)
        none = np.zeros(0, np.int64)
        nothing = exists(d, none, np.zeros((0, 4, 4)), np.zeros((0, 3)), config.trees)
        empty = Decided(none, problem, nothing, shapes(d, none, np.zeros((0, 4, 4)), 0), 0)
        return empty, replace(graph.solve(problem, config.estimate), tree=none), Loops()
    a = Association(problem, track, config)
    end = float(problem.motion.distance[-1])
    if guess is not None:
        estimate = a.solve(replace(estimate, map_T_robot=guess))
    cap = _gnss_cap(problem, a.way(estimate), config)
    while a.closer.advance(a.table(a.poses(estimate)), a.way(estimate), end, cap):
        progress("associate", min(1.0, a.closer.at / max(end, 1e-9)))
        a.tree_of_track = a.closer.tree
        estimate = a.shut(estimate)
    progress("associate", 1.0)
    a.tree_of_track = a.named(a.closer.tree)
    estimate = a.solve(estimate, patient=True)
    for n, patience in enumerate((4.0, 2.0, 1.0) if config.trees.reassociate else ()):
        progress("refine", n / 3)
        before = a.tree_of_track
        table = a.table(a.poses(estimate), settled=True)
        a.tree_of_track = a.named(refine(table, before, config.trees, patience))
        if not np.array_equal(a.tree_of_track, before):
            estimate = a.solve(estimate, patient=True)
    progress("solve", 0.0)
    del a.seen  # as large as the detections, and from here on each decision makes its own
    after = a.decide(estimate)
    earlier: list[Made] = []
    moving: graph.Moving | None = None
    for n in range(LAST_ROUNDS if config.trees.reassociate else 1):
        decided = after
        converged = graph.converge(decided.problem, config.estimate, moving)
        moving = converged.moving
        progress("solve", (n + 1) / LAST_ROUNDS)
        after = a.decide(converged.estimate)
        made, former = Made.of(after), Made.of(decided)
        rows = made.like(former)
        if rows is not None:
            if np.abs(made.slope[rows[0]] - former.slope[rows[1]]).max(initial=0.0) < SETTLED:
                break
        elif any(made.like(m) is not None for m in earlier):
            break  # a track goes to and fro between two trees, and would for ever
        earlier.append(former)
    del after
    estimate = replace(graph.finish(converged, config.estimate), tree=decided.tree)
    as_seen = a.shapes(decided.problem, decided.tree, a.poses(estimate))  # from the last path
    progress("solve", 1.0)
    return replace(decided, shapes=as_seen), estimate, a.closer.result


FLIPS = 1e-4
"""Share of the detections that may go to and fro between two trees: nothing moves by them."""


class Made(NamedTuple):
    """What a decision made: which trees (T,) are forked, their slopes (T, 2), and the tree (N,) of each detection, -1 none."""

    forked: NDArray[np.bool_]
    slope: Array
    tree: NDArray[np.int64]

    @staticmethod
    def of(decided: Decided) -> Made:
        return Made(decided.shapes.forked, decided.shapes.slope, decided.tree)

    def like(self, other: Made) -> NDArray[np.int64] | None:
        """Rows (2, M) of the trees that are one, where both made the same trees of the same detections, whatever they are called: a tree whose
        first track goes to another takes a new name. None where they did not.
        """
        if len(self.forked) != len(other.forked):
            return None
        size = len(other.forked) + 1
        key, count = np.unique((self.tree + 1) * size + other.tree + 1, return_counts=True)
        order = np.argsort(-count, kind="stable")
        mine, theirs, count = key[order] // size - 1, key[order] % size - 1, count[order]
        # Each tree and the one that has most of its detections; those are one where each is the other's, and nothing is one with nothing.
        mine_first, theirs_first = (np.unique(side, return_index=True)[1] for side in (mine, theirs))
        same = np.intersect1d(mine_first, theirs_first)
        same = same[(mine[same] < 0) == (theirs[same] < 0)]
        if int(count.sum() - count[same].sum()) > FLIPS * len(self.tree):
            return None
        same = same[mine[same] >= 0]
        rows = np.stack([mine[same], theirs[same]])
        return rows if np.array_equal(self.forked[rows[0]], other.forked[rows[1]]) else None


LAST_ROUNDS = 8
"""Association and solve go on until neither changes, the last solve included; at most so often."""
SETTLED = 0.01
"""Slopes of trees that change by less between two solves do not change what was solved, m/m."""


def _link(problem: Problem, estimate: Estimate, loop: Closed) -> Link | None:
    """The loop just closed as one relative pose: it pulls the path over distances at which robust losses let go."""
    distance = problem.motion.distance_at(problem.stamps_ns)
    a, b = (int(np.clip(np.searchsorted(distance, d), 0, len(distance) - 1)) for d in (loop.before, loop.now))
    if a == b:
        return None
    poses = estimate.map_T_robot
    return Link(a, b, inverse(poses[a]) @ moved_pose(poses[b], loop.centre, loop.move))


def _gnss_cap(problem: Problem, way: Way, config: MappingConfig) -> float:
    """How far the path may be off where GNSS holds it, m: a few of its deviations, and the drift of its longest gap."""
    f = problem.fixes
    if len(f.keyframe) < 3:
        return float("inf")
    at = problem.motion.distance_at(problem.stamps_ns)
    edges = np.concatenate([[at[0]], at[f.keyframe], [at[-1]]])
    sigma = float(np.sqrt(np.median(f.cov[:, 0, 0])))
    gap = int(np.argmax(np.diff(edges)))
    begin, end = edges[gap], 0.5 * (edges[gap] + edges[gap + 1])
    off = drift(way, begin, end, way.at(np.array([end]))[0, :2], problem.motion, config.motion)
    return max(0.5, 4.0 * sigma) + deviation(off)
