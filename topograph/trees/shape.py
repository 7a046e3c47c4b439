"""The shape of each tree from all its sightings: what was measured is added up, the prior applied once."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.special import betainc, betaln, expit, logit

from topograph.geometry import Array, inverse, transform
from topograph.trees.detections import Detections
from topograph.trees.robust import weighted_median

LEAN_PRIOR = 0.12
"""Sigma of a trunk's lean from the vertical, rad (per axis)."""
DIAMETER_PRIOR = (0.22, 0.25)
"""Mean and sigma of diameters, m: wide, since orchards differ more than trees of one."""
ALIKE = 0.3
"""Share of a sighting's information that is its own: the next scan sees the same bark from nearly the same side."""
VIEWS = 8
"""Sectors of the compass a tree is seen from: what is wrong with a view is wrong with all sightings of it."""
USUAL_VIEWS = 4.0
"""Views' worth of the run's other trees in what a tree's own views say of how far they disagree."""
VIEW_SIGMA, VIEW_LEAN = 0.006, 0.015
"""Disagreement of views that is there before any was seen: of places, m, and of slopes, rad."""
BEND = 0.008
"""A trunk's axis below what was seen is not the axis seen, rad."""
CHI2_MEDIAN = 1.386
"""Median of a squared distance in a plane, per variance of an axis."""
SCATTER = 3.0
"""Times the stated variance, that of a trunk's sightings may be: it is 0.2 to 0.6 of it for trunks that stand by themselves, up to 3 for
lobed ones and in thickets (both simulated and recorded), 4 to 12 for those that something leans on (recorded)."""
FORK = 0.4
"""Height above ground at which the stems of one tree are taken to part, m."""
APART = 0.2
"""Share of sightings that must see three stems, or four."""
SHOWN_SINGLE, SHOWN_FORKED = (0.6, 25.0), (1.0, 1.8)
"""Beta distributions of the share of a tree's nearer sightings that tell two stems apart: of single trunks hardly one in forty, by a
branch; of forked ones any share, since one stem hides the other from some sides. Simulated olives, seeds below 1000."""
SURELY = 0.3
"""Share beyond which a tree forks whatever the others do: posts and wires of a trellis come up to it."""
LEAST_TOLD = 5.0
"""Independent sightings of a tree before it counts in the run's share of forked ones."""
USUAL_FORKS = (1.0, 9.0)
"""Trees' worth of forked and of single ones that a run's share of forked ones is drawn towards."""
FORKED_LEAN = 0.13
"""Sigma of the lean below the fork about the mean of the stems, rad."""
MOST_STEMS = 3
"""That can be told apart by their places."""
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
        stems: (T,) as counted; `forked` (T,) where the sightings state the fork.
        place_var: (T,) of the axis at that height, from how far views from different sides disagree, and sightings scatter, m².
        own_slope: (N, 2) slope of the stem that each of the N sightings saw, where its tree has several; else NaN.
    """

    slope: Array
    slope_var: Array
    diameter: Array
    diameter_sigma: Array
    height: Array
    stems: NDArray[np.int64]
    forked: NDArray[np.bool_]
    place_var: Array
    own_slope: Array

    @property
    def axis(self) -> Array:
        """(T, 3) unit vectors, up."""
        a = np.concatenate([self.slope, np.ones((len(self.slope), 1))], axis=1)
        return np.asarray(a / np.linalg.norm(a, axis=1, keepdims=True))


def shapes(
    detections: Detections, tree: NDArray[np.int64], map_T_scan: Array, n: int, whole: NDArray[np.int64] | None = None
) -> Shapes:
    """Shapes of `n` trees; `tree` (N,) of each detection or -1. Trees `whole` are stated as of one stem, whatever was seen."""
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
        forked=np.zeros(n, bool),
        place_var=np.zeros(n),
        own_slope=np.full((len(d), 2), np.nan),
    )
    at_height, middle, lever = _places(d, map_T_scan)
    away = _directions(d, map_T_scan, middle)
    views = np.minimum(((np.arctan2(away[:, 1], away[:, 0]) + np.pi) / (2 * np.pi) * VIEWS).astype(np.int64), VIEWS - 1)
    slope = slope - _seen_lean(slope, weight, away, order, ends) * away
    sigma = d.sigma
    trust = d.believed / np.maximum(sigma**2, 1e-6)
    places, slopes = _Views(n, VIEW_SIGMA), _Views(n, VIEW_LEAN)
    forked = _forked_probability(_told(d, order, ends))
    blurred = np.zeros(n)
    for j in range(n):
        mine = order[ends[j] : ends[j + 1]]
        if not len(mine):
            continue
        out.diameter[j], out.diameter_sigma[j] = _thickness(d, mine)
        above = d.height[mine][np.isfinite(d.height[mine])]
        out.height[j] = np.median(above) if len(above) and measured else common
        out.stems[j] = _stems(d, mine) if forked[j] > 0.5 else 1
        out.forked[j] = out.stems[j] > 1 and (whole is None or j not in whole)
        if out.forked[j]:
            out.slope[j], own = _forked(
                at_height[mine], slope[mine], weight[mine], d.stems[mine] > 1, int(out.stems[j])
            )
            out.slope_var[j], out.own_slope[mine], out.height[j] = FORKED_LEAN**2, own, FORK
            above = np.where(np.isfinite(d.height[mine]), d.height[mine] - lever[mine] - FORK, 0.0)
            place = middle[mine] - above[:, None] * own
        else:
            out.slope[j], v = _together(slope[mine], weight[mine])
            out.slope_var[j] = 1.0 / (v.sum() + 1.0 / LEAN_PRIOR**2)
            slopes.add(j, slope[mine] - out.slope[j], v, views[mine])
            place = middle[mine] + lever[mine, None] * out.slope[j]
        place = place - np.median(place, axis=0)
        places.add(j, place, trust[mine], views[mine])
        blurred[j] = _blurred(place, sigma[mine])
    single = ~out.forked
    out.slope_var[single] = np.minimum(out.slope_var + BEND**2 + slopes.variance(), LEAN_PRIOR**2)[single]
    if measured:  # recorded detections are all spread that way, and the graph learns how far
        out.place_var[:] = places.variance() + blurred + np.where(single, forked, 0.0) * (FORK * FORKED_LEAN) ** 2
    return out


def _blurred(place: Array, sigma: Array) -> float:
    """Variance, m² an axis, of a tree whose sightings, `place` (M, 2) about their median, scatter further than `sigma` (M,) has them: a log
    or a bush beside the trunk is taken for it from some sides, and which of them is the tree no average tells.
    """
    away = np.sum(place**2, axis=1)
    return max(float(np.median(away) - SCATTER * np.median(sigma**2) * CHI2_MEDIAN), 0.0) / CHI2_MEDIAN


def _places(d: Detections, map_T_scan: Array) -> tuple[Array, Array, Array]:
    """Where each sighting states its trunk, (N, 2) in the map, where it measured it, (N, 2), and how far below that is, (N,) m."""
    lever = d.measured[:, LEVER]
    if not len(d):
        return np.zeros((0, 2)), np.zeros((0, 2)), lever
    T = map_T_scan[d.scan]
    below = d.p - (lever / np.maximum(d.axis[:, 2], 0.3))[:, None] * d.axis
    return transform(T, d.p)[:, :2], transform(T, below)[:, :2], lever


def _directions(d: Detections, map_T_scan: Array, place: Array) -> Array:
    """Unit vectors (N, 2) in the map from what was sighted at `place` (N, 2) towards the sensor's robot."""
    if not len(d):
        return np.zeros((0, 2))
    away = map_T_scan[d.scan, :2, 3] - place
    return np.asarray(away / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-9))


