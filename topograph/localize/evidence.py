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
from numba import njit
from numpy.typing import NDArray

from topograph.geometry import Array
from topograph.localize.config import LocalizeConfig
from topograph.localize.index import MapIndex
from topograph.localize.search import Found, Landmarks, _diameter, spread
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
    arguments = (
        marks.m, marks.cov, marks.tree, marks.other, marks.diameter, marks.diameter_var, marks.var, index.xy, index.var,
        index.diameter, index.diameter_mean, index.diameter_sd, index.origin, index.cell, index.nearest, index.bucket,
        index.buckets, index.start, index.member, submap.raster, submap.origin, c.felled, c.map_sigma**2,
    )  # fmt: skip
    log, pose, tree, scale, alike = _evidence(found.pose, *arguments, index.trust, 2.0 * index.jitter**2, scales, prior)
    order = np.argsort(-log)
    order = order[np.isfinite(log[order])]
    order = order[_unlike(pose[order], marks.m.mean(0))]
    if not len(order):
        return nothing()
    log, pose, tree, scale = log[order], pose[order], tree[order], scale[order]
    flat = np.log(1.0 - c.unknown - c.alike) - np.log(index.area * 2 * np.pi)
    placed = log + flat
    # Trees at random, with the density of the map where the submap looked.
    seen = _chance(submap.raster, c.felled)
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


@njit(cache=True)
def _unlike(pose, centre):
    """Rows of placements that differ from all better ones."""
    kept = np.empty(len(pose), np.int64)
    n = 0
    for i in range(len(pose)):
        new = True
        for q in range(n):
            k = kept[q]
            turn = abs((pose[i, 2] - pose[k, 2] + np.pi) % (2 * np.pi) - np.pi)
            if turn < 0.06:
                ci, si, ck, sk = np.cos(pose[i, 2]), np.sin(pose[i, 2]), np.cos(pose[k, 2]), np.sin(pose[k, 2])
                dx = pose[i, 0] - pose[k, 0] + (ci - ck) * centre[0] - (si - sk) * centre[1]
                dy = pose[i, 1] - pose[k, 1] + (si - sk) * centre[0] + (ci - ck) * centre[1]
                if dx * dx + dy * dy < 0.25:
                    new = False
                    break
        if new:
            kept[n] = i
            n += 1
    return kept[:n].copy()


@njit(cache=True)
def _chance(raster, felled):
    """Chance (X, Y) that a mapped tree in each cell would have been seen."""
    return (1.0 - felled) * (1.0 - np.exp(-raster))


@njit(cache=True)
def _match(
    c, s, x, y, m, var, tree, other, dia, dia_var, xy, tvar, tdia, dmean, dsd, origin, cell, nearest, base, seen, so
):
    """Mapped tree of each landmark under one placement; each tree once."""
    n = len(m)
    out = np.full(n, -1, np.int64)
    cost = np.zeros(n)
    for k in range(n):
        px, py = x + c * m[k, 0] - s * m[k, 1], y + s * m[k, 0] + c * m[k, 1]
        gx, gy = int((px - origin[0]) / cell), int((py - origin[1]) / cell)
        if px <= origin[0] or py <= origin[1] or gx >= nearest.shape[0] or gy >= nearest.shape[1]:
            continue
        t = nearest[gx, gy]
        if t < 0:
            continue
        V = var[k] + base + tvar[t]
        d2 = (xy[t, 0] - px) ** 2 + (xy[t, 1] - py) ** 2
        i, j = int(m[k, 0] - so[0]), int(m[k, 1] - so[1])
        chance = 0.02
        if 0 <= i < seen.shape[0] and 0 <= j < seen.shape[1]:
            chance = max(chance, seen[i, j])
        # Being missed is what the tree would pay otherwise.
        good = tree[k] + np.log(chance / (1.0 - chance)) - 3.0 * np.log(1.0 + d2 / (4.0 * V)) - np.log(2 * np.pi * V)
        good -= _diameter(dia[k], dia_var[k], tdia[t], dmean, dsd)
        good -= other[k]
        if good <= 0.0:
            continue
        clash = -1
        for q in range(k):
            if out[q] == t:
                clash = q
        if clash >= 0:
            if cost[clash] >= good:
                continue
            out[clash] = -1
        out[k] = t
        cost[k] = good
    return out


