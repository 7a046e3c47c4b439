"""Our front end: one sweep -> trunks."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from topograph.bags import Scan, Trunks
from topograph.geometry import Array
from topograph.trunks import fit as fitting
from topograph.trunks import score as scoring
from topograph.trunks.config import LEAST_CLOUD, MOST_CLOUD, TrunksConfig
from topograph.trunks.features import FEATURES, describe
from topograph.trunks.fit import OUT_SIZE, covariances, fit_chains, gather, members, merge_stems, suppress, vertical
from topograph.trunks.ground import fit_ground
from topograph.trunks.nothing import none_at
from topograph.trunks.organise import angular_step, once, organise, rings_of
from topograph.trunks.passage import passage, ring_image
from topograph.trunks.runs import FIRST, LAST, RUN_SIZE, find_runs, heights, link

_NO_TIME = np.zeros(0, np.float32)
SURE = float(np.log(0.7))
"""Log-probability from which a candidate's kind is taken at its word."""
_LOWEST, _HIGHEST = FEATURES.index("lowest"), FEATURES.index("highest")
STEM_DISTANCE = 0.45
"""Two trunks whose axes come that near are stems or pieces of one tree, m."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Candidates:
    """What could be trunks, before the score decides.

    Attributes:
        fits: (C, OUT_SIZE), see fit.py; `features` (C, F); `name` (C,) first run of each one's chain.
        points: (M, 3) of the sweep in `base_link`; `runs`, `label`, `chain`: how they hang together, see runs.py.
        free: (SECTORS,) what was seen through, see passage.py.
    """

    fits: Array
    features: Array
    name: NDArray[np.int64]
    points: NDArray[np.float32]
    runs: Array
    label: NDArray[np.int32]
    chain: NDArray[np.int64]
    free: NDArray[np.uint32]


_NOTHING = Candidates(
    fits=np.zeros((0, OUT_SIZE)),
    features=np.zeros((0, len(FEATURES))),
    name=np.zeros(0, np.int64),
    points=np.zeros((0, 3), np.float32),
    runs=np.zeros((0, RUN_SIZE)),
    label=np.zeros(0, np.int32),
    chain=np.zeros(0, np.int64),
    free=np.zeros(0, np.uint32),
)


def candidates(
    scan: Scan, base_T_lidar: Array, twist: Array, config: TrunksConfig, up: Array | None = None
) -> Candidates:
    """Everything in a sweep that stands up and is as thin as a trunk. A pure function.

    `twist` (6,) is the base's linear (m/s) and angular (rad/s) velocity during the sweep; `up` (2,) the vertical in
    the base's frame, horizontal metres per metre of height, where it is known: else the trunks tell.
    """
    scan = once(scan)
    if not (np.abs(twist) < FASTEST).all():  # False for NaN: a broken message says nothing of the sweep
        twist = np.zeros(6)
    if len(scan.xyz) == 0:
        return _NOTHING
    R = base_T_lidar[:3, :3]
    ring, tangent = rings_of(scan, bool(R[2, 2] < 0))
    offset = _NO_TIME if scan.offset is None else scan.offset
    p, r, u, starts, low = organise(
        scan.xyz, ring, offset, base_T_lidar, twist, len(tangent), config.nearest, config.farthest + 8.0
    )
    if len(p) < 50:
        return _NOTHING
    eye = base_T_lidar[:3, 3].copy()
    step = angular_step(u, starts)
    plane, grid = fit_ground(low)
    h, above, beside = heights(p, plane, grid)
    runs, label = find_runs(p, r, u, h, starts, step, config.low, config.high, config.widest)
    chain = link(runs)
    near, slope = ring_image(p, r, u, starts, eye)
    if up is None:
        up = vertical(runs, chain, 64)
    heads, order, ends = members(chain)
    fits, name = fit_chains(
        runs, heads, order, ends, plane, grid, eye, step, up, config.reference,
        config.prior_diameter, config.prior_sigma, config.thinnest, config.widest,
    )  # fmt: skip
    within = fits[:, fitting.FAR] < config.farthest
    fits, name = fits[within], name[within]
    features = describe(
        p, r, runs, label, order, ends, fits, name, near, tangent, np.ascontiguousarray(R), eye, above, beside, up, step
    )
    return Candidates(
        fits=fits,
        features=features,
        name=heads[name],
        points=p,
        runs=runs,
        label=label,
        chain=chain,
        free=passage(near, slope, eye, plane, grid),
    )


def heights_above_ground(scan: Scan, base_T_lidar: Array) -> tuple[float, float]:
    """How high the LiDAR and the base stand above the ground around, m; NaN where no ground is seen."""
    scan = once(scan)
    ring, tangent = rings_of(scan, bool(base_T_lidar[2, 2] < 0))
    *_, low = organise(scan.xyz, ring, _NO_TIME, base_T_lidar, np.zeros(6), len(tangent), 1.0, 20.0)
    if int((low < NOTHING).sum()) < LEAST_GROUND:
        return float("nan"), float("nan")
    plane, _ = fit_ground(low)
    return float(base_T_lidar[2, 3] - plane[0]), float(-plane[0])


FASTEST = 100.0
"""m/s and rad/s: what no robot does."""
NOTHING = 1e8
"""Cells without a point are higher, m."""
LEAST_GROUND = 20
"""Cells of a square metre below which no ground is fitted."""


class Detector:
    """Scan -> trunks in `base_link` at the scan's stamp; holds the mounting and the settings, nothing else."""

    def __init__(self, base_T_lidar: Array, config: TrunksConfig) -> None:
        self.base_T_lidar = np.ascontiguousarray(base_T_lidar, float)
        self.config = config
        self.network = scoring.network(config.score)

    def __call__(self, scan: Scan, twist: Array, up: Array | None = None) -> Trunks:
        c = candidates(scan, self.base_T_lidar, np.asarray(twist, float), self.config, up)
        if len(c.fits) == 0:
            return replace(none_at(scan.stamp_ns), free=c.free, eye=self.base_T_lidar[:3, 3])
        kinds = scoring.kinds(c.features, self.network)
        odds = scoring.column_odds(kinds)
        keep = odds > self.config.min_score
        fits, kinds, odds, name = c.fits[keep], kinds[keep], odds[keep], c.name[keep]
        post = (kinds[:, scoring.POST] > SURE).astype(float) - (kinds[:, scoring.TREE] > SURE)
        group = suppress(fits, odds, post, STEM_DISTANCE)
        lowest, highest = c.features[keep][:, _LOWEST], c.features[keep][:, _HIGHEST]
        best, merged = merge_stems(fits, scoring.tree_odds(kinds), group, lowest, highest)
        wanted = np.full(len(c.runs), -1, np.int64)
        wanted[name] = np.searchsorted(best, group)
        rows, ends = gather(wanted, len(best), c.chain, c.runs, c.label, FIRST, LAST)
        return Trunks(
            stamp_ns=scan.stamp_ns,
            frame="base_link",
            p=merged[:, :3],
            axis=merged[:, 3:6],
            diameter=merged[:, fitting.DIAMETER],
            cov=covariances(merged, scoring.error_scales(c.features[keep][best], self.network)),
            height=merged[:, fitting.ABOVE],
            score=scoring.tree_odds(kinds[best]),
            clouds=_clouds(c.points[rows], ends),
            kinds=kinds[best],
            measured=merged[:, [fitting.LEVER, fitting.SLOPE_X, fitting.SLOPE_Y, fitting.SLOPE_WEIGHT, fitting.WIDE, fitting.WIDE_SIGMA]],
            stems=merged[:, fitting.STEMS].astype(np.int64),
            free=c.free,
            eye=self.base_T_lidar[:3, 3],
        )  # fmt: skip


