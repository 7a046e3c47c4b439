"""A small EKF over the robot and the landmarks around it, in the plane: the submap, and later the track on the map.

State: x, y, yaw, then x, y of each landmark. Kept as an EKF with the full joint covariance because the search needs that
covariance at every step; a graph would have to be marginalised for it each time.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from topograph.geometry import Array


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
        _predict(self._mean, self._cov, 3 + 2 * self.n, move, cov)
        self.run += distance

    def innovations(self, z: Array, R: Array) -> tuple[Array, Array]:
        """Squared Mahalanobis distances (N, n) of detections to landmarks, and log determinants of their S (N, n)."""
        m2, logdet = _innovations(self._mean, self._cov, self.n, z, R)
        return m2, logdet

    def update(self, k: int, z: Array, R: Array) -> tuple[float, float]:
        """Sight landmark `k` at `z` (2,) in the robot's plane; returns chi-square and log |S| of the innovation."""
        out = _update(self._mean, self._cov, 3 + 2 * self.n, k, z, R)
        return float(out[0]), float(out[1])

    def fix(self, k: int, place: Array, cov: Array) -> None:
        """Landmark `k` is known to be at `place` (2,) with covariance (2, 2)."""
        _fix(self._mean, self._cov, 3 + 2 * self.n, k, place, cov)

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
        _add(self._mean, self._cov, 3 + 2 * k, z, R)
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


@njit(cache=True)
def _predict(mean, cov, d, move, q):
    c, s = np.cos(mean[2]), np.sin(mean[2])
    dx = c * move[0] - s * move[1]
    dy = s * move[0] + c * move[1]
    mean[0] += dx
    mean[1] += dy
    mean[2] += move[2]
    for j in range(d):  # F = [[1, 0, -dy], [0, 1, dx], [0, 0, 1]]
        cov[0, j] -= dy * cov[2, j]
        cov[1, j] += dx * cov[2, j]
    for j in range(d):
        cov[j, 0] -= dy * cov[j, 2]
        cov[j, 1] += dx * cov[j, 2]
    # Noise is given in the robot's frame before the step.
    a = c * c * q[0, 0] + s * s * q[1, 1] - 2 * c * s * q[0, 1]
    b = s * s * q[0, 0] + c * c * q[1, 1] + 2 * c * s * q[0, 1]
    o = c * s * (q[0, 0] - q[1, 1]) + (c * c - s * s) * q[0, 1]
    cov[0, 0] += a
    cov[1, 1] += b
    cov[0, 1] += o
    cov[1, 0] += o
    cov[2, 2] += q[2, 2]
    ux = c * q[0, 2] - s * q[1, 2]
    uy = s * q[0, 2] + c * q[1, 2]
    cov[0, 2] += ux
    cov[2, 0] += ux
    cov[1, 2] += uy
    cov[2, 1] += uy


@njit(cache=True)
def _innovations(mean, cov, n, z, R):
    m2 = np.empty((len(z), n))
    logdet = np.empty((len(z), n))
    c, s = np.cos(mean[2]), np.sin(mean[2])
    for k in range(n):
        a = 3 + 2 * k
        ex, ey = mean[a] - mean[0], mean[a + 1] - mean[1]
        hx, hy = c * ex + s * ey, -s * ex + c * ey
        # H over (x, y, yaw, lx, ly)
        S00, S01, S11 = _project(cov, a, c, s, hx, hy)
        for i in range(len(z)):
            p, q, r = S00 + R[i, 0, 0], S01 + R[i, 0, 1], S11 + R[i, 1, 1]
            det = p * r - q * q
            vx, vy = z[i, 0] - hx, z[i, 1] - hy
            m2[i, k] = (vx * vx * r - 2 * vx * vy * q + vy * vy * p) / det
            logdet[i, k] = np.log(det)
    return m2, logdet


