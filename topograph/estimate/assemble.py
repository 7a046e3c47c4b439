"""Streams -> Problem: fixes and headings tied to keyframes, steps with their noise."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from topograph.estimate.initial import heading_misfit, initial_path, moves_enough
from topograph.estimate.problem import EstimateConfig, Fixes, Headings, Problem
from topograph.geometry import Array, Datum, Stamps, inverse, transform
from topograph.motion import Inertial, Motion, MotionConfig
from topograph.session import Streams
from topograph.trees import Detections, Sightings
from topograph.trees.sightings import DELAY_NS, nearest_keyframe


def empty_sightings() -> Sightings:
    """No sightings yet."""
    none = np.zeros(0, np.int64)
    return Sightings(
        keyframe=none, tree=none, p=np.zeros((0, 3)), cov=np.zeros((0, 3, 3)), count=none, late=np.zeros((0, 3))
    )


LEAST_FIXES = 3
"""Keyframes with a fix that georeference a map."""


FARTHEST_NS = 4_000_000_000
"""A fix further in time from its keyframe says nothing of it: scans that end before the run leave minutes to the last one."""


def no_fixes() -> Fixes:
    """No fixes."""
    return Fixes(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros((0, 3)))


def choose_datum(streams: Streams, keep: NDArray[np.bool_]) -> Datum | None:
    """Origin of the map frame: the median of the first fixes, rounded to 1e-7° and 1 cm; None with too few."""
    g = streams.lat_lon_h[keep]
    if len(g) < 3:
        return None
    lat, lon, h = np.median(g[:25], axis=0)
    return Datum(round(float(lat), 7), round(float(lon), 7), round(float(h), 2))


def assemble(
    keyframes_ns: Stamps,
    motion: Motion,
    motion_config: MotionConfig,
    inertial: Inertial | None,
    streams: Streams,
    used_fixes: NDArray[np.bool_],
    robot_T_antenna: Array,
    robot_T_baseline: Array,
    datum: Datum | None,
    detections: Detections,
    config: EstimateConfig,
    skipped: Counter[str],
) -> Problem:
    """The problem of a run, without sightings; `used_fixes` (F,) leaves out those that are held out.

    Its datum is None where fewer than LEAST_FIXES keyframes have a fix.
    """
    odom = motion.at(keyframes_ns)
    fixes = _fixes(keyframes_ns, odom, motion, streams, used_fixes, robot_T_antenna, datum, config, skipped)
    if len(fixes.keyframe) < LEAST_FIXES:  # they hold neither the heading nor, with the antenna's lever, the place
        fixes, datum = no_fixes(), None
    headings = _headings(keyframes_ns, odom, motion, streams, robot_T_baseline, datum)
    up, up_sigma = _mean_axes(keyframes_ns, odom, detections)
    return Problem(
        stamps_ns=keyframes_ns,
        odom_T_robot=odom,
        step_sigma=motion.sigma(motion_config, keyframes_ns),
        motion=motion,
        motion_config=motion_config,
        inertial=inertial,
        fixes=fixes,
        headings=headings,
        datum=datum,
        detections=detections,
        sightings=empty_sightings(),
        n_trees=0,
        up=up,
        up_sigma=up_sigma,
    )


SEEN_FROM = 8.0
"""Keyframes nearer together than this see mostly the same trees, m."""
LEAST_LEAN = 0.02
"""Trees that all seem upright may still lean together, rad."""


def _mean_axes(keyframes_ns: Stamps, odom: Array, detections: Detections, least: int = 10) -> tuple[Array, Array]:
    """Mean trunk axis (K, 3) at each keyframe and its deviation (K,): trees grow upwards, within the lean that they show.

    Keyframes that see the same trees err alike, so that each counts for as much less as there are of them. NaN with fewer
    than `least` trunks, and everywhere when the axes are not measured (all alike).
    """
    n = len(keyframes_ns)
    up, sigma = np.full((n, 3), np.nan), np.full(n, np.nan)
    if not len(detections) or detections.axis[:, :2].std() < 1e-3:
        return up, sigma
    scan_keyframe = nearest_keyframe(detections.stamps_ns, keyframes_ns)
    keyframe = scan_keyframe[detections.scan]
    scans = np.maximum(np.bincount(scan_keyframe, minlength=n), 1)
    order = np.argsort(keyframe, kind="stable")
    ends = np.searchsorted(keyframe[order], np.arange(n + 1))
    tree = cKDTree(odom[:, :2, 3])
    alike = np.asarray(tree.query_ball_point(odom[:, :2, 3], SEEN_FROM, return_length=True), float)
    for k in range(n):
        mine = order[ends[k] : ends[k + 1]]
        trees = len(mine) / scans[k]  # scans of one keyframe see the same trees as well
        if trees >= 0.5 * least and len(mine) >= least:
            mean = np.median(detections.axis[mine], axis=0)
            up[k] = mean / np.linalg.norm(mean)
            lean = 1.4826 * float(np.median(np.abs(detections.axis[mine, :2] - mean[:2])))
            sigma[k] = max(lean, LEAST_LEAN) / np.sqrt(trees) * np.sqrt(alike[k])
    return up, sigma


def _at_keyframes(keyframes_ns: Stamps, odom: Array, motion: Motion, stamps: Stamps) -> tuple[NDArray[np.int64], Array]:
    """Nearest keyframe (N,) of stamps and the robot's pose then in it (N, 4, 4)."""
    k = nearest_keyframe(stamps, keyframes_ns)
    return k, inverse(odom[k]) @ motion.at(stamps)


