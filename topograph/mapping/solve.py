"""A session in, its problem and its estimate out."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from topograph.errors import InsufficientDataError
from topograph.estimate import Estimate, Problem, path_at
from topograph.estimate.assemble import assemble, choose_datum, without_wrong_headings
from topograph.geometry import Array, Datum
from topograph.mapping.association import associate_and_solve
from topograph.mapping.config import MappingConfig
from topograph.mapping.known import KnownMap, Placed, put
from topograph.mapping.progress import Progress, silent
from topograph.motion import Motion, align_imu, dead_reckon, in_radians, without_nonsense
from topograph.session import Session, Streams
from topograph.trees import Detections, Existence, Loops, Shapes, choose_keyframes, follow, screen, with_trunks_way


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
        loops: what became of them.
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
    loops: Loops
    moving: float
    seconds: dict[str, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class Prepared:
    """A run, ready to be solved.

    Attributes:
        streams: the small streams as they are used: without nonsense, clocks set right.
        problem: with all detections, and no sightings yet.
        track: (N,) track of each detection.
        guess: (K, 4, 4) the path to begin from, as tracks held it, or None.
        moving: share of the detections that were of things that moved or rode along.
        held_out: (H,) indices of the fixes withheld from the estimator.
    """

    run: Session
    streams: Streams
    problem: Problem
    track: NDArray[np.int64]
    guess: Array | None
    moving: float
    held_out: NDArray[np.int64]


def solve_session(
    run: Session,
    config: MappingConfig,
    *,
    check_fixes: int = 0,
    known: KnownMap | None = None,
    placed: Placed | None = None,
    datum: Datum | None = None,
    progress: Progress = silent,
) -> Solved:
    """Prepare, associate and solve; see `prepare`."""
    began = time.perf_counter()
    p = prepare(run, config, check_fixes=check_fixes, known=known, placed=placed, datum=datum)
    decided, estimate, loops = associate_and_solve(p.problem, p.track, p.guess, config, progress)
    return Solved(
        run=run,
        streams=p.streams,
        motion=p.problem.motion,
        detections=decided.problem.detections,
        problem=decided.problem,
        estimate=estimate,
        tree=decided.tree,
        existence=decided.existence,
        shapes=decided.shapes,
        held_out=p.held_out,
        rejected=decided.rejected,
        loops=loops,
        moving=p.moving,
        seconds={"read": run.seconds, "associate and solve": time.perf_counter() - began},
    )


def prepare(
    run: Session,
    config: MappingConfig,
    *,
    check_fixes: int = 0,
    known: KnownMap | None = None,
    placed: Placed | None = None,
    datum: Datum | None = None,
    screened: bool = True,
) -> Prepared:
    """What a run is before anything is solved. Every `check_fixes`-th fix is withheld from the estimator and kept for checking.

    With a `known` map the run is put into its frame, by GNSS or where it was `placed` in it, and its trees are landmarks with
    their covariances. A `datum` that is given is kept to, where there are fixes. Not `screened`, what moved is not left out, as in the thesis.

    Raises:
        InsufficientDataError: neither motion nor fixes; or a known map and no common frame.
    """
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
            "name them with --topic-odometry or --topic-fix, or take the motion from the point clouds with --topic-odometry lidar"
        )
    if not motion.wheels:
        notes.append("no wheel odometry: the motion between poses rests on GNSS fixes, IMU and trunks")
    if not motion.gyro:
        notes.append("no IMU: turns rest on the wheels, the slope on GNSS and trunks")
    detections = _covered(Detections.of(run.trunks), motion, notes)
    if screened:
        motion = with_trunks_way(motion, detections, streams.fix_ns)
    notes += _wheel_notes(motion)
    track, moving, held_T_robot = np.arange(len(detections)), 0.0, None
    if screened:
        detections, track, moving, held_T_robot = _screened(detections, motion, config, notes)
    n_fix = len(run.streams.fix_ns)
    used = np.ones(n_fix, bool)
    if check_fixes > 0:
        used[check_fixes - 1 :: check_fixes] = False
    if check_fixes == 1:
        used[:] = False
    found = choose_datum(run.streams, used)
    datum = found if datum is None or found is None else datum
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
        problem = put(problem, placed, known.datum)
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
        problem = replace(problem, known=known.at(detections))
    return Prepared(
        run=run, streams=streams, problem=problem, track=track, guess=_guess(problem, held_T_robot), moving=moving,
        held_out=np.flatnonzero(~used),
    )  # fmt: skip


def _guess(problem: Problem, held_T_robot: Array | None) -> Array | None:
    """The path (K, 4, 4) as tracks held it, where it would begin as dead reckoning has it and that was put right; else None."""
    if held_T_robot is None or len(problem.fixes.keyframe) or problem.known is not None:
        return None
    scans_ns = problem.detections.stamps_ns
    if np.array_equal(held_T_robot, problem.motion.at(scans_ns)):
        return None
    return path_at(scans_ns, held_T_robot, problem.motion, problem.stamps_ns)


def _wheel_notes(motion: Motion) -> list[str]:
    out = []
    if motion.wheel_scale != 1.0:
        off = 100 * (1 / motion.wheel_scale - 1)
        word = "overstate" if off > 0 else "understate"
        out.append(f"wheels {word} distances by {abs(off):.0f} % against the fixes: corrected (calibrate their radius)")
    for begin, end, speed in motion.slips[:5].tolist():
        out.append(
            f"wheels slipped or were blocked from {begin:.1f} to {end:.1f} s (off by {-speed:+.2f} m/s): "
            f"the {'trunks' if motion.slips_by_trunks else 'fixes'}' speed stands in"
        )
    if len(motion.slips) > 5:
        out.append(f"wheels slipped {len(motion.slips) - 5} more times")
    for at, apart, turned in motion.breaks[:5].tolist():
        out.append(
            f"at {at:.1f} s wheels and fixes part in one step, by {apart:.2f} m and {np.degrees(turned):.0f}°: "
            "it is left to the trees (a jump of the odometry, or of the fixes)"
        )
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
    detections: Detections, motion: Motion, config: MappingConfig, notes: list[str]
) -> tuple[Detections, NDArray[np.int64], float, Array]:
    """The detections that may be of landmarks, their tracks, numbered without gaps, the share of all that moved, and `follow`'s held_T_robot."""
    track, held_T_robot = follow(detections, motion, config.trees, config.motion)
    screened = screen(detections, track, motion, held_T_robot)
    if screened.moved:
        notes.append(f"{screened.moved} things that moved, or rode along with the robot, were left out")
    keep = screened.keep
    tracks = np.unique(track[keep], return_inverse=True)[1].astype(np.int64)
    return detections.select(keep), tracks, screened.moving, held_T_robot


def _or(pose: Array | None, other: Array) -> Array:
    return other if pose is None else pose


def _keyframes(detections: Detections, motion: Motion, config: MappingConfig) -> NDArray[np.int64]:
    c = config.estimate
    stamps = detections.stamps_ns
    inside = (stamps >= motion.stamps_ns[0] - 200_000_000) & (stamps <= motion.stamps_ns[-1] + 200_000_000)
    if inside.sum() < 2:
        stamps = motion.stamps_ns
    else:
        stamps = np.unique(np.concatenate([stamps[inside], motion.stamps_ns[[0, -1]]]))
    return stamps[choose_keyframes(motion, stamps, c.keyframe_distance, c.keyframe_turn, c.keyframe_seconds)]


def map_T_scans(solved: Solved) -> Array:
    """Poses (S, 4, 4) of the scans in the estimate."""
    e = solved.estimate
    return path_at(e.stamps_ns, e.map_T_robot, solved.motion, solved.detections.stamps_ns)
