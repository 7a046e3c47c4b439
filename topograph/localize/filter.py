"""A small EKF over the robot and the landmarks around it, in the plane: the submap, and later the track on the map.

State: x, y, yaw, then x, y of each landmark. Kept as an EKF with the full joint covariance because the search needs that
covariance at every step; a graph would have to be marginalised for it each time.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from topograph.geometry import Array
from topograph.localize.filter_kernels import add_kernel, fix_kernel, innovations_kernel, predict_kernel, update_kernel


class Filter:
    """Robot and landmarks with their joint covariance; grows and shrinks.

    Attributes:
        n: landmarks.
        mean: (3 + 2n,) and `cov` (3 + 2n, 3 + 2n), as views of larger arrays.
        tree: (n,) row of the mapped tree that a landmark is; -1 unknown.
        hits, looks: (n,) sightings, and scans that should have shown it since the first.
        diameter, weight: (n,) weighted mean of diameters, m, and its information, 1/m².
        seen: (n,) distance driven at the last sighting, m.
        near: (n,) shortest range of a sighting, m.
        run: distance driven, m.
    """

    def __init__(self, capacity: int = 24) -> None:
        self.n = 0
        self.run = 0.0
        self._mean = np.zeros(3 + 2 * capacity)
        self._cov = np.zeros((3 + 2 * capacity, 3 + 2 * capacity))
        self._tree = np.full(capacity, -1, np.int64)
        self._rows = np.zeros((6, capacity))  # hits, looks, diameter, weight, seen, near

    @property
    def mean(self) -> Array:
        return self._mean[: 3 + 2 * self.n]

    @property
    def cov(self) -> Array:
        return self._cov[: 3 + 2 * self.n, : 3 + 2 * self.n]

    @property
    def landmarks(self) -> Array:
        """(n, 2) m."""
        return self.mean[3:].reshape(-1, 2)

    @property
    def tree(self) -> NDArray[np.int64]:
        return self._tree[: self.n]

    @property
    def hits(self) -> Array:
        return self._rows[0, : self.n]

    @property
    def looks(self) -> Array:
        return self._rows[1, : self.n]

    @property
    def diameter(self) -> Array:
        return self._rows[2, : self.n]

    @property
    def weight(self) -> Array:
        return self._rows[3, : self.n]

    @property
    def seen(self) -> Array:
        return self._rows[4, : self.n]

    @property
    def near(self) -> Array:
        return self._rows[5, : self.n]

    def predict(self, move: Array, cov: Array, distance: float) -> None:
        """Move by (x, y, yaw) in the robot's own plane, with covariance (3, 3)."""
        predict_kernel(self._mean, self._cov, 3 + 2 * self.n, move, cov)
        self.run += distance

    def innovations(self, z: Array, R: Array) -> tuple[Array, Array]:
        """Squared Mahalanobis distances (N, n) of detections to landmarks, and log determinants of their S (N, n)."""
        m2, logdet = innovations_kernel(self._mean, self._cov, self.n, z, R)
        return m2, logdet

    def update(self, k: int, z: Array, R: Array) -> tuple[float, float]:
        """Sight landmark `k` at `z` (2,) in the robot's plane; returns chi-square and log |S| of the innovation."""
        out = update_kernel(self._mean, self._cov, 3 + 2 * self.n, k, z, R)
        return float(out[0]), float(out[1])

    def fix(self, k: int, place: Array, cov: Array) -> None:
        """Landmark `k` is known to be at `place` (2,) with covariance (2, 2)."""
        fix_kernel(self._mean, self._cov, 3 + 2 * self.n, k, place, cov)

    def count(self, k: int, diameter: float, diameter_var: float, reach: float) -> None:
        """Bookkeeping of a sighting."""
        r = self._rows
        r[0, k] += 1
        r[4, k] = self.run
        r[5, k] = min(r[5, k], reach)
        if np.isfinite(diameter):
            w = 1.0 / diameter_var
            r[2, k] = (r[2, k] * r[3, k] + diameter * w) / (r[3, k] + w)
            r[3, k] += w

    def add(self, z: Array, R: Array) -> int:
        """A new landmark seen at `z` (2,) in the robot's plane."""
        k = self._room()
        add_kernel(self._mean, self._cov, 3 + 2 * k, z, R)
        return k

    def place(self, xy: Array, cov: Array, tree: int) -> int:
        """A landmark known beforehand: mapped tree `tree`."""
        k = self._room()
        a = 3 + 2 * k
        self._mean[a : a + 2] = xy
        self._cov[a : a + 2, : a + 2] = 0.0
        self._cov[: a + 2, a : a + 2] = 0.0
        self._cov[a : a + 2, a : a + 2] = cov
        self._tree[k] = tree
        return k

    def _room(self) -> int:
        if self.n == len(self._tree):
            more = 2 * self.n
            mean, cov = np.zeros(3 + 2 * more), np.zeros((3 + 2 * more, 3 + 2 * more))
            mean[: len(self._mean)] = self._mean
            cov[: len(self._mean), : len(self._mean)] = self._cov
            rows, tree = np.zeros((6, more)), np.full(more, -1, np.int64)
            rows[:, : self.n], tree[: self.n] = self._rows, self._tree
            self._mean, self._cov, self._rows, self._tree = mean, cov, rows, tree
        k = self.n
        self.n += 1
        self._tree[k] = -1
        self._rows[:, k] = (0.0, 0.0, np.nan, 0.0, self.run, 1e9)
        self._rows[2, k] = 0.0
        return k

    def keep(self, chosen: NDArray[np.bool_]) -> None:
        """Drop the landmarks that are not `chosen` (n,); they are marginalised."""
        if chosen.all():
            return
        rows = np.flatnonzero(chosen)
        index = np.concatenate([[0, 1, 2], (3 + 2 * rows[:, None] + np.arange(2)).ravel()])
        m = len(index)
        self._cov[:m, :m] = self._cov[np.ix_(index, index)]
        self._mean[:m] = self._mean[index]
        self._rows[:, : len(rows)] = self._rows[:, rows]
        self._tree[: len(rows)] = self._tree[rows]
        self.n = len(rows)

    def copy(self) -> Filter:
        """An independent copy."""
        out = Filter.__new__(Filter)
        out.n, out.run = self.n, self.run
        out._mean, out._cov = self._mean.copy(), self._cov.copy()
        out._tree, out._rows = self._tree.copy(), self._rows.copy()
        return out

    def moved(self, x: float, y: float, yaw: float, slack: Array) -> Filter:
        """The same in another frame: turned and shifted, with independent deviations `slack` (3,) of that motion."""
        out = self.copy()
        c, s = np.cos(yaw), np.sin(yaw)
        R = np.array([[c, -s], [s, c]])
        d = 3 + 2 * self.n
        G = np.eye(d)
        G[:2, :2] = R
        for a in range(3, d, 2):
            G[a : a + 2, a : a + 2] = R
        points = np.concatenate([self.mean[None, :2], self.landmarks]) @ R.T + [x, y]
        out._mean[:2] = points[0]
        out._mean[2] = self.mean[2] + yaw
        out._mean[3:d] = points[1:].ravel()
        centre = points.mean(0)
        J = np.zeros((d, 3))
        J[0, 0] = J[1, 1] = J[2, 2] = 1.0
        J[3::2, 0] = J[4::2, 1] = 1.0
        J[[0, *range(3, d, 2)], 2] = -(points[:, 1] - centre[1])
        J[[1, *range(4, d, 2)], 2] = points[:, 0] - centre[0]
        out._cov[:d, :d] = G @ self.cov @ G.T + (J * slack**2) @ J.T
        return out
