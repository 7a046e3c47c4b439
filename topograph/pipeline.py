"""Straight lines from bags to a map, and the one loop: associate <-> solve."""

from __future__ import annotations

import logging
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from topograph.bags import Recording, Scan, Trunks
from topograph.config import Config
from topograph.errors import InputError, InsufficientDataError
from topograph.estimate import Estimate, Problem, graph, path_at
from topograph.estimate.assemble import assemble, choose_datum
from topograph.geometry import Array, inverse, transform
from topograph.motion import Motion, Streams, StreamsBuilder, align_imu, dead_reckon, twist_during
from topograph.trees import Detections, LoopCloser, choose_keyframes, exists, follow, gather, refine, tabulate
from topograph.trunks import TrunksConfig, from_recorded

log = logging.getLogger(__name__)

Progress = Callable[[str, float], None]


def _silent(stage: str, share: float) -> None:
    """No progress shown."""


@dataclass(frozen=True, slots=True)
class Run:
    """What was read of a recording.

    Attributes:
        streams: the small streams.
        trunks: trunks of each scan in `base_link`, in time order.
        mounts: "imu", "fix", "heading" -> robot_T_sensor, or None where no transform is known.
        chosen: stream kind -> topic.
        skipped: reason -> count.
        notes: what had to be assumed.
        scans, seconds, duration_s: counted, spent reading and detecting, recorded.
    """

    streams: Streams
    trunks: list[Trunks]
    mounts: dict[str, Array | None]
    child_T_robot: Array
    chosen: dict[str, str]
    skipped: Counter[str]
    notes: list[str]
    scans: int
    seconds: float
    duration_s: float


@dataclass(frozen=True, slots=True)
class Solved:
    """A run's problem and its estimate, with the associations they rest on.

    Attributes:
        tree: (N,) tree of each detection (-1: none), numbered as in the estimate.
        score, sightings: (T,) of the trees.
        problem, estimate, motion, detections, run: the products on the way.
        held_out: (H,) indices of the fixes withheld from the estimator.
        rejected: trees that did not exist.
        loops: loops closed.
    """

    run: Run
    motion: Motion
    detections: Detections
    problem: Problem
    estimate: Estimate
    tree: NDArray[np.int64]
    score: Array
    sightings: NDArray[np.int64]
    held_out: NDArray[np.int64]
    rejected: int
    loops: int
    seconds: dict[str, float]


def read_run(paths: Sequence[Path], config: Config, progress: Progress = _silent) -> Run:
    """Read a run once: small streams into arrays, scans into trunks as they come.

    Raises:
        InputError: nothing usable in the bags.
        FrameError: the LiDAR's frame is not known.
    """
    began = time.perf_counter()
    notes: list[str] = []
    with Recording(paths, config.bags) as recording:
        detect = _detector(recording, config.trunks)
        builder = StreamsBuilder()
        pending: list[Scan] = []
        trunks: list[Trunks] = []
        scans = 0
        newest = 0
        expected = max(1, sum(recording.counts[t] for t in recording.chosen.values()))
        for n, (_, product) in enumerate(recording.messages()):
            if n % 200 == 0:
                progress("read", n / expected)
            newest = max(newest, product.stamp_ns)
            if isinstance(product, Scan):
                scans += 1
                pending.append(product)
            elif isinstance(product, Trunks):
                scans += 1
                trunks.append(from_recorded(product, recording.frames.get(product.frame), config.trunks))
            else:
                builder.add(product)
            while pending and newest > pending[0].stamp_ns + 250_000_000:
                trunks.append(detect(pending.pop(0), builder))
        trunks += [detect(s, builder) for s in pending]
        progress("read", 1.0)
        streams = builder.build(recording.skipped)
        mounts = {k: recording.frames.find(streams.frames[k]) for k in ("imu", "fix", "heading") if k in streams.frames}
        child = streams.frames.get("child", "")
        base_T_child = recording.frames.find(child)
        if base_T_child is None:
            notes.append(f"odometry's frame {child!r} is not in TF: taken as {config.bags.base_frame!r}")
            base_T_child = np.eye(4)
        for k, name in (("fix", "antenna"), ("heading", "heading")):
            if k in mounts and mounts[k] is None:
                notes.append(
                    f"{name} frame {streams.frames[k]!r} is not in TF: taken at the base; "
                    f"add --extrinsic {streams.frames[k]}=X,Y,Z,ROLL,PITCH,YAW"
                )
        skipped = recording.skipped
        chosen, duration = dict(recording.chosen), recording.duration_s
    return Run(
        streams, trunks, mounts, inverse(base_T_child), chosen, skipped, notes, scans, time.perf_counter() - began, duration
    )


