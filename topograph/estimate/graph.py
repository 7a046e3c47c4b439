"""The factor graph: poses, velocities, biases and trunks, solved robustly, then once more exactly.

Schedule (shared/GTSAM.md 5): a first path from windows of fixes; poses alone under wide losses; all under Huber;
all under Tukey with noise scales learned from the residuals; last, Gauss-Newton steps with Cartesian trunk residuals,
whose linear system also gives the covariances. Odometry and IMU are never robust.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import gtsam
import numpy as np

import factors
from factors import Kernel
from topograph.errors import InsufficientDataError
from topograph.estimate import covariance
from topograph.estimate.generator import B, L, Pass, V, X, factors_of, fix_cov, graph_of, orthonormal, path_of, trees_of
from topograph.estimate.inertia import Inertia, inertia
from topograph.estimate.initial import initial_path, yaw_of_direction
from topograph.estimate.offsets import tested
from topograph.estimate.problem import Estimate, EstimateConfig, Problem
from topograph.estimate.solver import optimised, ordering_of, with_big_stack
from topograph.geometry import Array, Stamps, inverse, log, transform, wrap
from topograph.trees import Sightings

_NONE = Kernel("none")
_log = logging.getLogger(__name__)


NEAR, MINIMUM = 1e-3, 1e-4
"""Share of the error below which a step's gain ends a pass: where association goes on at once, and else. What is left are millimetres; the exact
steps at the end take them out."""
RELEARNT, STALE = 4, 0.6
"""Under Huber, wrong fixes bend the path, and what they bend is learnt as noise of the trunks. Where the residuals of the last
pass shrink below this share of the noise, it is learnt again, at most so often."""


QUICK_HEIGHT = 0.3
"""Sigma of the trees' heights about their first sighting in quick passes, m. Recorded detections do not tell where on the trunk they lie: left
free, the height takes up what the range is off by, in steps of metres that Gauss-Newton overshoots."""


class Moving(NamedTuple):
    """What a solve leaves to the next one of the same run with other trees: preintegrated samples, and GTSAM's values with velocities and biases."""

    inert: Inertia | None
    values: Any


@dataclass(frozen=True, slots=True)
class Converged:
    """A solve before its last, exact steps: `estimate` has path and trees, and no covariances yet.

    Attributes:
        problem: with the sightings that were used.
        last: losses and noise of the last pass.
        moving: with all of GTSAM's values.
        began: of `time.perf_counter`.
    """

    problem: Problem
    last: Pass
    moving: Moving
    estimate: Estimate
    began: float


def solve(problem: Problem, config: EstimateConfig) -> Estimate:
    """Path and trees of a run with their covariances.

    Raises:
        InsufficientDataError: the data contradict each other or do not determine the path.
    """
    return finish(converge(problem, config), config)


@contextmanager
def _determined() -> Iterator[None]:
    """Whatever GTSAM stumbles over is that the data contradict each other or do not determine the path."""
    try:
        yield
    except (RuntimeError, IndexError, ValueError, np.linalg.LinAlgError) as err:
        first = (str(err).strip().splitlines() or [type(err).__name__])[0]
        _log.debug("the solve failed", exc_info=True)
        raise InsufficientDataError(
            f"the data do not determine the path, or contradict each other beyond repair ({first}); `topograph inspect` shows the streams"
        ) from err


@_determined()
def quick(problem: Problem, config: EstimateConfig, *, patient: bool = False) -> Estimate:
    """As `solve`, for association: one Huber pass of few steps, or `patient`, until it has converged; no covariances."""
    began = time.perf_counter()
    problem, values = _begun(problem, config, config.quick_sightings, None)
    huber = Kernel("huber", config.huber)
    first = Pass(trunk=huber, fix=huber, fix_floor=0.05, height=QUICK_HEIGHT)
    steps, tolerance = (3 * config.iterations, MINIMUM) if patient else (10, NEAR)
    values = optimised(graph_of(factors_of(problem, first, config, None, values)), values, steps, tolerance)
    return _estimate(problem, config, values, first, None, time.perf_counter() - began)


