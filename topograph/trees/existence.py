"""Is it a tree? Decided by evidence over scans: sightings, scores, and the scans that should have shown it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from topograph.geometry import Array, inverse, transform
from topograph.trees.detections import Detections
from topograph.trees.tracks import TreesConfig


def exists(
    detections: Detections, tree: NDArray[np.int64], map_T_scan: Array, places: Array, config: TreesConfig
) -> tuple[NDArray[np.bool_], Array, NDArray[np.int64], NDArray[np.int64]]:
    """Which of the trees at `places` (T, 3) exist; mean score (T,), sightings (T,) and expected sightings (T,).

    The chance of detection by range and bearing is learned from the run itself: the field of view and reach of the
    sensor need not be configured. A scan counts as expected where that chance is high and no nearer tree is in
    the way.
    """
    n = len(places)
    used = tree >= 0
    hits = np.bincount(tree[used], minlength=n)
    score = np.bincount(tree[used], detections.score[used], minlength=n) / np.maximum(hits, 1)
    seen = np.zeros((len(detections.stamps_ns), n), bool)
    seen[detections.scan[used], tree[used]] = True
    p = transform(inverse(map_T_scan)[:, None], places[None])  # (S, T, 3)
    far = np.hypot(p[..., 0], p[..., 1])
    bearing = np.arctan2(p[..., 1], p[..., 0])
    chance = _chance(far, bearing, seen, hits)
    expected = (chance > 0.35) & ~_hidden(far, bearing)
    shown = np.sum(expected, axis=0)
    found = np.sum(expected & seen, axis=0)
    # A few false detections may fall on one spot; a tree of the run's own kind is seen far more often.
    typical = float(np.median(hits[hits >= config.min_sightings])) if (hits >= config.min_sightings).any() else 0.0
    enough = hits >= max(config.min_sightings, config.min_share * typical)
    ratio = found / np.maximum(shown, 1)
    scored = bool(np.any(detections.score != 0.0))  # recorded detections may come without
    # Scores differ between sensors and orchards: what counts is also how this run's own trees score.
    usual = _usual(score[enough], hits[enough])
    ok = (
        enough
        & ((score >= min(config.min_score, config.usual_score * usual)) | (not scored))
        & ((ratio >= config.min_ratio) | (shown < 4))
    )
    return ok, score, hits, shown


def _usual(score: Array, hits: NDArray[np.int64]) -> float:
    """Median score, by sightings: false trees are many, but seldom seen."""
    if not len(score):
        return 0.0
    order = np.argsort(score)
    total = np.cumsum(hits[order])
    return float(score[order[np.searchsorted(total, 0.5 * total[-1])]])


def _chance(far: Array, bearing: Array, seen: NDArray[np.bool_], hits: NDArray[np.int64]) -> Array:
    """Share of scans that show a well-seen tree, by 5 m of range and 20° of bearing."""
    sure = hits >= max(8.0, float(np.median(hits)) if len(hits) else 0.0)
    i = np.minimum((far / 5.0).astype(int), 19)
    j = ((bearing + np.pi) / (2 * np.pi) * 18).astype(int) % 18
    cell = i * 18 + j
    total = np.bincount(cell[:, sure].ravel(), minlength=360)
    shown = np.bincount(cell[:, sure].ravel(), seen[:, sure].ravel().astype(float), minlength=360)
    return np.asarray(((shown + 0.1) / (total + 1.0))[cell])


def _hidden(far: Array, bearing: Array) -> NDArray[np.bool_]:
    """(S, T): a nearer tree stands within 0.25 m of the line of sight."""
    hidden = np.zeros(far.shape, bool)
    for s in range(len(far)):
        order = np.argsort(far[s])
        b, r = bearing[s, order], far[s, order]
        near = r < 60.0
        b, r = b[near], r[near]
        d = np.abs((b[:, None] - b[None] + np.pi) % (2 * np.pi) - np.pi)
        blocks = (r[None] < r[:, None] - 1.0) & (d * r[None] < 0.25)
        hidden[s, order[: len(b)]] = blocks.any(axis=1)
    return hidden
