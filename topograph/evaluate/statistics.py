"""Intervals: how much of a figure is chance. Runs are the units, never trees or scans, which err alike within a run."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from scipy.special import ndtri

from topograph.geometry import Array

RESAMPLES = 2000


def wilson(wrong: int, n: int, level: float = 0.95) -> tuple[float, float]:
    """Interval of a share (Wilson 1927): right also where none of few went wrong, unlike the normal approximation."""
    if n == 0:
        return 0.0, 1.0
    z = float(ndtri(0.5 + 0.5 * level))
    p = wrong / n
    middle = (p + z**2 / (2 * n)) / (1 + z**2 / n)
    half = z / (1 + z**2 / n) * float(np.sqrt(p * (1 - p) / n + z**2 / (4 * n**2)))
    low, high = max(0.0, middle - half), min(1.0, middle + half)
    return (0.0 if wrong == 0 else low), (1.0 if wrong == n else high)


def bootstrap(
    runs: Sequence[float], level: float = 0.95, of: Callable[[Array], float] = lambda v: float(np.mean(v))
) -> tuple[float, float]:
    """Percentile interval of a statistic `of` the runs (Efron 1979); NaN for fewer than two."""
    v = np.asarray(runs, float)
    v = v[np.isfinite(v)]
    if len(v) < 2:
        return float("nan"), float("nan")
    rng = np.random.default_rng(0)
    drawn = [of(v[rng.integers(0, len(v), len(v))]) for _ in range(RESAMPLES)]
    low, high = np.percentile(drawn, [50 * (1 - level), 50 * (1 + level)])
    return float(low), float(high)


def paired_ratio(ours: Sequence[float], theirs: Sequence[float], level: float = 0.95) -> tuple[float, float, float]:
    """Mean of `ours` over mean of `theirs`, and its interval, runs drawn in pairs: what one run's orchard does to both cancels."""
    a, b = np.asarray(ours, float), np.asarray(theirs, float)
    ok = np.isfinite(a) & np.isfinite(b)
    a, b = a[ok], b[ok]
    if not len(a) or b.mean() == 0:
        return float("nan"), float("nan"), float("nan")
    ratio = float(a.mean() / b.mean())
    if len(a) < 2:
        return ratio, float("nan"), float("nan")
    rng = np.random.default_rng(0)
    drawn = []
    for _ in range(RESAMPLES):
        i = rng.integers(0, len(a), len(a))
        drawn.append(a[i].mean() / max(float(b[i].mean()), 1e-12))
    low, high = np.percentile(drawn, [50 * (1 - level), 50 * (1 + level)])
    return ratio, float(low), float(high)
