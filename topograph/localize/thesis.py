"""The thesis's localization (4.3.4, Algorithms 4-6): what every run is compared with.

Distances and ICP give each trunk a list of candidate nodes; all combinations that agree in their distances are located
by multilateration (3.4); poses are predicted by odometry, averaged with a measured pose within a gate (eq. 4.18), and
dropped when too many scans went by without one. It commits when one pose is left.

Where the thesis is silent: heading comes from the bearings of the combination's trees; combinations are built by backtracking, which
gives those that the thesis's table would leave, and above `combinations` of them the scan measures nothing. The defaults are kinder
than Algorithms 4-6 as they are written: `configs/thesis.yaml` has these, `configs/thesis_best.yaml` says where the two differ.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from topograph.bags import Trunks
from topograph.geometry import Array, from_xyz_rpy, transform, wrap
from topograph.localize.method import Fix, Report
from topograph.motion import Leg
from topograph.ranges import Count, NonNegative, Positive
from topograph.topomap import Query, Target, TopoMap


@dataclass(frozen=True, slots=True)
class ThesisConfig:
    """Thresholds of the thesis's method; lengths in m.

    Attributes:
        distance: D_th of Algorithm 4; `consistency` the same in the check of combinations.
        edges: which distances between nodes Algorithm 4 looks in: "view", all within twice the view, or "map", the map's edges.
        icp: score_th of Algorithm 5, mean squared distance of the registered clouds, m²; 0 leaves the step out.
        icp_turn: registration begins with the line of sight turned onto the node's viewpoint, or ("none") as the robot stands.
        gate: d_max of Algorithm 6; `gate_yaw` the same for the heading, rad (the thesis has none).
        first: the first measured pose in the gate is taken, as Algorithm 6 is written, not the nearest.
        count: cnt_th, iterations without a measured pose; `count_distance`, where it is not 0, metres without one instead.
        reset: a measured pose sets the counter back to zero; Algorithm 6 never does.
        step: metres from one measurement to the next (the thesis took a cloud every 2 m); 0: every scan. Between, odometry predicts.
        view: farthest trunk used; `trunks` how many, the nearest first.
        combinations: most combinations of one scan.
        merge: poses nearer than this are one; 0: they never are, as in the thesis.
    """

    distance: Positive = 0.3
    consistency: Positive = 0.3
    edges: Literal["view", "map"] = "view"
    icp: NonNegative = 0.05
    icp_turn: Literal["viewpoint", "none"] = "viewpoint"
    gate: Positive = 1.0
    gate_yaw: Positive = 0.5
    first: bool = False
    count: Count = 5
    count_distance: NonNegative = 0.0
    reset: bool = True
    step: NonNegative = 0.0
    view: Positive = 10.0
    trunks: Count = 5
    combinations: Count = 2000
    merge: NonNegative = 0.3


@dataclass(frozen=True, slots=True)
class Measured:
    """Poses (Z, 3) by multilateration, and the rows of the map's nodes each of them rests on."""

    poses: Array
    nodes: list[tuple[int, ...]]


NOTHING = Measured(np.zeros((0, 3)), [])


