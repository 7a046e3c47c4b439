"""The thesis's map building (4.3.3, Algorithm 3): nearest node within d_max, mean of old and new.

Robot poses come from an extended Kalman filter like ROS's `robot_localization`, run forward once (thesis 5.3).
"""

from __future__ import annotations

import time

import numpy as np

from topograph.estimate.ekf import filtered_path
from topograph.estimate.problem import Estimate, EstimateConfig, Problem
from topograph.geometry import transform


def solve(problem: Problem, config: EstimateConfig) -> Estimate:
    """Path by filter, trees by running means. Covariances are NaN: the method has none."""
    began = time.perf_counter()
    d = problem.detections
    poses_at_scans = filtered_path(problem, d.stamps_ns)
    seen = transform(poses_at_scans[d.scan], d.p) if len(d) else np.zeros((0, 3))
    nodes = np.zeros((0, 3))
    tree = np.full(len(d), -1, np.int64)
    for i, c in enumerate(seen):
        if len(nodes):
            # Algorithm 3 takes the first node in range; the nearest one is its intent (4.3.3) and never worse.
            distance = np.linalg.norm(nodes[:, :2] - c[:2], axis=1)
            j = int(np.argmin(distance))
            if distance[j] < config.d_max:
                nodes[j] = 0.5 * (nodes[j] + c)  # eq. 4.14
                tree[i] = j
                continue
        nodes = np.vstack([nodes, c])
        tree[i] = len(nodes) - 1
    path = filtered_path(problem, problem.stamps_ns)
    return Estimate(
        problem.stamps_ns, path, nodes, np.full((len(nodes), 3, 3), np.nan), None, np.full((3, 3), np.nan), tree,
        np.ones(0), {}, {}, time.perf_counter() - began,
    )  # fmt: skip