@_determined()
def converge(problem: Problem, config: EstimateConfig, former: Moving | None = None) -> Converged:
    """The robust passes of `solve`; it begins where `former` was. Raises as it does."""
    began = time.perf_counter()
    inert = former.inert if former is not None else inertia(problem) if config.use_imu else None
    problem, values = _begun(problem, config, config.most_sightings, inert)
    if former is not None and inert is not None:
        for k in range(len(problem.stamps_ns)):
            values.update(V + k, former.values.atVector(V + k))
            values.update(B + k, former.values.atConstantBias(B + k))
    huber = Kernel("huber", config.huber)
    first = Pass(trunk=huber, fix=huber, fix_floor=0.0)
    values = optimised(
        graph_of(factors_of(problem, first, config, inert, values)), values, 3 * config.iterations, MINIMUM
    )
    scales = _learned_scales(problem, values, first) if config.learn_scale else (1.0, 1.0, 1.0)
    tukey = Kernel("tukey", config.tukey)
    last = Pass(trunk=tukey, fix=tukey, trunk_scale=scales[0], fix_scale=scales[1], alike=scales[2])
    values = optimised(graph_of(factors_of(problem, last, config, inert, values)), values, config.iterations, MINIMUM)
    for _ in range(RELEARNT if config.learn_scale else 0):
        scales = _learned_scales(problem, values, last)
        if scales[0] > STALE * last.trunk_scale and scales[1] > STALE * last.fix_scale:
            break
        less = (min(scales[0], last.trunk_scale), min(scales[1], last.fix_scale))
        last = replace(last, trunk_scale=less[0], fix_scale=less[1], alike=scales[2])
        values = optimised(
            graph_of(factors_of(problem, last, config, inert, values)), values, config.iterations, MINIMUM
        )
    estimate = _estimate(problem, config, values, last, None, time.perf_counter() - began)
    return Converged(problem, last, Moving(inert, values), estimate, began)


@_determined()
def finish(c: Converged, config: EstimateConfig) -> Estimate:
    """The exact steps of `solve`, covariances, and the tests of what is taken as given. Raises as it does."""
    inert = c.moving.inert
    values, linear = with_big_stack(lambda: _polish(c.problem, c.last, config, inert, c.moving.values))
    out = _estimate(c.problem, config, values, c.last, linear, 0.0)
    del linear  # as large as the graph: the tests make one of their own
    try:
        offsets = with_big_stack(lambda: tested(c.problem, c.last, config, inert, values, out.map_T_robot, out.trees))
    except (RuntimeError, IndexError, np.linalg.LinAlgError):  # the estimate stands without them
        _log.warning("clocks and mountings could not be tested", exc_info=True)
        offsets = ()
    return replace(out, offsets=offsets, seconds=time.perf_counter() - c.began)


def _begun(problem: Problem, config: EstimateConfig, most: int, inert: Inertia | None) -> tuple[Problem, Any]:
    """The problem with at most so many sightings of each keyframe, and the values to begin from."""
    poses = problem.start
    if poses is None:
        poses = _poses_alone(problem, initial_path(problem), config)
    trees = _median_trees(problem, poses)
    problem = replace(problem, sightings=_nearest(problem.sightings, most))
    return problem, _values(problem, poses, trees, inert)


def _nearest(s: Sightings, most: int) -> Sightings:
    """At most `most` sightings of each keyframe, the surest first; and at least two of each tree."""
    size = np.trace(s.cov, axis1=1, axis2=2)
    order = np.lexsort((size, s.keyframe))
    rank = np.empty(len(s), np.int64)
    keyframe = s.keyframe[order]
    first = np.searchsorted(keyframe, keyframe, side="left")
    rank[order] = np.arange(len(s)) - first
    by_tree = np.lexsort((size, s.tree))
    tree = s.tree[by_tree]
    rank_in_tree = np.empty(len(s), np.int64)
    rank_in_tree[by_tree] = np.arange(len(s)) - np.searchsorted(tree, tree, side="left")
    keep = (rank < most) | (rank_in_tree < 2)
    if keep.all():  # no copy of what a long run holds most of
        return s
    return Sightings(
        keyframe=s.keyframe[keep],
        tree=s.tree[keep],
        p=s.p[keep],
        cov=s.cov[keep],
        count=s.count[keep],
        late=s.late[keep],
    )


def _poses_alone(problem: Problem, poses: Array, config: EstimateConfig) -> Array:
    """Odometry, fixes and headings only, under losses that narrow from metres to decimetres."""
    values = _values(problem, poses, np.zeros((0, 3)), None)
    if len(problem.fixes.keyframe) >= 3:
        for p in (
            Pass(trunk=_NONE, fix=Kernel("huber", 1.345), fix_floor=1.0),
            Pass(trunk=_NONE, fix=Kernel("cauchy", 1.0), fix_floor=0.1),
        ):
            values = optimised(
                graph_of(factors_of(problem, p, config, None, values, without=("trunk", "tree"))), values, 30, 1e-4
            )
    return path_of(problem, values)