def _seen_lean(slope: Array, weight: Array, away: Array, order: NDArray[np.int64], ends: NDArray[np.int64]) -> float:
    """How much all trunks of a run seem to lean towards whoever looks at them: they taper more or less than was thought.

    It shows in trees that are seen from several sides; those that are seen from one need it.
    """
    seen, total = 0.0, 0.0
    for a, b in pairwise(ends.tolist()):
        mine = order[a:b]
        w = weight[mine]
        if w.sum() <= 0:
            continue
        mean, side = w @ slope[mine] / w.sum(), w @ away[mine] / w.sum()
        apart = away[mine] - side
        seen += float(w @ np.sum((slope[mine] - mean) * apart, axis=1))
        total += float(w @ np.sum(apart * apart, axis=1))
    return float(np.clip(seen / (total + 1e3), -0.1, 0.1))


class _Views:
    """How far the means of views disagree, tree by tree, drawn towards the run's other trees where a tree shows few sides:
    a cluster-robust variance (Liang & Zeger 1986) with a prior.
    """

    def __init__(self, n: int, least: float) -> None:
        self.least = least
        self.square, self.count, self.share = np.zeros(n), np.zeros(n), np.ones(n)

    def add(self, tree: int, residual: Array, weight: Array, view: NDArray[np.int64]) -> None:
        """Residuals (M, 2) of a tree's sightings about its mean, their weights and views (M,)."""
        total = np.bincount(view, weight, VIEWS)
        if total.sum() <= 0:
            return
        centre = weight @ residual / total.sum()
        seen = np.flatnonzero(total > 0)
        share = total[seen] / total.sum()
        apart = [np.bincount(view, weight * (residual[:, k] - centre[k]), VIEWS)[seen] / total[seen] for k in (0, 1)]
        # A view's mean is nearer to the tree's the more it has made it.
        free = np.maximum(1.0 - share, 0.0)
        self.square[tree] = 0.5 * float((share * len(share)) @ (apart[0] ** 2 + apart[1] ** 2))
        self.count[tree] = float((share * len(share)) @ free)
        self.share[tree] = float(np.sum(share**2))

    def variance(self) -> Array:
        """(T,) of the trees' means."""
        usual = (self.square.sum() + USUAL_VIEWS * self.least**2) / (self.count.sum() + USUAL_VIEWS)
        own = (self.square + USUAL_VIEWS * usual) / (self.count + USUAL_VIEWS)
        return np.asarray(own * self.share)