class ThesisMethod:
    """Algorithms 4, 5 and 6 behind the same interface as ours.

    Attributes:
        exploded: scans whose combinations exceeded the cap and measured nothing.
    """

    def __init__(self, topo: TopoMap, config: ThesisConfig | None = None) -> None:
        self.topo = topo = topo.trees()  # the thesis knows no other landmarks
        self.config = config or ThesisConfig()
        self.nodes = topo.p[:, :2] + topo.axis[:, :2] * (0.8 / np.maximum(topo.axis[:, 2:], 0.3))
        if self.config.edges == "map":
            self.edges = topo.edges
        else:
            pairs = cKDTree(self.nodes).query_pairs(2 * self.config.view, output_type="ndarray")
            self.edges = pairs.reshape(-1, 2)
        length = np.linalg.norm(self.nodes[self.edges[:, 0]] - self.nodes[self.edges[:, 1]], axis=1)
        order = np.argsort(length)
        self.edges, self.length = self.edges[order], length[order]
        self.poses = np.zeros((0, 3))
        self.counts = np.zeros(0)
        self.by: list[tuple[int, ...]] = []
        self.started = False
        self._since = 0.0
        self._targets: dict[int, list[tuple[float, Target]]] = {int(t): [] for t in range(len(topo))}
        for v in topo.viewpoints:
            if len(v.cloud) >= FULL_CLOUD:
                self._targets[v.tree].append((float(np.arctan2(v.direction[1], v.direction[0])), Target(v.cloud)))
        self.exploded = 0

    def step(self, trunks: Trunks, leg: Leg) -> Report:
        """One scan further."""
        self._since += leg.distance
        if self.started and self._since < self.config.step:
            self.poses, self.by = _moved(self.poses, leg), [()] * len(self.poses)
            return self._report(trunks.stamp_ns, leg)
        driven, self._since = self._since, 0.0
        self._update(self._measure(trunks, leg), leg, driven)
        return self._report(trunks.stamp_ns, leg)

    def _measure(self, trunks: Trunks, leg: Leg) -> Measured:
        """Local map matching and multilateration."""
        flat = transform(from_xyz_rpy(0, 0, 0, leg.roll, leg.pitch, 0), trunks.p) if len(trunks) else np.zeros((0, 3))
        reach = np.hypot(flat[:, 0], flat[:, 1])
        use = [int(i) for i in np.argsort(reach) if 0.3 < reach[i] < self.config.view and trunks.score[i] >= 0]
        use = use[: self.config.trunks]
        if len(use) < 2:
            return NOTHING
        z = flat[use, :2]
        clouds = [trunks.clouds[i] if trunks.clouds else None for i in use]
        candidates = [
            self._by_icp(c, p, n) for c, p, n in zip(clouds, trunks.p[use], self._by_distance(z), strict=True)
        ]
        found = self._combine(z, candidates)
        if not found:
            return NOTHING
        return Measured(multilaterate_all(z, self.nodes[np.array(found)]), found)

    def _report(self, stamp_ns: int, leg: Leg) -> Report:
        places = self.poses[_distinct(self.poses, TOGETHER)]
        n = len(places)
        fix = None
        trees = np.zeros(0, np.int64)
        if n == 1:
            x, y, yaw = places[0]
            near = np.argmin(np.hypot(*(self.topo.p[:, :2] - [x, y]).T))
            T = from_xyz_rpy(x, y, self.topo.p[near, 2], leg.roll, leg.pitch, yaw)
            fix = Fix(stamp_ns, T, np.full((6, 6), np.nan), np.nan)
            trees = self.topo.ids[sorted({t for nodes in self.by for t in nodes})]
        state = "tracking" if n == 1 else "ambiguous" if n else "lost" if self.started else "searching"
        if not n:
            self.started = False
        pairs = np.zeros((0, 2), np.int64)
        return Report(
            stamp_ns=stamp_ns,
            state=state,
            fix=fix,
            hypotheses=n,
            risk=np.nan,
            places=places[:200],
            trees=trees,
            pairs=pairs,
            along=np.nan,
            across=np.nan,
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

    def _by_icp(self, cloud: NDArray[np.float32] | None, p: Array, nodes: NDArray[np.int64]) -> NDArray[np.int64]:
        """Algorithm 5: the candidates onto whose cloud the cloud of a trunk at `p` (3,) can be registered; a node without clouds passes."""
        if cloud is None or len(cloud) < FULL_CLOUD or self.config.icp <= 0 or not self.topo.viewpoints:
            return nodes
        query = Query(cloud)
        sight = float(np.arctan2(-p[1], -p[0])) if self.config.icp_turn == "viewpoint" else None
        keep = [
            t
            for t in nodes.tolist()
            if not self._targets[t]
            or any(
                query.fitness(target, 0.0 if sight is None else yaw - sight) < self.config.icp
                for yaw, target in self._targets[t]
            )
        ]
        return np.array(keep, np.int64)

    def _combine(self, z: Array, candidates: list[NDArray[np.int64]]) -> list[tuple[int, ...]]:
        """Combinations whose distances agree with the map's (Table 4.1); none when there are too many."""
        d = np.linalg.norm(z[:, None] - z[None], axis=2)
        parts = np.zeros((1, 0), np.int64)
        for i, nodes in enumerate(candidates):
            longer: list[NDArray[np.int64]] = []
            total = 0
            block = max(1, PAIRS_AT_ONCE // max(len(nodes), 1))
            for k in range(0, len(parts), block):
                some = parts[k : k + block]
                ok = np.ones((len(some), len(nodes)), bool)
                for q in range(some.shape[1]):
                    there = np.linalg.norm(self.nodes[some[:, q], None] - self.nodes[None, nodes], axis=2)
                    ok &= np.abs(there - d[i, q]) <= self.config.consistency
                    ok &= some[:, q, None] != nodes[None]
                rows, columns = np.nonzero(ok)
                longer.append(np.column_stack([some[rows], nodes[columns]]))
                total += len(rows)
                if total > 20 * self.config.combinations:
                    self.exploded += 1
                    return []
            parts = np.concatenate(longer) if longer else np.zeros((0, i + 1), np.int64)
        if len(parts) > self.config.combinations:
            self.exploded += 1
            return []
        return [tuple(row) for row in parts.tolist()]

    def _update(self, measured: Measured, leg: Leg, driven: float) -> None:
        """Algorithm 6, `driven` metres after the last iteration."""
        c, z = self.config, measured.poses
        if not self.started:
            if len(z):
                self.poses, self.counts, self.started = z.copy(), np.zeros(len(z)), True
                self.by = list(measured.nodes)
            self._merge()
            return
        alive = self.counts <= (c.count_distance or c.count)
        poses, counts = _moved(self.poses[alive], leg), self.counts[alive]
        by: list[tuple[int, ...]] = [()] * len(poses)
        tree = cKDTree(z[:, :2]) if len(z) else None
        for k in range(len(poses)):
            near = tree.query_ball_point(poses[k, :2], c.gate) if tree is not None else []
            near = [i for i in sorted(near) if abs(wrap(z[i, 2] - poses[k, 2])) < c.gate_yaw]
            if not near:
                counts[k] += driven if c.count_distance else 1
                continue
            chosen = near[0] if c.first else min(near, key=lambda i: float(np.hypot(*(z[i, :2] - poses[k, :2]))))
            away = wrap(z[chosen, 2] - poses[k, 2])
            poses[k] = [*(0.5 * (poses[k, :2] + z[chosen, :2])), poses[k, 2] + 0.5 * away]  # eq. 4.18
            by[k] = measured.nodes[chosen]
            if c.reset:
                counts[k] = 0
        self.poses, self.counts, self.by = poses, counts, by
        self._merge()

    def _merge(self) -> None:
        """Poses that have become one are one."""
        if self.config.merge <= 0:
            return
        order = np.argsort(self.counts, kind="stable")
        keep = order[_distinct(self.poses[order], self.config.merge)].tolist()
        self.poses, self.counts, self.by = self.poses[keep], self.counts[keep], [self.by[k] for k in keep]


PAIRS_AT_ONCE = 1_000_000
"""Parts of combinations times candidate nodes that are looked at together."""
TOGETHER = 0.3
"""Poses nearer than this to each other are one place: the hypotheses have converged, whether or not they are counted as one, m."""


def _distinct(poses: Array, apart: float) -> NDArray[np.int64]:
    """Rows of `poses` (N, 3), each further than `apart` m from all that were taken before it."""
    keep: list[int] = []
    for k in range(len(poses)):
        if not keep or float(np.hypot(*(poses[keep, :2] - poses[k, :2]).T).min()) > apart:
            keep.append(k)
    return np.array(keep, np.int64)


FULL_CLOUD = 12
"""Points of a cloud that can be registered."""


def _moved(poses: Array, leg: Leg) -> Array:
    """Poses (N, 3) a leg further (eq. 4.17)."""
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    dx, dy, turn = leg.step
    return np.asarray(poses + np.stack([c * dx - s * dy, s * dx + c * dy, np.full(len(poses), turn)], axis=1))


def multilaterate(z: Array, beacons: Array, steps: int = 100) -> Array:
    """Pose (3,) from ranges to beacons (N, 2); see `multilaterate_all`."""
    return np.asarray(multilaterate_all(z, beacons[None], steps)[0])


def multilaterate_all(z: Array, beacons: Array, steps: int = 100) -> Array:
    """Poses (C, 3) from ranges to beacons (C, N, 2), by gradient descent on the squared range errors (thesis 3.4).

    `z` (N, 2) are the trunks in the robot's frame, m. The start is the rigid fit's position, which resolves the mirror image
    of two ranges; the heading is the mean turn between bearings in the robot's frame and in the map.
    """
    a, b = z - z.mean(0), beacons - beacons.mean(1, keepdims=True)
    yaw = np.arctan2(np.sum(a[:, 0] * b[..., 1] - a[:, 1] * b[..., 0], axis=1), np.sum(a * b, axis=(1, 2)))
    c, s = np.cos(yaw), np.sin(yaw)
    mx, my = z.mean(0)
    x = beacons.mean(1) - np.stack([c * mx - s * my, s * mx + c * my], axis=1)
    ranges = np.hypot(z[:, 0], z[:, 1])
    going = np.arange(len(x))
    for _ in range(steps):
        away = x[going, None] - beacons[going]
        d = np.maximum(np.linalg.norm(away, axis=2), 1e-6)
        gradient = np.sum(((d - ranges) / d)[..., None] * away, axis=1)
        x[going] -= 0.5 / len(z) * gradient
        going = going[np.abs(gradient).max(axis=1) >= 1e-5]
        if not len(going):
            break
    seen = beacons - x[:, None]
    turn = np.arctan2(seen[..., 1], seen[..., 0]) - np.arctan2(z[:, 1], z[:, 0])
    return np.column_stack([x, np.arctan2(np.sin(turn).sum(axis=1), np.cos(turn).sum(axis=1))])
