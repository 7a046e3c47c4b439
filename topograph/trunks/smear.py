"""What a sweep costs that could not be deskewed: the trunks' stated covariance widens by what the motion may have moved them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from topograph.bags import Trunks
from topograph.geometry import Array

SWEEP_S = 0.1
"""Duration of a sweep whose points have no times: that of most spinning sensors."""
WALK, TURN = 1.0, 0.3
"""Speed (m/s) and rate (rad/s) of a robot of which nothing is known."""


def smeared(trunks: Trunks, twist: Array, known: bool) -> Trunks:
    """Trunks of a sweep without times per point, or (`known` false) without any word on the motion during it.

    A point was taken anywhere within the sweep: the displacement is uniform over what the robot moved in that time.
    """
    speed = float(np.linalg.norm(twist[:3])) if known else WALK
    rate = float(np.linalg.norm(twist[3:])) if known else TURN
    far2 = np.sum(trunks.p[:, :2] ** 2, axis=1)
    var = ((speed * SWEEP_S) ** 2 + far2 * (rate * SWEEP_S) ** 2) / 3.0
    cov = trunks.cov.copy()
    cov[:, 0, 0] += var
    cov[:, 1, 1] += var
    return replace(trunks, cov=cov)
