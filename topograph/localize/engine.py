"""Search, commit, track, lose: localization in the plane, one scan at a time."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from topograph.geometry import Array, inverse, planar, wrap
from topograph.localize.belief import CONTRADICTED, Belief, against, held, likely, open_among
from topograph.localize.config import LocalizeConfig
from topograph.localize.filter import Filter
from topograph.localize.filter_kernels import assign, in_view
from topograph.localize.hypothesis import DRAGGED, Hypothesis
from topograph.localize.posterior import Posterior, describe, nothing, weigh
from topograph.localize.submap import BINS, Move, Submap, Sweep, Visibility, absorb, in_reach, sectors
from topograph.places import Found, Landmarks, MapIndex, search, searching
from topograph.places.search_kernels import within_kernel

ASTRAY = 0.3
"""Deviation of a tree's place in the middle of the view, in mean spacings of trees, beyond which it is searched anew."""
OVERRULE = 0.01
"""Share of the risk at which the shadow may overrule a track: it is asked every metre, and the track was sure as well."""
UNSEEN = 4.0
"""Without a mapped tree for so many metres, wheels alone say where the robot is: wheels that slip or are off by 5 % need less to be
20 cm off."""
MET, FADE = 0.5, 0.9
"""Share of the near mapped trees, of those that should be seen, below which a track is doubted; weight of the scans before."""
DRAGGED_AGAIN = 5.0
"""Metres within which a second drag says that the place is lost."""
CROWD, FEW = 3.0, 0.3
"""Where more trees than this should be seen, and fewer than this share of them are, the pose is in doubt at once."""
NO_PAIRS = np.zeros((0, 2), np.int64)


@dataclass(slots=True, kw_only=True)
class _Hunt:
    """One attempt to find the place: a submap, what the last search found, and what that is worth now."""

    submap: Submap
    found: Found | None = None
    posterior: Posterior = field(default_factory=nothing)
    rows: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    searched: float = -1e9
    weighed: tuple[float, int] = (-1e9, 0)
    informed: bool = False
    search: Iterator[Found | None] | None = None


