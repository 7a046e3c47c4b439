"""The trunks of all scans of a run, flat."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from topograph.bags import Trunks
from topograph.geometry import Array, Stamps

LEAST_BELIEVED = 0.05
"""Share of its information that a sighting keeps however little its scan believed in it: many such may still be a tree."""
SECTORS = 360
"""Words of a scan's record of passage (trunks/passage.py)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Detections:
    """N trunks of S scans, sorted by scan; all in `base_link` at the scan's stamp.

    Attributes:
        stamps_ns: (S,) rising.
        scan: (N,) index of the scan.
        p: (N, 3) on the axis, m; `cov` (N, 3, 3); `axis` (N, 3); `height` (N,) of p above ground or NaN;
        diameter: (N,) m or NaN; `score` (N,) log-odds.
        kinds: (N, 3) log-probabilities of tree, post, other; NaN where the source tells no kinds.
        measured: (N, 6) as in `Trunks`; zeros where nothing was measured.
        stems: (N,).
        source: (N,) row among all trunks of the run, in the order of the scans.
        free: (S, 360) what each scan saw through, or (0, 360); `eye` (S, 3) the sensor in `base_link`.
    """

    stamps_ns: Stamps
    scan: NDArray[np.int64]
    p: Array
    cov: Array
    axis: Array
    height: Array
    diameter: Array
    score: Array
    kinds: Array
    measured: Array
    stems: NDArray[np.int64]
    source: NDArray[np.int64]
    free: NDArray[np.uint32]
    eye: Array

    def __len__(self) -> int:
        return len(self.scan)

    @property
    def believed(self) -> Array:
        """(N,) chance that each is a column at all, and not leaves beside one: its share of the information on where and how
        its tree stands; 1 where the source tells no kinds.
        """
        column = np.exp(self.kinds[:, 0]) + np.exp(self.kinds[:, 1])
        return np.where(np.isfinite(column), np.clip(column, LEAST_BELIEVED, 1.0), 1.0)

    @staticmethod
    def of(trunks: Sequence[Trunks]) -> Detections:
        """Flat arrays of trunks given scan by scan, already in `base_link`."""
        unique = in_order(trunks)
        count = [len(t) for t in unique]

        def rows(name: str, *shape: int, missing: float = 0.0) -> Array:
            parts = []
            for t in unique:
                part = np.asarray(getattr(t, name), float)
                parts.append(part if len(part) == len(t) else np.full((len(t), *shape), missing))
            return np.concatenate([*parts, np.zeros((0, *shape))]).astype(float)

        free = [t.free for t in unique]
        looked = len(free) > 0 and all(len(f) in (0, SECTORS) for f in free) and any(map(len, free))
        nothing = np.zeros(SECTORS, np.uint32)
        return Detections(
            stamps_ns=np.array([t.stamp_ns for t in unique], np.int64),
            scan=np.repeat(np.arange(len(unique)), count),
            p=rows("p", 3),
            cov=rows("cov", 3, 3),
            axis=rows("axis", 3),
            height=rows("height"),
            diameter=rows("diameter"),
            score=rows("score"),
            kinds=rows("kinds", 3, missing=np.nan),
            measured=rows("measured", 6),
            stems=rows("stems", missing=1.0).astype(np.int64),
            source=np.arange(sum(count)),
            free=np.array([f if len(f) else nothing for f in free], np.uint32) if looked else np.zeros((0, SECTORS), np.uint32),
            eye=np.array([t.eye for t in unique]).reshape(-1, 3),
        )  # fmt: skip

    def select(self, keep: NDArray[np.bool_]) -> Detections:
        """The detections where `keep` (N,); all scans stay."""
        per_row = ("scan", "p", "cov", "axis", "height", "diameter", "score", "kinds", "measured", "stems", "source")
        return replace(self, **{k: getattr(self, k)[keep] for k in per_row})


def in_order(trunks: Sequence[Trunks]) -> list[Trunks]:
    """Scans in time order, each stamp once: the order that `Detections.source` counts in."""
    ordered = sorted(trunks, key=lambda t: t.stamp_ns)
    return [t for i, t in enumerate(ordered) if i == 0 or t.stamp_ns > ordered[i - 1].stamp_ns]
