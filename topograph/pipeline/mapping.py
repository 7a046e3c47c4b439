"""Straight lines from a run to a map, and the one loop: associate <-> solve."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from topograph.config import Config
from topograph.errors import InsufficientDataError
from topograph.estimate import Estimate, KnownTrees, Link, Problem, average, graph, path_at
from topograph.estimate.assemble import assemble, choose_datum, without_wrong_headings
from topograph.evaluate import Metric, fix_metrics
from topograph.geometry import Array, inverse, transform
from topograph.motion import Motion, align_imu, dead_reckon, in_radians, without_nonsense
from topograph.pipeline.placing import Placed, put
from topograph.pipeline.read import Progress, silent
from topograph.session import Session, Streams
from topograph.topomap import SessionRecord, TopoMap, build, merge
from topograph.trees import (
    AtKeyframes,
    Detections,
    Existence,
    LoopCloser,
    Shapes,
    TrackTable,
    choose_keyframes,
    exists,
    follow,
    gather,
    in_order,
    moved_pose,
    refine,
    relevelled,
    screen,
    seen_through,
    shapes,
    tabulate,
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Solved:
    """A run's problem and its estimate, with the associations they rest on.

    Attributes:
        tree: (N,) tree of each detection (-1: none), numbered as in the estimate.
        existence, shapes: of the trees, (T,) rows.
        problem, estimate, motion, detections, run: the products on the way.
        streams: the small streams as they were used: without nonsense, clocks set right.
        moving: share of the detections that were of things that moved or rode along.
        held_out: (H,) indices of the fixes withheld from the estimator.
        rejected: trees that did not exist.
        loops: loops closed.
    """

    run: Session
    streams: Streams
    motion: Motion
    detections: Detections
    problem: Problem
    estimate: Estimate
    tree: NDArray[np.int64]
    existence: Existence
    shapes: Shapes
    held_out: NDArray[np.int64]
    rejected: int
    loops: int
    moving: float
    seconds: dict[str, float]


def solve_run(
    run: Session,
    config: Config,
    *,
    check_fixes: int = 0,
    known: TopoMap | None = None,
    placed: Placed | None = None,
    progress: Progress = silent,
) -> Solved:
    """Associate and solve. Every `check_fixes`-th fix is withheld from the estimator and kept for checking.

    With a `known` map the run is put into its frame, by GNSS or where it was `placed` in it, and its trees are landmarks with
    their covariances.

    Raises:
        InsufficientDataError: neither motion nor fixes; or a known map and no common frame.
    """
    began = time.perf_counter()
    notes, skipped = run.notes, run.skipped
    streams, said = in_radians(run.streams)
    streams = without_nonsense(streams, skipped)
    notes += said
    inertial = None
    if "imu" in run.mounts:
        inertial, streams, said = align_imu(streams, run.mounts["imu"])
        notes += said
    antenna, baseline = (_or(run.mounts.get(k), np.eye(4)) for k in ("fix", "heading"))
    motion = dead_reckon(streams, inertial, run.child_T_robot, config.motion, antenna[:3, 3])
    if motion is None:
        raise InsufficientDataError(
            "no wheel odometry and fewer than ten usable fixes: the distance between scans is unknown; "
            "name them with --topic-odometry or --topic-fix"
        )
    if not motion.wheels:
        notes.append("no wheel odometry: the motion between poses rests on GNSS fixes, IMU and trunks")
    notes += _wheel_notes(motion)
    if not motion.gyro:
        notes.append("no IMU: turns rest on the wheels, the slope on GNSS and trunks")
    detections, track, moving = _screened(_covered(Detections.of(run.trunks), motion, notes), motion, config, notes)
    n_fix = len(run.streams.fix_ns)
    used = np.ones(n_fix, bool)
    if check_fixes > 0:
        used[check_fixes - 1 :: check_fixes] = False
    if check_fixes == 1:
        used[:] = False
    datum = choose_datum(run.streams, used)
    if known is not None and placed is None:
        if known.datum is None or datum is None:
            raise InsufficientDataError(
                "a map is extended in its own frame: the run has no GNSS in common with it, and was not placed in it"
            )
        datum = known.datum
    keyframes = _keyframes(detections, motion, config)
    problem = assemble(
        keyframes, motion, config.motion, inertial, streams, used, antenna, baseline, datum, detections,
        config.estimate, skipped,
    )  # fmt: skip
    if known is not None and placed is not None:
        problem = put(problem, placed, known)
        notes.append(
            f"no GNSS in common with the map: the run was found in it by its trees, at {len(placed.stamps_ns)} places"
        )
    elif problem.datum is None:
        if known is not None:
            raise InsufficientDataError("too few GNSS fixes fall into the run to put it into the map's frame")
        notes.append("no usable GNSS fixes: the map is not georeferenced")
    problem, said = without_wrong_headings(problem)
    notes += said
    if known is not None:
        problem = replace(problem, known=_known_trees(known, detections))
    seconds = {"read": run.seconds}
    decided, estimate, loops = _associate_and_solve(problem, track, config, progress)
    problem = decided.problem
    seconds["associate and solve"] = time.perf_counter() - began
    return Solved(
        run=run,
        streams=streams,
        motion=motion,
        detections=problem.detections,
        problem=problem,
        estimate=estimate,
        tree=decided.tree,
        existence=decided.existence,
        shapes=decided.shapes,
        held_out=np.flatnonzero(~used),
        rejected=decided.rejected,
        loops=loops,
        moving=moving,
        seconds=seconds,
    )


def _wheel_notes(motion: Motion) -> list[str]:
    out = []
    if motion.wheel_scale != 1.0:
        off = 100 * (1 / motion.wheel_scale - 1)
        word = "overstate" if off > 0 else "understate"
        out.append(f"wheels {word} distances by {abs(off):.0f} % against the fixes: corrected (calibrate their radius)")
    for begin, end, speed in motion.slips[:5].tolist():
        out.append(
            f"wheels slipped or were blocked from {begin:.1f} to {end:.1f} s (off by {-speed:+.2f} m/s): "
            "the fixes' speed stands in"
        )
    if len(motion.slips) > 5:
        out.append(f"wheels slipped {len(motion.slips) - 5} more times")
    return out


OUTSIDE_NS = 300_000_000
"""Dead reckoning is not drawn out for longer: poses outside of it would be invented."""


def _covered(detections: Detections, motion: Motion, notes: list[str]) -> Detections:
    """The detections without those of scans that dead reckoning does not reach."""
    ns = detections.stamps_ns
    if not len(ns):
        return detections
    outside = (ns < motion.stamps_ns[0] - OUTSIDE_NS) | (ns > motion.stamps_ns[-1] + OUTSIDE_NS)
    if not outside.any():
        return detections
    begin, end = ((s - ns[0]) * 1e-9 for s in (motion.stamps_ns[0], motion.stamps_ns[-1]))
    what = "wheel odometry" if motion.wheels else "GNSS"
    notes.append(
        f"{int(outside.sum())} of {len(ns)} scans were left out: {what} covers only {max(begin, 0):.0f} to {end:.0f} s of the run"
    )
    return detections.select(~outside[detections.scan])


def _screened(
    detections: Detections, motion: Motion, config: Config, notes: list[str]
) -> tuple[Detections, NDArray[np.int64], float]:
    """The detections that may be of landmarks, their tracks, numbered without gaps, and the share of all that moved."""
    track = follow(detections, motion, config.trees)
    screened = screen(detections, track, motion)
    if screened.moved:
        notes.append(f"{screened.moved} things that moved, or rode along with the robot, were left out")
    keep = screened.keep
    tracks = np.unique(track[keep], return_inverse=True)[1].astype(np.int64)
    return detections.select(keep), tracks, screened.moving


def _known_trees(topo: TopoMap, detections: Detections) -> KnownTrees:
    """A map's trees as landmarks: on their axes, at the height where the detections state theirs."""
    above = detections.height[np.isfinite(detections.height)]
    height = float(np.median(above)) if len(above) else 0.0
    p = topo.p + topo.axis * (height / np.maximum(topo.axis[:, 2:], 0.3))
    cov = np.where(np.isfinite(topo.cov), topo.cov, 0.0)
    cov[:, [0, 1, 2], [0, 1, 2]] = np.maximum(cov[:, [0, 1, 2], [0, 1, 2]], 1e-5)
    return KnownTrees(p, cov, np.full(len(p), -1, np.int64))


