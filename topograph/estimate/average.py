"""The thesis's map building (4.3.3, Algorithm 3): the node within d_max, mean of old and new; and the rungs between it and the graph.

Robot poses come from an extended Kalman filter like ROS's `robot_localization`, run forward once (thesis 5.3), or from a path that is given.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from topograph.estimate.ekf import filtered_path
from topograph.estimate.path import path_at
from topograph.estimate.problem import Estimate, Problem
from topograph.geometry import Array, transform
from topograph.ranges import Count, Positive

Rule = Literal["halving", "mean", "inverse"]


@dataclass(frozen=True, slots=True)
class AverageConfig:
    """Algorithm 3, and what the thesis does not state of it.

    Attributes:
        d_max: a cluster nearer than this to a node is of that node, m (not stated in the thesis).
        rule: "halving" is eq. 4.14, in which the last cluster has half of the weight; "mean" weighs all clusters alike; "inverse" by
            their inverse covariance.
        nearest: the nearest node within d_max takes the cluster, as 4.3.3 means it; else the first one in the list, as Algorithm 3 is
            written.
        least: nodes of fewer clusters are left out (the thesis keeps all: 1).
        begin: where the filter starts: "batch", from a fit of the whole run (kind), or "first": the first fix and the first heading.
    """

    d_max: Positive = 1.5
    rule: Rule = "halving"
    nearest: bool = True
    least: Count = 6
    begin: Literal["batch", "first"] = "batch"


def solve(problem: Problem, config: AverageConfig, path: Array | None = None) -> Estimate:
    """Path by filter (or `path` (K, 4, 4) at the keyframes), trees by running means. Covariances are NaN: the method has none."""
    began = time.perf_counter()
    d = problem.detections
    if path is None:
        path = filtered_path(problem, problem.stamps_ns, config.begin)
        map_T_scan = filtered_path(problem, d.stamps_ns, config.begin)
    else:
        map_T_scan = path_at(problem.stamps_ns, path, problem.motion, d.stamps_ns)
    poses = map_T_scan[d.scan]
    seen = transform(poses, d.p) if len(d) else np.zeros((0, 3))
    weight = np.ones(len(d))
    if config.rule == "inverse" and len(d):
        R = poses[:, :3, :3]
        cov = (R @ d.cov @ R.transpose(0, 2, 1))[:, :2, :2]
        weight = 2.0 / np.maximum(np.trace(cov, axis1=1, axis2=2), 1e-8)
    # The thesis's trunks have no score: what ours doubts is left out, which is kinder than to make a node of each.
    sure = np.flatnonzero(d.score >= 0)
    nodes, of = _nodes(seen[sure], weight[sure], config)
    tree = np.full(len(d), -1, np.int64)
    tree[sure] = of
    hits = np.bincount(of, minlength=len(nodes))
    keep = hits >= config.least
    name = np.where(keep, np.cumsum(keep) - 1, -1)
    return Estimate(
        stamps_ns=problem.stamps_ns, map_T_robot=path, trees=nodes[keep], tree_cov=np.full((int(keep.sum()), 3, 3), np.nan),
        joint=None, datum_cov=np.full((3, 3), np.nan), tree=np.where(tree >= 0, name[tree], -1) if len(nodes) else tree,
        weights=np.ones(0), seconds=time.perf_counter() - began,
    )  # fmt: skip


def _nodes(seen: Array, weight: Array, config: AverageConfig) -> tuple[Array, NDArray[np.int64]]:
    """Nodes (T, 3) of clusters (N, 3) as they came, and the node (N,) of each."""
    nodes, total = np.zeros((len(seen), 3)), np.zeros(len(seen))
    tree = np.full(len(seen), -1, np.int64)
    n = 0
    for i, c in enumerate(seen):
        distance = np.linalg.norm(nodes[:n, :2] - c[:2], axis=1)
        near = np.flatnonzero(distance < config.d_max)
        if not len(near):
            nodes[n], total[n], tree[i] = c, weight[i], n
            n += 1
            continue
        j = int(near[np.argmin(distance[near])] if config.nearest else near[0])
        total[j] += weight[i]
        share = 0.5 if config.rule == "halving" else weight[i] / total[j]  # eq. 4.14
        nodes[j] += share * (c - nodes[j])
        tree[i] = j
    return nodes[:n], tree
