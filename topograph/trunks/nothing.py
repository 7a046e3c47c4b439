"""A scan in which no trunk was seen."""

from __future__ import annotations

import numpy as np

from topograph.bags import Trunks


def none_at(stamp_ns: int) -> Trunks:
    """No trunks."""
    z = np.zeros(0)
    return Trunks(
        stamp_ns=stamp_ns,
        frame="base_link",
        p=np.zeros((0, 3)),
        axis=np.zeros((0, 3)),
        diameter=z,
        cov=np.zeros((0, 3, 3)),
        height=z,
        score=z,
    )
