"""Joint covariance of the trees, and of the frame they are in."""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np

from topograph.estimate.problem import EstimateConfig, Problem
from topograph.geometry import Array

MOST_JOINT = 2000
"""Trees up to which the joint covariance is computed at once; beyond, block by block."""


def of_trees(linear: Any, keys: list[int]) -> tuple[Array | None, Array]:
    """Joint covariance (3T, 3T), or None for very large maps, and its 3x3 diagonal blocks (T, 3, 3)."""
    blocks = []
    joint = None
    for at in range(0, len(keys), MOST_JOINT):
        part = keys[at : at + MOST_JOINT]
        H, _ = linear.marginal(part).hessian(gtsam.Ordering(part))
        cov = np.linalg.inv(H)
        cov = 0.5 * (cov + cov.T)
        n = len(part)
        blocks.append(cov.reshape(n, 3, n, 3)[np.arange(n), :, np.arange(n), :])
        joint = cov if len(part) == len(keys) else None
    return joint, np.concatenate(blocks)


def of_datum(problem: Problem, fix_scale: float, config: EstimateConfig) -> Array:
    """Common error (3, 3) of the map in the ENU frame, m².

    GNSS errors last for `fix_correlation_s`: a run of duration T holds about T / 2τ independent fixes, however many
    it recorded. What their mean errs by, the whole map errs by.
    """
    f = problem.fixes
    if len(f.keyframe) < 3:
        return np.zeros((3, 3))
    span = float(problem.stamps_ns[f.keyframe[-1]] - problem.stamps_ns[f.keyframe[0]]) * 1e-9
    independent = max(1.0, span / (2 * config.fix_correlation_s))
    information = np.sum(np.linalg.inv(f.cov * fix_scale**2 + 1e-8 * np.eye(3)), axis=0) / len(f.keyframe)
    return np.asarray(np.linalg.inv(information) / independent)
