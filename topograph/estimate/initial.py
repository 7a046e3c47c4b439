"""A first path: dead reckoning laid onto the fixes piece by piece, so that the solver starts near the answer."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from topograph.estimate.problem import Problem
from topograph.geometry import Array, fit_rigid_2d, planar, transform, wrap, yaw_of


def initial_path(problem: Problem) -> Array:
    """Poses (K, 4, 4) near enough for a robust solve.

    Windows of the dead-reckoned path are fitted to their fixes (rigid, in the plane, robust); the turn and shift
    found are interpolated between window centres. Without fixes the path is dead reckoning itself, turned by the
    first headings when there are some.
    """
    odom = problem.odom_T_robot
    fixes = problem.fixes
    if len(fixes.keyframe) < 3:
        return _turned_by_heading(problem, odom)
    distance = problem.motion.distance_at(problem.stamps_ns)
    antenna = transform(odom[fixes.keyframe], fixes.keyframe_p_antenna)
    at = distance[fixes.keyframe]
    half = 60.0 if problem.motion.gyro else 20.0
    centres, values = [], []
    for c in np.arange(at[0], at[-1] + 10.0, 10.0):
        chosen = slice(
            int(np.searchsorted(at, c - half, "right")), int(np.searchsorted(at, c + half))
        )  # keyframes, and so distances, rise
        if chosen.stop - chosen.start < 5 or np.ptp(antenna[chosen, :2], axis=0).max() < 4.0:
            continue
        source, target = antenna[chosen], fixes.map_p_antenna[chosen]
        x, y, yaw = _robust_fit(source[:, :2], target[:, :2])
        z = float(np.median(target[:, 2] - source[:, 2]))
        centres.append(c)
        values.append((x, y, yaw, z))
    if not centres:
        return _shifted(problem, odom)
    v = np.array(values)
    # Far-apart windows give shifts about different turns; compare them where the robot is.
    yaw_all = np.interp(distance, centres, np.unwrap(v[:, 2]))
    here = odom[:, :2, 3]

    def placed(window: NDArray[np.int64]) -> Array:
        """Where each pose lies by the fit of its `window` (K,)."""
        x, y, yaw = v[window, :3].T
        c, s = np.cos(yaw), np.sin(yaw)
        return np.stack([c * here[:, 0] - s * here[:, 1] + x, s * here[:, 0] + c * here[:, 1] + y], axis=1)

    i = np.clip(np.searchsorted(centres, distance) - 1, 0, max(len(centres) - 2, 0))
    j = np.minimum(i + 1, len(centres) - 1)
    span = np.maximum(np.array(centres)[j] - np.array(centres)[i], 1e-9)
    u = np.clip((distance - np.array(centres)[i]) / span, 0.0, 1.0)[:, None]
    xy = (1 - u) * placed(i) + u * placed(j)
    out = planar(0.0, 0.0, yaw_all) @ odom
    out[:, :2, 3] = xy
    out[:, 2, 3] = odom[:, 2, 3] + np.interp(distance, centres, v[:, 3])
    return np.asarray(out)


def moves_enough(problem: Problem, least: float = 8.0) -> bool:
    """The fixes reach so far, m, that the path laid onto them has a heading of its own."""
    p = problem.fixes.map_p_antenna
    return len(p) >= 10 and bool(np.ptp(p[:, :2], axis=0).max() > least)


def _robust_fit(source: Array, target: Array) -> tuple[float, float, float]:
    w = np.ones(len(source))
    fit = fit_rigid_2d(source, target, w)
    for _ in range(8):
        c, s = np.cos(fit[2]), np.sin(fit[2])
        moved = np.stack([c * source[:, 0] - s * source[:, 1], s * source[:, 0] + c * source[:, 1]], axis=1) + fit[:2]
        r = np.linalg.norm(target - moved, axis=1)
        scale = max(1.4826 * float(np.median(r)), 0.02)
        w = 1.0 / (1.0 + (r / (2.0 * scale)) ** 2)
        fit = fit_rigid_2d(source, target, w)
    return fit


def _turned_by_heading(problem: Problem, odom: Array) -> Array:
    h = problem.headings
    if len(h.keyframe) == 0:
        return odom.copy()
    first = h.keyframe[:10]
    seen = yaw_of_direction(odom[first], h.direction[:10])
    turn = float(np.angle(np.mean(np.exp(1j * wrap(h.yaw[:10] - seen)))))
    return np.asarray(planar(0.0, 0.0, turn) @ odom)


def _shifted(problem: Problem, odom: Array) -> Array:
    out = _turned_by_heading(problem, odom)
    f = problem.fixes
    antenna = transform(out[f.keyframe], f.keyframe_p_antenna)
    out[:, :3, 3] += np.median(f.map_p_antenna - antenna, axis=0)
    return out


def yaw_of_direction(pose: Array, direction: Array) -> Array:
    """Azimuth (N,) in rad of body directions (N, 3) under poses (N, 4, 4)."""
    d = (pose[:, :3, :3] @ direction[:, :, None])[..., 0]
    return np.asarray(np.arctan2(d[:, 1], d[:, 0])) if len(d) else yaw_of(pose)


def heading_misfit(problem: Problem, poses: Array) -> tuple[float, float]:
    """Mean difference of the headings from poses (K, 4, 4), rad, and the median of its size."""
    h = problem.headings
    off = wrap(yaw_of_direction(poses[h.keyframe], h.direction) - h.yaw)
    return float(np.angle(np.mean(np.exp(1j * off)))), float(np.median(np.abs(off)))