def _or(pose: Array | None, other: Array) -> Array:
    return other if pose is None else pose


def _keyframes(detections: Detections, motion: Motion, config: Config) -> NDArray[np.int64]:
    c = config.estimate
    stamps = detections.stamps_ns
    inside = (stamps >= motion.stamps_ns[0] - 200_000_000) & (stamps <= motion.stamps_ns[-1] + 200_000_000)
    if inside.sum() < 2:
        stamps = motion.stamps_ns
    else:
        stamps = np.unique(np.concatenate([stamps[inside], motion.stamps_ns[[0, -1]]]))
    return stamps[choose_keyframes(motion, stamps, c.keyframe_distance, c.keyframe_turn, c.keyframe_seconds)]


@dataclass(frozen=True, slots=True)
class _Decided:
    """Tree (N,) of each detection, the problem of the trees that exist with their own axes, what was decided of them, their
    shapes, and how many do not exist.
    """

    tree: NDArray[np.int64]
    problem: Problem
    existence: Existence
    shapes: Shapes
    rejected: int


class _Association:
    """The state of associate <-> solve: tracks, their trees, and the problem that follows from them."""

    def __init__(self, problem: Problem, track: NDArray[np.int64], config: Config) -> None:
        self.problem, self.config = problem, config
        self.track = track
        self.seen = AtKeyframes.of(problem.detections, problem.stamps_ns, problem.motion)
        self.tracks = int(self.track.max(initial=-1)) + 1
        self.known = len(problem.known.p) if problem.known is not None else 0
        self.closer = LoopCloser(self.tracks + self.known, problem.motion.gyro, config.trees, config.motion)
        self.tree_of_track = self.closer.tree

    def poses(self, e: Estimate) -> Array:
        """map_T_scan (S, 4, 4)."""
        return path_at(e.stamps_ns, e.map_T_robot, self.problem.motion, self.problem.detections.stamps_ns)

    def table(self, e: Estimate) -> TrackTable:
        """Tracks in the map as estimated; trees of an earlier map are tracks seen long ago."""
        d = self.problem.detections
        t = tabulate(d, self.track, self.poses(e), self.problem.motion.distance_at(d.stamps_ns))
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
        )

    def solve(self, e: Estimate, *, least: int = 3, patient: bool = False, link: Link | None = None) -> Estimate:
        """An estimate without covariances of the trees as they are now; `patient`: until it has converged."""
        if link is not None:  # pull the loop shut with the trees as they were, then join them
            e = graph.solve(
                replace(self.problem, start=e.map_T_robot, link=link),
                self.config.estimate,
                quick=True,
                patient=True,
            )
        self.problem, _, _ = self.with_trees(self.tree_of_track, least)
        self.problem = replace(self.problem, start=e.map_T_robot)
        return graph.solve(self.problem, self.config.estimate, quick=True, patient=patient)

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

    def decide(self, e: Estimate) -> _Decided:
        """What there is, given an estimate."""
        c, d = self.config.trees, self.problem.detections
        t = self.table(e)
        self.tree_of_track = self.named(refine(t, self.tree_of_track, c))
        map_T_scan = self.poses(e)
        _, tree, ids = self.with_trees(self.tree_of_track, 1)
        seen = transform(map_T_scan[d.scan], d.p)
        count = np.maximum(np.bincount(tree, minlength=len(ids)), 1)
        places = np.stack([np.bincount(tree, seen[:, k], minlength=len(ids)) / count for k in range(3)], axis=1)
        found = exists(d, tree, map_T_scan, places, c)
        keep = np.zeros(int(self.tree_of_track.max(initial=-1)) + 1, bool)
        keep[ids[found.ok]] = True
        if self.problem.known is not None:  # what the map knows exists, however rarely this run saw it
            keep[self.tree_of_track[self.tracks :]] = True
        problem, tree, final = self.with_trees(self.tree_of_track, 1, keep)
        # A known map states its trees at one height, whatever their stems.
        whole = None if problem.known is None else problem.known.tree[problem.known.tree >= 0]
        shape = shapes(d, tree, map_T_scan, len(final), whole)
        own = relevelled(d, tree, map_T_scan, shape)
        sightings = gather(own, tree, problem.stamps_ns, problem.motion)
        problem = replace(problem, start=e.map_T_robot, detections=own, sightings=sightings)
        return _Decided(tree, problem, found.select(np.searchsorted(ids, final)), shape, int((~found.ok).sum()))

    def with_trees(
        self, tree_of_track: NDArray[np.int64], least: int, keep: NDArray[np.bool_] | None = None
    ) -> tuple[Problem, NDArray[np.int64], NDArray[np.int64]]:
        """Problem, tree (N,) of each detection and former name (T,) of each tree, for trees of `least` detections."""
        tree = tree_of_track[self.track]
        size = int(tree_of_track.max(initial=-1)) + 1
        hits = np.bincount(tree, minlength=size)
        exists_ = hits >= max(least, 1)
        if keep is not None:
            exists_ &= keep
        ids = np.flatnonzero(exists_)
        name = np.full(size, -1, np.int64)
        name[ids] = np.arange(len(ids))
        tree = name[tree]
        p = self.problem
        known = None if p.known is None else replace(p.known, tree=name[tree_of_track[self.tracks :]])
        return replace(p, sightings=self.seen.gather(tree), n_trees=len(ids), tree_ids=ids, known=known), tree, ids