def _values(problem: Problem, poses: Array, trees: Array, inert: Inertia | None) -> Any:
    values = gtsam.Values()
    for k, T in enumerate(factors.to_pose3s(orthonormal(poses))):
        values.insert(X + k, T)
    for j, p in zip(problem.names().tolist(), trees, strict=False):
        values.insert(L + j, p)
    if inert is not None:
        seconds = problem.stamps_ns * 1e-9
        velocity = np.gradient(poses[:, :3, 3], seconds - seconds[0], axis=0)
        bias = gtsam.imuBias.ConstantBias(np.zeros(3), inert.gyro_bias)
        for k in range(len(poses)):
            values.insert(V + k, velocity[k])
            values.insert(B + k, bias)
    return values


def _median_trees(problem: Problem, poses: Array) -> Array:
    """(T, 3) median of each tree's projected sightings: a wrong one does not move it."""
    s = problem.sightings
    projected = transform(poses[s.keyframe], s.p) if len(s) else np.zeros((0, 3))
    trees = np.zeros((problem.n_trees, 3))
    order = np.argsort(s.tree, kind="stable")
    ends = np.searchsorted(s.tree[order], np.arange(problem.n_trees + 1))
    for j in range(problem.n_trees):
        mine = order[ends[j] : ends[j + 1]]
        if len(mine) == 0:
            raise InsufficientDataError(f"tree {j} has no sighting")
        trees[j] = np.median(projected[mine], axis=0)
    return trees


def _trunk_residuals(problem: Problem, values: Any, scale: float) -> Array:
    """Whitened Cartesian residuals (M, 3) of the sightings."""
    s = problem.sightings
    if len(s) == 0:
        return np.zeros((0, 3))
    e, _, _ = factors.trunk_residual(path_of(problem, values)[s.keyframe], trees_of(problem, values)[s.tree], s.p)
    return np.asarray(np.linalg.solve(np.linalg.cholesky(s.cov) * scale, e[..., None])[..., 0])


def _fix_residuals(problem: Problem, values: Any) -> Array:
    f = problem.fixes
    return np.asarray(transform(path_of(problem, values)[f.keyframe], f.keyframe_p_antenna) - f.map_p_antenna)


def _learned_scales(problem: Problem, values: Any, p: Pass) -> tuple[float, float, float]:
    """Factors on the noise of trunks and fixes that make the middle of their residuals what a Gaussian's would be, and the part of
    the trunks' factor that neighbours' likeness makes.

    Sightings of a tree from places close together err alike; the scale of the trunks grows with that correlation.
    """
    trunk, fix, alike = 1.0, 1.0, 1.0
    e = _trunk_residuals(problem, values, 1.0)
    s = problem.sightings
    if len(e) > 30:
        norm = np.linalg.norm(e, axis=1)
        trunk = float(np.clip(np.median(norm) / 1.538, 0.2, 6.0))  # median of a chi with 3 dof
        order = np.lexsort((s.keyframe, s.tree))
        next_to = (np.diff(s.tree[order]) == 0) & (np.diff(s.keyframe[order]) <= 2)
        a, b = e[order][:-1][next_to], e[order][1:][next_to]
        good = (np.linalg.norm(a, axis=1) < 4 * trunk) & (np.linalg.norm(b, axis=1) < 4 * trunk)
        if good.sum() > 30:
            rho = float(np.clip(np.mean(a[good] * b[good]) / np.mean(0.5 * (a[good] ** 2 + b[good] ** 2)), 0.0, 0.9))
            alike = float(np.sqrt((1 + rho) / (1 - rho)))
            trunk *= alike
    if len(problem.fixes.keyframe) > 10:
        r = _fix_residuals(problem, values)[:, :2] / np.sqrt(problem.fixes.cov[:, [0, 1], [0, 1]] + 1e-4)
        fix = float(np.clip(np.median(np.linalg.norm(r, axis=1)) / 1.177, 1.0, 5.0))
    return trunk, fix, alike


POLISHED, UNDECIDED = 2e-5, 0.01
"""Root mean square of a last step, m: steps shrink, and a hundredth of this is what is left; and the share of poses and trees that it leaves out: a
tree whose sightings contradict each other may creep on for many steps, and moves nothing else."""