def _forked(place: Array, slope: Array, weight: Array, several: NDArray[np.bool_], stems: int) -> tuple[Array, Array]:
    """Slope (2,) of a tree of several stems, the mean of theirs, and the slope (M, 2) of what each sighting saw: of one stem, or
    of their middle where it saw `several` (M,).

    Stems lean away from each other about the axis below them; one that is seen more often must not pull it to its side.
    """
    own = np.zeros((len(place), 2))
    one = np.flatnonzero(~several)
    found = []
    if len(one) >= stems:
        group = _groups(place[one], min(stems, MOST_STEMS))
        for g in np.unique(group):
            rows = one[group == g]
            own[rows] = _together(slope[rows], weight[rows])[0]
            if len(rows) > 0.1 * len(one):
                found.append(own[rows[0]])
    middle = np.mean(found, axis=0) if found else np.zeros(2)
    own[several] = middle
    return np.asarray(middle), own


def _groups(place: Array, k: int) -> NDArray[np.int64]:
    """Group (M,) of places (M, 2) by Lloyd's algorithm, started from the points that lie furthest apart."""
    centres = [place[np.argmax(np.linalg.norm(place - np.median(place, axis=0), axis=1))]]
    while len(centres) < k:
        near = np.min([np.linalg.norm(place - c, axis=1) for c in centres], axis=0)
        centres.append(place[np.argmax(near)])
    middle = np.array(centres)
    group = np.zeros(len(place), np.int64)
    for _ in range(10):
        group = np.linalg.norm(place[:, None] - middle[None], axis=2).argmin(axis=1)
        middle = np.array([np.median(place[group == g], axis=0) if (group == g).any() else middle[g] for g in range(k)])
    return np.asarray(group)


