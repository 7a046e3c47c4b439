"""The trunks of all scans of a run, flat."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from topograph.bags import Trunks
from topograph.geometry import Array, Stamps


@dataclass(frozen=True, slots=True)
class Detections:
    """N trunks of S scans, sorted by scan; all in `base_link` at the scan's stamp.

    Attributes:
        stamps_ns: (S,) rising.
        scan: (N,) index of the scan.
        p: (N, 3) on the axis, m; `cov` (N, 3, 3); `axis` (N, 3); `height` (N,) of p above ground or NaN;
        diameter: (N,) m or NaN; `score` (N,) log-odds.
    """

    stamps_ns: Stamps
    scan: NDArray[np.int64]
    p: Array
    cov: Array
    axis: Array
    height: Array
    diameter: Array
    score: Array

    def __len__(self) -> int:
        return len(self.scan)

    @staticmethod
    def of(trunks: Sequence[Trunks]) -> Detections:
        """Flat arrays of trunks given scan by scan, already in `base_link`; scans are put in time order."""
        ordered = sorted(trunks, key=lambda t: t.stamp_ns)
        unique = [t for i, t in enumerate(ordered) if i == 0 or t.stamp_ns > ordered[i - 1].stamp_ns]

        def rows(name: str, *shape: int) -> Array:
            parts = [getattr(t, name) for t in unique]
            return np.concatenate([*parts, np.zeros((0, *shape))]).astype(float)

        return Detections(
            np.array([t.stamp_ns for t in unique], np.int64),
            np.repeat(np.arange(len(unique)), [len(t) for t in unique]),
            rows("p", 3),
            rows("cov", 3, 3),
            rows("axis", 3),
            rows("height"),
            rows("diameter"),
            rows("score"),
        )
