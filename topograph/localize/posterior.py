"""How probable placements of the submap are, beside two further hypotheses: "not on this map" (trees at random), and "another
orchard of the same design" (trees near the map's lattice, but off by a planting error of their own).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from topograph.geometry import Array
from topograph.localize.config import LocalizeConfig
from topograph.localize.submap import Submap
from topograph.places import Found, Landmarks, MapIndex, placements, spread
from topograph.places.evidence_kernels import chance_kernel

LOOKS_EVERY = 2.0
"""Metres after which a further look counts as a new trial for the prior of another orchard."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Posterior:
    """Over placements of the submap; probabilities sum to one together with `unknown` and `rest`.

    Attributes:
        pose: (M, 3) x, y, yaw of the submap's frame in the map, falling probability.
        p: (M,) probabilities; `unknown`: not on this map, of which `alike`: in another orchard of its design; `rest`: placements that were dropped or not evaluated.
        tree: (M, n) mapped tree of each landmark, -1 none.
        scale: (M,) most probable noise scale.
        log: (M,) log evidence, to compare with the same submap later.
    """

    pose: Array
    p: Array
    unknown: float
    alike: float
    rest: float
    tree: NDArray[np.int64]
    scale: Array
    log: Array

    @property
    def risk(self) -> float:
        """Chance that the best placement is wrong."""
        return float(min(1.0, self.unknown + self.rest + self.p[1:].sum())) if len(self.p) else 1.0


def nothing() -> Posterior:
    """Before anything is known."""
    return Posterior(
        pose=np.zeros((0, 3)),
        p=np.zeros(0),
        unknown=1.0,
        alike=0.0,
        rest=0.0,
        tree=np.zeros((0, 0), np.int64),
        scale=np.zeros(0),
        log=np.zeros(0),
    )


def describe(submap: Submap, index: MapIndex, config: LocalizeConfig) -> tuple[Landmarks, NDArray[np.int64]]:
    """The landmarks to search with, and their rows in the submap's filter."""
    f, c, v = submap.filter, config, submap.visibility
    rows = np.arange(f.n)
    if f.n > c.landmarks:
        rows = np.sort(
            np.argsort(-(np.minimum(f.hits, 4.0) + 2.0 * f.hits / f.looks) + 0.02 * (f.run - f.seen))[: c.landmarks]
        )
    hits, looks = f.hits[rows], np.maximum(f.looks[rows], f.hits[rows])
    seen = _beta_binomial(hits, looks, 3.0 * 0.75, 3.0 * 0.25)
    passing = v.clutter(c.view) * np.maximum(looks, 1.0) * 0.05 ** (hits - 1)
    other = np.log(c.new * index.density * np.exp(seen) + passing)
    tree = seen
    lasting = np.exp(tree) * index.density / (np.exp(tree) * index.density + np.exp(other))
    block = (3 + 2 * rows[:, None] + np.arange(2)).ravel()
    cov = f.cov[np.ix_(block, block)]
    m = f.landmarks[rows]
    weight = f.weight[rows]
    diameter = np.where(weight > 0, f.diameter[rows], np.nan)
    d_var = 1.0 / np.maximum(weight, 1e-9) + c.diameter_sigma**2
    return Landmarks(
        m=m, cov=cov, var=spread(m, cov), diameter=diameter, diameter_var=d_var, tree=tree, other=other, lasting=lasting
    ), rows


def _beta_binomial(hits: Array, looks: Array, a: float, b: float) -> Array:
    """Log chance of `hits` in `looks` given at least one, with a chance of detection drawn from Beta(a, b)."""
    from scipy.special import betaln, gammaln

    def log_p(h: Array) -> Array:
        choose = gammaln(looks + 1) - gammaln(h + 1) - gammaln(looks - h + 1)
        return np.asarray(choose + betaln(h + a, looks - h + b) - betaln(a, b))

    return log_p(hits) - np.log1p(-np.exp(np.minimum(log_p(np.zeros_like(hits)), -1e-6)))


def weigh(found: Found, marks: Landmarks, submap: Submap, index: MapIndex, config: LocalizeConfig) -> Posterior:
    """Posterior over placements that a search found (or an earlier posterior held)."""
    c = config
    if not len(found.pose) or len(marks) < 2:
        return nothing()
    placed = placements(found.pose, marks, submap.raster, submap.origin, index, c.places)
    if not len(placed):
        return nothing()
    log = placed.log + np.log(1.0 - c.unknown - c.alike) - np.log(index.area * 2 * np.pi)
    # Trees at random, with the density of the map where the submap looked.
    seen = chance_kernel(submap.raster, c.felled)
    at = np.clip((marks.m - submap.origin).astype(int), 0, np.array(submap.raster.shape) - 1)
    here = np.maximum(seen[at[:, 0], at[:, 1]], 0.02)
    random = float(np.sum(np.logaddexp(marks.tree + np.log(index.density * here), marks.other)))
    random -= index.density * float(seen.sum())
    # Another orchard of this design: any of its placements would do, so its prior is spread over one cell of the lattice.
    design = placed.alike - np.log(np.pi / (2.0 * index.density))
    # Looking again and again finds a lucky fit sooner or later: the longer nothing was sure, the more is asked.
    alike_prior = c.alike * max(1.0, submap.filter.run / LOOKS_EVERY)
    design += np.log(alike_prior)
    unknown = np.logaddexp(np.log(c.unknown) + random, design)
    rest = (np.log(found.rest) + log.min()) if found.rest > 0 else -np.inf
    dropped = np.log(max(found.seeds, 1)) - c.bound + log.max()
    rest = np.logaddexp(rest, dropped)
    total = np.logaddexp(np.logaddexp.reduce(log), np.logaddexp(unknown, rest))
    return Posterior(
        pose=placed.pose,
        p=np.exp(log - total),
        unknown=float(np.exp(unknown - total)),
        alike=float(np.exp(design - total)),
        rest=float(np.exp(rest - total)),
        tree=placed.tree,
        scale=placed.scale,
        log=log,
    )