def _fixes(
    keyframes_ns: Stamps, odom: Array, motion: Motion, streams: Streams, used: NDArray[np.bool_], robot_T_antenna: Array,
    datum: Datum | None, config: EstimateConfig, skipped: Counter[str],
) -> Fixes:  # fmt: skip
    if datum is None:
        return no_fixes()
    stamps = streams.fix_ns
    margin = 500_000_000
    nearest = keyframes_ns[nearest_keyframe(stamps, keyframes_ns)]
    inside = used & (stamps >= keyframes_ns[0] - margin) & (stamps <= keyframes_ns[-1] + margin)
    inside &= np.abs(stamps - nearest) < FARTHEST_NS
    skipped["fix: outside the run"] += int((used & ~inside).sum())
    skipped += Counter()  # zero counts vanish
    if inside.sum() < LEAST_FIXES:
        return no_fixes()
    enu = datum.to_enu(streams.lat_lon_h[inside])
    k, keyframe_T_robot = _at_keyframes(keyframes_ns, odom, motion, stamps[inside])
    lever = transform(keyframe_T_robot, robot_T_antenna[:3, 3])
    later = inverse(odom[k]) @ motion.at(stamps[inside] + DELAY_NS)
    late = (transform(later, robot_T_antenna[:3, 3]) - lever) / (DELAY_NS * 1e-9)
    cov = streams.fix_cov[inside].copy()
    h, v = config.fix_floor
    cov[:, [0, 1, 2], [0, 1, 2]] = np.maximum(cov[:, [0, 1, 2], [0, 1, 2]], np.array([h, h, v]) ** 2)
    agree = _agreeing(k, enu, lever, np.sqrt(cov[:, 0, 0]))
    k, enu, lever, late, cov = k[agree], enu[agree], lever[agree], late[agree], cov[agree]
    # Fixes of one keyframe err alike: their mean is one fix with the noise of one.
    ids, index, count = np.unique(k, return_inverse=True, return_counts=True)

    def mean(x: Array) -> Array:
        out = np.zeros((len(ids), *x.shape[1:]))
        np.add.at(out, index, x)
        return np.asarray(out / count.reshape(-1, *([1] * (x.ndim - 1))))

    return Fixes(ids, mean(lever), mean(enu), mean(cov), mean(late))


def _agreeing(keyframe: NDArray[np.int64], enu: Array, lever: Array, sigma: Array) -> NDArray[np.bool_]:
    """Fixes (N,) that most others of their keyframe agree with: as far apart as the antenna has moved. Of two, both."""
    out = np.ones(len(keyframe), bool)
    order = np.argsort(keyframe, kind="stable")
    for mine in np.split(order, np.flatnonzero(np.diff(keyframe[order])) + 1):
        if len(mine) < 3:
            continue
        apart = np.linalg.norm(enu[mine, None, :2] - enu[None, mine, :2], axis=2)
        moved = np.linalg.norm(lever[mine, None, :2] - lever[None, mine, :2], axis=2)
        near = np.abs(apart - moved) < 0.1 + 5.0 * np.maximum(sigma[mine, None], sigma[None, mine])
        best = near[int(near.sum(axis=1).argmax())]
        if best.sum() > 1:
            out[mine] = best
    return out


def _headings(
    keyframes_ns: Stamps,
    odom: Array,
    motion: Motion,
    streams: Streams,
    robot_T_baseline: Array,
    datum: Datum | None,
) -> Headings:
    stamps = streams.heading_ns
    inside = (stamps >= keyframes_ns[0]) & (stamps <= keyframes_ns[-1])
    if datum is None or not inside.any():
        none = np.zeros(0)
        return Headings(np.zeros(0, np.int64), np.zeros((0, 3)), none, none)
    k, keyframe_T_robot = _at_keyframes(keyframes_ns, odom, motion, stamps[inside])
    direction = (keyframe_T_robot[:, :3, :3] @ robot_T_baseline[:3, 0][:, None])[..., 0]
    sigma = np.nan_to_num(streams.heading_sigma[inside], nan=0.01)
    # One per keyframe is enough: the others say the same.
    first = np.unique(k, return_index=True)[1]
    return Headings(k[first], direction[first], streams.heading[inside][first], np.maximum(sigma[first], 0.005))


WRONG_HEADING = 0.07
"""Median difference from the course of the fixes beyond which headings are not used, rad."""


def without_wrong_headings(problem: Problem) -> tuple[Problem, list[str]]:
    """The problem without headings that contradict the path laid onto the fixes, and what to say of them.

    A baseline turned by 90°, or azimuth counted from north, costs more than no heading: losses give up on it only in part.
    """
    h = problem.headings
    # Without a gyro the path laid onto the fixes turns as the wheels do, and who is wrong is not for the wheels to say.
    if len(h.keyframe) < 10 or not problem.motion.gyro or not moves_enough(problem):
        return problem, []
    middle, size = heading_misfit(problem, initial_path(problem))
    if size < WRONG_HEADING:
        return problem, []
    none = np.zeros(0)
    note = (
        f"headings are {np.degrees(middle):+.0f}° from the course that fixes and wheels take (median {np.degrees(size):.0f}°): they are left out "
        "(check the baseline's frame, the receiver's clock, and that azimuth is counted from east)"
    )
    return replace(problem, headings=Headings(np.zeros(0, np.int64), np.zeros((0, 3)), none, none)), [note]
