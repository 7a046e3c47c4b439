"""Does it stand there, and what is it? Decided by evidence over scans: sightings, beams that went through, kinds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from topograph.geometry import Array, inverse, transform, wrap
from topograph.session import SECTORS
from topograph.trees.detections import Detections
from topograph.trees.robust import weighted_median
from topograph.trees.screen import parts_apart
from topograph.trees.tracks import TreesConfig
from topograph.trunks.score import KIND_PRIOR, KINDS, OTHER, TREE, column_odds

FRESH = 0.05
"""Share of what a further sighting of the same tree says that the ones before have not said."""
MOST = 1.5
"""Sightings that count at most: looks from all sides still share the tree. (Log-likelihood of the kinds of 1,200 landmarks in 33 simulated runs, seeds 401-403,
and a street: -502 with 0.25 and 6, -344 with 0.1 and 2, -317 so; the kinds chosen are the same but for one tree in 1,100.)"""
SLIPS = 2.0
"""Scans that may have seen through a tree by mistake: a mixed pixel, a pose that is off for a moment."""
STILL = 0.6
"""Parts of a landmark's sightings lie no further apart in the solved map, m: half of a thick trunk."""
NEAR = 5.0
"""Range at which a sighting tells half as much of what a thing is as one at arm's length, m."""
DOUBTFUL = 0.7
"""Log-odds by which a tree may fall short of its share of the run's usual score, see `TreesConfig.usual_score`."""
RARE = 2.5
"""Log-odds that a tree seen once would need beyond that; the demand falls with the root of the sightings."""
COLUMN = 7.0
"""Mean log-odds of tree or post against anything else beyond which a thing stands there: what is left to ask is which of the two. (Simulated designs, seeds
401-403: bare trunks that were left out had 10 to 12, what is neither tree nor post at most 5.7.)"""
BLOCK = 100_000
"""Pairs of scans and trees that are looked at together."""
BESIDE, HARDLY = 1.2, 0.12
"""m, and share of the neighbour's sightings (real neighbours in trellises and hedgerows at 1.0 to 1.8 m: 0.39 and more)."""
REACH = 31.0
"""Beyond this no scan records what it saw through, m."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Existence:
    """Of T trees.

    Attributes:
        ok: (T,) it exists as a landmark; `kind` (T,) TREE, POST or OTHER; `probability` (T,) of that kind, NaN unknown.
        score: (T,) mean log-odds of tree, of near sightings above all; `hits` (T,) sightings; `passed` (T,) scans that saw through its place.
    """

    ok: NDArray[np.bool_]
    kind: NDArray[np.int64]
    probability: Array
    score: Array
    hits: NDArray[np.int64]
    passed: NDArray[np.int64]

    def select(self, rows: NDArray[np.int64]) -> Existence:
        """The given rows."""
        return Existence(
            **{k: getattr(self, k)[rows] for k in ("ok", "kind", "probability", "score", "hits", "passed")}
        )


def exists(
    detections: Detections, tree: NDArray[np.int64], map_T_scan: Array, places: Array, config: TreesConfig
) -> Existence:
    """Which of the trees at `places` (T, 3) exist, and what they are.

    A scan that saw a trunk speaks for it, a scan whose beams went on through its place at trunk height against it;
    a scan whose view was blocked says nothing. Without a record of passage (recorded detections) the scans that should
    have shown a tree and did not take that part; the chance of detection by range and bearing is learned from the run.
    """
    d, n = detections, len(places)
    used = tree >= 0
    hits = np.bincount(tree[used], minlength=n)
    weight = _weight(d, used)
    score = np.bincount(tree[used], weight * d.score[used], n) / np.maximum(np.bincount(tree[used], weight, n), 1e-9)
    passed = np.zeros(n, np.int64)
    # A few false detections may fall on one spot; a tree of the run's own kind is seen far more often.
    typical = float(np.median(hits[hits >= config.min_sightings])) if (hits >= config.min_sightings).any() else 0.0
    ok = hits >= max(config.min_sightings, config.min_share * typical)
    # What was seen too seldom does not exist whatever scans say of its place: clutter is many times the trees, and grows with the run.
    scan, which = _pairs(d, map_T_scan, places, ok)
    seen = np.isin(scan * n + which, d.scan[used] * n + tree[used])
    p = _seen_from(map_T_scan, scan, places, which)
    if len(d.free):
        through = _through(d, scan, p) & ~seen
        passed = np.bincount(which[through], minlength=n)
        ok &= passed <= config.passed * hits + SLIPS
        in_map = transform(map_T_scan[d.scan], d.p)[:, :2]
        ok &= ~parts_apart(in_map, d, tree, n, np.zeros(len(d)), STILL)
    else:
        anew = _looks(map_T_scan)[scan]
        ok &= _shown_often(scan[anew], which[anew], p[anew], seen[anew], hits, n, config)
    kind, probability = _kinds(d, tree, n)
    if (d.score[used] != 0.0).any():  # recorded detections may come without
        # Scores differ between sensors and orchards: what counts is also how this run's own trees score.
        surely = ok & (kind == TREE)
        demand = np.full(n, config.usual_score * _usual(score[surely], hits[surely]))
        if np.isfinite(d.kinds).any():  # ours are log-odds; of what other sources call a score nobody knows the scale
            demand += RARE / np.sqrt(np.maximum(hits, 1)) - DOUBTFUL
        ok &= (kind != TREE) | (score >= demand) | (_column(d, tree, n) >= COLUMN)
        ok &= ~_hangers_on(places, hits, ok & (kind == TREE))
    return Existence(ok=ok & (kind != OTHER), kind=kind, probability=probability, score=score, hits=hits, passed=passed)


def _hangers_on(places: Array, hits: NDArray[np.int64], trees: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(T,) of those that pass for trees, what is seen hardly ever close beside a tree that always is: a sucker, a low branch. Of two trees that
    stand so close neither hides the other for nearly all of a run."""
    rows = np.flatnonzero(trees)
    out = np.zeros(len(places), bool)
    if len(rows) < 2:
        return out
    pairs = cKDTree(places[rows, :2]).query_pairs(BESIDE, output_type="ndarray").reshape(-1, 2)
    a, b = rows[pairs[:, 0]], rows[pairs[:, 1]]
    out[a[hits[a] < HARDLY * hits[b]]] = True
    out[b[hits[b] < HARDLY * hits[a]]] = True
    return out


