"""The thesis's localization (4.3.4, Algorithms 4-6): what every run is compared with.

Distances and ICP give each trunk a list of candidate nodes; all combinations that agree in their distances are located
by multilateration (3.4); poses are predicted by odometry, averaged with a measured pose within a gate (eq. 4.18), and
dropped when too many scans went by without one. It commits when one pose is left.

Where the thesis is silent: edges join all nodes within twice the view, for with neighbours only most pairs of trunks would
have no edge; heading comes from the bearings of the combination's trees; combinations are built by backtracking, which
gives those that the thesis's table would leave, and above `combinations` of them the scan measures nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from topograph.bags import Trunks
from topograph.geometry import Array, from_xyz_rpy, transform
from topograph.localize.method import Fix, Report
from topograph.motion import Leg
from topograph.ranges import Count, NonNegative, Positive
from topograph.topomap import TopoMap


@dataclass(frozen=True, slots=True)
class ThesisConfig:
    """Thresholds of the thesis's method; lengths in m.

    Attributes:
        distance: D_th of Algorithm 4; `consistency` the same in the check of combinations.
        icp: score_th of Algorithm 5, mean squared distance of the registered clouds, m²; 0 leaves the step out.
        gate: d_max of Algorithm 6; `count` is cnt_th.
        view: farthest trunk used; `trunks` how many, the nearest first.
        combinations: most combinations of one scan.
        merge: poses nearer than this are one.
    """

    distance: Positive = 0.3
    consistency: Positive = 0.3
    icp: NonNegative = 0.05
    gate: Positive = 1.0
    count: Count = 5
    view: Positive = 10.0
    trunks: Count = 5
    combinations: Count = 2000
    merge: Positive = 0.3


class ThesisMethod:
    """Algorithms 4, 5 and 6 behind the same interface as ours.

    Attributes:
        exploded: scans whose combinations exceeded the cap and measured nothing.
    """

    def __init__(self, topo: TopoMap, config: ThesisConfig | None = None) -> None:
        self.topo = topo = topo.trees()  # the thesis knows no other landmarks
        self.config = config or ThesisConfig()
        self.nodes = topo.p[:, :2] + topo.axis[:, :2] * (0.8 / np.maximum(topo.axis[:, 2:], 0.3))
        pairs = cKDTree(self.nodes).query_pairs(2 * self.config.view, output_type="ndarray")
        self.edges = pairs.reshape(-1, 2)
        length = np.linalg.norm(self.nodes[self.edges[:, 0]] - self.nodes[self.edges[:, 1]], axis=1)
        order = np.argsort(length)
        self.edges, self.length = self.edges[order], length[order]
        self.poses = np.zeros((0, 3))
        self.counts = np.zeros(0, np.int64)
        self.started = False
        self.exploded = 0
        self._z = float(np.median(topo.p[:, 2])) if len(topo) else 0.0

    def step(self, trunks: Trunks, leg: Leg) -> Report:
        """One scan further."""
        flat = transform(from_xyz_rpy(0, 0, 0, leg.roll, leg.pitch, 0), trunks.p) if len(trunks) else np.zeros((0, 3))
        reach = np.hypot(flat[:, 0], flat[:, 1])
        use = [int(i) for i in np.argsort(reach) if 0.3 < reach[i] < self.config.view and trunks.score[i] >= 0]
        use = use[: self.config.trunks]
        measured = np.zeros((0, 3))
        if len(use) > 1:
            clouds = [trunks.clouds[i] if trunks.clouds else None for i in use]
            z = flat[use, :2]
            candidates = [self._by_icp(c, n) for c, n in zip(clouds, self._by_distance(z), strict=True)]
            measured = np.array([multilaterate(z, self.nodes[list(c)]) for c in self._combine(z, candidates)]).reshape(
                -1, 3
            )
        self._update(measured, leg)
        n = len(self.poses)
        fix = None
        if n == 1:
            x, y, yaw = self.poses[0]
            near = np.argmin(np.hypot(*(self.topo.p[:, :2] - [x, y]).T))
            T = from_xyz_rpy(x, y, self.topo.p[near, 2], leg.roll, leg.pitch, yaw)
            fix = Fix(trunks.stamp_ns, T, np.full((6, 6), np.nan), np.nan)
        state = "tracking" if n == 1 else "ambiguous" if n else "lost" if self.started else "searching"
        if not n:
            self.started = False
        none = np.zeros(0, np.int64)
        return Report(
            trunks.stamp_ns, state, fix, n, np.nan, self.poses[:200], none, np.zeros((0, 2), np.int64), np.nan, np.nan
        )

    def _by_distance(self, z: Array) -> list[NDArray[np.int64]]:
        """Algorithm 4: candidate nodes of each trunk."""
        n = len(z)
        d = np.linalg.norm(z[:, None] - z[None], axis=2)
        out = []
        for i in range(n):
            common: NDArray[np.int64] | None = None
            for j in range(n):
                if i == j:
                    continue
                low, high = np.searchsorted(
                    self.length, [d[i, j] - self.config.distance, d[i, j] + self.config.distance]
                )
                nodes = np.unique(self.edges[low:high])
                common = nodes if common is None else np.intersect1d(common, nodes, assume_unique=True)
            out.append(np.zeros(0, np.int64) if common is None else common)
        return out

    def _by_icp(self, cloud: NDArray[np.float32] | None, nodes: NDArray[np.int64]) -> NDArray[np.int64]:
        """Algorithm 5: the candidates onto whose cloud the trunk's cloud can be registered."""
        if cloud is None or len(cloud) < 8 or self.config.icp <= 0 or not self.topo.viewpoints:
            return nodes
        centred = np.asarray(cloud - cloud.mean(0), float)
        of = {int(t): [v.cloud for v in self.topo.viewpoints if v.tree == t and len(v.cloud) >= 8] for t in nodes}
        keep = [t for t in nodes if not of[int(t)] or min(_fitness(centred, c) for c in of[int(t)]) < self.config.icp]
        return np.array(keep, np.int64)

    def _combine(self, z: Array, candidates: list[NDArray[np.int64]]) -> list[tuple[int, ...]]:
        """Combinations whose distances agree with the map's (Table 4.1); none when there are too many."""
        d = np.linalg.norm(z[:, None] - z[None], axis=2)
        found: list[tuple[int, ...]] = [()]
        for i, nodes in enumerate(candidates):
            longer = []
            for part in found:
                for t in nodes.tolist():
                    if t in part:
                        continue
                    if part:
                        there = np.linalg.norm(self.nodes[list(part)] - self.nodes[t], axis=1)
                        if (np.abs(there - d[i, : len(part)]) > self.config.consistency).any():
                            continue
                    longer.append((*part, t))
                    if len(longer) > 20 * self.config.combinations:
                        self.exploded += 1
                        return []
            found = longer
        if len(found) > self.config.combinations:
            self.exploded += 1
            return []
        return found

    def _update(self, measured: Array, leg: Leg) -> None:
        """Algorithm 6."""
        c = self.config
        if not self.started:
            if len(measured):
                self.poses, self.counts, self.started = measured.copy(), np.zeros(len(measured), np.int64), True
            self._merge()
            return
        alive = self.counts <= c.count
        poses, counts = self.poses[alive], self.counts[alive]
        cs, sn = np.cos(poses[:, 2]), np.sin(poses[:, 2])
        dx, dy, turn = leg.step
        poses = poses + np.stack([cs * dx - sn * dy, sn * dx + cs * dy, np.full(len(poses), turn)], axis=1)
        tree = cKDTree(measured[:, :2]) if len(measured) else None
        for k in range(len(poses)):
            near = tree.query_ball_point(poses[k, :2], c.gate) if tree is not None else []
            turns = [abs((measured[i, 2] - poses[k, 2] + np.pi) % (2 * np.pi) - np.pi) for i in near]
            near = [i for i, a in zip(near, turns, strict=True) if a < 0.5]
            if not near:
                counts[k] += 1
                continue
            z = measured[min(near, key=lambda i: float(np.hypot(*(measured[i, :2] - poses[k, :2]))))]
            away = (z[2] - poses[k, 2] + np.pi) % (2 * np.pi) - np.pi
            poses[k] = [*(0.5 * (poses[k, :2] + z[:2])), poses[k, 2] + 0.5 * away]  # eq. 4.18
            counts[k] = 0
        self.poses, self.counts = poses, counts
        self._merge()

    def _merge(self) -> None:
        """Poses that have become one are one."""
        keep: list[int] = []
        for k in np.argsort(self.counts, kind="stable").tolist():
            if all(np.hypot(*(self.poses[k, :2] - self.poses[q, :2])) > self.config.merge for q in keep):
                keep.append(k)
        self.poses, self.counts = self.poses[keep], self.counts[keep]


