"""The whole run once more as a factor graph: what later scans say of earlier poses."""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numpy as np
from numpy.typing import NDArray

from factors import sighting_2d
from topograph.geometry import Array, from_xyz_rpy, yaw_of
from topograph.localize.hypothesis import HUBER
from topograph.localize.method import Fix
from topograph.localize.submap import Move, Sweep

_X, _L = gtsam.symbol_shorthand.X, gtsam.symbol_shorthand.L


def smooth(
    fixes: Sequence[Fix],
    moves: Sequence[Move],
    sweeps: Sequence[Sweep],
    pairs: Sequence[NDArray[np.int64]],
    trees: Array,
    var: Array,
) -> Array:
    """Poses (K, 4, 4) of a stretch of K committed fixes, by a planar graph of odometry and known landmarks.

    `moves[k]` leads to fix k, `pairs[k]` (N, 2) are rows of `sweeps[k]` and of `trees` (T, 2) with variances `var` (T,).
    Height, roll and pitch stay as they were. The map's trees are variables with their covariance: the run may not pull
    them, but their errors are shared by all sightings.
    """
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    known: set[int] = set()
    for k, fix in enumerate(fixes):
        x, y, yaw = fix.map_T_robot[0, 3], fix.map_T_robot[1, 3], float(yaw_of(fix.map_T_robot))
        values.insert(_X(k), gtsam.Pose2(x, y, yaw))
        if k == 0:
            prior = gtsam.noiseModel.Gaussian.Covariance(_to_pose2(fix.cov, yaw))
            graph.add(gtsam.PriorFactorPose2(_X(0), gtsam.Pose2(x, y, yaw), prior))
        else:
            m = moves[k]
            noise = gtsam.noiseModel.Gaussian.Covariance(m.cov + 1e-10 * np.eye(3))
            graph.add(gtsam.BetweenFactorPose2(_X(k - 1), _X(k), gtsam.Pose2(*m.step), noise))
        for i, t in pairs[k].tolist():
            if t not in known:
                known.add(t)
                values.insert(_L(t), trees[t])
                graph.add(
                    gtsam.PriorFactorPoint2(
                        _L(t), trees[t], gtsam.noiseModel.Isotropic.Sigma(2, float(np.sqrt(var[t])))
                    )
                )
            graph.add(sighting_2d(_X(k), _L(t), sweeps[k].p[i], sweeps[k].cov[i], HUBER))
    result = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    out = []
    for k, fix in enumerate(fixes):
        pose = result.atPose2(_X(k))
        turn = from_xyz_rpy(0, 0, 0, 0, 0, pose.theta() - float(yaw_of(fix.map_T_robot)))
        T = np.eye(4)
        T[:3, :3] = turn[:3, :3] @ fix.map_T_robot[:3, :3]
        T[:3, 3] = pose.x(), pose.y(), fix.map_T_robot[2, 3]
        out.append(T)
    return np.array(out)


def _to_pose2(cov: Array, yaw: float) -> Array:
    """Covariance (3, 3) of a Pose2's tangent (x, y in the robot's axes, yaw) from a fix's (6, 6)."""
    c, s = np.cos(yaw), np.sin(yaw)
    R = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    picked = cov[np.ix_([3, 4, 2], [3, 4, 2])]
    return np.asarray(R @ picked @ R.T + 1e-9 * np.eye(3))
