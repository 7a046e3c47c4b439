"""Our front end: one sweep -> trunks."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from topograph.bags import Scan, Trunks
from topograph.geometry import Array
from topograph.trunks import score as scoring
from topograph.trunks.config import TrunksConfig
from topograph.trunks.fit import FEATURES, OUT_SIZE, covariances, fit_chains, gather, merge_stems, suppress
from topograph.trunks.ground import fit_ground
from topograph.trunks.organise import angular_step, organise, rings_of
from topograph.trunks.runs import RUN_SIZE, find_runs, heights, link

_NO_TIME = np.zeros(0, np.float32)


@dataclass(frozen=True, slots=True)
class Candidates:
    """What could be trunks, before the score decides.

    Attributes:
        fits: (C, OUT_SIZE), see fit.py; `features` (C, F); `name` (C,) chain of each.
        points: (M, 3) of the sweep in `base_link`; `runs`, `label`, `chain`: how they hang together, see runs.py.
    """

    fits: Array
    features: Array
    name: NDArray[np.int64]
    points: NDArray[np.float32]
    runs: Array
    label: NDArray[np.int32]
    chain: NDArray[np.int64]


_NOTHING = Candidates(
    np.zeros((0, OUT_SIZE)), np.zeros((0, len(FEATURES))), np.zeros(0, np.int64), np.zeros((0, 3), np.float32),
    np.zeros((0, RUN_SIZE)), np.zeros(0, np.int32), np.zeros(0, np.int64),
)  # fmt: skip


def candidates(scan: Scan, base_T_lidar: Array, twist: Array, config: TrunksConfig) -> Candidates:
    """Everything in a sweep that stands up and is as thin as a trunk. A pure function.

    `twist` (6,) is the base's linear (m/s) and angular (rad/s) velocity during the sweep.
    """
    if len(scan.xyz) == 0:
        return _NOTHING
    ring, n_rings = rings_of(scan)
    offset = _NO_TIME if scan.offset is None else scan.offset
    p, r, starts, top, low = organise(
        scan.xyz, ring, offset, base_T_lidar, twist, n_rings, config.nearest, config.farthest + 8.0
    )
    if len(p) < 50:
        return _NOTHING
    eye = base_T_lidar[:3, 3].copy()
    step = angular_step(p, r, eye, starts)
    plane, grid = fit_ground(low)
    h, above, beside = heights(p, plane, grid)
    runs, label = find_runs(p, r, h, starts, eye, step, config.low, config.high, config.widest)
    chain = link(runs)
    fits, features, name = fit_chains(
        p, r, h, runs, label, chain, plane, grid, above, beside, eye, step, top, config.reference,
        config.prior_diameter, config.prior_sigma, config.thinnest, config.widest,
    )  # fmt: skip
    near = fits[:, 13] < config.farthest
    return Candidates(fits[near], features[near], name[near], p, runs, label, chain)


class Detector:
    """Scan -> trunks in `base_link` at the scan's stamp; holds the mounting and the settings, nothing else."""

    def __init__(self, base_T_lidar: Array, config: TrunksConfig) -> None:
        self.base_T_lidar = np.ascontiguousarray(base_T_lidar, float)
        self.config = config

    def __call__(self, scan: Scan, twist: Array) -> Trunks:
        c = candidates(scan, self.base_T_lidar, np.asarray(twist, float), self.config)
        if len(c.fits) == 0:
            return none_at(scan.stamp_ns)
        log_odds = scoring.score(c.features)
        keep = log_odds > self.config.min_score
        fits, odds, name = c.fits[keep], log_odds[keep], c.name[keep]
        group = suppress(fits, odds, 0.6)
        best, merged = merge_stems(fits, odds, group)
        wanted = np.full(len(c.runs), -1, np.int64)
        wanted[name] = np.searchsorted(best, group)
        rows, ends = gather(wanted, len(best), c.chain, c.runs, c.label)
        clouds = tuple(c.points[rows[a:b]] for a, b in pairwise(ends.tolist()))
        return Trunks(
            scan.stamp_ns, "base_link", merged[:, :3], merged[:, 3:6], merged[:, 6], covariances(merged, *scoring.calibration()), merged[:, 7],
            odds[best], clouds,
        )  # fmt: skip


def none_at(stamp_ns: int) -> Trunks:
    """No trunks."""
    z = np.zeros(0)
    return Trunks(stamp_ns, "base_link", np.zeros((0, 3)), np.zeros((0, 3)), z, np.zeros((0, 3, 3)), z, z)


@lru_cache(maxsize=1)
def warm_up() -> None:
    """Compile the hot loops on a made-up sweep, so that no measured sweep pays for it."""
    az = np.linspace(-3.1, 3.1, 600)
    xyz = np.concatenate(
        [np.stack([5 * np.cos(az), 5 * np.sin(az), np.full(600, -0.8 + 0.2 * k)], 1) for k in range(4)]
    )
    scan = Scan(1, "lidar", xyz.astype(np.float32), np.repeat(np.arange(4), 600).astype(np.int32), None, None)
    candidates(scan, np.eye(4), np.zeros(6), TrunksConfig())