@njit(cache=True)
def _project(cov, a, c, s, hx, hy):
    H = np.empty((2, 5))
    H[0, 0], H[0, 1], H[0, 2], H[0, 3], H[0, 4] = -c, -s, hy, c, s
    H[1, 0], H[1, 1], H[1, 2], H[1, 3], H[1, 4] = s, -c, -hx, -s, c
    index = np.array([0, 1, 2, a, a + 1])
    out = np.zeros(3)
    for i in range(5):
        for j in range(5):
            v = cov[index[i], index[j]]
            out[0] += H[0, i] * v * H[0, j]
            out[1] += H[0, i] * v * H[1, j]
            out[2] += H[1, i] * v * H[1, j]
    return out[0], out[1], out[2]


@njit(cache=True)
def _update(mean, cov, d, k, z, R):
    a = 3 + 2 * k
    c, s = np.cos(mean[2]), np.sin(mean[2])
    ex, ey = mean[a] - mean[0], mean[a + 1] - mean[1]
    hx, hy = c * ex + s * ey, -s * ex + c * ey
    PH = np.empty((d, 2))
    for j in range(d):
        PH[j, 0] = -c * cov[j, 0] - s * cov[j, 1] + hy * cov[j, 2] + c * cov[j, a] + s * cov[j, a + 1]
        PH[j, 1] = s * cov[j, 0] - c * cov[j, 1] - hx * cov[j, 2] - s * cov[j, a] + c * cov[j, a + 1]
    p = -c * PH[0, 0] - s * PH[1, 0] + hy * PH[2, 0] + c * PH[a, 0] + s * PH[a + 1, 0] + R[0, 0]
    q = -c * PH[0, 1] - s * PH[1, 1] + hy * PH[2, 1] + c * PH[a, 1] + s * PH[a + 1, 1] + R[0, 1]
    r = s * PH[0, 1] - c * PH[1, 1] - hx * PH[2, 1] - s * PH[a, 1] + c * PH[a + 1, 1] + R[1, 1]
    return _gain(mean, cov, d, PH, p, q, r, z[0] - hx, z[1] - hy)


@njit(cache=True)
def _fix(mean, cov, d, k, place, C):
    a = 3 + 2 * k
    PH = cov[:d, a : a + 2].copy()
    p, q, r = cov[a, a] + C[0, 0], cov[a, a + 1] + C[0, 1], cov[a + 1, a + 1] + C[1, 1]
    return _gain(mean, cov, d, PH, p, q, r, place[0] - mean[a], place[1] - mean[a + 1])


@njit(cache=True)
def _gain(mean, cov, d, PH, p, q, r, vx, vy):
    det = p * r - q * q
    ip, iq, ir = r / det, -q / det, p / det
    wx, wy = ip * vx + iq * vy, iq * vx + ir * vy
    for i in range(d):
        k0 = PH[i, 0] * ip + PH[i, 1] * iq
        k1 = PH[i, 0] * iq + PH[i, 1] * ir
        mean[i] += PH[i, 0] * wx + PH[i, 1] * wy
        for j in range(d):
            cov[i, j] -= k0 * PH[j, 0] + k1 * PH[j, 1]
    return vx * wx + vy * wy, np.log(det)


@njit(cache=True)
def _add(mean, cov, a, z, R):
    c, s = np.cos(mean[2]), np.sin(mean[2])
    gx, gy = c * z[0] - s * z[1], s * z[0] + c * z[1]
    mean[a] = mean[0] + gx
    mean[a + 1] = mean[1] + gy
    for j in range(a):
        cov[a, j] = cov[0, j] - gy * cov[2, j]
        cov[a + 1, j] = cov[1, j] + gx * cov[2, j]
        cov[j, a] = cov[a, j]
        cov[j, a + 1] = cov[a + 1, j]
    cov[a, a] = cov[a, 0] - gy * cov[a, 2] + c * c * R[0, 0] + s * s * R[1, 1] - 2 * c * s * R[0, 1]
    cov[a + 1, a + 1] = cov[a + 1, 1] + gx * cov[a + 1, 2] + s * s * R[0, 0] + c * c * R[1, 1] + 2 * c * s * R[0, 1]
    cov[a, a + 1] = cov[a, 1] + gx * cov[a, 2] + c * s * (R[0, 0] - R[1, 1]) + (c * c - s * s) * R[0, 1]
    cov[a + 1, a] = cov[a, a + 1]
