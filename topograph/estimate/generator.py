"""The graph as a generator: every factor of a problem, once."""

from __future__ import annotations

from collections.abc import Container, Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np

import factors
from factors import Kernel
from topograph.estimate.inertia import Inertia
from topograph.estimate.problem import EstimateConfig, Problem
from topograph.geometry import Array, inverse, transform

X, V, B, L = (gtsam.symbol(c, 0) for c in "xvbl")
"""Poses, velocities, biases, and trees."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Pass:
    """Losses and noise of one solve: least deviation of a fix (m), factors on the noise of trunks and fixes, the
    part of the trunks' that the likeness of neighbours makes, and the deviation of the trees' heights about where they begin (m)."""

    trunk: Kernel
    fix: Kernel
    fix_floor: float = 0.0
    trunk_scale: float = 1.0
    fix_scale: float = 1.0
    alike: float = 1.0
    height: float = 100.0


def orthonormal(poses: Array) -> Array:
    """Poses (..., 4, 4) with rounding taken out of their rotations."""
    U, _, Vt = np.linalg.svd(poses[..., :3, :3])
    out = poses.copy()
    out[..., :3, :3] = U @ Vt
    return out


def path_of(problem: Problem, values: Any) -> Array:
    """map_T_robot (K, 4, 4) in GTSAM's values."""
    rows = gtsam.utilities.extractPose3(values)  # rotation (9), translation (3), in key order
    out = np.tile(np.eye(4), (len(problem.stamps_ns), 1, 1))
    out[:, :3, :3] = rows[:, :9].reshape(-1, 3, 3)
    out[:, :3, 3] = rows[:, 9:]
    return out


def trees_of(problem: Problem, values: Any) -> Array:
    """Trees (T, 3) in GTSAM's values."""
    return np.array([values.atPoint3(L + j) for j in problem.names().tolist()]).reshape(-1, 3)


def factors_of(
    problem: Problem,
    p: Pass,
    config: EstimateConfig,
    inert: Inertia | None,
    values: Any,
    *,
    without: Container[str] = (),
) -> Iterator[tuple[str, Any]]:
    """Every factor of the problem once, with its kind: "motion", "odometry", "imu", "fix", "link", "heading", "trunk", "tree".

    `values` are those that a solve begins from; kinds in `without` are left out, and not built.
    """
    yield from ((kind, f) for kind, f in motion_factors(problem, inert) if kind not in without)
    parts = (
        ("fix", _fixes(problem, p)),
        ("link", _links(problem)),
        ("heading", _headings(problem, config)),
        ("trunk", _trunks(problem, p, values)),
        ("tree", _tree_priors(problem, p.height)),
    )
    for kind, part in parts:  # generators: what is left out has not begun
        if kind not in without:
            yield from ((kind, f) for f in part)


def graph_of(chosen: Iterable[tuple[str, Any]]) -> Any:
    """A NonlinearFactorGraph of factors with their kinds."""
    g = gtsam.NonlinearFactorGraph()
    for _, f in chosen:
        g.add(f)
    return g


def _links(problem: Problem) -> Iterator[Any]:
    if problem.link is not None:
        sigma = [0.1, 0.1, 0.02, 0.2, 0.2, 0.5]
        yield factors.odometry(X + problem.link.a, X + problem.link.b, orthonormal(problem.link.a_T_b), sigma)


def _headings(problem: Problem, config: EstimateConfig) -> Iterator[Any]:
    h = problem.headings
    sigma = np.maximum(h.sigma, config.heading_floor)
    yield from factors.headings((X + h.keyframe).tolist(), h.yaw, h.direction, sigma, Kernel("huber", 1.345))


def _trunks(problem: Problem, p: Pass, values: Any) -> Iterator[Any]:
    s = problem.sightings
    keys = (X + s.keyframe).tolist(), (L + problem.names()[s.tree]).tolist()
    robot_T_map = inverse(path_of(problem, values))
    expected = transform(robot_T_map[s.keyframe], trees_of(problem, values)[s.tree])
    yield from factors.trunks(*keys, s.p, p.trunk_scale**2 * s.cov, p.trunk, expected=expected)