def _detector(recording: Recording, config: TrunksConfig) -> Callable[[Scan, StreamsBuilder], Trunks]:
    """Scan -> trunks in the base's frame, deskewed with what the small streams said around the scan."""
    from topograph.trunks.detector import Detector

    detectors: dict[str, Detector] = {}

    def detect(scan: Scan, streams: StreamsBuilder) -> Trunks:
        if scan.frame not in detectors:
            detectors[scan.frame] = Detector(recording.frames.get(scan.frame), config)
        robot_R_imu = None
        if streams.imu:
            mount = recording.frames.find(streams.imu[0].frame)
            robot_R_imu = None if mount is None else mount[:3, :3]
        first, last = scan.stamp_ns, scan.stamp_ns
        if scan.offset is not None and len(scan.offset):
            first += int(np.nanmin(scan.offset) * 1e9)
            last += int(np.nanmax(scan.offset) * 1e9)
        twist, _ = twist_during(first, last, streams.odometry, streams.imu, robot_R_imu)
        return detectors[scan.frame](scan, twist)

    return detect


def solve_run(run: Run, config: Config, *, check_fixes: int = 0, progress: Progress = _silent) -> Solved:
    """Associate and solve. Every `check_fixes`-th fix is withheld from the estimator and kept for checking.

    Raises:
        InsufficientDataError: neither motion nor fixes.
    """
    began = time.perf_counter()
    notes, skipped = run.notes, run.skipped
    inertial = align_imu(run.streams, run.mounts.get("imu")) if "imu" in run.mounts else None
    if inertial is not None and inertial.note:
        notes.append(inertial.note)
    motion = dead_reckon(run.streams, inertial, run.child_T_robot, config.motion)
    if motion is None:
        raise InsufficientDataError(
            "no wheel odometry and no IMU: the motion between scans is unknown; name them with --topic-odometry or --topic-imu"
        )
    if not motion.wheels:
        notes.append("no wheel odometry: the distance between poses rests on GNSS, IMU and trunks")
    if not motion.gyro:
        notes.append("no IMU: turns rest on the wheels, the slope on GNSS and trunks")
    detections = Detections.of(run.trunks)
    n_fix = len(run.streams.fix_ns)
    used = np.ones(n_fix, bool)
    if check_fixes > 0:
        used[check_fixes - 1 :: check_fixes] = False
    if check_fixes == 1:
        used[:] = False
    datum = choose_datum(run.streams, used)
    if datum is None:
        notes.append("no usable GNSS fixes: the map is not georeferenced")
    keyframes = _keyframes(detections, motion, config)
    eye = np.eye(4)
    problem = assemble(
        keyframes, motion, config.motion, inertial, run.streams, used, _or(run.mounts.get("fix"), eye),
        _or(run.mounts.get("heading"), eye), datum, detections, config.estimate, skipped,
    )  # fmt: skip
    seconds = {"read": run.seconds}
    tree, problem, estimate, score, hits, rejected, loops = _associate_and_solve(problem, config, progress)
    seconds["associate and solve"] = time.perf_counter() - began
    return Solved(
        run, motion, detections, problem, estimate, tree, score, hits, np.flatnonzero(~used), rejected, loops, seconds
    )


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


