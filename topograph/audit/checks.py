"""The checks, each a number and a bound. What a clean run shows stands beside each bound (simulated runs of 11 designs, seeds below 1000)."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.spatial import cKDTree

from topograph.audit.verdict import Finding
from topograph.estimate import Estimate, Problem
from topograph.estimate.initial import yaw_of_direction
from topograph.geometry import Array, inverse, transform, wrap
from topograph.motion import Motion, Streams

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
UNBELIEVED = 0.3
"""Share of fixes that may be so (clean: 0; a reflection for a quarter of a run is absorbed)."""
HEADING = 0.06
"""Median difference of heading and path, rad (clean: 0.003)."""
MOVING = 0.3
"""Share of detections that seem to move (clean: 0.03)."""
DOUBLED = 0.12
"""Share of trees with another one nearer than half of the usual distance (clean: 0.01)."""
TILT = 0.07
"""Mean lean of all trunks in the robot's own frame, rad (clean: up to 0.03)."""
DRIFT = (0.05, 6.0)
"""Fixes may drift so far while the wheels stand, m and standard deviations (clean: 0.01)."""
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
    """How many fixes the path does not go through, and when."""
    f = problem.fixes
    if len(f.keyframe) < 10:
        return
    at = transform(estimate.map_T_robot[f.keyframe], f.keyframe_p_antenna)
    away = np.linalg.norm((at - f.map_p_antenna)[:, :2], axis=1)
    sigma = np.sqrt(f.cov[:, [0, 1], [0, 1]].max(axis=1))
    far = away > np.maximum(AWAY[0], AWAY[1] * sigma)
    share = float(far.mean())
    if share > UNBELIEVED:
        seconds = (problem.stamps_ns[f.keyframe] - problem.stamps_ns[0]) * 1e-9
        yield Finding(
            name="fixes not believed", value=share, bound=UNBELIEVED, unit="",
            sentence=f"{100 * share:.0f} % of the fixes contradict the others, or wheels and trunks, by {float(np.median(away[far])):.2f} m "
            f"(from {seconds[far][0]:.0f} to {seconds[far][-1]:.0f} s): the map may lie off by as much; check the receiver's base and its status",
        )  # fmt: skip


def standing(streams: Streams, motion: Motion) -> Iterator[Finding]:
    """Do fixes move while the wheels stand?"""
    if not motion.wheels or len(streams.fix_ns) < 10 or len(motion.stamps_ns) < 10:
        return
    v = np.diff(motion.distance) / np.maximum(np.diff(motion.stamps_ns) * 1e-9, 1e-3)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], (v < 0.01).astype(int), [0]]))).reshape(-1, 2)
    worst, when = 0.0, 0.0
    for a, b in edges.tolist():
        begin, end = motion.stamps_ns[a], motion.stamps_ns[b]
        inside = (streams.fix_ns >= begin) & (streams.fix_ns <= end)
        if end - begin < STAND_S * 1e9 or inside.sum() < 6:
            continue
        sigma = float(np.sqrt(np.median(streams.fix_cov[inside][:, 0, 0])))
        g = streams.lat_lon_h[inside]
        enu = (g[:, :2] - g[0, :2]) * 111_320.0 * np.array([1.0, np.cos(np.radians(g[0, 0]))])
        n = max(2, len(enu) // 3)
        moved = float(np.linalg.norm(np.median(enu[-n:], axis=0) - np.median(enu[:n], axis=0)))
        if moved > max(DRIFT[0], DRIFT[1] * max(sigma, 0.005) / np.sqrt(n)) and moved > worst:
            worst, when = moved, (begin - motion.stamps_ns[0]) * 1e-9
    if worst > 0:
        yield Finding(
            name="fixes drift", value=worst, bound=DRIFT[0], unit="m",
            sentence=f"fixes moved by {100 * worst:.0f} cm while the wheels stood (at {when:.0f} s): GNSS is worse than it states, or the wheels were blocked",
        )  # fmt: skip


def headings(problem: Problem, estimate: Estimate) -> Iterator[Finding]:
    """Does the heading's baseline lie as TF says?"""
    h = problem.headings
    if len(h.keyframe) < 10:
        return
    off = wrap(yaw_of_direction(estimate.map_T_robot[h.keyframe], h.direction) - h.yaw)
    middle = float(np.angle(np.mean(np.exp(1j * off))))
    size = float(np.median(np.abs(off)))
    if size > HEADING:
        yield Finding(
            name="heading", value=size, bound=HEADING, unit="rad",
            sentence=f"headings are {np.degrees(middle):+.0f}° from the path (median {np.degrees(size):.0f}°): check the baseline's frame, and that azimuth is counted from east",
        )  # fmt: skip


def trunks(problem: Problem, estimate: Estimate, moving: float) -> Iterator[Finding]:
    """What the trunks say of their own sensor: whether things stand still, where they point, whether they stand twice."""
    if moving > MOVING:
        yield Finding(
            name="moving", value=moving, bound=MOVING, unit="",
            sentence=f"{100 * moving:.0f} % of the detections seem to move: the sensor's mounting or clock is wrong, or the wheels are",
        )  # fmt: skip
    b = lean(problem, estimate)
    size = float(np.linalg.norm(b))
    if size > TILT:
        yield Finding(
            name="tilt", value=size, bound=TILT, unit="rad",
            sentence=f"trunks lean by {np.degrees(size):.1f}° on the mean as the robot sees them (forward {np.degrees(b[0]):+.1f}°, left {np.degrees(b[1]):+.1f}°): "
            "the mounting of LiDAR or IMU is tilted from what TF says",
        )  # fmt: skip
    doubled = twice(estimate.trees[:, :2])
    if doubled > DOUBLED:
        yield Finding(
            name="doubled", value=doubled, bound=DOUBLED, unit="",
            sentence=f"{100 * doubled:.0f} % of the trees have another one much nearer than is usual here: the map may show them twice",
        )  # fmt: skip


def lean(problem: Problem, estimate: Estimate) -> Array:
    """Mean (2,) over keyframes of the trunks' axes less the map's vertical, in the robot's frame, rad."""
    if problem.up is None:
        return np.zeros(2)
    known = np.isfinite(problem.up).all(axis=1)
    if known.sum() < 10:
        return np.zeros(2)
    vertical = inverse(estimate.map_T_robot[known])[:, :3, 2]
    return np.asarray(np.median(problem.up[known] - vertical, axis=0)[:2])


def twice(xy: Array) -> float:
    """Share of trees (T, 2) that have another one nearer than half of the usual distance."""
    if len(xy) < 6:
        return 0.0
    distance = np.asarray(cKDTree(xy).query(xy, k=2)[0])[:, 1]
    return float((distance < 0.5 * np.median(distance)).mean())