class Engine:
    """The localizer's core: `step` takes a motion and the trunks of a scan, and says what to believe."""

    def __init__(self, index: MapIndex, config: LocalizeConfig) -> None:
        self.index, self.config = index, config
        self.visibility = Visibility(config)
        self.hunt = _Hunt(submap=Submap(config, self.visibility))
        self.track: Filter | None = None
        self.graph: Hypothesis | None = None
        self.state = "searching"
        self.risk = 1.0
        self.sums = np.zeros(2)
        self._matched_at = 0.0
        self._dragged_at = -np.inf
        self._met = np.zeros(2)
        self.losses = 0
        self._blinded = False

    def step(
        self, move: Move, sweep: Sweep, doubted: Move | None = None, slips: bool = False, blinded: bool = False
    ) -> Belief:
        """One scan further. Where the trunks say that wheels or gyro are wrong, `doubted` is the motion made wide: a track follows it,
        and its second opinion begins anew. What is searched with stays as stiff as the sensors promise: a world that only fits
        when it is bent is another one. `slips`: it is the way that is contradicted; `blinded`: for so long that nobody is
        believed.
        """
        self._blinded = blinded
        if blinded:
            if self.track is not None:
                self._lose(sweep)
            self.hunt = _Hunt(submap=Submap(self.config, self.visibility))
            return self._belief(NO_PAIRS)
        if doubted is not None and self.track is not None:
            move, self.hunt = doubted, _Hunt(submap=Submap(self.config, self.visibility))
        self.hunt.submap.step(move, sweep)
        if self.track is None:
            self._look()
            if self.hunt.posterior.risk <= self.config.risk:
                return self._belief(self._pairs(self._commit(), sweep))
            self._restart_when_stale()
            return self._belief(NO_PAIRS)
        self.track.predict(move.step, move.cov, move.distance)
        if self._astray(self.track):
            self._lose(sweep)
            return self._belief(NO_PAIRS)
        pairs = self._follow(self.track, sweep)
        if slips:
            self.state = "degraded"
        if self.graph is not None:
            self.graph.step(move, sweep, pairs)
            if self.graph.dragged > DRAGGED:
                self._forget_drag()
        self._shadow()
        if self.sums[0] > self.config.lost or self.sums[1] > self.config.slip:
            self._lose(sweep)
            return self._belief(NO_PAIRS)
        return self._belief(pairs)

    # -- searching ------------------------------------------------------------------------------------------------

    def _look(self) -> bool:
        """Search, or weigh anew what was found, as the submap grows; whether the posterior is of the submap as it is now."""
        h, c = self.hunt, self.config
        f = h.submap.filter
        if f.n < 2:
            return False
        key = (f.run, f.n)
        if f.run - h.weighed[0] < 0.25 and f.n <= h.weighed[1] and h.submap.scans % 5:
            return False
        h.weighed = key
        marks, rows = describe(h.submap, self.index, c)
        if self._bits(marks) < self._need() and (len(marks) < 10 or f.run - h.searched < 2 * c.again):
            return False  # too little to decide; where planting is regular, the places that are left are still counted
        h.informed = True
        small = len(self.index.length) < 10000
        if not small and h.found is not None and f.run - h.searched < c.again:
            h.posterior, h.rows = weigh(self._kept(h), marks, h.submap, self.index, c), rows
            if h.posterior.risk > c.risk:
                return True
        h.found = search(marks, self.index, c.places)
        h.searched = f.run
        h.posterior, h.rows = weigh(h.found, marks, h.submap, self.index, c), rows
        return True

    def _glance(self) -> bool:
        """`_look` while tracking: in slices, so that no scan waits for a large map; whether the posterior is of the submap as it is now.

        A search that took several scans tells where the submap's frame lies; what that is worth is weighed by the landmarks of now.
        """
        h, c = self.hunt, self.config
        if h.search is None:
            h.searched = h.submap.filter.run
            if h.submap.filter.n < 2:
                return False
            marks, _ = describe(h.submap, self.index, c)
            if self._bits(marks) < self._need():
                return False
            h.search = searching(marks, self.index, c.places)
        found = next(h.search)
        if found is None:
            return False
        h.search, h.found, h.informed = None, found, True
        marks, rows = describe(h.submap, self.index, c)
        h.posterior, h.rows = weigh(found, marks, h.submap, self.index, c), rows
        return True

    def _bits(self, marks: Landmarks) -> float:
        """Nats that the landmarks tell of where they are, at most."""
        s2 = self.index.jitter**2
        bits = np.log1p(s2 / (marks.var + self.config.map_sigma**2)) * marks.lasting
        if self.index.diameter_sd > 0:
            ok = np.isfinite(marks.diameter)
            bits[ok] += 0.5 * np.log1p(self.index.diameter_sd**2 / marks.diameter_var[ok]) * marks.lasting[ok]
        return float(bits.sum())

    def _need(self) -> float:
        """Nats below which a search cannot decide."""
        return float(self.config.information * np.log(4.0 * len(self.index) / self.config.risk))

    @staticmethod
    def _kept(h: _Hunt) -> Found:
        assert h.found is not None
        p = h.posterior
        return Found(p.pose, -p.log, 0.0 if p.rest < 1e-9 else h.found.rest, h.found.seeds)

    def _restart_when_stale(self) -> None:
        """A long drive that fits nowhere begins anew: dead reckoning has bent the submap, or it began off the map."""
        h = self.hunt
        if h.submap.filter.run > 3.0 * self.config.forget and h.posterior.unknown > 0.5:
            self.hunt = _Hunt(submap=Submap(self.config, self.visibility))

    def begin_at(self, pose: Array, cov: Array) -> None:
        """Track from a pose (3,) x, y, yaw in the map that somebody else is sure of, with its covariance (3, 3)."""
        f = Filter()
        f.mean[:], f.cov[:] = pose, cov
        self._tracked(f, self.config.risk)

    def _forget_drag(self) -> None:
        """What was learnt of the trees' places is dropped: the map's are taken again, from a pose as unsure as they were moved."""
        assert self.graph is not None
        assert self.track is not None
        self.graph = self.graph.anew()
        f = self.track
        if f.run - self._dragged_at < DRAGGED_AGAIN:
            self.sums[0] = np.inf
        self._dragged_at = f.run
        f.keep(np.zeros(f.n, bool))
        f.mean[:3], f.cov[:3, :3] = self.graph.pose, self.graph.cov
        self.state = "degraded"

    def _commit(self) -> Filter:
        return self._tracked(anchored(self.hunt, self.index, self.config), self.hunt.posterior.risk)

    def _tracked(self, track: Filter, risk: float) -> Filter:
        self.track, self.risk = track, risk
        self.graph = None
        if self.config.estimator == "graph":
            f, var = self.track, self.index.var + self.config.map_sigma**2
            self.graph = Hypothesis(f.mean[:3], f.cov[:3, :3], self.index.xy, var, self.config)
        self.state = "tracking"
        self.sums[:] = 0.0
        self._met[:] = 0.0
        self._matched_at = self.track.run
        self._dragged_at = -np.inf
        self.hunt = _Hunt(submap=Submap(self.config, self.visibility))
        return self.track

    # -- tracking -------------------------------------------------------------------------------------------------

    def _astray(self, f: Filter) -> bool:
        """Dead reckoning has gone so far without trees that the nearest tree need not be the right one."""
        across = f.cov[2, 2] * (0.5 * self.config.view) ** 2
        spread = np.sqrt(max(f.cov[0, 0], f.cov[1, 1]) + across)
        return bool(spread > ASTRAY / np.sqrt(self.index.density))

    def _follow(self, f: Filter, sweep: Sweep) -> NDArray[np.int64]:
        """One scan of tracking; the pairs of trunks and mapped trees."""
        c = self.config
        used, rows = in_reach(sweep, c)
        z = used.p
        self._bring_in(f)
        m2, logdet = f.innovations(z, used.cov)
        match = assign(m2, logdet, c.gate)
        blocked = np.minimum(sectors(z), used.open_to)
        reach, hidden = in_view(f.mean, f.n, blocked)
        found = np.zeros(f.n, bool)
        found[match[match >= 0]] = True
        self._suspect(f, z, m2, logdet, match, found, reach, hidden)
        looked = found | (~hidden & (reach < c.view))
        expected = (f.tree >= 0) & ~hidden & (reach < 0.5 * c.view)
        chance = self.visibility.table()[np.searchsorted(BINS, reach[expected])]
        self._met = FADE * self._met + (float(found[expected].sum()), float(chance.sum()))
        f.looks[looked] += 1
        absorb(f, used, m2, match, c.gate)
        mapped = np.flatnonzero(match >= 0)
        mapped = mapped[f.tree[match[mapped]] >= 0]
        pairs = np.stack([rows[mapped], f.tree[match[mapped]]], axis=1)
        if len(pairs):
            self._matched_at = f.run
        away = np.hypot(*(f.landmarks - f.mean[:2]).T) > c.view + 8.0
        stale = (f.tree < 0) & (((f.looks >= 6) & (f.hits < 0.25 * f.looks)) | (f.run - f.seen > 15.0))
        f.keep(~(away | stale))
        sigma = float(np.sqrt(max(f.cov[0, 0], f.cov[1, 1])))
        doubt = self.sums[0] > 0.5 * c.lost or self.sums[1] > 0.5 * c.slip
        doubt |= self._met[0] < MET * self._met[1] and self._met[1] > 3.0
        doubt |= float(chance.sum()) > CROWD and float(found[expected].sum()) < FEW * float(chance.sum())
        far = f.run - self._matched_at > UNSEEN
        self.state = "degraded" if sigma > c.degraded or doubt or far else "tracking"
        if sigma > 5.0 * c.degraded:
            self.sums[0] = np.inf
        return pairs

    def _bring_in(self, f: Filter) -> None:
        """Mapped trees that come into view become landmarks with the map's covariance."""
        rows = self.near(f.mean[:2], self.config.view + 3.0)
        for t in rows[~np.isin(rows, f.tree)]:
            f.place(self.index.xy[t], (self.index.var[t] + self.config.map_sigma**2) * np.eye(2), int(t))

    def _pairs(self, f: Filter, sweep: Sweep) -> NDArray[np.int64]:
        """Trunks of a sweep that are known landmarks on mapped trees, without an update."""
        if not len(sweep) or not f.n:
            return NO_PAIRS
        match = assign(*f.innovations(sweep.p, sweep.cov), self.config.gate)
        rows = np.flatnonzero(match >= 0)
        rows = rows[f.tree[match[rows]] >= 0]
        return np.stack([rows, f.tree[match[rows]]], axis=1)

    def near(self, xy: Array, reach: float) -> NDArray[np.int64]:
        """Rows of mapped trees within `reach` of a place."""
        i = self.index
        return np.asarray(within_kernel(xy, reach, i.xy, i.grid))

    def _suspect(
        self, f: Filter, z: Array, m2: Array, logdet: Array, match: NDArray[np.int64], found: NDArray[np.bool_],
        reach: Array, hidden: NDArray[np.bool_],
    ) -> None:  # fmt: skip
        """Two cumulative sums (Page 1954): lost against tracked, and moved by a lattice vector against tracked."""
        if not len(z):  # a sensor in the leaves, or dark: sooner than that all trees were gone at once
            return
        c, index = self.config, self.index
        table = self.visibility.table()
        passing = self.visibility.clutter(c.view)
        here = np.log(0.75 * index.density + passing)
        lost = slip = 0.0
        c_, s_ = np.cos(f.mean[2]), np.sin(f.mean[2])
        for i in range(len(z)):
            k = match[i]
            if k >= 0:
                if f.tree[k] < 0:
                    continue
                own = -0.5 * m2[i, k] - 0.5 * logdet[i, k] - np.log(2 * np.pi)
                lost += here - own
                ratio = 1.0 + 2 * index.jitter**2 / np.exp(0.5 * logdet[i, k])
                # Where jitter is no larger than the noise, errors that stay would add up to a false alarm.
                slip += min(ratio / 9.0, 1.0) * min(0.5 * m2[i, k] * (1 - 1 / ratio) - np.log(ratio), 2.5)
            elif f.n and m2[i].min() <= 2.5 * c.gate:
                # Too far from the tree to be it, too near to be another: as in a lattice that is off by its jitter.
                k = int(np.argmin(m2[i]))
                ratio = 1.0 + 2 * index.jitter**2 / np.exp(0.5 * logdet[i, k])
                slip += 2.5 * min(ratio / 9.0, 1.0) * min(ratio - 1.0, 1.0) if f.tree[k] >= 0 else 0.0
            else:
                at = f.mean[:2] + [c_ * z[i, 0] - s_ * z[i, 1], s_ * z[i, 0] + c_ * z[i, 1]]
                if len(self.near(at, 1.3 / np.sqrt(index.density))):  # trees beyond the map's edge say nothing
                    lost += here - np.log(c.new * index.density + passing)
        steady = (f.tree >= 0) & (f.hits >= 3) & (f.hits > 0.6 * f.looks) & ~found & ~hidden & (reach < 0.8 * c.view)
        chance = table[np.searchsorted(BINS, reach[steady])]
        lost += float(np.sum(np.minimum(-0.5 * np.log(1.0 - chance), 1.0)))
        self.sums[0] = max(0.0, self.sums[0] + lost)
        self.sums[1] = max(0.0, self.sums[1] + slip)

    def _shadow(self) -> None:
        """A second opinion without a prior, from a submap that begins anew every few metres."""
        h, c = self.hunt, self.config
        f = h.submap.filter
        if h.search is not None or f.run - h.searched >= 1.0 or f.run >= c.shadow:
            renewed = self._glance()  # an older posterior speaks of landmarks that may have been dropped since
            p = h.posterior
            if renewed and len(p.pose) and p.risk <= OVERRULE * c.risk and self.track is not None:
                other = anchored(h, self.index, c)
                apart = np.hypot(*(other.mean[:2] - self.track.mean[:2]))
                turn = abs(float(wrap(other.mean[2] - self.track.mean[2])))
                elsewhere = apart > 1.0 + 3 * np.sqrt(self.track.cov[0, 0]) or turn > 0.2
                if elsewhere and self._fits_worse(self.track):
                    self.losses += 1
                    self._commit()
                    return
                if not elsewhere:
                    self.risk = p.risk
        if f.run >= c.shadow and h.search is None:
            self.hunt = _Hunt(submap=Submap(c, self.visibility))

    def _fits_worse(self, held: Filter) -> bool:
        """Whether the second opinion, as it is now, would not hold the `held` place for as likely as what may be overruled: a search may have
        left it out."""
        h, c = self.hunt, self.config
        assert h.found is not None
        own = on_top(held.mean[:3], h.submap.filter.mean[:3])
        marks, _ = describe(h.submap, self.index, c)
        there = weigh(replace(h.found, pose=own[None]), marks, h.submap, self.index, c)
        return not len(there.log) or float(there.log[0] - h.posterior.log[0]) < np.log(OVERRULE * c.risk)

    def _lose(self, sweep: Sweep) -> None:
        """The evidence has turned: forget the pose and begin with this scan."""
        self.track = self.graph = None
        self.state = "lost"
        self.risk = 1.0
        self.losses += 1
        self.sums[:] = 0.0
        self.hunt = _Hunt(submap=Submap(self.config, self.visibility))
        still = Move(np.zeros(3), np.zeros((3, 3)), 0.0)
        self.hunt.submap.step(still, sweep)

    # -- saying ---------------------------------------------------------------------------------------------------

    def _belief(self, pairs: NDArray[np.int64]) -> Belief:
        if self.graph is not None:
            return held(self.state, self.graph.pose.copy(), self.graph.scale * self.graph.cov, self.risk, pairs)
        if self.track is not None:
            return held(self.state, self.track.mean[:3].copy(), self.track.cov[:3, :3].copy(), self.risk, pairs)
        h, p = self.hunt, self.hunt.posterior
        if likely(p) and p.unknown < 0.5:
            self.state = "ambiguous"
        elif self.state != "lost" or h.informed:
            self.state = "searching"
        tried = h.found is None or h.found.seeds > 0
        why = CONTRADICTED if self._blinded else against(p, informed=h.informed, tried=tried)
        return open_among(self.state, p, h.submap.filter.mean[:3], pairs, why)


def on_top(map_pose: Array, frame_pose: Array) -> Array:
    """Pose (3,) x, y, yaw in the map of a frame in which the robot is at `frame_pose` (3,), when it is at `map_pose` (3,)."""
    x, y = (planar(*map_pose) @ inverse(planar(*frame_pose)))[:2, 3]
    return np.array([x, y, map_pose[2] - frame_pose[2]])


def anchored(hunt: _Hunt, index: MapIndex, config: LocalizeConfig) -> Filter:
    """The submap's filter put onto the map by its best placement: matched landmarks are tied to their trees."""
    p = hunt.posterior
    x, y, yaw = p.pose[0]
    f = hunt.submap.filter.moved(float(x), float(y), float(yaw), np.array([3.0, 3.0, 0.2]))
    scale = float(p.scale[0]) ** 2
    for k, t in zip(hunt.rows, p.tree[0], strict=True):
        if t >= 0:
            f.fix(int(k), index.xy[t], scale * (index.var[t] + config.map_sigma**2) * np.eye(2))
            f.tree[k] = t
    f.mean[2] = wrap(f.mean[2])
    return f
