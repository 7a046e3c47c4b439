"""A trunk seen from a pose: bearing and range to the landmark (thesis 6.1; Thrun et al., Probabilistic Robotics 6.6).

The detector states a point and its covariance on the robot. GTSAM's native factor wants a direction and a range, so
the covariance is turned into the bearing's own basis. The native factor bends straight errors into arcs: with an
error e at range r it is biased by e²/2r. `trunk_linear` is the same measurement as a plain Cartesian residual,
linearised; the last solver steps use it, and then the limit of exact poses is the average of the sightings.
"""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np
from numpy.typing import ArrayLike, NDArray

from factors.noise import Kernel, robust, sigmas

Array = NDArray[np.float64]


def trunk(pose_key: int, point_key: int, robot_p_trunk: ArrayLike, cov: ArrayLike, kernel: Kernel) -> Any:
    """Bearing and range from a Pose3 to a Point3, of a point (3,) with covariance (3, 3) in the robot's frame, m.

    Raises:
        ValueError: not finite, nearer than 1 cm, or a covariance that is not positive definite.
    """
    p = np.asarray(robot_p_trunk, float)[None]
    return trunks([pose_key], [point_key], p, np.asarray(cov, float)[None], kernel)[0]


def trunks(
    pose_keys: list[int], point_keys: list[int], robot_p_trunk: Array, cov: Array, kernel: Kernel,
    *, expected: Array | None = None,
) -> list[Any]:  # fmt: skip
    """`trunk` for N sightings at once: points (N, 3), covariances (N, 3, 3); checks and algebra are done in bulk.

    GTSAM states a bearing's error in the basis at the *predicted* direction, and across the least of the axes that basis turns by 90°: a trunk
    straight abeam would have its height weighed as its side. `expected` (N, 3) is where the values to begin from have the trunks on the
    robot, m; the measurements themselves where it is not given, or points elsewhere.

    Raises:
        ValueError: as `trunk`.
    """
    distance = np.linalg.norm(robot_p_trunk, axis=1)
    if not (np.isfinite(distance).all() and (distance >= 0.01).all()):
        raise ValueError("a trunk must be finite and not inside the sensor")
    unit = robot_p_trunk / distance[:, None]
    begun = robot_p_trunk if expected is None else expected
    near = np.sum(begun * unit, axis=1) > NEAR * np.maximum(np.linalg.norm(begun, axis=1), 1e-9)
    basis = bearing_basis(np.where(near[:, None], begun, robot_p_trunk))
    J = np.concatenate([np.swapaxes(basis, 1, 2) / distance[:, None, None], unit[:, None, :]], axis=1)
    turned = J @ cov @ np.swapaxes(J, 1, 2)
    turned = 0.5 * (turned + np.swapaxes(turned, 1, 2))
    if not np.isfinite(turned).all() or (len(turned) and np.linalg.eigvalsh(turned)[:, 0].min() <= 0):
        raise ValueError("a covariance must be finite and positive definite")
    estimator = kernel.estimator()
    create, robustly = gtsam.noiseModel.Gaussian.Covariance, gtsam.noiseModel.Robust.Create
    out = []
    for k, j, p, r, c in zip(pose_keys, point_keys, robot_p_trunk, distance.tolist(), turned, strict=True):
        noise = create(c) if estimator is None else robustly(estimator, create(c))
        out.append(gtsam.BearingRangeFactor3D(k, j, gtsam.Unit3(p), r, noise))
    return out


NEAR = 0.7
"""Cosine between two directions whose tangent planes are nearly one."""


TIE = 1e-9
"""Two components of a direction that are this near to each other: rounding says which is the less."""


def bearing_basis(towards: Array) -> Array:
    """Tangent basis (N, 3, 2) that gtsam.Unit3 uses at the directions of vectors (N, 3): across the least of the axes.

    Where two axes are the least, the basis turns by 90° with the last bit of a component; there GTSAM itself is asked.
    """
    unit = towards / np.linalg.norm(towards, axis=1, keepdims=True)
    size = np.abs(unit)
    first = np.cross(unit, np.eye(3)[size.argmin(axis=1)])
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(unit, first)
    basis = np.stack([first, second / np.linalg.norm(second, axis=1, keepdims=True)], axis=2)
    least = np.sort(size, axis=1)
    for row in np.flatnonzero(least[:, 1] - least[:, 0] < TIE):
        basis[row] = gtsam.Unit3(towards[row]).basis()
    return basis


def trunk_2d(pose_key: int, point_key: int, bearing: float, distance: float, sigma: ArrayLike, kernel: Kernel) -> Any:
    """Bearing (rad) and range (m) from a Pose2 to a Point2; `sigma` (2,) in that order."""
    return gtsam.BearingRangeFactor2D(pose_key, point_key, gtsam.Rot2(bearing), distance, robust(sigmas(sigma), kernel))


def trunk_residual(map_T_robot: Array, map_p_tree: Array, robot_p_trunk: Array) -> tuple[Array, Array, Array]:
    """Cartesian residual (..., 3) of sightings, and its Jacobians by pose (..., 3, 6) and by tree (..., 3, 3).

    The pose moves as T·Exp(rotation, translation), GTSAM's convention.
    """
    Rt = np.swapaxes(map_T_robot[..., :3, :3], -1, -2)
    q = (Rt @ (map_p_tree - map_T_robot[..., :3, 3])[..., None])[..., 0]
    by_pose = np.zeros((*q.shape[:-1], 3, 6))
    by_pose[..., 0, 1], by_pose[..., 0, 2] = -q[..., 2], q[..., 1]
    by_pose[..., 1, 0], by_pose[..., 1, 2] = q[..., 2], -q[..., 0]
    by_pose[..., 2, 0], by_pose[..., 2, 1] = -q[..., 1], q[..., 0]
    by_pose[..., [0, 1, 2], [3, 4, 5]] = -1.0
    return q - robot_p_trunk, by_pose, Rt


def trunk_linear(
    graph: Any,
    pose_keys: list[int],
    point_keys: list[int],
    poses: Array,
    trees: Array,
    points: Array,
    cov: Array,
    kernel: Kernel,
    extra: tuple[int, Array] | None = None,
) -> Array:
    """Add N sightings, linearised at `poses` (N, 4, 4) and `trees` (N, 3), to a GaussianFactorGraph.

    `points` (N, 3) and `cov` (N, 3, 3) are the measurements; `extra` a further variable and the residuals' derivatives (N, 3, q)
    by it. Returns the kernel's weights (N,).
    """
    e, by_pose, by_tree = trunk_residual(poses, trees, points)
    whiten = np.linalg.inv(np.linalg.cholesky(cov))
    e = (whiten @ e[..., None])[..., 0]
    weight = kernel.weight(np.linalg.norm(e, axis=1))
    root = np.sqrt(weight)[:, None, None]
    A, B, b = root * (whiten @ by_pose), root * (whiten @ by_tree), -root[..., 0] * e
    unit = gtsam.noiseModel.Unit.Create(3)
    used = np.flatnonzero(weight > 1e-9).tolist()
    if extra is not None:
        D = root * (whiten @ extra[1])
        for i in used:
            graph.add(gtsam.JacobianFactor(pose_keys[i], A[i], point_keys[i], B[i], extra[0], D[i], b[i], unit))
        return weight
    for i in used:
        graph.add(gtsam.JacobianFactor(pose_keys[i], A[i], point_keys[i], B[i], b[i], unit))
    return weight
