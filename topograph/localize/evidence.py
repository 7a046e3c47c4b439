"""How probable a placement of the submap is: closed-form evidence with the full joint covariance.

A placement explains each landmark as a mapped tree (density around it, chance of having been seen, diameter) or as
something else (a density over the plane), and each mapped tree in view that was not seen as missed. The three degrees of
freedom of the placement are integrated out (Laplace); the common noise scale is marginalised over a few values.

Two further hypotheses stand beside the placements: "not on this map" (trees at random), and "another orchard of the same
design" (trees near the map's lattice, but off by a planting error of their own).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from topograph.geometry import Array
from topograph.localize.config import LocalizeConfig
from topograph.localize.evidence_kernels import chance_kernel, evidence_kernel, unlike_kernel
from topograph.localize.index import MapIndex
from topograph.localize.search import Found, Landmarks, spread
from topograph.localize.submap import Submap

LOOKS_EVERY = 2.0
"""Metres after which a further look counts as a new trial for the prior of another orchard."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Posterior:
    """Over placements of the submap; probabilities sum to one together with `unknown` and `rest`.

    Attributes:
        pose: (M, 3) x, y, yaw of the submap's frame in the map, falling probability.
        p: (M,) probabilities; `unknown`: not on this map; `rest`: placements that were dropped or not evaluated.
        tree: (M, n) mapped tree of each landmark, -1 none.
        scale: (M,) most probable noise scale.
        log: (M,) log evidence, to compare with the same submap later.
    """

    pose: Array
    p: Array
    unknown: float
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
    n = len(marks)
    if not len(found.pose) or n < 2:
        return nothing()
    scales, prior = np.array(c.scales), np.log(np.array(c.scale_prior) / np.sum(c.scale_prior))
    log, pose, tree, scale, alike = evidence_kernel(
        found.pose, marks.bundle, marks.cov, index.trees, index.grid, submap.raster, submap.origin, c.felled, c.map_sigma**2,
        index.trust, 2.0 * index.jitter**2, scales, prior,
    )  # fmt: skip
    order = np.argsort(-log)
    order = order[np.isfinite(log[order])]
    order = order[unlike_kernel(pose[order], marks.m.mean(0))]
    if not len(order):
        return nothing()
    log, pose, tree, scale = log[order], pose[order], tree[order], scale[order]
    flat = np.log(1.0 - c.unknown - c.alike) - np.log(index.area * 2 * np.pi)
    placed = log + flat
    # Trees at random, with the density of the map where the submap looked.
    seen = chance_kernel(submap.raster, c.felled)
    at = np.clip((marks.m - submap.origin).astype(int), 0, np.array(submap.raster.shape) - 1)
    here = np.maximum(seen[at[:, 0], at[:, 1]], 0.02)
    random = float(np.sum(np.logaddexp(marks.tree + np.log(index.density * here), marks.other)))
    random -= index.density * float(seen.sum())
    # Another orchard of this design: any of its placements would do, so its prior is spread over one cell of the lattice.
    design = float(alike[np.isfinite(alike)].max(initial=-np.inf)) - np.log(np.pi / (2.0 * index.density))
    # Looking again and again finds a lucky fit sooner or later: the longer nothing was sure, the more is asked.
    alike_prior = c.alike * max(1.0, submap.filter.run / LOOKS_EVERY)
    unknown = np.logaddexp(np.log(c.unknown) + random, np.log(alike_prior) + design)
    rest = (np.log(found.rest) + placed.min()) if found.rest > 0 else -np.inf
    dropped = np.log(max(found.seeds, 1)) - c.bound + placed.max()
    rest = np.logaddexp(rest, dropped)
    total = np.logaddexp(np.logaddexp.reduce(placed), np.logaddexp(unknown, rest))
    return Posterior(
        pose=pose,
        p=np.exp(placed - total),
        unknown=float(np.exp(unknown - total)),
        rest=float(np.exp(rest - total)),
        tree=tree,
        scale=scale,
        log=placed,
    )
