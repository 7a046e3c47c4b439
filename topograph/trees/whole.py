"""A scan as a whole: where dead reckoning's last step was off by more than trees are known, all of its trunks are off alike."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from topograph.geometry import Array, planar

LEAST = 3
"""Trunks that have to agree on a shift and a turn of the scan: two always do."""
AGREED = 0.5
"""Share of the trunks that could be matched by shifting the scan of which more have to agree on how: people who walk along are no majority."""
NEAR = 9.0
"""Squared deviations within which they agree: closer than a track's gate, in which two groups may both find themselves."""
TRIED = 50
"""Turns that are tried first, at most."""
ROUNDS = 5
"""Of reweighting."""
ARM = 2.0
"""m from the robot within which a trunk does not tell a turn."""


def misstep(offset: Array, arm: Array, var: Array, trunk: NDArray[np.int64], sigma: Array, gate: float) -> Array | None:
    """Shift and turn (x, y, yaw) that lay a scan onto the tracks, None where its trunks do not agree.

    K candidate pairs: `offset` (K, 2) from the trunk to the track, m, `arm` (K, 2) from the robot to the trunk, `var` (K,) m² per axis, `trunk` (K,) its row;
    `sigma` (3,) of the step along and across, m, and of its turn, rad. A trunk may be in several pairs: most of them are wrong. Turns that one
    pair alone would take are tried, and reweighted least squares (Geman-McClure) goes on from the one that most agree with.
    """
    turned = np.stack([-arm[:, 1], arm[:, 0]], axis=1)  # by one radian
    square = np.sum(turned**2, axis=1)
    far = square > ARM**2
    tried = np.append(np.sum(offset * turned, axis=1)[far] / square[far], 0.0)
    tried = tried[np.abs(tried) < 3.0 * sigma[2]]
    tried = tried[:: len(tried) // TRIED + 1]
    left = offset[None] - _swept(arm, tried)
    support = (1.0 / (1.0 + np.sum(left**2, axis=2) / (gate * var))).sum(axis=1)
    x = np.array([0.0, 0.0, tried[np.argmax(support)]])
    for _ in range(ROUNDS):
        e = offset - x[:2] - _swept(arm, x[2:])[0]
        w = 1.0 / (var * (1.0 + np.sum(e**2, axis=1) / var / gate) ** 2)
        c, s = np.cos(x[2]), np.sin(x[2])
        by_turn = turned @ np.array([[c, s], [-s, c]])
        A = np.concatenate([np.tile(np.eye(2), (len(arm), 1, 1)), by_turn[:, :, None]], axis=2)
        H = np.einsum("k,kij,kil->jl", w, A, A) + np.diag(sigma**-2.0)
        x = x + np.linalg.solve(H, np.einsum("k,kij,ki->j", w, A, e) - x / sigma**2)
    e = offset - x[:2] - _swept(arm, x[2:])[0]
    agree = np.unique(trunk[np.sum(e**2, axis=1) < NEAR * var])
    return x if len(agree) >= LEAST and len(agree) > AGREED * len(np.unique(trunk)) else None


def _swept(arm: Array, turn: Array) -> Array:
    """(T, K, 2) how far turns (T,) move what is at `arm` (K, 2)."""
    return np.asarray(arm @ planar(0.0, 0.0, turn)[:, :2, :2].swapaxes(1, 2) - arm)