def multilaterate(z: Array, beacons: Array, steps: int = 100) -> Array:
    """Pose (3,) from ranges to beacons (N, 2), by gradient descent on the squared range errors (thesis 3.4).

    `z` (N, 2) are the trunks in the robot's frame, m. The start is the rigid fit's position, which resolves the mirror image
    of two ranges; the heading is the mean turn between bearings in the robot's frame and in the map.
    """
    a, b = z - z.mean(0), beacons - beacons.mean(0)
    yaw = np.arctan2(np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]), np.sum(a * b))
    c, s = np.cos(yaw), np.sin(yaw)
    x = beacons.mean(0) - np.array([[c, -s], [s, c]]) @ z.mean(0)
    ranges = np.hypot(z[:, 0], z[:, 1])
    for _ in range(steps):
        away = x - beacons
        d = np.maximum(np.linalg.norm(away, axis=1), 1e-6)
        gradient = ((d - ranges) / d) @ away
        x = x - 0.5 / len(z) * gradient
        if np.abs(gradient).max() < 1e-5:
            break
    seen = np.arctan2(*(beacons - x).T[::-1]) - np.arctan2(z[:, 1], z[:, 0])
    return np.array([x[0], x[1], np.arctan2(np.sin(seen).sum(), np.cos(seen).sum())])


def _fitness(cloud: Array, node: NDArray[np.float32]) -> float:
    """Mean squared distance of a cloud registered to a node's cloud (point-to-point ICP, translation start), m²."""
    target = np.asarray(node - node.mean(0), float)
    tree = cKDTree(target)
    moved = cloud.copy()
    for _ in range(10):
        _, near = tree.query(moved)
        goal = target[near]
        U, _, Vt = np.linalg.svd((goal - goal.mean(0)).T @ (moved - moved.mean(0)))
        R = U @ np.diag([1, 1, np.sign(np.linalg.det(U @ Vt))]) @ Vt
        moved = (moved - moved.mean(0)) @ R.T + goal.mean(0)
    return float(np.mean(tree.query(moved)[0] ** 2))