@njit(cache=True)
def _evidence(
    poses, m, P, tree, other, dia, dia_var, var, xy, tvar, tdia, dmean, dsd, origin, cell, nearest, bucket, buckets, start,
    member, raster, so, felled, base, trust, wild, scales, prior,
):  # fmt: skip
    n, M = len(m), len(poses)
    log = np.full(M, -np.inf)
    alike = np.full(M, -np.inf)
    out = poses.copy()
    trees = np.full((M, n), -1, np.int64)
    scale = np.ones(M)
    seen = _chance(raster, felled)
    centre = np.array([so[0] + 0.5 * raster.shape[0], so[1] + 0.5 * raster.shape[1]])
    reach = 0.5 * np.sqrt(float(raster.shape[0] ** 2 + raster.shape[1] ** 2))
    best = -np.inf
    for h in range(M):
        x, y, yaw = poses[h, 0], poses[h, 1], poses[h, 2]
        ids = np.full(n, -1, np.int64)
        k = 0
        q, logdet = 0.0, 0.0
        L = np.zeros((3, 3))
        ok = True
        for turn in range(3):
            c, s = np.cos(yaw), np.sin(yaw)
            new = _match(
                c,
                s,
                x,
                y,
                m,
                var,
                tree,
                other,
                dia,
                dia_var,
                xy,
                tvar,
                tdia,
                dmean,
                dsd,
                origin,
                cell,
                nearest,
                base,
                seen,
                so,
            )
            if turn == 2 and np.all(new == ids):
                break
            ids = new
            rows = np.flatnonzero(ids >= 0)
            k = len(rows)
            if k < 2:
                ok = False
                break
            x, y, yaw, q, logdet, L = _align(rows, ids, m, P, xy, tvar, base, 0.0, 1.0, x, y, yaw)
        if not ok:
            continue
        fixed = 0.0
        for i in range(n):
            if ids[i] < 0:
                fixed += other[i]
            else:
                fixed += tree[i] - _diameter(dia[i], dia_var[i], tdia[ids[i]], dmean, dsd)
        fixed += _views(x, y, yaw, ids, xy, origin, bucket, buckets, start, member, seen, so, centre, reach)
        top = -np.inf
        total = 0.0
        dof = 2 * k - 3
        half = -0.5 * logdet - 0.5 * np.linalg.slogdet(L)[1] + (1.5 - k) * np.log(2 * np.pi)
        for a in range(len(scales)):
            value = half - 0.5 * trust * q / scales[a] ** 2 - dof * np.log(scales[a]) + prior[a]
            if value > top:
                top = value
                scale[h] = scales[a]
        for a in range(len(scales)):
            total += np.exp(half - 0.5 * trust * q / scales[a] ** 2 - dof * np.log(scales[a]) + prior[a] - top)
        log[h] = fixed + top + np.log(total)
        out[h, 0], out[h, 1], out[h, 2] = x, y, yaw
        trees[h] = ids
        if log[h] > best:
            best = log[h]
        if log[h] > best - 6.0:
            # The same trees planted anew: their residuals are larger by both orchards' planting errors.
            for a in range(len(scales)):
                _, _, _, qa, la, La = _align(rows, ids, m, P, xy, tvar, base, wild, scales[a] ** 2, x, y, yaw)
                anew = (
                    fixed - 0.5 * trust * qa - 0.5 * la - 0.5 * np.linalg.slogdet(La)[1] + (1.5 - k) * np.log(2 * np.pi)
                )
                alike[h] = np.logaddexp(alike[h], anew - np.log(len(scales)))
    return log, out, trees, scale, alike


