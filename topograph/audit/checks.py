"""The checks, each a number and a bound. What a clean run shows stands beside each bound (simulated runs of 11 designs, seeds below 1000)."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from topograph.audit.verdict import Finding
from topograph.estimate import Estimate, Problem, path_at
from topograph.estimate.initial import heading_misfit
from topograph.geometry import Array, inverse, transform, yaw_of
from topograph.motion import Motion
from topograph.session import Streams

SURE = 25.0
"""Gain of a score test from which it is no chance: five standard deviations of one parameter."""
SHIFT = 0.06
"""What a clock may be off by, times the speed of the robot, m (clean: up to 0.01)."""
MOUNT = 0.08
"""What antenna and trunks' sensor may be off by, m (clean: up to 0.013)."""
YAW = 0.012
"""And in yaw, rad (clean: up to 0.003)."""
AWAY = (0.10, 5.0)
"""A fix so far from the path, m and stated deviations, was not believed."""
UNBELIEVED = 0.36
"""Share of the run in which they may be so (clean: 0): two thirds that agree outvote the rest."""
STRETCH_S = 4.0
HEADING = 0.06
"""Median difference of heading and path, rad (clean: 0.003)."""
MOVING, NOTHING_STANDS = 0.3, 0.7
"""Share of detections that seem to move (clean: 0.03), and from which on there is nothing to map."""
UNCLAIMED, NOBODYS, SURE_TRUNKS, CLOSE_BY = 0.35, 0.7, 100, 12.0
"""Share of the trunks that the front end is sure of, nearer than so many m, that belong to no tree of the map (clean: up to 0.06; LiDAR
turned by 90 or 180 degrees: 0.97 and more, pitched by 20: 0.85; among bushes of a recorded forest 0.37, and the map right), from which on nothing stands, and of how many at least."""
DOUBLED = 0.12
"""Share of trees with another one nearer than a quarter of the usual distance (clean: 0.02; trees that stand at random: 0.04)."""
TORN = 0.15
"""Share of sightings beyond five deviations (clean: up to 0.08, in a trellis)."""
BENT = 2.6
"""Likeness of neighbouring sightings' errors, as a factor on their noise (clean: 1.0 to 2.1)."""
TILT = 0.07
"""Mean lean of all trunks in the robot's own frame, rad (clean: up to 0.03, where axes are recorded; 0.01 in LiDAR runs)."""
DRIFT = (0.05, 6.0)
"""Fixes may drift so far while the wheels stand, m and standard deviations (clean: 0.01)."""
JUMP, JUMP_FIXES, JUMP_S = (0.33, 8.0), 8, 6.0
"""A step of the fixes against dead reckoning, m and stated deviations, between the medians of so many fixes before and after it, all within
so many seconds (clean: up to 0.21 m, in tight turns)."""
TOLD = 4.0
"""Deviations of the less sure side that a step may be long."""
OUTVOTED = 0.25
"""Share of the fixes that three quarters which agree with wheels, trunks and each other outvote."""
JUMP_WIDE = 0.3
"""Of the step: how far the fixes of one side may lie apart."""
REFUSING = ("moving", "trunks of no tree")
"""Findings that refuse a map."""
ALIKE_S = 6.0
"""Errors of fixes last for so long."""
PAIRS = 3
"""Of trees that stand twice, at least."""
STAND_S = 2.0
"""Shorter stands say nothing."""