def _associate_and_solve(
    problem: Problem, config: Config, progress: Progress
) -> tuple[NDArray[np.int64], Problem, Estimate, Array, NDArray[np.int64], int, int]:
    d, motion = problem.detections, problem.motion
    progress("track", 0.0)
    track = follow(d, motion, config.trees)
    distance = motion.distance_at(d.stamps_ns)[d.scan] if len(d) else np.zeros(0)
    variance = 0.5 * (d.cov[:, 0, 0] + d.cov[:, 1, 1])
    estimate = graph.solve(problem, config.estimate, quick=True)
    closer = LoopCloser(int(track.max(initial=-1)) + 1, motion.gyro, config.trees, config.motion)
    end = float(motion.distance[-1])
    cap = _gnss_cap(problem, closer)

    def table_of(e: Estimate) -> tuple[Array, object]:
        map_T_scan = path_at(e.stamps_ns, e.map_T_robot, motion, d.stamps_ns)
        return map_T_scan, tabulate(transform(map_T_scan[d.scan], d.p)[:, :2], variance, track, distance)

    if len(d):
        for _ in range(200):
            _, table = table_of(estimate)
            moved = closer.advance(table, end, cap)  # type: ignore[arg-type]
            progress("associate", min(1.0, closer.at / max(end, 1e-9)))
            if not moved:
                break
            problem, estimate, _ = _solve_with(problem, closer.tree[track], config, estimate, quick=True)
    tree_of_track = closer.tree
    score, hits = np.zeros(0), np.zeros(0, np.int64)
    rejected = 0
    tree = np.full(len(d), -1, np.int64)
    if len(d):
        for n in range(3):
            progress("refine", n / 3)
            _, table = table_of(estimate)
            tree_of_track = refine(table.place, table.sigma, table.hits, tree_of_track, config.trees)  # type: ignore[attr-defined]
            problem, estimate, _ = _solve_with(problem, tree_of_track[track], config, estimate, quick=True)
        map_T_scan, table = table_of(estimate)
        tree_of_track = refine(table.place, table.sigma, table.hits, tree_of_track, config.trees)  # type: ignore[attr-defined]
        problem, tree, ids = _with_trees(problem, tree_of_track[track], 1, config)
        places = np.zeros((len(ids), 3))
        seen = transform(map_T_scan[d.scan], d.p)
        for k in range(3):
            places[:, k] = np.bincount(tree[tree >= 0], seen[tree >= 0, k], minlength=len(ids)) / np.maximum(
                np.bincount(tree[tree >= 0], minlength=len(ids)), 1
            )
        ok, score, hits, _ = exists(d, tree, map_T_scan, places, config.trees)
        rejected = int((~ok).sum())
        tree = np.where((tree >= 0) & ok[np.maximum(tree, 0)], tree, -1)
        score, hits = score[ok], hits[ok]
    progress("solve", 0.0)
    problem, estimate, tree = _solve_with(problem, tree, config, estimate, quick=False, least=1)
    progress("solve", 1.0)
    return tree, problem, replace(estimate, tree=tree), score, hits, rejected, closer.loops


def _gnss_cap(problem: Problem, closer: LoopCloser) -> float:
    """How far the path may be off where GNSS holds it, m: a few of its deviations, and the drift of its longest gap."""
    f = problem.fixes
    if len(f.keyframe) < 3:
        return float("inf")
    at = problem.motion.distance_at(problem.stamps_ns)
    edges = np.concatenate([[at[0]], at[f.keyframe], [at[-1]]])
    sigma = float(np.sqrt(np.median(f.cov[:, 0, 0])))
    return max(0.5, 4.0 * sigma) + closer.drift(0.5 * float(np.diff(edges).max()))[0]


def _with_trees(
    problem: Problem, tree: NDArray[np.int64], least: int, config: Config
) -> tuple[Problem, NDArray[np.int64], NDArray[np.int64]]:
    """The problem with the sightings of trees that have `least` detections, renumbered."""
    hits = np.bincount(tree[tree >= 0]) if (tree >= 0).any() else np.zeros(0, np.int64)
    ids = np.flatnonzero(hits >= max(least, 1))
    name = np.full(len(hits) + 1, -1, np.int64)
    name[ids] = np.arange(len(ids))
    tree = name[tree]
    sightings = gather(problem.detections, tree, problem.stamps_ns, problem.motion)
    return replace(problem, sightings=sightings, n_trees=len(ids)), tree, ids


def _solve_with(
    problem: Problem, tree: NDArray[np.int64], config: Config, start: Estimate, *, quick: bool, least: int = 3
) -> tuple[Problem, Estimate, NDArray[np.int64]]:
    problem, tree, _ = _with_trees(problem, tree, least, config)
    problem = replace(problem, start=start.map_T_robot)
    return problem, graph.solve(problem, config.estimate, quick=quick), tree


def require_trees(solved: Solved) -> None:
    """Raises InsufficientDataError when a run has scans or detections but no tree came of them."""
    if solved.run.scans == 0:
        raise InputError("no trunks: the recording has no point cloud and no trunk detections; name one with --topic-points")
    if solved.problem.n_trees == 0:
        raise InsufficientDataError(f"no trunks: none of {solved.run.scans} scans showed a tree often enough to be mapped")
