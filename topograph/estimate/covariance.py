"""Joint covariance of the trees, and of the frame they are in."""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np
from scipy.linalg import lapack

from topograph.estimate.problem import EstimateConfig, Problem
from topograph.geometry import Array

MOST_JOINT = 2000
"""Trees up to which the joint covariance is kept: 0.3 GB."""
BLOCK = 1000
"""Trees whose covariances are computed together beyond that: each block eliminates the rest anew, and is a dense matrix."""


def of_trees(linear: Any, keys: list[int]) -> tuple[Array | None, Array]:
    """Joint covariance (3T, 3T), or None for very large maps, and its 3x3 diagonal blocks (T, 3, 3)."""
    whole = len(keys) <= MOST_JOINT
    if whole:
        joint = _covariance(linear, keys)
        return joint, _diagonal(joint)
    return None, np.concatenate(
        [_diagonal(_covariance(linear, keys[k : k + BLOCK])) for k in range(0, len(keys), BLOCK)]
    )


def _covariance(linear: Any, keys: list[int]) -> Array:
    """Joint covariance (3T, 3T) of `keys`. Inverted in place: the matrix is the largest thing of a solve."""
    H, _ = linear.marginal(keys).hessian(gtsam.Ordering(keys))
    factor, failed = lapack.dpotrf(np.asfortranarray(H), lower=1, clean=0, overwrite_a=1)
    del H
    cov, failed_too = lapack.dpotri(factor, lower=1, overwrite_c=1)
    if failed or failed_too:
        raise np.linalg.LinAlgError("the information of the trees is singular")
    for k in range(1, len(cov)):  # the upper triangle is what was there before
        cov[:k, k] = cov[k, :k]
    return np.asarray(cov.T)  # the same, in the order of rows


def _diagonal(cov: Array) -> Array:
    """Blocks (T, 3, 3) of a joint covariance (3T, 3T)."""
    n = len(cov) // 3
    return np.asarray(cov.reshape(n, 3, n, 3)[np.arange(n), :, np.arange(n), :])


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
