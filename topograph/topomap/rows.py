"""Rows, where there are rows."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from topograph.geometry import Array


def find_rows(xy: Array, path_xy: Array) -> NDArray[np.int64]:
    """Row (T,) of each tree, counted from one side, or all -1 when the trees do not stand in rows.

    Seen along its rows an orchard is narrow bands with gaps between them. The direction with the clearest bands is
    taken; between equals (a square grid) the one that the robot mostly drove.
    """
    none = np.full(len(xy), -1, np.int64)
    if len(xy) < 8:
        return none
    step = np.diff(path_xy, axis=0)
    moved = np.linalg.norm(step, axis=1) > 1e-3
    heading = np.arctan2(step[moved, 1], step[moved, 0])
    best, found = 0.0, none
    for angle in np.radians(np.arange(0.0, 180.0, 1.0)):
        across = xy @ np.array([-np.sin(angle), np.cos(angle)])
        row, clarity = _bands(across)
        if row is None:
            continue
        driven = float(np.mean(np.abs(np.cos(heading - angle)))) if len(heading) else 0.5
        value = clarity * (0.5 + driven)
        if value > best:
            best, found = value, row
    return found


def _bands(across: Array) -> tuple[NDArray[np.int64] | None, float]:
    """Bands of projected positions (T,), and how clear they are: gap between bands over spread within; None: no bands."""
    order = np.argsort(across)
    sorted_ = across[order]
    gaps = np.diff(sorted_)
    span = sorted_[-1] - sorted_[0]
    if span < 3.0:
        return None, 0.0
    best: tuple[NDArray[np.int64] | None, float] = (None, 0.0)
    for bound in np.unique(np.sort(gaps)[-min(len(gaps), 60) :]):
        if bound < 0.8:
            continue
        band = np.concatenate([[0], np.cumsum(gaps >= bound)])
        count = np.bincount(band)
        if len(count) < 2 or np.mean(count >= 3) < 0.7 or np.median(count) < 3:
            continue
        mean = np.bincount(band, sorted_) / count
        spread = np.sqrt(np.mean((sorted_ - mean[band]) ** 2))
        spacing = float(np.median(np.diff(mean)))
        clarity = spacing / max(float(spread), 0.05)
        if clarity > 6.0 and clarity > best[1]:
            row = np.empty(len(across), np.int64)
            row[order] = band
            best = (row, float(clarity))
    return best
