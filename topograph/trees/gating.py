"""The loop over trunks and tracks near each other: which of them may be one."""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, error_model="numpy")
def gated(p, cov, place, spread, since, floor, drift, gate):
    """Pairs (K, 2) of trunks at `p` (N, 2) and tracks at `place` (M, 2) within the gate, and what each costs (K,): the squared
    Mahalanobis distance and the log-determinant. `cov` (N, 2, 2), `spread` (M, 2, 2), `since` (M,) m driven.
    """
    n, m = p.shape[0], place.shape[0]
    pairs, cost = np.empty((n * m, 2), np.int64), np.empty(n * m)
    k = 0
    for i in range(n):
        for j in range(m):
            dx, dy = p[i, 0] - place[j, 0], p[i, 1] - place[j, 1]
            slack = floor**2 + (drift * since[j]) ** 2
            a = cov[i, 0, 0] + spread[j, 0, 0] + slack
            c = cov[i, 1, 1] + spread[j, 1, 1] + slack
            if dx * dx + dy * dy > gate * (a + c):  # no axis of the ellipse is longer than both of its sides together
                continue
            b = cov[i, 0, 1] + spread[j, 0, 1]
            det = max(a * c - b * b, 1e-12)
            m2 = (dx * dx * c - 2 * dx * dy * b + dy * dy * a) / det
            if m2 <= gate:
                pairs[k, 0], pairs[k, 1] = i, j
                cost[k] = min(m2 + np.log(det), 1e3)
                k += 1
    return pairs[:k], cost[:k]


@njit(cache=True, error_model="numpy")
def seen_again(p, cov, match, place, spread, hits):
    """Moves the tracks that trunks were matched to, `match` (N,) or -1, towards them, in place."""
    for i in range(match.shape[0]):
        j = match[i]
        if j < 0:
            continue
        gain = max(1.0 / (hits[j] + 1), 0.1)
        for a in range(2):
            place[j, a] += gain * (p[i, a] - place[j, a])
            for b in range(2):
                spread[j, a, b] = (1 - gain) * spread[j, a, b] + gain * gain * cov[i, a, b]
        hits[j] += 1
