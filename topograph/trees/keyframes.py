"""Which moments of a run become poses of the graph."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from topograph.geometry import Stamps
from topograph.motion import Motion


def choose_keyframes(
    motion: Motion, stamps_ns: Stamps, distance: float, turn: float, seconds: float
) -> NDArray[np.int64]:
    """Indices into `stamps_ns` (S,): every `distance` m, `turn` rad or `seconds` s, whichever comes first."""
    d, a, t = motion.distance_at(stamps_ns), motion.turned_at(stamps_ns), stamps_ns * 1e-9
    chosen = [0]
    for i in range(1, len(stamps_ns)):
        k = chosen[-1]
        if d[i] - d[k] >= distance or a[i] - a[k] >= turn or t[i] - t[k] >= seconds:
            chosen.append(i)
    if chosen[-1] != len(stamps_ns) - 1:
        chosen.append(len(stamps_ns) - 1)
    return np.array(chosen, np.int64)