def _polish(problem: Problem, p: Pass, config: EstimateConfig, inert: Inertia | None, values: Any) -> tuple[Any, Any]:
    """Gauss-Newton with Cartesian trunk residuals until steps are below `POLISHED`; the values and the last system."""
    ordering = None
    rest = graph_of(factors_of(problem, p, config, inert, values, without=("trunk",)))
    s = problem.sightings
    keys_x, keys_l = (X + s.keyframe).tolist(), (L + problem.names()[s.tree]).tolist()
    cov = p.trunk_scale**2 * s.cov
    linear = None
    path, trees = path_of(problem, values), trees_of(problem, values)
    for _ in range(8):
        linear = rest.linearize(values)
        if len(s):
            factors.trunk_linear(linear, keys_x, keys_l, path[s.keyframe], trees[s.tree], s.p, cov, p.trunk)
        ordering = ordering or ordering_of(linear, values.size())
        before = np.concatenate([path[:, :3, 3], trees])
        values = values.retract(linear.optimize(ordering))
        path, trees = path_of(problem, values), trees_of(problem, values)
        moved = np.sum((np.concatenate([path[:, :3, 3], trees]) - before) ** 2, axis=1)
        if np.sort(moved)[: math.ceil((1.0 - UNDECIDED) * len(moved))].mean() < POLISHED**2:
            break
    return values, linear


def _estimate(problem: Problem, config: EstimateConfig, values: Any, p: Pass, linear: Any, seconds: float) -> Estimate:
    poses, trees = path_of(problem, values), trees_of(problem, values)
    # What a known map's frame is off by is in its trees' covariances already.
    datum_cov = covariance.of_datum(problem, p.fix_scale, config) if problem.known is None else np.zeros((3, 3))
    joint = None
    tree_cov = np.full((problem.n_trees, 3, 3), np.nan)
    if linear is not None and problem.n_trees:
        keys = [L + j for j in problem.names().tolist()]
        joint, tree_cov = with_big_stack(lambda: covariance.of_trees(linear, keys))
        tree_cov = tree_cov + datum_cov + config.tree_floor**2 * np.diag([1.0, 1.0, 1.0])
    e = _trunk_residuals(problem, values, p.trunk_scale)
    residuals = {"trunk": e.ravel(), **_other_residuals(problem, values, p, config)}
    return Estimate(
        stamps_ns=problem.stamps_ns, map_T_robot=poses, trees=trees, tree_cov=tree_cov, joint=joint, datum_cov=datum_cov,
        tree=np.zeros(0, np.int64), weights=p.trunk.weight(np.linalg.norm(e, axis=1)), residuals=residuals,
        residual_ns=_residual_stamps(problem, residuals), seconds=seconds,
        scales={"trunk": p.trunk_scale, "fix": p.fix_scale, "trunks alike": p.alike},
    )  # fmt: skip


def _residual_stamps(problem: Problem, residuals: dict[str, Array]) -> dict[str, Stamps]:
    """Factor type -> the keyframe's stamp of each residual; a step's is that of its end."""
    steps = np.arange(1, len(problem.stamps_ns))
    keyframe = {
        "trunk": problem.sightings.keyframe, "odometry": steps, "turn": steps, "fix": problem.fixes.keyframe, "heading": problem.headings.keyframe,
    }  # fmt: skip
    return {
        name: np.repeat(problem.stamps_ns[keyframe[name]], len(r) // max(len(keyframe[name]), 1))
        for name, r in residuals.items()
    }


def _other_residuals(problem: Problem, values: Any, p: Pass, config: EstimateConfig) -> dict[str, Array]:
    poses = path_of(problem, values)
    step = inverse(problem.odom_T_robot[:-1]) @ problem.odom_T_robot[1:]
    misfit = log(inverse(step) @ inverse(poses[:-1]) @ poses[1:]) / problem.step_sigma
    out = {"odometry": misfit[:, 3:5].ravel(), "turn": misfit[:, 2]}
    if len(problem.fixes.keyframe):
        variance = np.diagonal(fix_cov(problem, p), axis1=1, axis2=2)
        out["fix"] = (_fix_residuals(problem, values) / np.sqrt(variance)).ravel()
    h = problem.headings
    if len(h.keyframe):
        seen = yaw_of_direction(poses[h.keyframe], h.direction)
        out["heading"] = wrap(seen - h.yaw) / np.maximum(h.sigma, config.heading_floor)
    return out