def _slopes(d: Detections, map_T_scan: Array) -> tuple[Array, Array]:
    """Slope (N, 2) of each sighting's axis in the map frame as measured, and its information (N,).

    A source that measures no slope but states an axis (recorded detections) is taken at its word, at 3°.
    """
    if not len(d):
        return np.zeros((0, 2)), np.zeros(0)
    weight = d.measured[:, SLOPE_WEIGHT] * d.believed
    axis = np.concatenate([d.measured[:, [SLOPE_X, SLOPE_Y]], np.ones((len(d), 1))], axis=1)
    stated = ~np.isfinite(d.kinds).all(axis=1) & (np.abs(d.axis[:, 2]) < 1.0 - 1e-9)
    axis[stated], weight[stated] = d.axis[stated], 1.0 / 0.05**2
    turned = (map_T_scan[d.scan, :3, :3] @ axis[:, :, None])[..., 0]
    flat = np.maximum(turned[:, 2], 0.2)
    return turned[:, :2] / flat[:, None], np.where(np.abs(turned[:, :2]).max(axis=1) < flat, weight, 0.0)


def feet(detections: Detections, track: NDArray[np.int64], map_T_scan: Array) -> Array:
    """Where each sighting (N, 2) has the foot of its column in the map, along the axis that all of its `track` (N,) measured: one scan's
    axis is mostly what it took for granted, and stems that part from one foot would seem to stand apart.
    """
    d, n = detections, int(track.max(initial=-1)) + 1
    slope, weight = _slopes(d, map_T_scan)
    weight = _counted(weight)
    total = np.bincount(track, weight, n) + 1.0 / LEAN_PRIOR**2
    lean = np.stack([np.bincount(track, weight * slope[:, k], n) / total for k in range(2)], axis=1)
    _, middle, lever = _places(d, map_T_scan)
    above = np.where(np.isfinite(d.height), d.height - lever, 0.0)
    return np.asarray(middle - above[:, None] * lean[track])


def _counted(weight: Array) -> Array:
    """What slopes of information `weight` (N,) count for beside others of the same column: none is better than 0.03, and they err alike."""
    return ALIKE * np.minimum(weight, 1.0 / 0.03**2)


def _together(slope: Array, weight: Array) -> tuple[Array, Array]:
    """Mean slope (2,) with the prior, robust to sightings of something else, and the weight (M,) that each was given."""
    prior = 1.0 / LEAN_PRIOR**2
    if weight.sum() <= 0:
        return np.zeros(2), np.zeros(len(weight))
    w = _counted(weight)
    mean = np.asarray(w @ slope / w.sum())
    for _ in range(4):
        e2 = np.sum((slope - mean) ** 2, axis=1)
        v = w / (1.0 + e2 / (1.0 / np.maximum(weight, 1e-9) + 0.06**2))
        mean = np.asarray(v @ slope / v.sum())
    return np.asarray(mean * v.sum() / (v.sum() + prior)), v


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
    middle = weighted_median(x, w)
    var = float(np.median(sigma[near])) ** 2 / (1.0 + ALIKE * (len(x) - 1)) + 0.015**2
    mean, prior = DIAMETER_PRIOR[0], DIAMETER_PRIOR[1] ** 2
    gain = prior / (prior + var)
    return max(mean + gain * (middle - mean), 0.02), float(np.sqrt(gain * var))


def _nearer(d: Detections, mine: NDArray[np.int64]) -> NDArray[np.int64]:
    """Stems that the nearer half of the sightings told apart."""
    far = np.linalg.norm(d.p[mine, :2], axis=1)
    return np.asarray(d.stems[mine[far <= np.median(far)]])


def _told(d: Detections, order: NDArray[np.int64], ends: NDArray[np.int64]) -> Array:
    """(T, 2) of each tree's nearer sightings, how many told two stems apart and how many there were, as independent ones."""
    out = np.zeros((len(ends) - 1, 2))
    for j, (a, b) in enumerate(pairwise(ends.tolist())):
        if b > a:
            near = _nearer(d, order[a:b])
            out[j] = np.sum(near > 1), len(near)
    return ALIKE * out