def seen_through(detections: Detections, map_T_scan: Array, places: Array) -> NDArray[np.int64]:
    """Scans (T,) that saw through each of `places` (T, 3) at trunk height; zeros where scans do not tell what they passed."""
    if not len(detections.free):
        return np.zeros(len(places), np.int64)
    scan, which = _pairs(detections, map_T_scan, places, np.ones(len(places), bool))
    through = _through(detections, scan, _seen_from(map_T_scan, scan, places, which))
    return np.bincount(which[through], minlength=len(places))


def _weight(d: Detections, rows: NDArray[np.bool_]) -> Array:
    """How much of what a thing is each sighting tells, at `rows` (N,)."""
    return np.asarray(1.0 / (1.0 + np.sum(d.p[rows, :2] ** 2, axis=1) / NEAR**2))


def _usual(score: Array, hits: NDArray[np.int64]) -> float:
    """Median score, by sightings: false trees are many, but seldom seen."""
    return weighted_median(score, hits) if len(score) else 0.0


def _pairs(
    d: Detections, map_T_scan: Array, places: Array, asked: NDArray[np.bool_]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Scans and trees `asked` (T,) for that are near each other, (P,) each: memory grows with the recording, not with the map."""
    rows = np.flatnonzero(asked)
    if not len(rows) or not len(d.stamps_ns):
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    reach = REACH if len(d.free) else max(float(np.max(np.linalg.norm(d.p[:, :2], axis=1), initial=0.0)), 1.0)
    found = cKDTree(places[rows, :2]).query_ball_point(map_T_scan[:, :2, 3], reach)
    near = [np.asarray(k, np.int64) for k in found]
    return np.repeat(np.arange(len(near)), [len(k) for k in near]), rows[np.concatenate(near)]


def _seen_from(map_T_scan: Array, scan: NDArray[np.int64], places: Array, which: NDArray[np.int64]) -> Array:
    """(P, 3) places in the base frames of scans, pair by pair; in blocks, since pairs are many."""
    scan_T_map = inverse(map_T_scan)
    out = np.empty((len(scan), 3))
    for at in range(0, len(scan), BLOCK):
        part = slice(at, at + BLOCK)
        out[part] = transform(scan_T_map[scan[part]], places[which[part]])
    return out


def _through(d: Detections, scan: NDArray[np.int64], p: Array) -> NDArray[np.bool_]:
    """Pairs (P,) whose tree at `p` (P, 3) in the scan's base frame was seen through, on both sides of its middle."""
    away = p - d.eye[scan]
    far = np.hypot(away[:, 0], away[:, 1])
    cell = np.minimum(far.astype(np.int64), 31).astype(np.uint32)
    bearing = (np.arctan2(away[:, 1], away[:, 0]) + np.pi) * (SECTORS / (2 * np.pi))
    out = far < REACH
    for shift in (-0.5, 0.0, 0.5):
        word = d.free[scan, np.floor(bearing + shift).astype(np.int64) % SECTORS]
        out &= ((word >> cell) & 1).astype(bool)
    return np.asarray(out)


def _column(d: Detections, tree: NDArray[np.int64], n: int) -> Array:
    """Mean log-odds (n,) of tree or post against something else, of near sightings above all; -inf where the source tells no kinds."""
    told = (tree >= 0) & np.isfinite(d.kinds).all(axis=1)
    weight = _weight(d, told)
    total = np.bincount(tree[told], weight, n)
    mean = np.bincount(tree[told], weight * column_odds(d.kinds[told]), n) / np.maximum(total, 1e-9)
    return np.asarray(np.where(total > 0, mean, -np.inf))


def _kinds(d: Detections, tree: NDArray[np.int64], n: int) -> tuple[NDArray[np.int64], Array]:
    """Most likely kind (n,) and its probability (n,); trees where the source tells no kinds.

    Sightings of one thing are alike; a further one tells only so much more. What was seen from near weighs more.
    """
    told = (tree >= 0) & np.isfinite(d.kinds).all(axis=1)
    if not told.any():
        return np.full(n, TREE), np.full(n, np.nan)
    t = tree[told]
    weight = _weight(d, told)
    total = np.bincount(t, weight, n)
    ratio = d.kinds[told] - KIND_PRIOR
    mean = (
        np.stack([np.bincount(t, weight * ratio[:, k], n) for k in range(3)], axis=1) / np.maximum(total, 1e-9)[:, None]
    )
    effective = np.minimum(1.0 + FRESH * (np.bincount(t, minlength=n) - 1.0), MOST)
    z = KIND_PRIOR + effective[:, None] * mean
    z -= z.max(axis=1, keepdims=True)
    chance = np.exp(z) / np.exp(z).sum(axis=1, keepdims=True)
    kind = chance.argmax(axis=1)
    kind[total == 0] = TREE
    probability = (1.0 - DECEIVED) * chance[np.arange(n), kind] + DECEIVED / len(KINDS)
    probability[total == 0] = np.nan
    return kind, probability


DECEIVED = 0.03
"""Chance that looks tell nothing of a kind, from whatever side and however often: no kind is surer than 0.98. Of simulated nodes that are
called trees one in a hundred is none; of those in a recorded street (masts, pillars) six in ten.
"""
LOOK = 0.2
"""Between two looks at the same place, m: what rides along stands still beside a robot that stands, however long it does."""


def _looks(map_T_scan: Array) -> NDArray[np.bool_]:
    """Scans (S,) that were taken from another place than the look before."""
    way = np.linalg.norm(np.diff(map_T_scan[:, :2, 3], axis=0), axis=1)
    at = np.floor(np.concatenate([[0.0], np.cumsum(way)]) / LOOK)
    return np.concatenate([[True], np.diff(at) > 0])


LEAST_DUE = 12.0
"""Sightings that the run's other trees would have had from where a place was looked at, before their lack says anything."""


def _shown_often(
    scan: NDArray[np.int64], which: NDArray[np.int64], p: Array, seen: NDArray[np.bool_], hits: NDArray[np.int64],
    n: int, config: TreesConfig,
) -> NDArray[np.bool_]:  # fmt: skip
    """Trees (n,) that enough of the scans showed that should have: where the chance is high and nothing stands before."""
    chance, open_to = _chance(scan, which, p, seen, hits)
    expected = (chance > 0.35) & open_to
    asked = np.bincount(which[expected], minlength=n)
    found = np.bincount(which[expected & seen], minlength=n)
    ok = (found / np.maximum(asked, 1) >= config.min_ratio) | (asked < 4)
    # From places where trees are rarely seen, a run of many laps should have seen one now and then.
    due, came = _due(which, chance, open_to, seen, n)
    return np.asarray(ok & ((came >= config.min_ratio * due) | (due < LEAST_DUE)))


def _chance(
    scan: NDArray[np.int64], which: NDArray[np.int64], p: Array, seen: NDArray[np.bool_], hits: NDArray[np.int64]
) -> tuple[Array, NDArray[np.bool_]]:
    """Chance (P,) that a scan shows a tree, by range and bearing as the run's own trees have it, and whether nothing stands before it."""
    far, bearing = np.hypot(p[:, 0], p[:, 1]), np.arctan2(p[:, 1], p[:, 0])
    sure = (hits >= max(8.0, float(np.median(hits)) if len(hits) else 0.0))[which]
    cell = np.minimum((far / 5.0).astype(int), 19) * 18 + ((bearing + np.pi) / (2 * np.pi) * 18).astype(int) % 18
    total = np.bincount(cell[sure], minlength=360)
    shown = np.bincount(cell[sure], seen[sure].astype(float), minlength=360)
    return ((shown + 0.1) / (total + 1.0))[cell], ~_hidden(scan, far, bearing)


def _due(
    which: NDArray[np.int64], chance: Array, open_to: NDArray[np.bool_], seen: NDArray[np.bool_], n: int
) -> tuple[Array, NDArray[np.int64]]:
    """Sightings (n,) that each tree would have had by `_chance`, and those that it had."""
    due = np.asarray(np.bincount(which[open_to], chance[open_to], n), float)
    return due, np.asarray(np.bincount(which[open_to & seen], minlength=n), np.int64)


def overdue(detections: Detections, tree: NDArray[np.int64], map_T_scan: Array, places: Array) -> NDArray[np.int64]:
    """Sightings (T,) that are lacking of trees at `places` (T, 3), were they as the others of the run; 0 where they came now and then, and where
    the run hardly looked. `tree` (N,) is that of each detection, -1 none. In high grass no beam passes where a felled tree stood; that it
    never came tells as well.
    """
    d, n = detections, len(places)
    used = tree >= 0
    hits = np.bincount(tree[used], minlength=n)
    scan, which = _pairs(d, map_T_scan, places, np.ones(n, bool))
    anew = _looks(map_T_scan)[scan]
    scan, which = scan[anew], which[anew]
    seen = np.isin(scan * n + which, d.scan[used] * n + tree[used])
    chance, open_to = _chance(scan, which, _seen_from(map_T_scan, scan, places, which), seen, hits)
    due, came = _due(which, chance, open_to, seen, n)
    return np.asarray(np.where((due >= OVERDUE) & (came <= STRAY * due), due - came, 0.0).astype(np.int64))


OVERDUE, STRAY = 2.0 * LEAST_DUE, 0.1
"""Sightings that must be due before their lack tells that a tree of an earlier map is gone, and the share of them that came all the same: a leaf, a twig."""


def _hidden(scan: NDArray[np.int64], far: Array, bearing: Array) -> NDArray[np.bool_]:
    """Pairs (P,): a nearer tree stands within 0.25 m of the line of sight."""
    hidden = np.zeros(len(far), bool)
    ends = np.flatnonzero(np.diff(scan)) + 1
    for rows in np.split(np.arange(len(scan)), ends):
        rows = rows[far[rows] < 60.0]
        b, r = bearing[rows], far[rows]
        d = np.abs(wrap(b[:, None] - b[None]))
        hidden[rows] = ((r[None] < r[:, None] - 1.0) & (d * r[None] < 0.25)).any(axis=1)
    return hidden
