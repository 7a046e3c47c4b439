"""The trunks of all scans of a run, flat."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from topograph.bags import Trunks
from topograph.geometry import Array, Stamps
from topograph.session import ROWS, Scans, picked

LEAST_BELIEVED = 0.05
"""Share of its information that a sighting keeps however little its scan believed in it: many such may still be a tree."""

ALONG = 0.5
"""m, along the axis, at worst: a trunk is seen at about the same height from everywhere."""


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
        source: (N,) row among all trunks of the run, in the order of the scans (`Scans.in_order`).
        free: (S, 360) what each scan saw through, or (0, 360); `eye` (S, 3) the sensor in `base_link`.
    """

    stamps_ns: Stamps
    scan: NDArray[np.int64]
    p: Array
    cov: NDArray[np.float32]
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

    @property
    def sigma(self) -> Array:
        """(N,) standard deviation, per axis, of where each axis stands in the robot's plane, m. Along itself an axis is known
        to `ALONG` at worst: a recorded detection does not say where on the trunk it lies, and metres along a leaning axis
        would be as many decimetres on the ground.
        """
        a, C = self.axis, self.cov
        along = np.einsum("nij,nj->ni", C, a)  # C a
        var = np.einsum("ni,ni->n", a, along)
        flat = a[:, 0] ** 2 + a[:, 1] ** 2
        across = C[:, 0, 0] + C[:, 1, 1] - 2.0 * np.sum(a[:, :2] * along[:, :2], axis=1) + flat * var
        return np.asarray(np.sqrt(0.5 * np.maximum(across + flat * np.minimum(var, ALONG**2), 0.0)))

    @staticmethod
    def of(trunks: Iterable[Trunks]) -> Detections:
        """Trunks given scan by scan, already in `base_link`; on the same memory, where they come in columns and in order."""
        s = Scans.of(trunks).in_order()
        return Detections(
            stamps_ns=s.stamps_ns,
            scan=np.repeat(np.arange(len(s)), np.diff(s.ends)),
            source=np.arange(len(s.p)),
            free=s.free,
            eye=s.eye,
            **{k: getattr(s, k) for k in ROWS},
        )

    def select(self, keep: NDArray[np.bool_]) -> Detections:
        """The detections where `keep` (N,); all scans stay."""
        return replace(self, **{k: picked(getattr(self, k), keep) for k in ("scan", "source", *ROWS)})