def offsets(problem: Problem, estimate: Estimate) -> Iterator[Finding]:
    """The one calibration, if any, that explains the residuals best."""
    v = np.diff(problem.motion.distance) / np.maximum(np.diff(problem.motion.stamps_ns) * 1e-9, 1e-3)
    speed = float(np.percentile(v, 90)) if len(v) else 0.0
    worst: tuple[float, Finding] | None = None
    for o in estimate.offsets:
        size = float(np.linalg.norm(o.value))
        where = ", ".join(f"{x:+.2f}" for x in o.value)
        sigma = float(o.sigma.max())
        if o.name == "fix clock":
            bound, unit = SHIFT / max(speed, 0.1), "s"
            says = f"the GNSS clock seems {_late(o.value[0])} ({size:.2f} s): synchronise the receiver, or the map lies {100 * size * speed:.0f} cm along the track"
        elif o.name == "trunk clock":
            bound, unit = SHIFT / max(speed, 0.1), "s"
            says = f"the clock of the LiDAR (or of the detections) seems {_late(o.value[0])} ({size:.2f} s): synchronise it"
        elif o.name == "antenna":
            bound, unit = MOUNT, "m"
            says = f"the antenna seems to sit ({where}) m (x, y) from where TF has it: measure it, give it with --extrinsic"
        elif o.name == "trunk mount":
            bound, unit = MOUNT, "m"
            says = (
                f"the LiDAR seems to sit ({where}) m (x, y) from where TF has it: measure it, give it with --extrinsic"
            )
        elif o.name == "trunk yaw":
            bound, unit = YAW, "rad"
            says = f"the LiDAR seems turned by {np.degrees(o.value[0]):+.1f}° about the vertical from what TF has: give it with --extrinsic"
        else:
            continue
        if size > bound and size > 4.0 * sigma and o.gain > SURE and (worst is None or o.gain > worst[0]):
            worst = (o.gain, Finding(name=o.name, value=size, bound=bound, unit=unit, sentence=says))
    if worst is not None:
        yield worst[1]


def _late(value: float) -> str:
    return "behind" if value > 0 else "ahead"


def fixes(problem: Problem, estimate: Estimate) -> Iterator[Finding]:
    """In how many stretches of the run the fixes, taken together, are not where the path is, and when.

    The median of a stretch counts, not single fixes: scattered outliers point everywhere, what could be right points one way.
    """
    if len(problem.fixes.keyframe) < 10:
        return
    begin, off = _refused(problem, estimate)
    far = off > 0
    share = float(far.mean())
    if share > UNBELIEVED:
        yield Finding(
            name="fixes not believed", value=share, bound=UNBELIEVED, unit="",
            sentence=f"for {100 * share:.0f} % of the run fixes lie {float(np.median(off[far])):.2f} m from where the other fixes, wheels and trunks "
            f"put them (from {begin[far][0]:.0f} to {begin[far][-1] + STRETCH_S:.0f} s): either part may be the right one; check the receiver's base",
        )  # fmt: skip


def refused_fixes(problem: Problem, estimate: Estimate) -> Iterator[str]:
    """What to know of fixes that the rest outvoted for a while, a sentence each: they are wrong, mostly, and the path is where it is not."""
    begin, off = _refused(problem, estimate)
    far = np.concatenate([[False], off > 0, [False]])
    for a, b in np.flatnonzero(np.diff(far)).reshape(-1, 2).tolist():
        first, last = begin[a], begin[b - 1] + STRETCH_S
        if last - first >= 2 * STRETCH_S:
            yield (
                f"from {first:.0f} to {last:.0f} s the fixes lie {float(np.median(off[a:b])):.2f} m from the path and are not believed; "
                "if they are right, trees seen there alone are off by as much"
            )