_NO_CLOUD = np.zeros((0, 3), np.float32)


def _clouds(points: NDArray[np.float32], ends: NDArray[np.int64]) -> tuple[NDArray[np.float32], ...]:
    """Of the points (M, 3) of each trunk, whose borders are `ends` (N + 1,), at most about `MOST_CLOUD`; none where there are too few."""
    return tuple(
        points[a : b : max((b - a) // MOST_CLOUD, 1)].copy() if b - a >= LEAST_CLOUD else _NO_CLOUD
        for a, b in pairwise(ends.tolist())
    )


@lru_cache(maxsize=1)
def warm_up() -> None:
    """Compile the hot loops on a made-up sweep, so that no measured sweep pays for it."""
    az = np.linspace(-3.1, 3.1, 600)
    xyz = np.concatenate(
        [np.stack([5 * np.cos(az), 5 * np.sin(az), np.full(600, -0.8 + 0.2 * k)], 1) for k in range(4)]
    )
    scan = Scan(
        stamp_ns=1,
        frame="lidar",
        xyz=xyz.astype(np.float32),
        ring=np.repeat(np.arange(4), 600).astype(np.int32),
        offset=None,
        intensity=None,
    )
    Detector(np.eye(4), TrunksConfig())(scan, np.zeros(6))