@njit(cache=True)
def _align(rows, ids, m, P, xy, tvar, base, wild, noise, x, y, yaw):
    """Least squares of a placement with the joint covariance: pose, chi-square, log |S|, information (3, 3)."""
    k = len(rows)
    S = np.empty((2 * k, 2 * k))
    c, s = np.cos(yaw), np.sin(yaw)
    J = np.zeros((2 * k, 4))
    for a in range(k):
        i = rows[a]
        for b in range(k):
            j = rows[b]
            for u in range(2):
                for v in range(2):
                    S[2 * a + u, 2 * b + v] = noise * P[2 * i + u, 2 * j + v]
        S[2 * a, 2 * a] += noise * (base + tvar[ids[i]]) + wild
        S[2 * a + 1, 2 * a + 1] += noise * (base + tvar[ids[i]]) + wild
        # Residuals in the submap's frame, where the covariance is: R^T (tree - t) - m.
        ex, ey = xy[ids[i], 0] - x, xy[ids[i], 1] - y
        px, py = c * ex + s * ey, -s * ex + c * ey
        J[2 * a, 0], J[2 * a + 1, 1] = 1.0, 1.0
        J[2 * a, 2], J[2 * a + 1, 2] = -py, px  # turning the map's piece about the submap's origin
        J[2 * a, 3], J[2 * a + 1, 3] = px - m[i, 0], py - m[i, 1]
    C = np.linalg.cholesky(S)
    W = _forward(C, J)
    A, g, q = np.zeros((3, 3)), np.zeros(3), 0.0
    for a in range(2 * k):
        for u in range(3):
            g[u] += W[a, u] * W[a, 3]
            for v in range(3):
                A[u, v] += W[a, u] * W[a, v]
        q += W[a, 3] * W[a, 3]
    d = np.linalg.solve(A, -g)
    q += g[0] * d[0] + g[1] * d[1] + g[2] * d[2]
    logdet = 0.0
    for a in range(2 * k):
        logdet += 2.0 * np.log(C[a, a])
    # d shifts and turns the map's piece in the submap's frame: the placement moves the other way.
    t = yaw - d[2]
    ct, st = np.cos(t), np.sin(t)
    x2 = x - (ct * d[0] - st * d[1])
    y2 = y - (st * d[0] + ct * d[1])
    return x2, y2, t, q, logdet, A


@njit(cache=True)
def _forward(C, B):
    """Solve C X = B for a lower triangular C."""
    X = B.copy()
    for i in range(C.shape[0]):
        for j in range(i):
            if C[i, j] != 0.0:
                for u in range(B.shape[1]):
                    X[i, u] -= C[i, j] * X[j, u]
        for u in range(B.shape[1]):
            X[i, u] /= C[i, i]
    return X


@njit(cache=True)
def _views(x, y, yaw, ids, xy, origin, bucket, buckets, start, member, seen, so, centre, reach):
    """Log chance of the mapped trees in view to have been seen or missed as they were."""
    c, s = np.cos(yaw), np.sin(yaw)
    cx, cy = x + c * centre[0] - s * centre[1], y + s * centre[0] + c * centre[1]
    total = 0.0
    x0, x1 = (
        int(max(0.0, (cx - reach - origin[0]) / bucket)),
        int(min(buckets[0] - 1.0, (cx + reach - origin[0]) / bucket)),
    )
    y0, y1 = (
        int(max(0.0, (cy - reach - origin[1]) / bucket)),
        int(min(buckets[1] - 1.0, (cy + reach - origin[1]) / bucket)),
    )
    for bx in range(x0, x1 + 1):
        for by in range(y0, y1 + 1):
            at = bx * buckets[1] + by
            for q in range(start[at], start[at + 1]):
                t = member[q]
                ex, ey = xy[t, 0] - x, xy[t, 1] - y
                i, j = int(c * ex + s * ey - so[0]), int(-s * ex + c * ey - so[1])
                if 0 <= i < seen.shape[0] and 0 <= j < seen.shape[1] and seen[i, j] > 0.0:
                    total += np.log(1.0 - seen[i, j])
    for k in range(len(ids)):
        t = ids[k]
        if t < 0:
            continue
        ex, ey = xy[t, 0] - x, xy[t, 1] - y
        i, j = int(c * ex + s * ey - so[0]), int(-s * ex + c * ey - so[1])
        chance = 0.0
        if 0 <= i < seen.shape[0] and 0 <= j < seen.shape[1]:
            chance = seen[i, j]
        total += np.log(max(chance, 0.02)) - (np.log(1.0 - chance) if chance > 0.0 else 0.0)
    return total
