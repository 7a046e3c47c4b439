"""Statistics that a few wrong values do not move."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from topograph.geometry import Array


def weighted_median(x: Array, weight: NDArray[Any]) -> float:
    """Where half of the `weight` (M,) of `x` (M,) lies below."""
    order = np.argsort(x)
    total = np.cumsum(weight[order])
    return float(x[order][np.searchsorted(total, 0.5 * total[-1])])
