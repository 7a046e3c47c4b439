"""Our front end: one sweep -> trunks."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from topograph.bags import Scan, Trunks
from topograph.geometry import Array
from topograph.trunks import score as scoring
from topograph.trunks.config import TrunksConfig
from topograph.trunks.fit import FEATURES, fit_chains, suppress
from topograph.trunks.ground import fit_ground
from topograph.trunks.organise import angular_step, organise, rings_of
from topograph.trunks.runs import FIRST, LAST, find_runs, heights, link

RANGE_EDGES = (5.0, 10.0, 20.0)
_NO_TIME = np.zeros(0, np.float32)


@dataclass(frozen=True, slots=True)
class Candidates:
    """What could be trunks, before the score decides.

    Attributes:
        fits: (C, OUT_SIZE), see fit.py; `features` (C, F).
        points: (M, 3) of the sweep in `base_link`; `members` C index arrays into them.
    """

    fits: Array
    features: Array
    points: NDArray[np.float32]
    members: list[NDArray[np.int64]]


def candidates(scan: Scan, base_T_lidar: Array, twist: Array, config: TrunksConfig) -> Candidates:
    """Everything in a sweep that stands up and is as thin as a trunk. A pure function.

    `twist` (6,) is the base's linear (m/s) and angular (rad/s) velocity during the sweep.
    """
    if len(scan.xyz) == 0:
        return Candidates(np.zeros((0, 16)), np.zeros((0, len(FEATURES))), np.zeros((0, 3), np.float32), [])
    ring, n_rings = rings_of(scan)
    offset = _NO_TIME if scan.offset is None else scan.offset
    p, r, a, starts = organise(
        scan.xyz,
        ring,
        offset,
        base_T_lidar,
        np.asarray(twist, float),
        n_rings,
        config.nearest,
        config.farthest + 8.0,
    )
    if len(p) < 50:
        return Candidates(np.zeros((0, 16)), np.zeros((0, len(FEATURES))), p, [])
    step = angular_step(a, starts)
    plane, grid = fit_ground(p)
    h, above, beside = heights(p, plane, grid)
    runs, label = find_runs(p, r, a, h, starts, step, config.low, config.high, config.widest)
    chain = link(runs)
    top = _top(scan, n_rings)
    fits, features, name = fit_chains(
        p, r, h, runs, label, chain, plane, grid, above, beside, base_T_lidar[:3, 3].copy(), step, top, config.reference,
        config.prior_diameter, config.prior_sigma, config.thinnest, config.widest,
    )  # fmt: skip
    near = fits[:, 13] < config.farthest
    fits, features, name = fits[near], features[near], name[near]
    order = np.argsort(chain, kind="stable")
    lo = np.searchsorted(chain[order], name)
    hi = np.searchsorted(chain[order], name, side="right")
    first, last = runs[:, FIRST].astype(np.int64).tolist(), runs[:, LAST].astype(np.int64).tolist()
    members = [
        np.concatenate([first[i] + np.flatnonzero(label[first[i] : last[i] + 1] == i) for i in order[b:e].tolist()])
        for b, e in zip(lo.tolist(), hi.tolist(), strict=True)
    ]
    return Candidates(fits, features, p, members)


def _top(scan: Scan, n_rings: int) -> float:
    """Elevation of the highest ring, rad: what the sensor could have seen of a canopy."""
    z = scan.xyz[:, 2]
    flat = np.hypot(scan.xyz[:, 0], scan.xyz[:, 1])
    with np.errstate(invalid="ignore", divide="ignore"):
        tangent = z[::7] / flat[::7]
    finite = tangent[np.isfinite(tangent)]
    return float(np.arctan(np.percentile(finite, 99.5))) if len(finite) > 20 else 0.26


class Detector:
    """Scan -> trunks in `base_link` at the scan's stamp; holds the mounting and the settings, nothing else."""

    def __init__(self, base_T_lidar: Array, config: TrunksConfig) -> None:
        self.base_T_lidar = np.ascontiguousarray(base_T_lidar, float)
        self.config = config

    def __call__(self, scan: Scan, twist: Array) -> Trunks:
        c = candidates(scan, self.base_T_lidar, twist, self.config)
        if len(c.fits) == 0:
            return none_at(scan.stamp_ns)
        log_odds = scoring.score(c.features)
        keep = np.flatnonzero(log_odds > self.config.min_score)
        fits, odds = c.fits[keep], log_odds[keep]
        group = suppress(fits, odds, 0.6)
        best = np.flatnonzero(group == np.arange(len(group)))
        return trunks_of(scan.stamp_ns, _with_stems(fits, odds, group, best), odds[best], best, group, c, keep)


def none_at(stamp_ns: int) -> Trunks:
    """No trunks."""
    z = np.zeros(0)
    return Trunks(stamp_ns, "base_link", np.zeros((0, 3)), np.zeros((0, 3)), z, np.zeros((0, 3, 3)), z, z)


def _with_stems(fits: Array, odds: Array, group: NDArray[np.int64], best: NDArray[np.int64]) -> Array:
    """Stems of one tree meet at its foot: their mean, by points, stands for the tree."""
    out = fits[best].copy()
    for n, i in enumerate(best.tolist()):
        stems = np.flatnonzero((group == i) & (odds > 0.5 * odds[i]))
        if len(stems) > 1:
            w = fits[stems, 11] / fits[stems, 11].sum()
            out[n, :6] = w @ fits[stems, :6]
            out[n, 3:6] /= np.linalg.norm(out[n, 3:6])
            out[n, 8:10] = np.hypot(out[n, 8:10], 0.05)
    return out


def trunks_of(
    stamp_ns: int, fits: Array, odds: Array, best: NDArray[np.int64], group: NDArray[np.int64], c: Candidates,
    keep: NDArray[np.int64],
) -> Trunks:  # fmt: skip
    """Trunks with covariances turned from line of sight into the base's axes."""
    radial_factor, tangential_factor = scoring.calibration()
    cls = np.searchsorted(RANGE_EDGES, fits[:, 13])
    radial, tangential = fits[:, 8] * radial_factor[cls], fits[:, 9] * tangential_factor[cls]
    n = len(fits)
    line, side = np.zeros((n, 3)), np.zeros((n, 3))
    line[:, 0], line[:, 1] = fits[:, 14], fits[:, 15]
    side[:, 0], side[:, 1] = -fits[:, 15], fits[:, 14]
    axis = fits[:, 3:6]
    cov = (
        radial[:, None, None] ** 2 * line[:, :, None] * line[:, None, :]
        + tangential[:, None, None] ** 2 * side[:, :, None] * side[:, None, :]
        + 0.12**2 * axis[:, :, None] * axis[:, None, :]
        + 1e-6 * np.eye(3)
    )
    clouds = tuple(
        c.points[np.concatenate([c.members[keep[j]] for j in np.flatnonzero(group == i)])] for i in best.tolist()
    )
    return Trunks(stamp_ns, "base_link", fits[:, :3], axis, fits[:, 6], cov, fits[:, 7], odds, clouds)


@lru_cache(maxsize=1)
def warm_up() -> None:
    """Compile the hot loops on a made-up sweep, so that no measured sweep pays for it."""
    az = np.linspace(-3.1, 3.1, 600)
    xyz = np.concatenate(
        [np.stack([5 * np.cos(az), 5 * np.sin(az), np.full(600, -0.8 + 0.2 * k)], 1) for k in range(4)]
    )
    scan = Scan(1, "lidar", xyz.astype(np.float32), np.repeat(np.arange(4), 600).astype(np.int32), None, None)
    candidates(scan, np.eye(4), np.zeros(6), TrunksConfig())