def _tree_priors(problem: Problem, height: float) -> Iterator[Any]:
    """Keep every tree in the system even when a loss has given up on all its sightings."""
    wide = factors.sigmas([100.0, 100.0, height])
    s, names = problem.sightings, problem.names()
    if problem.known is not None:
        k = problem.known
        for i in np.flatnonzero(k.tree >= 0).tolist():
            yield gtsam.PriorFactorPoint3(L + int(names[k.tree[i]]), k.p[i], factors.gaussian(k.cov[i]))
    first = np.unique(s.tree, return_index=True)[1]
    T = problem.start if problem.start is not None else problem.odom_T_robot
    for i in first.tolist():
        yield gtsam.PriorFactorPoint3(L + int(names[s.tree[i]]), transform(T[s.keyframe[i]], s.p[i]), wide)


def motion_factors(problem: Problem, inert: Inertia | None) -> Iterator[tuple[str, Any]]:
    n = len(problem.stamps_ns)
    if problem.pose_sigma is not None:
        assert problem.start is not None
        for k in range(n):
            exact = factors.sigmas([problem.pose_sigma] * 6)
            yield "motion", gtsam.PriorFactorPose3(X + k, factors.to_pose3(problem.start[k]), exact)
        return
    step = inverse(problem.odom_T_robot[:-1]) @ problem.odom_T_robot[1:]
    sigma = problem.step_sigma.copy()
    if inert is not None:  # the gyro speaks through its own factor
        covered = ~np.array([f is None for f in inert.preintegrated])
        sigma[covered, :3] = np.maximum(5.0 * sigma[covered, :3], 0.05)
    for f in factors.odometries([X + k for k in range(n)], orthonormal(step), sigma):
        yield "odometry", f
    georeferenced = len(problem.fixes.keyframe) >= 3
    first = factors.to_pose3(orthonormal(problem.start[0] if problem.start is not None else problem.odom_T_robot[0]))
    tilt = 0.3 if problem.up_sigma is not None and np.isfinite(problem.up_sigma).any() else 0.03
    loose = [10.0, 10.0, 10.0, 1e4, 1e4, 1e4] if georeferenced else [tilt, tilt, 1e-3, 1e-3, 1e-3, 1e-3]
    yield "motion", gtsam.PriorFactorPose3(X, first, factors.sigmas(loose))
    if problem.inertial is None:
        for k in range(0, n, 10):
            yield "motion", factors.level(X + k, 0.3)
        if problem.up is not None and problem.up_sigma is not None:
            for k in np.flatnonzero(np.isfinite(problem.up_sigma)).tolist():
                yield "motion", factors.level(X + k, float(problem.up_sigma[k]), problem.up[k])
    elif inert is None:  # quick passes: the complementary filter's attitude stands in for the IMU factors
        for k in range(0, n, 5):
            yield "motion", factors.level(X + k, 0.02, problem.odom_T_robot[k, 2, :3])
    if inert is not None:
        for f in inert.factors(X, V, B):
            yield "imu", f


def _fixes(problem: Problem, p: Pass) -> Iterator[Any]:
    """Each fix twice: its horizontal part and its height, each under a loss of its own.

    Heights fail by tens of metres while positions are sound (a receiver that has just started): one must not take
    the other with it.
    """
    f = problem.fixes
    cov = fix_cov(problem, p)
    free = 1e6
    flat, tall = cov.copy(), np.zeros_like(cov)
    flat[:, 2, :2] = flat[:, :2, 2] = 0.0
    flat[:, 2, 2] = free
    tall[:, 0, 0] = tall[:, 1, 1] = free
    tall[:, 2, 2] = cov[:, 2, 2]
    for part in (flat, tall):
        yield from factors.fixes((X + f.keyframe).tolist(), f.map_p_antenna, f.keyframe_p_antenna, part, p.fix)


def fix_cov(problem: Problem, p: Pass) -> Array:
    f = problem.fixes
    return np.asarray(p.fix_scale**2 * f.cov + p.fix_floor**2 * np.eye(3))