def _refused(problem: Problem, estimate: Estimate) -> tuple[Array, Array]:
    """Stretches with fixes: when they begin (S,), s, and how far the path leaves the middle of their fixes (S,), m, 0 where it believes them."""
    away, sigma = from_path(problem, estimate)
    seconds = (problem.stamps_ns[problem.fixes.keyframe] - problem.stamps_ns[0]) * 1e-9
    stretch = (seconds // STRETCH_S).astype(np.int64)
    begin, off = [], []
    for k in np.unique(stretch):
        mine = stretch == k
        middle = float(np.linalg.norm(np.median(away[mine], axis=0)))
        off.append(middle if middle > max(AWAY[0], AWAY[1] * float(np.median(sigma[mine]))) else 0.0)
        begin.append(k * STRETCH_S)
    return np.array(begin), np.array(off)


def from_path(problem: Problem, estimate: Estimate) -> tuple[Array, Array]:
    """How far each fix lies from where the path has the antenna (F, 2), m, and its stated deviation (F,), m."""
    f = problem.fixes
    at = transform(estimate.map_T_robot[f.keyframe], f.keyframe_p_antenna)
    return (f.map_p_antenna - at)[:, :2], np.sqrt(f.cov[:, [0, 1], [0, 1]].max(axis=1))


def jumps(problem: Problem, estimate: Estimate, streams: Streams, lever: Array) -> Iterator[Finding]:
    """Do the fixes step aside and stay there, while wheels and gyro go on? `lever` (3,) is the antenna's place in the robot's frame.

    Over a few seconds dead reckoning is good to centimetres; a solve may bend a whole run to take in half a metre.
    """
    motion = problem.motion
    if not motion.wheels or problem.datum is None or len(problem.stamps_ns) < 2:
        return
    covered = (streams.fix_ns >= motion.stamps_ns[0]) & (streams.fix_ns <= motion.stamps_ns[-1])
    fix_ns, n = streams.fix_ns[covered], int(covered.sum())
    if n < 4 * JUMP_FIXES:
        return
    at = motion.at(fix_ns)
    nearest = np.clip(np.searchsorted(problem.stamps_ns, fix_ns), 0, len(problem.stamps_ns) - 1)
    yaw = yaw_of(estimate.map_T_robot[nearest]) - yaw_of(motion.at(problem.stamps_ns[nearest]))
    told = transform(at, np.broadcast_to(lever, (n, 3)))[:, :2]
    c, s = np.cos(yaw), np.sin(yaw)
    enu, sigma = problem.datum.to_enu(streams.lat_lon_h[covered]), streams.fix_sigma()[covered]
    fix = enu[:, :2]
    poses = path_at(estimate.stamps_ns, estimate.map_T_robot, motion, fix_ns)
    off = np.linalg.norm((transform(poses, np.broadcast_to(lever, (n, 3))) - enu)[:, :2], axis=1)
    refused = off > np.maximum(AWAY[0], AWAY[1] * sigma)
    outvoted = refused.mean() < OUTVOTED
    worst, when, most = 0.0, 0.0, 1.0
    for i in range(JUMP_FIXES, n - JUMP_FIXES):
        mine = slice(i - JUMP_FIXES, i + JUMP_FIXES)
        if fix_ns[i + JUMP_FIXES - 1] - fix_ns[i - JUMP_FIXES] > JUMP_S * 1e9:
            continue
        way = told[mine] - told[i]
        turned = np.column_stack([c[i] * way[:, 0] - s[i] * way[:, 1], s[i] * way[:, 0] + c[i] * way[:, 1]])
        left = fix[mine] - turned
        sides = [np.median(part, axis=0) for part in (left[:JUMP_FIXES], left[JUMP_FIXES:])]
        step = float(np.linalg.norm(sides[1] - sides[0]))
        wide = np.hypot(*(left - np.repeat(sides, JUMP_FIXES, axis=0)).T).reshape(2, -1)
        if np.median(wide, axis=1).max() > JUMP_WIDE * step:
            continue  # scattered outliers, not two places
        if outvoted and _left_behind(off, refused, i, step):
            continue  # a few are elsewhere for a while, and the solve has not followed them
        # A receiver that says that it floats on one side has told of the step.
        stated = max(float(np.median(part)) for part in (sigma[mine][:JUMP_FIXES], sigma[mine][JUMP_FIXES:]))
        bound = max(JUMP[0], JUMP[1] * float(np.median(sigma[mine])), TOLD * stated)
        if step > bound and step / bound > worst / most:
            worst, when, most = step, (fix_ns[i] - motion.stamps_ns[0]) * 1e-9, bound
    if worst > 0:
        yield Finding(
            name="fixes jump", value=worst, bound=most, unit="m",
            sentence=f"at {when:.0f} s the fixes step aside by {worst:.2f} m and stay there, while wheels and gyro go on: either side may be the "
            "right one; check the receiver's base and ambiguities",
        )  # fmt: skip


def _left_behind(off: Array, refused: NDArray[np.bool_], i: int, step: float) -> bool:
    """Whether one side of a step of so many m before fix `i` is refused as a whole: all the while as far from the path, `off` (n,) m, as
    the step is. Where the path bends to it, that falls off.
    """
    for forward in (True, False):
        there = refused[i:] if forward else refused[:i][::-1]
        far = off[i:] if forward else off[:i][::-1]
        back = np.flatnonzero(~there[SKIPPED:])
        length = SKIPPED + int(back[0]) if len(back) else len(there)
        if length >= JUMP_FIXES and float(np.percentile(far[SKIPPED:length], 20)) > WHOLE * step:
            return True
    return False


SKIPPED, WHOLE = 5, 0.7
"""Fixes at the step itself, which may lie on either side; share of the step that a refused side keeps from the path."""


def standing(streams: Streams, motion: Motion) -> Iterator[Finding]:
    """Do fixes move while the wheels stand?"""
    if not motion.wheels or len(streams.fix_ns) < 10 or len(motion.stamps_ns) < 10:
        return
    v = np.diff(motion.distance) / np.maximum(np.diff(motion.stamps_ns) * 1e-9, 1e-3)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], (v < 0.01).astype(int), [0]]))).reshape(-1, 2)
    enu = streams.fixes_enu()[:, :2]
    worst, when, most = 0.0, 0.0, DRIFT[0]
    for a, b in edges.tolist():
        begin, end = motion.stamps_ns[a], motion.stamps_ns[min(b, len(motion.stamps_ns) - 1)]
        seconds = (begin - motion.stamps_ns[0]) * 1e-9
        slipping = any(x - 1 < seconds < y + 1 for x, y, _ in motion.slips)
        if end - begin < STAND_S * 1e9 or slipping:
            continue
        i, j = np.searchsorted(streams.fix_ns, [begin, end])
        if j - i < 6:
            continue
        sigma = float(np.sqrt(np.median(streams.fix_cov[i:j, 0, 0])))
        n = max(2, int(j - i) // 3)
        moved = float(np.linalg.norm(np.median(enu[j - n : j], axis=0) - np.median(enu[i : i + n], axis=0)))
        # Neighbours in time err alike: a stand holds as many independent fixes as it lasts time constants.
        free = max(1.0, (end - begin) * 1e-9 / 3.0 / ALIKE_S)
        bound = max(DRIFT[0], DRIFT[1] * max(sigma, 0.005) / np.sqrt(free))
        if moved > bound and moved > worst:
            worst, when, most = moved, seconds, bound
    if worst > 0:
        yield Finding(
            name="fixes drift", value=worst, bound=most, unit="m",
            sentence=f"fixes moved by {100 * worst:.0f} cm while the wheels stood (at {when:.0f} s): GNSS is worse than it states, or the wheels were blocked",
        )  # fmt: skip


def headings(problem: Problem, estimate: Estimate) -> Iterator[Finding]:
    """Does the heading's baseline lie as TF says?"""
    h = problem.headings
    if len(h.keyframe) < 10:
        return
    middle, size = heading_misfit(problem, estimate.map_T_robot)
    if size > HEADING:
        yield Finding(
            name="heading", value=size, bound=HEADING, unit="rad",
            sentence=f"headings are {np.degrees(middle):+.0f}° from the path (median {np.degrees(size):.0f}°): check the baseline's frame, and that azimuth is counted from east",
        )  # fmt: skip


def trunks(problem: Problem, estimate: Estimate, moving: float, is_tree: NDArray[np.bool_]) -> Iterator[Finding]:
    """What the trunks say of their own sensor: whether things stand still, where they point, whether they stand twice."""
    if moving > MOVING:
        yield Finding(
            name="moving", value=moving, bound=MOVING, unit="", refuses=moving > NOTHING_STANDS,
            sentence=f"{100 * moving:.0f} % of the detections seem to move: the sensor's mounting or clock is wrong, or the wheels are",
        )  # fmt: skip
    tilt, sigma = lean(problem, estimate)
    size = float(np.linalg.norm(tilt))
    if size > max(TILT, 3.0 * float(sigma.max())):
        yield Finding(
            name="tilt", value=size, bound=TILT, unit="rad",
            sentence=f"trunks lean by {np.degrees(size):.1f}° on the mean as the robot sees them (forward {np.degrees(tilt[0]):+.1f}°, left {np.degrees(tilt[1]):+.1f}°): "
            "the mounting of LiDAR or IMU is tilted from what TF says",
        )  # fmt: skip
    e = estimate.residuals.get("trunk", np.zeros(0)).reshape(-1, 3)
    if len(e) > 100:
        torn = float((np.linalg.norm(e, axis=1) > 5.0).mean())
        if torn > TORN:
            yield Finding(
                name="trunks not believed", value=torn, bound=TORN, unit="",
                sentence=f"{100 * torn:.0f} % of the sightings do not fit the trees they were taken for: the path is torn, or fixes drag it",
            )  # fmt: skip
    alike = estimate.scales.get("trunks alike", 1.0)
    if alike > BENT:
        yield Finding(
            name="trunks err alike", value=alike, bound=BENT, unit="",
            sentence=f"sightings of a tree err alike for long ({alike:.1f} times what chance would): the path is bent, or a mounting or clock is wrong",
        )  # fmt: skip
    doubled = twice(estimate.trees[is_tree, :2])
    if doubled > DOUBLED:
        yield Finding(
            name="doubled", value=doubled, bound=DOUBLED, unit="",
            sentence=f"{100 * doubled:.0f} % of the trees have another one much nearer than is usual here: the map may show them twice",
        )  # fmt: skip


def unclaimed(p: Array, score: Array, used: Array, tree: NDArray[np.int64]) -> Iterator[Finding]:
    """Do the trunks that were surely seen become trees? Of all (N, 3) with log-odds (N,), those `used` (M, 3) have a tree (M,) or -1.

    Where the sensor is mounted otherwise than TF says, nothing stands still for long enough to be one.
    """
    near = (np.hypot(p[:, 0], p[:, 1]) < CLOSE_BY) & (score >= 0)
    n = int(near.sum())
    if n < SURE_TRUNKS:
        return
    claimed = int(((np.hypot(used[:, 0], used[:, 1]) < CLOSE_BY) & (tree >= 0)).sum())
    share = 1.0 - claimed / n
    if share > UNCLAIMED:
        nothing = share > NOBODYS
        wrong = "the LiDAR is mounted otherwise than TF says, its axes or its clock are wrong, or the wheels are"
        why = (
            f"they do not stand still in it, so {wrong}"
            if nothing
            else f"they look like trunks from one side alone (bushes, undergrowth), or they do not stand still (people; or {wrong})"
        )
        yield Finding(
            name="trunks of no tree", value=share, bound=UNCLAIMED, unit="", refuses=nothing,
            sentence=f"{100 * share:.0f} % of the trunks that were surely seen belong to no tree of the map: {why}",
        )  # fmt: skip


def seldom(scans: int, with_trees: int) -> Iterator[Finding]:
    """Do the scans show the trees of the map at all? `with_trees` of the `scans` that were taken on the way have a sighting of one."""
    share = with_trees / max(scans, 1)
    if scans >= FEW_SCANS and share < SELDOM:
        yield Finding(
            name="seldom", value=1.0 - share, bound=1.0 - SELDOM, unit="",
            sentence=f"only {with_trees} of {scans} scans show a tree of the map: there are next to none, or the LiDAR is mounted otherwise than TF says",
        )  # fmt: skip


def rows(slid: float) -> Iterator[Finding]:
    """Was a loop closed by much in a planting as regular as its trees are known? By `slid` spacings."""
    if slid > SLID:
        yield Finding(
            name="rows", value=slid, bound=SLID, unit="",
            sentence=f"the run was laid onto itself over {slid:.1f} spacings of a regular planting, which looks the same from every row: it may be off by whole "
            "rows; an IMU or GNSS tells which",
        )  # fmt: skip


SLID = 0.5
"""Of the spacing: beyond half of it the next row was nearer."""


def unsure(probability: Array) -> Iterator[Finding]:
    """Are the trees trees? `probability` (T,) of that kind of each node that is called a tree, NaN where the source tells none."""
    told = probability[np.isfinite(probability)]
    doubted = int((told < SURE_TREE).sum())
    if doubted >= FEW_TREES and doubted > UNSURE * len(told):
        yield Finding(
            name="kinds", value=doubted / len(told), bound=UNSURE, unit="",
            sentence=f"{doubted} of {len(told)} nodes that are called trees may be posts, pillars or corners of houses: what is here is unlike what the trunk "
            f"score was trained on; believe those with kind_probability above {SURE_TREE} rather than the others",
        )  # fmt: skip


SURE_TREE, UNSURE, FEW_TREES = 0.9, 0.25, 4
"""Probability below which a tree is not surely one, share of them, and how many at least (33 simulated runs: up to 0.15; recorded stems, judged by scores that
have not seen them: 0; a recorded street, where half of the trees are none: 0.33 to 0.6)."""
FEW_SCANS, SELDOM = 50, 0.25
"""Scans, and share of them that show a tree: of a recorded street and park all but all do, with the LiDAR turned by 90° a tenth."""


def lean(problem: Problem, estimate: Estimate) -> tuple[Array, Array]:
    """Mean lean (2,) of the trunks in the robot's frame, forward and left, rad, and its standard deviation.

    Least squares of what is the robot's (a mounting) and what is the orchard's (wind, light): they part where the robot turns.
    """
    none = np.zeros(2), np.full(2, np.inf)
    if problem.up is None:
        return none
    known = np.isfinite(problem.up).all(axis=1)
    if known.sum() < 10:
        return none
    T = estimate.map_T_robot[known]
    seen = (problem.up[known] - inverse(T)[:, :3, 2])[:, :2]
    n = len(seen)
    A = np.concatenate([np.tile(np.eye(2), (n, 1, 1)), inverse(T)[:, :2, :2]], axis=2).reshape(2 * n, 4)
    b = seen.reshape(-1)
    prior = np.diag([0.0, 0.0, 1.0, 1.0]) / COMMON_LEAN**2 * ALIKE_LEAN**2
    H = A.T @ A + prior
    x = np.linalg.solve(H, A.T @ b)
    # Keyframes see the same trees again and again: what they say together is no surer than a few of them.
    sigma = ALIKE_LEAN * np.sqrt(np.diag(np.linalg.inv(H)) * max(1.0, n / SEEN_ANEW))
    return x[:2], sigma[:2]


COMMON_LEAN = 0.05
"""All trees of an orchard may lean one way by so much, rad."""
ALIKE_LEAN = 0.06
"""Standard deviation of a keyframe's mean axis, rad."""
SEEN_ANEW = 12.0
"""Keyframes' worth of independent trees in a run."""


TOO_NEAR, TWIN, TWOFOLD = 0.25, 0.3, 0.5
"""Shares of the usual distance and of that to the third nearest below which a tree is one too many; the share of trees so near that the map is there twice."""


def twice(xy: Array) -> float:
    """Share of trees (T, 2) that have another one nearer than a quarter of the usual distance; 0 where they are fewer than PAIRS pairs.

    Where most are there twice, what is usual is the distance to their second one: then each is held against its third nearest, which is another tree's (of
    trees that stand at random 0.17 have one so near, in rows none).
    """
    if len(xy) < 6:
        return 0.0
    distance = np.asarray(cKDTree(xy).query(xy, k=4)[0])
    near = distance[:, 1] < TOO_NEAR * np.median(distance[:, 1])
    twofold = distance[:, 1] < TWIN * distance[:, 3]
    near |= twofold & (twofold.mean() > TWOFOLD)
    return float(near.mean()) if near.sum() >= 2 * PAIRS else 0.0
