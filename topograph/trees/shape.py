"""The shape of each tree from all its sightings: what was measured is added up, the prior applied once."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from topograph.geometry import Array, inverse, transform
from topograph.trees.detections import Detections

LEAN_PRIOR = 0.12
"""Sigma of a trunk's lean from the vertical, rad (per axis)."""
DIAMETER_PRIOR = (0.22, 0.25)
"""Mean and sigma of diameters, m: wide, since orchards differ more than trees of one."""
ALIKE = 0.1
"""Share of a sighting's information that is its own: the next scan sees the same bark from nearly the same side."""
BEND = 0.012
"""A trunk's axis below what was seen is not the axis seen, rad."""
FORK = 0.4
"""Height above ground at which the stems of one tree are taken to part, m."""
APART = 0.12
"""Share of sightings that must see two stems; of single trunks up to 9 % do, by a branch."""
FORKED_LEAN = 0.08
"""Sigma of the lean below the fork, which no stem shows, rad."""
STATED_PRIOR = 0.12
"""Sigma of the lean's prior within a sighting's stated axis (trunks/fit.py), rad."""
LEVER, SLOPE_X, SLOPE_Y, SLOPE_WEIGHT, WIDE, WIDE_SIGMA = range(6)


@dataclass(frozen=True, slots=True, kw_only=True)
class Shapes:
    """Of T trees, in the map frame.

    Attributes:
        slope: (T, 2) horizontal metres per metre of height; `slope_var` (T,).
        diameter: (T,) m or NaN; `diameter_sigma` (T,).
        height: (T,) above ground of the point that the sightings state, m.
        stems: (T,).
    """

    slope: Array
    slope_var: Array
    diameter: Array
    diameter_sigma: Array
    height: Array
    stems: NDArray[np.int64]

    @property
    def axis(self) -> Array:
        """(T, 3) unit vectors, up."""
        a = np.concatenate([self.slope, np.ones((len(self.slope), 1))], axis=1)
        return np.asarray(a / np.linalg.norm(a, axis=1, keepdims=True))


def shapes(detections: Detections, tree: NDArray[np.int64], map_T_scan: Array, n: int) -> Shapes:
    """Shapes of `n` trees; `tree` (N,) of each detection or -1."""
    d = detections
    order = np.argsort(tree, kind="stable")
    ends = np.searchsorted(tree[order], np.arange(n + 1))
    slope, weight = _slopes(d, map_T_scan)
    # Recorded detections lie at one height, which each scan states from where it stands: all of them say it together.
    measured = np.isfinite(d.kinds).any()
    stated = d.height[np.isfinite(d.height)]
    common = float(np.median(stated)) if len(stated) else 0.0
    out = Shapes(
        slope=np.zeros((n, 2)),
        slope_var=np.full(n, LEAN_PRIOR**2),
        diameter=np.full(n, np.nan),
        diameter_sigma=np.full(n, np.nan),
        height=np.zeros(n),
        stems=np.ones(n, np.int64),
    )
    for j in range(n):
        mine = order[ends[j] : ends[j + 1]]
        if not len(mine):
            continue
        out.slope[j], out.slope_var[j] = _together(slope[mine], weight[mine])
        out.diameter[j], out.diameter_sigma[j] = _thickness(d, mine)
        above = d.height[mine][np.isfinite(d.height[mine])]
        out.height[j] = np.median(above) if len(above) and measured else common
        out.stems[j] = _stems(d, mine)
        if out.stems[j] > 1:
            out.slope_var[j] = max(out.slope_var[j], FORKED_LEAN**2)
    return out


def _slopes(d: Detections, map_T_scan: Array) -> tuple[Array, Array]:
    """Slope (N, 2) of each sighting's axis in the map frame as measured, and its information (N,).

    A source that measures no slope but states an axis (recorded detections) is taken at its word, at 3°.
    """
    if not len(d):
        return np.zeros((0, 2)), np.zeros(0)
    weight = d.measured[:, SLOPE_WEIGHT].copy()
    axis = np.concatenate([d.measured[:, [SLOPE_X, SLOPE_Y]], np.ones((len(d), 1))], axis=1)
    stated = ~np.isfinite(d.kinds).all(axis=1) & (np.abs(d.axis[:, 2]) < 1.0 - 1e-9)
    axis[stated], weight[stated] = d.axis[stated], 1.0 / 0.05**2
    turned = (map_T_scan[d.scan, :3, :3] @ axis[:, :, None])[..., 0]
    flat = np.maximum(turned[:, 2], 0.2)
    return turned[:, :2] / flat[:, None], np.where(np.abs(turned[:, :2]).max(axis=1) < flat, weight, 0.0)


