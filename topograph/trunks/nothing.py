"""A scan in which no trunk was seen."""

from __future__ import annotations

import numpy as np

from topograph.bags import Trunks


def none_at(stamp_ns: int) -> Trunks:
    """No trunks."""
    z = np.zeros(0)
    return Trunks(stamp_ns, "base_link", np.zeros((0, 3)), np.zeros((0, 3)), z, np.zeros((0, 3, 3)), z, z)
