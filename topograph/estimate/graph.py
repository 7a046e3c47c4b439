"""The factor graph: poses, velocities, biases and trunks, solved robustly, then once more exactly.

Schedule (shared/GTSAM.md 5): a first path from windows of fixes; poses alone under wide losses; all under Huber;
all under Tukey with noise scales learned from the residuals; last, Gauss-Newton steps with Cartesian trunk residuals,
whose linear system also gives the covariances. Odometry and IMU are never robust.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Container, Iterator
from dataclasses import dataclass, replace
from typing import Any

import gtsam
import numpy as np

import factors
from factors import Kernel
from topograph.errors import InsufficientDataError
from topograph.estimate import covariance
from topograph.estimate.inertia import Inertia, inertia
from topograph.estimate.initial import initial_path, yaw_of_direction
from topograph.estimate.problem import Estimate, EstimateConfig, Offset, Problem
from topograph.estimate.solver import optimised, ordering_of, with_big_stack
from topograph.geometry import Array, Stamps, inverse, log, transform, wrap
from topograph.trees import Sightings

X, V, B, L, C = (gtsam.symbol(c, 0) for c in "xvblc")
_NONE = Kernel("none")
_log = logging.getLogger(__name__)


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


RELEARNT, STALE = 4, 0.6
"""Under Huber, wrong fixes bend the path, and what they bend is learnt as noise of the trunks. Where the residuals of the last
pass shrink below this share of the noise, it is learnt again, at most so often."""


QUICK_HEIGHT = 0.3
"""Sigma of the trees' heights about their first sighting in quick passes, m. Recorded detections do not tell where on the trunk they lie: left
free, the height takes up what the range is off by, in steps of metres that Gauss-Newton overshoots."""


def solve(problem: Problem, config: EstimateConfig, *, quick: bool = False, patient: bool = False) -> Estimate:
    """Path and trees of a run, or InsufficientDataError: whatever GTSAM stumbles over is that the data contradict each other or do not
    determine the path. See `_solve`.
    """
    try:
        return _solve(problem, config, quick=quick, patient=patient)
    except (RuntimeError, IndexError, ValueError, np.linalg.LinAlgError) as err:
        first = (str(err).strip().splitlines() or [type(err).__name__])[0]
        _log.debug("the solve failed", exc_info=True)
        raise InsufficientDataError(
            f"the data do not determine the path, or contradict each other beyond repair ({first}); `topograph inspect` shows the streams"
        ) from err


def _solve(problem: Problem, config: EstimateConfig, *, quick: bool, patient: bool) -> Estimate:
    """Path and trees of a run. `quick` stops after a Huber pass of few steps and gives no covariances (for association);
    with `patient` that pass runs until it has converged.

    Raises:
        InsufficientDataError: the data do not determine the path.
    """
    began = time.perf_counter()
    if problem.start is None:
        poses = _poses_alone(problem, initial_path(problem), config)
    else:
        poses = problem.start
    trees = _median_trees(problem, poses)
    huber = Kernel("huber", config.huber)
    inert = None if quick or not config.use_imu else inertia(problem)
    most = config.quick_sightings if quick else config.most_sightings
    problem = replace(problem, sightings=_nearest(problem.sightings, most))
    values = _values(problem, poses, trees, inert)
    first = (
        Pass(trunk=huber, fix=huber, fix_floor=0.05, height=QUICK_HEIGHT)
        if quick
        else Pass(trunk=huber, fix=huber, fix_floor=0.0)
    )
    steps, tolerance = (3 * config.iterations, 1e-6)
    if quick:
        steps, tolerance = (3 * config.iterations, 1e-5) if patient else (10, 1e-3)
    values = optimised(graph_of(problem, first, config, inert), values, steps, tolerance)
    if quick:
        return _estimate(problem, config, values, first, None, time.perf_counter() - began)
    scales = _learned_scales(problem, values, first) if config.learn_scale else (1.0, 1.0, 1.0)
    tukey = Kernel("tukey", config.tukey)
    last = Pass(trunk=tukey, fix=tukey, trunk_scale=scales[0], fix_scale=scales[1], alike=scales[2])
    values = optimised(graph_of(problem, last, config, inert), values, config.iterations)
    for _ in range(RELEARNT if config.learn_scale else 0):
        scales = _learned_scales(problem, values, last)
        if scales[0] > STALE * last.trunk_scale and scales[1] > STALE * last.fix_scale:
            break
        less = (min(scales[0], last.trunk_scale), min(scales[1], last.fix_scale))
        last = replace(last, trunk_scale=less[0], fix_scale=less[1], alike=scales[2])
        values = optimised(graph_of(problem, last, config, inert), values, config.iterations)
    values, linear = with_big_stack(lambda: _polish(problem, last, config, inert, values))
    out = _estimate(problem, config, values, last, linear, time.perf_counter() - began)
    del linear  # as large as the graph: the tests make one of their own
    try:
        tested = with_big_stack(lambda: _tested(problem, last, config, inert, values))
    except (RuntimeError, IndexError, np.linalg.LinAlgError):  # the estimate stands without them
        _log.warning("clocks and mountings could not be tested", exc_info=True)
        tested = ()
    return replace(out, offsets=tested, seconds=time.perf_counter() - began)


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
            values = optimised(graph_of(problem, p, config, None, without=("trunk", "tree")), values, 30, 1e-4)
    return _path(problem, values)


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


def orthonormal(poses: Array) -> Array:
    """Poses (..., 4, 4) with rounding taken out of their rotations."""
    U, _, Vt = np.linalg.svd(poses[..., :3, :3])
    out = poses.copy()
    out[..., :3, :3] = U @ Vt
    return out


def factors_of(
    problem: Problem, p: Pass, config: EstimateConfig, inert: Inertia | None, *, without: Container[str] = ()
) -> Iterator[tuple[str, Any]]:
    """Every factor of the problem once, with its kind: "motion", "odometry", "imu", "fix", "link", "heading", "trunk", "tree".

    Kinds in `without` are left out, and not built.
    """
    yield from ((kind, f) for kind, f in _motion(problem, inert) if kind not in without)
    parts = (
        ("fix", _fixes(problem, p)),
        ("link", _links(problem)),
        ("heading", _headings(problem, config)),
        ("trunk", _trunks(problem, p)),
        ("tree", _tree_priors(problem, p.height)),
    )
    for kind, part in parts:  # generators: what is left out has not begun
        if kind not in without:
            yield from ((kind, f) for f in part)


def graph_of(
    problem: Problem, p: Pass, config: EstimateConfig, inert: Inertia | None, *, without: Container[str] = ()
) -> Any:
    """A NonlinearFactorGraph of the factors whose kind is not in `without`."""
    g = gtsam.NonlinearFactorGraph()
    for _, f in factors_of(problem, p, config, inert, without=without):
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


def _trunks(problem: Problem, p: Pass) -> Iterator[Any]:
    s = problem.sightings
    keys = (X + s.keyframe).tolist(), (L + problem.names()[s.tree]).tolist()
    yield from factors.trunks(*keys, s.p, p.trunk_scale**2 * s.cov, p.trunk)


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


def _motion(problem: Problem, inert: Inertia | None) -> Iterator[tuple[str, Any]]:
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
    cov = _fix_cov(problem, p)
    free = 1e6
    flat, tall = cov.copy(), np.zeros_like(cov)
    flat[:, 2, :2] = flat[:, :2, 2] = 0.0
    flat[:, 2, 2] = free
    tall[:, 0, 0] = tall[:, 1, 1] = free
    tall[:, 2, 2] = cov[:, 2, 2]
    for part in (flat, tall):
        yield from factors.fixes((X + f.keyframe).tolist(), f.map_p_antenna, f.keyframe_p_antenna, part, p.fix)


def _fix_cov(problem: Problem, p: Pass) -> Array:
    f = problem.fixes
    return np.asarray(p.fix_scale**2 * f.cov + p.fix_floor**2 * np.eye(3))


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


def _path(problem: Problem, values: Any) -> Array:
    rows = gtsam.utilities.extractPose3(values)  # rotation (9), translation (3), in key order
    out = np.tile(np.eye(4), (len(problem.stamps_ns), 1, 1))
    out[:, :3, :3] = rows[:, :9].reshape(-1, 3, 3)
    out[:, :3, 3] = rows[:, 9:]
    return out


def _trees(problem: Problem, values: Any) -> Array:
    return np.array([values.atPoint3(L + j) for j in problem.names().tolist()]).reshape(-1, 3)


def _trunk_residuals(problem: Problem, values: Any, scale: float) -> Array:
    """Whitened Cartesian residuals (M, 3) of the sightings."""
    s = problem.sightings
    if len(s) == 0:
        return np.zeros((0, 3))
    e, _, _ = factors.trunk_residual(_path(problem, values)[s.keyframe], _trees(problem, values)[s.tree], s.p)
    return np.asarray(np.linalg.solve(np.linalg.cholesky(s.cov) * scale, e[..., None])[..., 0])


def _fix_residuals(problem: Problem, values: Any) -> Array:
    f = problem.fixes
    return np.asarray(transform(_path(problem, values)[f.keyframe], f.keyframe_p_antenna) - f.map_p_antenna)


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


POLISHED = 2e-5
"""Root mean square of a last step, m and rad: steps shrink, and a hundredth of this is what is left."""


def _polish(problem: Problem, p: Pass, config: EstimateConfig, inert: Inertia | None, values: Any) -> tuple[Any, Any]:
    """Gauss-Newton with Cartesian trunk residuals until steps are below `POLISHED`; the values and the last system."""
    ordering = None
    rest = graph_of(problem, p, config, inert, without=("trunk",))
    s = problem.sightings
    keys_x, keys_l = (X + s.keyframe).tolist(), (L + problem.names()[s.tree]).tolist()
    cov = p.trunk_scale**2 * s.cov
    linear = None
    for _ in range(8):
        linear = rest.linearize(values)
        if len(s):
            path, trees = _path(problem, values), _trees(problem, values)
            factors.trunk_linear(linear, keys_x, keys_l, path[s.keyframe], trees[s.tree], s.p, cov, p.trunk)
        ordering = ordering or ordering_of(linear, values.size())
        step = linear.optimize(ordering)
        values = values.retract(step)
        if step.norm() < POLISHED * np.sqrt(values.size()):
            break
    return values, linear


def _tested(
    problem: Problem, p: Pass, config: EstimateConfig, inert: Inertia | None, values: Any
) -> tuple[Offset, ...]:
    """Score tests (Rao 1948) of what is taken as given: clocks, mountings, the wheels' scale.

    Each is a column of one more variable in the linear system of the solution, eliminated last. What it would have to be off
    by, and how much better the residuals would be, follow without solving anew.
    """
    g = graph_of(problem, p, config, inert, without=("trunk", "fix", "odometry")).linearize(values)
    path, trees = _path(problem, values), _trees(problem, values)
    s, f = problem.sightings, problem.fixes
    if problem.pose_sigma is None:
        step = inverse(problem.odom_T_robot[:-1]) @ problem.odom_T_robot[1:]
        for k, odometry in enumerate(f for kind, f in _motion(problem, inert) if kind == "odometry"):
            A, b = odometry.linearize(values).jacobian()
            longer = np.zeros((6, 1))
            longer[3:, 0] = -step[k, :3, :3].T @ step[k, :3, 3] / problem.step_sigma[k, 3:]
            g.add(gtsam.JacobianFactor(X + k, A[:, :6], X + k + 1, A[:, 6:], C, longer, b, _unit(6)))
    if len(s):
        mount = np.zeros((len(s), 3, 4))
        mount[:, :, 0] = -s.late
        mount[:, 0, 1] = mount[:, 1, 2] = -1.0
        mount[:, 0, 3], mount[:, 1, 3] = s.p[:, 1], -s.p[:, 0]
        factors.trunk_linear(
            g, (X + s.keyframe).tolist(), (L + problem.names()[s.tree]).tolist(), path[s.keyframe], trees[s.tree], s.p,
            p.trunk_scale**2 * s.cov, p.trunk, (C + 1, mount),
        )  # fmt: skip
    if len(f.keyframe):
        R = path[f.keyframe, :3, :3]
        moved = np.concatenate([(R @ f.late[:, :, None]), R[:, :, :2]], axis=2)
        factors.fix_linear(
            g, (X + f.keyframe).tolist(), path[f.keyframe], f.keyframe_p_antenna, f.map_p_antenna, _fix_cov(problem, p), p.fix,
            (C + 2, moved),
        )  # fmt: skip
    parts = [("wheel scale", C, [0]), ("trunk clock", C + 1, [0]), ("trunk mount", C + 1, [1, 2]), ("trunk yaw", C + 1, [3]),
             ("fix clock", C + 2, [0]), ("antenna", C + 2, [1, 2])]  # fmt: skip
    size = {C: 1, C + 1: 4, C + 2: 3}
    keys = g.keys()
    present = [c for c in size if keys.count(c)]
    if not present:
        return ()
    for c in present:  # what one fix cannot tell must not make the system singular
        g.add(gtsam.JacobianFactor(c, 1e-3 * np.eye(size[c]), np.zeros(size[c]), _unit(size[c])))
    H, eta = g.marginal(present).hessian(gtsam.Ordering(present))
    at = dict(zip(present, np.cumsum([0] + [size[c] for c in present[:-1]]).tolist(), strict=True))
    out = []
    for name, key, rows in parts:
        if key not in at:
            continue
        i = [at[key] + r for r in rows]
        information = H[np.ix_(i, i)] + 1e-9 * np.eye(len(i))
        value = np.linalg.solve(information, eta[i])
        sigma = np.sqrt(np.diag(np.linalg.inv(information)))
        out.append(Offset(name=name, value=value, sigma=sigma, gain=float(eta[i] @ value)))
    return tuple(out)


def _unit(n: int) -> Any:
    return gtsam.noiseModel.Unit.Create(n)


def _estimate(problem: Problem, config: EstimateConfig, values: Any, p: Pass, linear: Any, seconds: float) -> Estimate:
    poses, trees = _path(problem, values), _trees(problem, values)
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
    poses = _path(problem, values)
    step = inverse(problem.odom_T_robot[:-1]) @ problem.odom_T_robot[1:]
    misfit = log(inverse(step) @ inverse(poses[:-1]) @ poses[1:]) / problem.step_sigma
    out = {"odometry": misfit[:, 3:5].ravel(), "turn": misfit[:, 2]}
    if len(problem.fixes.keyframe):
        variance = np.diagonal(_fix_cov(problem, p), axis1=1, axis2=2)
        out["fix"] = (_fix_residuals(problem, values) / np.sqrt(variance)).ravel()
    h = problem.headings
    if len(h.keyframe):
        seen = yaw_of_direction(poses[h.keyframe], h.direction)
        out["heading"] = wrap(seen - h.yaw) / np.maximum(h.sigma, config.heading_floor)
    return out