def _together(slope: Array, weight: Array) -> tuple[Array, float]:
    """Mean slope (2,) with the prior, robust to sightings of something else, and its variance."""
    prior = 1.0 / LEAN_PRIOR**2
    if weight.sum() <= 0:
        return np.zeros(2), LEAN_PRIOR**2
    w = ALIKE * np.minimum(weight, 1.0 / 0.03**2)
    mean = np.asarray(w @ slope / w.sum())
    for _ in range(4):
        e2 = np.sum((slope - mean) ** 2, axis=1)
        v = w / (1.0 + e2 / (1.0 / np.maximum(weight, 1e-9) + 0.06**2))
        mean = np.asarray(v @ slope / v.sum())
    e2 = np.sum((slope - mean) ** 2, axis=1)
    spread = float(v @ e2 / v.sum()) / 2.0  # stems and bends: the views do not agree on one axis
    total = float(v.sum())
    var = 1.0 / (total + prior) + BEND**2 + 0.15 * spread * (total / (total + prior))
    return np.asarray(mean * total / (total + prior)), min(var, LEAN_PRIOR**2)


def _thickness(d: Detections, mine: NDArray[np.int64]) -> tuple[float, float]:
    """Diameter and its sigma: the weighted median of what was measured, then the prior; else the median of what was stated."""
    sigma = d.measured[mine, WIDE_SIGMA]
    if not (sigma > 0).any():
        known = d.diameter[mine][np.isfinite(d.diameter[mine])]
        return (float(np.median(known)), 0.03) if len(known) else (np.nan, np.nan)
    rows = mine[sigma > 0]
    sigma = d.measured[rows, WIDE_SIGMA]
    near = sigma <= np.percentile(sigma, 50)
    w, x = 1.0 / sigma[near] ** 2, d.measured[rows[near], WIDE]
    order = np.argsort(x)
    total = np.cumsum(w[order])
    middle = float(x[order][np.searchsorted(total, 0.5 * total[-1])])
    var = float(np.median(sigma[near])) ** 2 / (1.0 + ALIKE * (len(x) - 1)) + 0.015**2
    mean, prior = DIAMETER_PRIOR[0], DIAMETER_PRIOR[1] ** 2
    gain = prior / (prior + var)
    return max(mean + gain * (middle - mean), 0.02), float(np.sqrt(gain * var))


def _stems(d: Detections, mine: NDArray[np.int64]) -> int:
    """Stems that enough of the nearer sightings tell apart: one stem mostly hides the other."""
    far = np.linalg.norm(d.p[mine, :2], axis=1)
    near = d.stems[mine[far <= np.median(far)]]
    return int(max((k for k in range(1, 5) if np.mean(near >= k) >= APART), default=1))


def relevelled(detections: Detections, tree: NDArray[np.int64], map_T_scan: Array, s: Shapes) -> Detections:
    """The detections with their points moved along their tree's axis, in place of along one scan's guess of it.

    A point was measured at the mean height of its returns; where it is stated above or below, it owes its place to the
    lean. With the tree's own lean the covariance loses what the guess had added. Of a tree of several stems each scan
    saw one or another: their points are stated where stems part, along the axis that the scan saw.
    """
    d = detections
    own = np.flatnonzero(tree >= 0)
    several = s.stems[tree[own]] > 1
    return _at_the_fork(_along(d, tree, own[~several], map_T_scan, s), own[several])


def _along(d: Detections, tree: NDArray[np.int64], rows: NDArray[np.int64], map_T_scan: Array, s: Shapes) -> Detections:
    """Rows of `d` stated on the axes of their trees."""
    rows = rows[np.abs(d.measured[rows, LEVER]) > 1e-6]
    if not len(rows):
        return d
    p, cov = d.p.copy(), d.cov.copy()
    lean = d.measured[rows, LEVER][:, None]
    middle = d.p[rows] - lean * d.axis[rows] / np.maximum(d.axis[rows, 2:], 0.3)
    T = map_T_scan[d.scan[rows]]
    up = s.axis[tree[rows]]
    p[rows] = transform(inverse(T), transform(T, middle) + lean * up / np.maximum(up[:, 2:], 0.3))
    change = lean[:, 0] ** 2 * (s.slope_var[tree[rows]] - _stated_lean_var(d, rows))
    _widen(cov, rows, change)
    return replace(d, p=p, cov=cov)


def _at_the_fork(d: Detections, rows: NDArray[np.int64]) -> Detections:
    """Rows of `d` stated where the stems of a tree part."""
    rows = rows[np.isfinite(d.height[rows])]
    if not len(rows):
        return d
    p, cov, height = d.p.copy(), d.cov.copy(), d.height.copy()
    down = d.height[rows] - FORK
    p[rows] -= down[:, None] * d.axis[rows] / np.maximum(d.axis[rows, 2:], 0.3)
    height[rows] = FORK
    lever = d.measured[rows, LEVER]
    _widen(cov, rows, ((lever - down) ** 2 - lever**2) * _stated_lean_var(d, rows))
    return replace(d, p=p, cov=cov, height=height)


def _stated_lean_var(d: Detections, rows: NDArray[np.int64]) -> Array:
    return np.asarray(1.0 / (d.measured[rows, SLOPE_WEIGHT] + 1.0 / STATED_PRIOR**2))


def _widen(cov: Array, rows: NDArray[np.int64], change: Array) -> None:
    """Add `change` (K,) to the horizontal variances of rows of `cov`; a quarter of the least variance stays."""
    change = np.maximum(change, -0.75 * np.linalg.eigvalsh(cov[rows])[:, 0])
    cov[rows, 0, 0] += change
    cov[rows, 1, 1] += change
