"""Monte Carlo localization with trunks, a rival for `topograph compare --rival tools/rivals/mcl.py`.

A particle filter (Dellaert et al. 1999; Thrun, Burgard, Fox: Probabilistic Robotics, ch. 8) over x, y and yaw, started anywhere on the map,
with injected random particles (augmented MCL). The likelihood of a scan is a mixture of each trunk's distance to the nearest mapped tree and a
uniform floor. It commits when nearly all weight lies within a metre, and gives no promise about the risk of that.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from topograph.geometry import from_xyz_rpy, transform
from topograph.localize import Fix, Report

PARTICLES, MOST_TRUNKS, VIEW = 20_000, 12, 20.0
SIGMA, OUTLIER = 0.35, 0.1
TOGETHER, SHARE = 1.0, 0.95
INJECTED = 0.02
TEMPER = 0.15
"""Scans that follow each other err alike; without it the cloud collapses onto the first place that fits."""


class Mcl:
    def __init__(self, topo, seed: int = 0) -> None:
        self.topo = topo.trees()
        self.xy = self.topo.p[:, :2]
        self.tree = cKDTree(self.xy)
        self.rng = np.random.default_rng(seed)
        self.low, self.high = self.xy.min(0) - 5.0, self.xy.max(0) + 5.0
        self.x = self._anywhere(PARTICLES)
        self.w = np.full(PARTICLES, 1.0 / PARTICLES)
        self.driven = 0.0

    def _anywhere(self, n: int) -> np.ndarray:
        at = self.rng.uniform(self.low, self.high, (n, 2))
        return np.column_stack([at, self.rng.uniform(-np.pi, np.pi, n)])

    def step(self, trunks, leg) -> Report:
        n, rng = PARTICLES, self.rng
        dx, dy, turn = leg.step
        noise = 0.05 * leg.distance + 0.005
        dx, dy = dx + rng.normal(0, noise, n), dy + rng.normal(0, noise, n)
        c, s = np.cos(self.x[:, 2]), np.sin(self.x[:, 2])
        self.x += np.column_stack(
            [c * dx - s * dy, s * dx + c * dy, turn + rng.normal(0, 0.005 + 0.02 * leg.turned, n)]
        )
        flat = (
            transform(from_xyz_rpy(0, 0, 0, leg.roll, leg.pitch, 0), trunks.p)[:, :2]
            if len(trunks)
            else np.zeros((0, 2))
        )
        reach = np.hypot(*flat.T) if len(flat) else np.zeros(0)
        use = np.argsort(reach)[:MOST_TRUNKS]
        use = use[(reach[use] < VIEW) & (trunks.score[use] >= 0)] if len(use) else use
        self.driven += leg.distance
        if len(use) and (self.driven > 0.2 or leg.distance == 0):
            self.driven = 0.0
            self._weigh(flat[use])
        return self._report(trunks.stamp_ns, leg)

    def _weigh(self, z: np.ndarray) -> None:
        c, s = np.cos(self.x[:, 2]), np.sin(self.x[:, 2])
        log = np.zeros(PARTICLES)
        for p in z:
            at = self.x[:, :2] + np.column_stack([c * p[0] - s * p[1], s * p[0] + c * p[1]])
            d = self.tree.query(at, distance_upper_bound=3.0)[0]
            log += np.log((1 - OUTLIER) * np.exp(-0.5 * (d / SIGMA) ** 2) + OUTLIER)
        log = TEMPER * log + np.log(self.w + 1e-300)  # neighbouring scans err alike
        self.w = np.exp(log - log.max())
        self.w /= self.w.sum()
        if 1.0 / np.sum(self.w**2) < 0.5 * PARTICLES:
            at = (self.rng.random() + np.arange(PARTICLES)) / PARTICLES
            self.x = self.x[np.minimum(np.searchsorted(np.cumsum(self.w), at), PARTICLES - 1)]
            self.x += self.rng.normal(0, [0.03, 0.03, 0.01], self.x.shape)
            lost = self.rng.random(PARTICLES) < INJECTED
            self.x[lost] = self._anywhere(int(lost.sum()))
            self.w[:] = 1.0 / PARTICLES

    def _report(self, stamp_ns: int, leg) -> Report:
        best = self.x[np.argmax(self.w), :2] if self.w.max() > 2.0 / PARTICLES else np.median(self.x[:, :2], axis=0)
        for _ in range(3):
            near = np.hypot(*(self.x[:, :2] - best).T) < TOGETHER
            if not near.any():
                break
            best = np.average(self.x[near, :2], axis=0, weights=self.w[near])
        share = float(self.w[near].sum())
        fix = None
        if share > SHARE:
            yaw = float(np.angle(np.sum(self.w[near] * np.exp(1j * self.x[near, 2]))))
            k = int(np.argmin(np.hypot(*(self.xy - best).T)))
            T = from_xyz_rpy(best[0], best[1], self.topo.p[k, 2], leg.roll, leg.pitch, yaw)
            fix = Fix(stamp_ns, T, np.full((6, 6), np.nan), np.nan)
        n = np.zeros(0, np.int64)
        shown = self.x[self.rng.integers(0, PARTICLES, 50)]
        return Report(
            stamp_ns=stamp_ns,
            state="tracking" if fix else "ambiguous",
            fix=fix,
            hypotheses=1 if fix else 50,
            risk=np.nan,
            places=shown,
            trees=n,
            pairs=np.zeros((0, 2), np.int64),
            along=np.nan,
            across=np.nan,
        )


def method(topo, config) -> Mcl:
    return Mcl(topo)