def _associate_and_solve(
    problem: Problem, track: NDArray[np.int64], config: Config, progress: Progress
) -> tuple[_Decided, Estimate, int]:
    d = problem.detections
    estimate = graph.solve(problem, config.estimate, quick=True)
    if not len(d):
        problem = replace(problem, start=estimate.map_T_robot)
        none = np.zeros(0, np.int64)
        nothing = exists(d, none, np.zeros((0, 4, 4)), np.zeros((0, 3)), config.trees)
        empty = _Decided(none, problem, nothing, shapes(d, none, np.zeros((0, 4, 4)), 0), 0)
        return empty, replace(graph.solve(problem, config.estimate), tree=none), 0
    a = _Association(problem, track, config)
    end = float(problem.motion.distance[-1])
    cap = _gnss_cap(problem, a.closer)
    while a.closer.advance(a.table(estimate), end, cap):
        progress("associate", min(1.0, a.closer.at / max(end, 1e-9)))
        a.tree_of_track = a.closer.tree
        estimate = a.solve(estimate, link=_link(problem, estimate, a.closer))
    progress("associate", 1.0)
    a.tree_of_track = a.named(a.closer.tree)
    estimate = a.solve(estimate, patient=True)
    for n, patience in enumerate((4.0, 2.0, 1.0)):
        progress("refine", n / 3)
        before = a.tree_of_track
        a.tree_of_track = a.named(refine(a.table(estimate), before, config.trees, patience))
        if not np.array_equal(a.tree_of_track, before):
            estimate = a.solve(estimate, patient=True)
    progress("solve", 0.0)
    after = a.decide(estimate)
    for n in range(LAST_ROUNDS):
        decided = after
        estimate = replace(graph.solve(decided.problem, config.estimate), tree=decided.tree)
        progress("solve", (n + 1) / LAST_ROUNDS)
        after = a.decide(estimate)
        if _settled(after, decided):
            turned = np.abs(after.shapes.slope - decided.shapes.slope).max(initial=0.0)
            decided = replace(decided, shapes=after.shapes)  # as the last path has them
            if turned < SETTLED:
                break
    progress("solve", 1.0)
    return decided, estimate, a.closer.loops