def _forked_probability(told: Array) -> Array:
    """Probability (T,) that a tree forks, from how many of its sightings say so (T, 2), and how many trees of the run surely do: the share
    that do is beta distributed, among single trunks and among forked ones.

    What looks like a branch in an orchard of single trunks is a stem among trees that mostly have two.
    """
    k, n = told.T
    (a, b), (c, e) = SHOWN_FORKED, SHOWN_SINGLE
    log_odds = betaln(k + a, n - k + b) - betaln(a, b) - betaln(k + c, n - k + e) + betaln(c, e)
    known = n >= LEAST_TOLD
    surely = np.sum(k[known] > SURELY * n[known]) / (1.0 - betainc(*SHOWN_FORKED, SURELY))
    rate = min((USUAL_FORKS[0] + surely) / (sum(USUAL_FORKS) + known.sum()), 0.95)
    return np.asarray(np.where(n > 0, expit(log_odds + logit(rate)), 0.0))


def _stems(d: Detections, mine: NDArray[np.int64]) -> int:
    """Stems of a tree that forks: as many as enough of the nearer sightings tell apart, one mostly hides another."""
    near = _nearer(d, mine)
    return int(max((k for k in range(3, 5) if np.mean(near >= k) >= APART), default=2))


def relevelled(detections: Detections, tree: NDArray[np.int64], map_T_scan: Array, s: Shapes) -> Detections:
    """The detections with their points moved along their tree's axis, in place of along one scan's guess of it.

    A point was measured at the mean height of its returns; where it is stated above or below, it owes its place to the
    lean. With the tree's own lean the covariance loses what the guess had added. Of a tree of several stems each scan
    saw one or another: their points are stated where stems part, down along the stem that the scan saw.
    """
    d = detections
    own = np.flatnonzero(tree >= 0)
    several = s.forked[tree[own]]
    return _at_the_fork(_along(d, tree, own[~several], map_T_scan, s), own[several], map_T_scan, s)


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


def _at_the_fork(d: Detections, rows: NDArray[np.int64], map_T_scan: Array, s: Shapes) -> Detections:
    """Rows of `d` stated where the stems of a tree part, each along the stem that it saw."""
    rows = rows[np.isfinite(d.height[rows])]
    if not len(rows):
        return d
    p, cov, height = d.p.copy(), d.cov.copy(), d.height.copy()
    down = d.height[rows] - FORK
    lever = d.measured[rows, LEVER]
    # What was measured lies `lever` below what is stated, along one scan's guess of the axis.
    p[rows] -= lever[:, None] * d.axis[rows] / np.maximum(d.axis[rows, 2:], 0.3)
    along = np.concatenate([s.own_slope[rows], np.ones((len(rows), 1))], axis=1)
    T = map_T_scan[d.scan[rows]]
    p[rows] = transform(inverse(T), transform(T, p[rows]) - (down - lever)[:, None] * along)
    height[rows] = FORK
    _widen(cov, rows, ((lever - down) ** 2 - lever**2) * _stated_lean_var(d, rows))
    return replace(d, p=p, cov=cov, height=height)


def _stated_lean_var(d: Detections, rows: NDArray[np.int64]) -> Array:
    return np.asarray(1.0 / (d.measured[rows, SLOPE_WEIGHT] + 1.0 / STATED_PRIOR**2))


def _widen(cov: NDArray[np.float32], rows: NDArray[np.int64], change: Array) -> None:
    """Add `change` (K,) to the horizontal variances of rows of `cov`; a quarter of the least variance stays."""
    C, change = cov[rows].astype(float), np.array(change)
    # The least variance is no less than four determinants over the square of the trace; only where that does not settle it, it is needed.
    near = np.flatnonzero(change * np.trace(C, axis1=1, axis2=2) ** 2 < -3.0 * np.linalg.det(C))
    change[near] = np.maximum(change[near], -0.75 * np.linalg.eigvalsh(C[near])[:, 0])
    cov[rows, 0, 0] += change
    cov[rows, 1, 1] += change
