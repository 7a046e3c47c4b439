"""The graph of one place that survived the search: poses, the map's trees, odometry, and bearings and ranges to the trees.

A fixed-lag smoother over `gtsam.NonlinearFactorGraph`: the last poses stay variables and are linearised anew with every scan, older
ones are marginalised into a linear factor on what they were tied to. (`gtsam.IncrementalFixedLagSmoother` does the same; its growth
and its crashes on re-stamped keys are known: gtsam #1452, #1935, #2567.)
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from factors import Kernel, sighting_2d
from topograph.geometry import Array
from topograph.localize.config import LocalizeConfig
from topograph.localize.submap import Move, Sweep

_X, _L = gtsam.symbol_shorthand.X, gtsam.symbol_shorthand.L
LAG, OLDEST = 10, 5
"""Poses that stay variables, at least; so many more, and they are marginalised at once."""
STEPS = 2
"""Gauss-Newton steps a scan: the last scan's solution is near."""
HUBER = Kernel("huber", 2.0)
AWAY = 8.0
"""Trees that are further beyond the view, m, are marginalised: what was learnt of nearer ones is wanted when they are seen again."""
DRAGGED = 2.0
"""Deviations of the map by which most trees in view may seem to stand elsewhere. Something that lasts pulls at them, such as a tilt that
nobody knows of, and what was learnt of the trees from scan to scan is wrong."""
ANEW_YAW = 0.03
"""Of the heading then, rad."""
TELLS = 6
"""Sightings of a tree before how far it was moved tells how well the map knows it."""
TAKEN, PLACE = 8.0, (0.015, 0.1)
"""Trees' worth of what is taken beforehand for the map's own deviation (`map_sigma`), and the least and the most that it can be found to be, m."""
OUTLIER = 9.0
"""Squared deviations beyond which a tree says no more of it: it may be another one."""
LEAST = 1e-10
"""Added to the variances of a step: a robot that stands has none."""


@dataclass(slots=True)
class _Seen:
    """What was seen of a tree: the `last` scan that saw it, how many did, and what they told of its place together, 1/m²."""

    last: int = 0
    count: int = 0
    information: float = 0.0

    def again(self, scan: int, cov: Array) -> None:
        """A sighting with covariance (2, 2)."""
        self.last = scan
        self.count += 1
        self.information += 2.0 / float(np.trace(cov))