FLIPS = 1e-4
"""Share of the detections that may go to and fro between two trees: nothing moves by them."""


def _settled(after: _Decided, before: _Decided) -> bool:
    """The same trees, made of the same detections."""
    if not np.array_equal(after.problem.tree_ids, before.problem.tree_ids):
        return False
    flips = int((after.tree != before.tree).sum())
    return flips <= FLIPS * len(after.tree) and np.array_equal(after.shapes.forked, before.shapes.forked)


LAST_ROUNDS = 4
"""Association and solve go on until neither changes, the last solve included; at most so often."""
SETTLED = 0.01
"""Slopes of trees that change by less between two solves do not change what was solved, m/m."""


def _link(problem: Problem, estimate: Estimate, closer: LoopCloser) -> Link | None:
    """The loop just closed as one relative pose: it pulls the path over distances at which robust losses let go."""
    if closer.link is None:
        return None
    before, now, centre, move = closer.link
    distance = problem.motion.distance_at(problem.stamps_ns)
    a, b = (int(np.clip(np.searchsorted(distance, d), 0, len(distance) - 1)) for d in (before, now))
    if a == b:
        return None
    poses = estimate.map_T_robot
    return Link(a, b, inverse(poses[a]) @ moved_pose(poses[b], centre, move))


def _gnss_cap(problem: Problem, closer: LoopCloser) -> float:
    """How far the path may be off where GNSS holds it, m: a few of its deviations, and the drift of its longest gap."""
    f = problem.fixes
    if len(f.keyframe) < 3:
        return float("inf")
    at = problem.motion.distance_at(problem.stamps_ns)
    edges = np.concatenate([[at[0]], at[f.keyframe], [at[-1]]])
    sigma = float(np.sqrt(np.median(f.cov[:, 0, 0])))
    return max(0.5, 4.0 * sigma) + closer.drift(0.5 * float(np.diff(edges).max()))[0]


