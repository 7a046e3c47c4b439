"""What is taken as given, tested against the residuals: clocks, mountings, the wheels' scale."""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np

import factors
from topograph.estimate.generator import L, Pass, X, factors_of, fix_cov, graph_of, motion_factors
from topograph.estimate.inertia import Inertia
from topograph.estimate.problem import EstimateConfig, Offset, Problem
from topograph.geometry import Array, inverse

C = gtsam.symbol("c", 0)


def tested(
    problem: Problem, p: Pass, config: EstimateConfig, inert: Inertia | None, values: Any, path: Array, trees: Array
) -> tuple[Offset, ...]:
    """Score tests (Rao 1948) of what is taken as given: clocks, mountings, the wheels' scale.

    Each is a column of one more variable in the linear system of the solution, eliminated last. What it would have to be off
    by, and how much better the residuals would be, follow without solving anew.
    """
    kept = factors_of(problem, p, config, inert, values, without=("trunk", "fix", "odometry"))
    g = graph_of(kept).linearize(values)
    s, f = problem.sightings, problem.fixes
    if problem.pose_sigma is None:
        step = inverse(problem.odom_T_robot[:-1]) @ problem.odom_T_robot[1:]
        for k, odometry in enumerate(f for kind, f in motion_factors(problem, inert) if kind == "odometry"):
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
            g, (X + f.keyframe).tolist(), path[f.keyframe], f.keyframe_p_antenna, f.map_p_antenna, fix_cov(problem, p), p.fix,
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
