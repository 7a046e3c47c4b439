"""Position of the antenna."""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np
from numpy.typing import ArrayLike, NDArray

from factors.noise import Kernel, gaussians

Array = NDArray[np.float64]


def fix(key: int, map_p_antenna: ArrayLike, robot_p_antenna: ArrayLike, cov: ArrayLike, kernel: Kernel) -> Any:
    """The antenna, `robot_p_antenna` (3,) on the robot, is at `map_p_antenna` (3,) with covariance (3, 3), m.

    Raises:
        ValueError: not finite.
    """
    z, lever, c = (np.asarray(v, float)[None] for v in (map_p_antenna, robot_p_antenna, cov))
    return fixes([key], z, lever, c, kernel)[0]


def fixes(keys: list[int], map_p_antenna: Array, robot_p_antenna: Array, cov: Array, kernel: Kernel) -> list[Any]:
    """`fix` for N fixes at once: places and lever arms (N, 3), covariances (N, 3, 3); checked in bulk.

    Raises:
        ValueError: as `fix`.
    """
    if not (np.isfinite(map_p_antenna).all() and np.isfinite(robot_p_antenna).all()):
        raise ValueError("a fix and its lever arm must be finite")
    return [
        gtsam.GPSFactorArm(k, z, lever, noise)
        for k, z, lever, noise in zip(keys, map_p_antenna, robot_p_antenna, gaussians(cov, kernel), strict=True)
    ]


def fix_linear(
    graph: Any,
    keys: list[int],
    poses: Array,
    robot_p_antenna: Array,
    map_p_antenna: Array,
    cov: Array,
    kernel: Kernel,
    extra: tuple[int, Array],
) -> None:
    """Add N fixes, linearised at `poses` (N, 4, 4), to a GaussianFactorGraph: horizontal and vertical part each under `kernel`.

    `robot_p_antenna`, `map_p_antenna` (N, 3) and `cov` (N, 3, 3) as in `fix`; `extra` is a further variable and the
    residuals' derivatives (N, 3, q) by it.
    """
    R = poses[:, :3, :3]
    e = (R @ robot_p_antenna[:, :, None])[..., 0] + poses[:, :3, 3] - map_p_antenna
    x, y, z = robot_p_antenna.T
    cross = np.zeros((len(x), 3, 3))
    cross[:, 0, 1], cross[:, 0, 2], cross[:, 1, 2] = -z, y, -x
    cross = cross - np.swapaxes(cross, 1, 2)
    by_pose = np.concatenate([-R @ cross, R], axis=2)
    for rows in ([0, 1], [2]):
        whiten = np.linalg.inv(np.linalg.cholesky(cov[:, rows][:, :, rows]))
        r = (whiten @ e[:, rows, None])[..., 0]
        root = np.sqrt(kernel.weight(np.linalg.norm(r, axis=1)))
        A, D = (root[:, None, None] * (whiten @ J[:, rows]) for J in (by_pose, extra[1]))
        unit = gtsam.noiseModel.Unit.Create(len(rows))
        for i in np.flatnonzero(root > 1e-4).tolist():
            graph.add(gtsam.JacobianFactor(keys[i], A[i], extra[0], D[i], -root[i] * r[i], unit))