class Hypothesis:
    """Where the robot is, if this place is the right one.

    Args:
        pose, cov: (3,), (3, 3) of x, y (m) and yaw (rad) in the map when the search ended.
        trees, var: (T, 2) m and (T,) m² of the map.
    """

    def __init__(self, pose: Array, cov: Array, trees: Array, var: Array, config: LocalizeConfig) -> None:
        self.trees, self.var, self.config = trees, var, config
        self._k = 0
        self._poses = [0]
        self._values = gtsam.Values()
        self._values.insert(_X(0), gtsam.Pose2(*pose))
        own = _turn(-float(pose[2])) @ cov @ _turn(-float(pose[2])).T + LEAST * np.eye(3)
        prior = gtsam.PriorFactorPose2(_X(0), gtsam.Pose2(*pose), gtsam.noiseModel.Gaussian.Covariance(own))
        self._factors: list[Any] = [prior]
        self._seen: dict[int, _Seen] = {}
        self._gone = np.zeros(2)
        self.dragged = 0.0
        self.pose, self.cov = np.asarray(pose, float).copy(), np.asarray(cov, float).copy()

    def step(self, move: Move, sweep: Sweep, pairs: NDArray[np.int64]) -> None:
        """One scan further: `move` leads to it, `pairs` (N, 2) are rows of `sweep` and of the map's trees."""
        noise = gtsam.noiseModel.Gaussian.Covariance(move.cov + LEAST * np.eye(3))
        step = gtsam.Pose2(*move.step)
        self.dragged = 0.0
        self._factors.append(gtsam.BetweenFactorPose2(_X(self._k), _X(self._k + 1), step, noise))
        self._values.insert(_X(self._k + 1), self._values.atPose2(_X(self._k)).compose(step))
        self._k += 1
        self._poses.append(self._k)
        side = self.config.trunk_sigma**2 * np.eye(2)
        for i, t in pairs.tolist():
            if t not in self._seen:
                self._seen[t] = _Seen()
                self._values.insert(_L(t), self.trees[t])
                sigma = float(np.sqrt(self.var[t]))
                self._factors.append(
                    gtsam.PriorFactorPoint2(_L(t), self.trees[t], gtsam.noiseModel.Isotropic.Sigma(2, sigma))
                )
            self._seen[t].again(self._k, sweep.cov[i] + side)
            self._factors.append(
                sighting_2d(_X(self._k), _L(t), sweep.p[i], sweep.cov[i] + side, HUBER, self.config.measure)
            )
        self._solve()
        self.dragged = self._drag(pairs[:, 1])
        if len(self._poses) > LAG + OLDEST:
            self._marginalise()

    def _solve(self) -> None:
        graph = gtsam.NonlinearFactorGraph()
        for f in self._factors:
            graph.push_back(f)
        order = gtsam.Ordering()
        for k in self._poses[:-1]:
            order.push_back(_X(k))
        for t in self._seen:
            order.push_back(_L(t))
        order.push_back(_X(self._k))  # last, so that its own conditional is its marginal
        for _ in range(STEPS):
            net = graph.linearize(self._values).eliminateSequential(order)
            self._values = self._values.retract(net.optimize())
        R = net.at(net.size() - 1).R()
        inverse = np.linalg.inv(R)
        last = self._values.atPose2(_X(self._k))
        self.pose = np.array([last.x(), last.y(), last.theta()])
        turn = _turn(last.theta())
        self.cov = turn @ (inverse @ inverse.T) @ turn.T

    def anew(self) -> Hypothesis:
        """The same place without what was learnt of its trees: they have been dragged along, as far as the pose may be off."""
        by = self.dragged**2 * float(np.median(self.var))
        return Hypothesis(self.pose, self.cov + np.diag([by, by, ANEW_YAW**2]), self.trees, self.var, self.config)

    def _moved(self, trees: NDArray[np.int64]) -> Array:
        """How far `trees` (N,) have been moved from where the map has them, (N,) m."""
        at = np.array([self._values.atPoint2(_L(t)) for t in trees.tolist()])
        return np.asarray(np.linalg.norm(at - self.trees[trees], axis=1))

    def _drag(self, seen: NDArray[np.int64]) -> float:
        """The same of most of the trees that are `seen`, in the map's own standard deviations."""
        return float(np.median(self._moved(seen) / np.sqrt(self.var[seen]))) if len(seen) >= 3 else 0.0

    def _told(self, trees: list[int]) -> Array:
        """What `trees` tell of the map's own deviation: the sum over them of its square, and how many there are.

        A tree of prior variance v that n sightings of variance r saw moves by v / (v + r/n) of what it is off and they err.
        """
        t = np.array([k for k in trees if self._seen[k].count >= TELLS], np.int64)
        if not len(t):
            return np.zeros(2)
        v, r = self.var[t], 1.0 / np.array([self._seen[k].information for k in t.tolist()])
        moved = np.minimum(0.5 * self._moved(t) ** 2, OUTLIER * v)
        own = v - self.config.map_sigma**2
        return np.array([float(np.sum(moved * ((v + r) / v) ** 2 - r - own)), len(t)])

    @property
    def scale(self) -> float:
        """Of the covariance: what is found of the map's own deviation against what was taken for it (a variance component, Förstner 1979)."""
        total, n = self._gone + self._told(list(self._seen))
        taken = self.config.map_sigma**2
        free = 2.0 * n / max(2.0 * n - 3.0, 1.0)  # the pose takes up what they have in common
        least, most = min(PLACE[0] ** 2, taken), max(PLACE[1] ** 2, taken)
        found = float(np.clip((TAKEN * taken + free * total) / (TAKEN + n), least, most))
        own = float(np.mean(self.var[list(self._seen)])) - taken if self._seen else 0.0
        return (own + found) / (own + taken)

    def _marginalise(self) -> None:
        """The oldest poses, and trees that only they saw, become a linear factor on the rest."""
        old = {_X(k) for k in self._poses[:OLDEST]}
        first = self._poses[OLDEST]
        away = self.config.view + AWAY
        gone = [
            t
            for t, seen in self._seen.items()
            if seen.last < first and float(np.hypot(*(self.trees[t] - self.pose[:2]))) > away
        ]
        self._gone += self._told(gone)
        old |= {_L(t) for t in gone}
        mine = [f for f in self._factors if not old.isdisjoint(f.keys())]
        touched = gtsam.NonlinearFactorGraph()
        for f in mine:
            touched.push_back(f)
        order = gtsam.Ordering()
        for key in sorted(old):
            order.push_back(key)
        _, rest = touched.linearize(self._values).eliminatePartialSequential(order)
        kept = {id(f) for f in mine}
        self._factors = [f for f in self._factors if id(f) not in kept]
        for n in range(rest.size()):
            if rest.at(n) is not None and rest.at(n).size():
                self._factors.append(gtsam.LinearContainerFactor(rest.at(n), self._values))
        for key in old:
            self._values.erase(key)
        for t in gone:
            del self._seen[t]
        del self._poses[:OLDEST]


def _turn(yaw: float) -> Array:
    """(3, 3): a vector of x, y and yaw turned about the vertical."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
