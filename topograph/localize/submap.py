"""What was seen since the submap began: landmarks with their joint covariance, and where nothing was seen.

The unit of evidence is the landmark, not the detection: an error that stays (of the map, of a side always seen from the
same side) would otherwise be counted once per scan and the posterior would lie.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from topograph.geometry import Array
from topograph.localize.config import LocalizeConfig
from topograph.localize.filter import Filter
from topograph.localize.filter_kernels import assign, enter_kernel, in_view

BINS = np.array([5.0, 10.0, 15.0, 20.0, 25.0, 30.0, 40.0, 60.0])


SECTORS = 180
"""Bearings of the view, two degrees each."""


@dataclass(frozen=True, slots=True)
class Sweep:
    """Trunks of one scan in the robot's levelled frame: `p` (N, 2) m, `cov` (N, 2, 2), `diameter` (N,) m or NaN,
    `diameter_var` (N,) m². `open_to` (SECTORS,) m by bearing, see `open_to`."""

    p: Array
    cov: Array
    diameter: Array
    diameter_var: Array
    open_to: Array = field(default_factory=lambda: np.full(SECTORS, np.inf))

    def __len__(self) -> int:
        return len(self.p)


@dataclass(frozen=True, slots=True)
class Move:
    """Planar motion since the last scan: `step` (x, y, yaw) in the robot's frame, `cov` (3, 3), `distance` m."""

    step: Array
    cov: Array
    distance: float


class Visibility:
    """How often a trunk in view is detected, by range: the configured chance, held against what is seen.

    Attributes:
        hits, looks: (9,) by range, of landmarks that exist beyond doubt.
        found: trunks a scan, running mean.
    """

    def __init__(self, config: LocalizeConfig) -> None:
        self.config = config
        self.hits = np.zeros(len(BINS) + 1)
        self.looks = np.zeros(len(BINS) + 1)
        self.found = 0.0
        self.scans = 0

    def table(self) -> Array:
        """Chance (9,) by range bin; zero beyond the view."""
        c = self.config
        lower = np.concatenate([[0.0], BINS])
        prior = np.where(lower < c.view, c.seen, 0.05)
        p = (self.hits + 8.0 * prior) / (self.looks + 8.0)
        # Detection does not get better with range: what is not known far out is bounded by what is known nearer.
        return np.asarray(np.clip(np.minimum.accumulate(np.maximum(p, 1e-3)), 1e-3, 0.97))

    def clutter(self, view: float) -> float:
        """False detections per m² and scan."""
        return self.config.clutter * max(self.found, 1.0) / (np.pi * view**2)


class Submap:
    """Landmarks since a beginning, in the frame of the robot's first pose.

    Attributes:
        filter: the landmarks and the robot.
        scans: scans since the beginning.
        raster: (X, Y) looks, as the sum of -ln(1 - chance of detection), per cell of 1 m about `origin` (2,).
    """

    def __init__(self, config: LocalizeConfig, visibility: Visibility) -> None:
        self.config, self.visibility = config, visibility
        self.filter = Filter()
        self.scans = 0
        half = int(np.ceil(config.view + 20.0))
        self.origin = np.array([-half, -half], float)
        self.raster = np.zeros((2 * half, 2 * half))
        self._looked = np.full(3, 1e9)

    def step(self, move: Move, sweep: Sweep) -> None:
        """One scan further."""
        f, c = self.filter, self.config
        f.predict(move.step, move.cov, move.distance)
        used, _ = in_reach(sweep, c)
        z = used.p
        v = self.visibility
        v.scans += 1
        v.found += (len(z) - v.found) / min(v.scans, 50)
        m2, logdet = f.innovations(z, used.cov)
        match = assign(m2, logdet, c.gate)
        blocked = sectors(z)
        self._count_looks(match, blocked)
        absorb(f, used, m2, match, c.gate)
        self.scans += 1
        self._drop()
        self._look(blocked)

    def _count_looks(self, match: NDArray[np.int64], blocked: Array) -> None:
        f, v = self.filter, self.visibility
        if not f.n:
            return
        reach, hidden = in_view(f.mean, f.n, blocked)
        found = np.zeros(f.n, bool)
        found[match[match >= 0]] = True
        looked = found | (~hidden & (reach < self.config.view))
        f.looks[looked] += 1
        sure = looked & (f.hits >= 3) & (f.hits > 0.3 * f.looks)
        if sure.any():
            bins = np.searchsorted(BINS, reach[sure])
            np.add.at(v.looks, bins, 1.0)
            np.add.at(v.hits, bins, found[sure])
            if v.looks.sum() > 4000:
                v.looks *= 0.5
                v.hits *= 0.5

    def _drop(self) -> None:
        f, c = self.filter, self.config
        if not f.n:
            return
        bad = ((f.looks >= 6) & (f.hits < 0.25 * f.looks)) | (f.run - f.seen > c.forget)
        if f.n - bad.sum() > 2 * c.landmarks:  # more than is ever searched with: the oldest go
            order = np.argsort(f.seen)
            bad[order[: f.n - 2 * c.landmarks]] = True
        f.keep(~bad)

    def _look(self, blocked: Array) -> None:
        """Enter this scan into the raster of looks; scans from the same place say the same."""
        x, y, yaw = self.filter.mean[:3]
        moved = np.hypot(x - self._looked[0], y - self._looked[1])
        if moved < 0.4 and abs(yaw - self._looked[2]) < 0.35:
            return
        self._looked[:] = x, y, yaw
        reach = self.config.view
        low, high = self.origin, self.origin + self.raster.shape
        if x - reach < low[0] or y - reach < low[1] or x + reach > high[0] or y + reach > high[1]:
            more = 40
            self.raster = np.pad(self.raster, more)
            self.origin = self.origin - more
        enter_kernel(self.raster, self.origin, x, y, yaw, blocked, np.append(BINS, 1e9), self.visibility.table(), reach)


