"""A scan as a whole: where dead reckoning's last step was off by more than trees are known, all of its trunks are off alike."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from topograph.geometry import Array

LEAST = 3
"""Trunks that have to agree on a shift and a turn of the scan: two always do."""
AGREED = 0.5
"""Share of the trunks that could be matched by shifting the scan which have to agree on how."""
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
    left = offset[None] - tried[:, None, None] * turned
    support = (1.0 / (1.0 + np.sum(left**2, axis=2) / (gate * var))).sum(axis=1)
    x = np.array([0.0, 0.0, tried[np.argmax(support)]])
    A = np.concatenate([np.tile(np.eye(2), (len(arm), 1, 1)), turned[:, :, None]], axis=2)
    for _ in range(ROUNDS):
        e2 = np.sum((offset - A @ x) ** 2, axis=1) / var
        w = 1.0 / (var * (1.0 + e2 / gate) ** 2)
        x = np.linalg.solve(
            np.einsum("k,kij,kil->jl", w, A, A) + np.diag(sigma**-2.0), np.einsum("k,kij,ki->j", w, A, offset)
        )
    agree = np.unique(trunk[np.sum((offset - A @ x) ** 2, axis=1) < gate * var])
    return x if len(agree) >= max(LEAST, AGREED * len(np.unique(trunk))) else None