def why_no_trees(solved: Solved) -> str:
    """One line on why a map has no trees; "" when it has some."""
    if solved.problem.n_trees:
        return ""
    if solved.run.scans == 0:
        return "no trunks: the recording has no point cloud and no trunk detections (name one with --topic-points or --topic-trunks)"
    return f"no trunks: none of {solved.run.scans} scans showed a tree often enough to be mapped"


def map_T_scans(solved: Solved) -> Array:
    """Poses (S, 4, 4) of the scans in the estimate."""
    e = solved.estimate
    return path_at(e.stamps_ns, e.map_T_robot, solved.motion, solved.detections.stamps_ns)


def topo_map(solved: Solved, config: Config, meta: dict[str, str]) -> TopoMap:
    """The map of a solved run."""
    return build(
        solved.estimate,
        solved.detections,
        in_order(solved.run.trunks),
        map_T_scans(solved),
        solved.existence,
        solved.shapes,
        solved.problem.datum,
        config.topomap,
        meta,
        _record(solved, meta),
    )


def _record(solved: Solved, meta: dict[str, str]) -> SessionRecord:
    """The run as a session of a map."""
    stamps = solved.estimate.stamps_ns
    return SessionRecord(
        name=solved.run.id,
        start_ns=int(stamps[0]),
        end_ns=int(stamps[-1]),
        distance=float(solved.motion.distance[-1]),
        inputs=meta.get("inputs", "[]"),
        verdict=meta.get("verdict", ""),
    )


def baseline(solved: Solved, config: Config) -> tuple[Estimate, TopoMap]:
    """The thesis's map of the same detections: Algorithm 3 with filtered poses, nodes with few sightings left out.

    The thesis kept every node; without a bound each false detection would be a tree. The same bound as ours is used.
    """
    e = average.solve(solved.problem, config.estimate)
    hits = np.bincount(e.tree[e.tree >= 0], minlength=len(e.trees))
    keep = hits >= config.trees.min_sightings
    name = np.where(keep, np.cumsum(keep) - 1, -1)
    tree = np.where(e.tree >= 0, name[np.maximum(e.tree, 0)], -1)
    e = replace(e, trees=e.trees[keep], tree_cov=e.tree_cov[keep], tree=tree)
    poses = path_at(e.stamps_ns, e.map_T_robot, solved.motion, solved.detections.stamps_ns)
    n = int(keep.sum())
    all_trees = Existence(
        ok=np.ones(n, bool),
        kind=np.zeros(n, np.int64),
        probability=np.full(n, np.nan),
        score=np.zeros(n),
        hits=hits[keep],
        passed=np.zeros(n, np.int64),
    )
    topo = build(
        e,
        solved.detections,
        [],
        poses,
        all_trees,
        shapes(solved.detections, tree, poses, n),
        solved.problem.datum,
        config.topomap,
        {"method": "thesis"},
    )
    return e, topo


def residual_metrics(solved: Solved) -> list[Metric]:
    """What can be said without truth: loops, doubles are in the map's metrics; here residuals and held-out fixes."""
    e, s = solved.estimate, solved.problem.sightings
    out = [
        Metric("keyframes", len(e.stamps_ns)),
        Metric("distance driven", float(solved.motion.distance[-1]), "m"),
        Metric("loops closed", solved.loops),
    ]
    if len(s):
        seen = transform(e.map_T_robot[s.keyframe], s.p) - e.trees[s.tree]
        r = np.linalg.norm(seen[:, :2], axis=1)
        out.append(Metric("trunk residual median", float(np.median(r)), "m", "lower"))
        out.append(Metric("trunk sightings", int(s.count.sum())))
    if len(solved.held_out) and solved.problem.datum is not None:
        streams, i = solved.run.streams, solved.held_out
        inside = (streams.fix_ns[i] >= e.stamps_ns[0]) & (streams.fix_ns[i] <= e.stamps_ns[-1])
        i = i[inside]
        poses = path_at(e.stamps_ns, e.map_T_robot, solved.motion, streams.fix_ns[i])
        antenna = transform(poses, _or(solved.run.mounts.get("fix"), np.eye(4))[:3, 3])
        fix = solved.problem.datum.to_enu(streams.lat_lon_h[i])
        out += fix_metrics(antenna, fix, np.sqrt(streams.fix_cov[i, 0, 0]))
    return out


def extend(old: TopoMap, new: TopoMap, solved: Solved, config: Config) -> TopoMap:
    """The old map with a further run in it: trees seen again are updated, the others kept, new ones added."""
    known = solved.problem.known
    assert known is not None
    passed = seen_through(solved.detections, map_T_scans(solved), known.p)
    return merge(old, new, known.tree, config.topomap, passed)