def in_reach(sweep: Sweep, config: LocalizeConfig) -> tuple[Sweep, NDArray[np.int64]]:
    """The trunks that are near enough to use, with the deviation that the view of a trunk adds, and their rows."""
    rows = np.flatnonzero(np.hypot(*sweep.p.T) < config.view) if len(sweep) else np.zeros(0, np.int64)
    cov = sweep.cov[rows] + config.trunk_sigma**2 * np.eye(2)
    return Sweep(sweep.p[rows], cov, sweep.diameter[rows], sweep.diameter_var[rows], sweep.open_to), rows


def absorb(f: Filter, seen: Sweep, m2: Array, match: NDArray[np.int64], gate: float) -> None:
    """Update the landmarks that are sighted, and begin new ones where no landmark is anywhere near."""
    lonely = (match < 0) & ((m2 > 2.5 * gate).all(axis=1) if m2.shape[1] else np.ones(len(seen), bool))
    for i in np.flatnonzero(match >= 0):
        k = int(match[i])
        f.update(k, seen.p[i], seen.cov[i])
        f.count(k, seen.diameter[i], seen.diameter_var[i], float(np.hypot(*seen.p[i])))
    for i in np.flatnonzero(lonely):
        k = f.add(seen.p[i], seen.cov[i])
        f.looks[k] = 1
        f.count(k, seen.diameter[i], seen.diameter_var[i], float(np.hypot(*seen.p[i])))


def open_to(free: NDArray[np.uint32]) -> Array:
    """Range (SECTORS,) up to which a scan saw through at trunk height, by bearing, m, of its record of passage `free` (2 SECTORS,): behind a parked vehicle
    no tree is missing. Infinity where there is no record. A trunk fills the cell of a metre in which it stands, and the one before.
    """
    if len(free) != 2 * SECTORS:
        return np.full(SECTORS, np.inf)
    far = (
        np.where(free > 0, np.floor(np.log2(np.maximum(free, 1).astype(float))) + 2.0, 0.0)
        .reshape(SECTORS, 2)
        .max(axis=1)
    )
    return np.asarray(
        np.maximum(far, np.maximum(np.roll(far, 1), np.roll(far, -1)))
    )  # the sensor stands beside the base


def sectors(z: Array, n: int = SECTORS) -> Array:
    """Range (n,) of the nearest trunk by bearing; infinity where the view is free."""
    out = np.full(n, np.inf)
    if len(z):
        reach = np.hypot(z[:, 0], z[:, 1])
        at = ((np.arctan2(z[:, 1], z[:, 0]) + np.pi) * (n / (2 * np.pi))).astype(int) % n
        np.minimum.at(out, at, reach)
    return out
