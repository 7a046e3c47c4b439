"""Evidence of placements, compiled. numba types the arguments by itself."""

from __future__ import annotations

import numpy as np
from numba import njit

from topograph.compiled import determinant3, quantile, solve3
from topograph.places.search_kernels import diameter_kernel


@njit(cache=True, error_model="numpy")
def unlike_kernel(pose, centre):
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


@njit(cache=True, error_model="numpy")
def chance_kernel(raster, felled):
    """Chance (X, Y) that a mapped tree in each cell would have been seen."""
    return (1.0 - felled) * (1.0 - np.exp(-raster))


@njit(cache=True, error_model="numpy")
def match_kernel(c, s, x, y, marks, trees, base, seen, so):
    """Mapped tree of each landmark under one placement; each tree once."""
    m, var, tree, other, dia, dia_var = marks.m, marks.var, marks.tree, marks.other, marks.diameter, marks.diameter_var
    xy, tvar, tdia, dmean, dsd = trees.xy, trees.var, trees.diameter, trees.diameter_mean, trees.diameter_sd
    origin, cell, nearest = trees.origin, trees.cell, trees.nearest
    n = len(m)
    out = np.full(n, -1, np.int64)
    cost = np.zeros(n)
    for k in range(n):
        px, py = x + c * m[k, 0] - s * m[k, 1], y + s * m[k, 0] + c * m[k, 1]
        gx, gy = int((px - origin[0]) / cell), int((py - origin[1]) / cell)
        if not (px > origin[0] and py > origin[1]) or gx >= nearest.shape[0] or gy >= nearest.shape[1]:
            continue  # outside, or no number
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
        good -= diameter_kernel(dia[k], dia_var[k], tdia[t], dmean, dsd)
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


@njit(cache=True, error_model="numpy")
def evidence_kernel(poses, marks, P, trees, grid, raster, so, felled, base, trust, wild, scales, prior):
    """Of each placement (M, 3): log evidence (M,), the placement aligned (M, 3), its information
    (M, 3, 3), mapped tree (M, n) of each landmark, noise scale (M,), and
    the log evidence (M,) of an orchard of the same design. `P` (2n, 2n) is the landmarks' covariance; see evidence.py.
    """
    m, xy, tvar = marks.m, trees.xy, trees.var
    n, M = len(m), len(poses)
    log = np.full(M, -np.inf)
    alike = np.full(M, -np.inf)
    out = poses.copy()
    matched = np.full((M, n), -1, np.int64)
    information = np.zeros((M, 3, 3))
    scale = np.ones(M)
    seen = chance_kernel(raster, felled)
    centre = np.array([so[0] + 0.5 * raster.shape[0], so[1] + 0.5 * raster.shape[1]])
    reach = 0.5 * np.sqrt(float(raster.shape[0] ** 2 + raster.shape[1] ** 2))
    best = -np.inf
    for h in range(M):
        x, y, yaw = poses[h, 0], poses[h, 1], poses[h, 2]
        ids, rows = np.full(n, -1, np.int64), np.empty(n, np.int64)
        k = 0
        q, logdet = 0.0, 0.0
        L = np.zeros((3, 3))
        ok = True
        for turn in range(3):
            c, s = np.cos(yaw), np.sin(yaw)
            new = match_kernel(c, s, x, y, marks, trees, base, seen, so)
            changed, k = False, 0
            for i in range(n):
                changed = changed or new[i] != ids[i]
                if new[i] >= 0:
                    rows[k] = i
                    k += 1
            if turn == 2 and not changed:
                break
            ids = new
            if k < 2:
                ok = False
                break
            x, y, yaw, q, logdet, L = align_kernel(rows[:k], ids, m, P, xy, tvar, base, 0.0, 1.0, x, y, yaw)
        if not ok or not np.isfinite(yaw):  # two trees at one place fix no heading
            continue
        # An orchard of the same design may explain what this one cannot: a tree that was planted anew aside.
        aside = marks.other.copy()
        anew_rows, anew_ids, anew_pose = rows[:k].copy(), ids.copy(), (x, y, yaw)
        for _ in range(PARTINGS):  # what is far off has pulled the placement towards itself
            left = part_kernel(anew_rows, anew_ids, rows, ids, aside, x, y, yaw, marks, trees, base, trust, seen, so)
            if left == k:
                break
            k = left
            x, y, yaw, q, logdet, L = align_kernel(rows[:k], ids, m, P, xy, tvar, base, 0.0, 1.0, x, y, yaw)
        fixed = fixed_kernel(x, y, yaw, ids, aside, marks, trees, grid, seen, so, centre, reach)
        top = -np.inf
        total = 0.0
        dof = 2 * k - 3
        half = -0.5 * logdet - 0.5 * np.log(determinant3(L)) + (1.5 - k) * np.log(2 * np.pi)
        for a in range(len(scales)):
            value = half - 0.5 * trust * q / scales[a] ** 2 - dof * np.log(scales[a]) + prior[a]
            if value > top:
                top = value
                scale[h] = scales[a]
        for a in range(len(scales)):
            total += np.exp(half - 0.5 * trust * q / scales[a] ** 2 - dof * np.log(scales[a]) + prior[a] - top)
        log[h] = fixed + top + np.log(total)
        out[h, 0], out[h, 1], out[h, 2] = x, y, yaw
        information[h] = L
        for i in range(n):
            matched[h, i] = ids[i]
        if log[h] > best:
            best = log[h]
        if log[h] > best - 6.0:
            # The same trees planted anew: their residuals are larger by both orchards' planting errors.
            xa, ya, yawa = anew_pose
            ka = len(anew_rows)
            whole = fixed
            if ka > k:
                whole = fixed_kernel(xa, ya, yawa, anew_ids, marks.other, marks, trees, grid, seen, so, centre, reach)
            for a in range(len(scales)):
                _, _, _, qa, la, La = align_kernel(
                    anew_rows, anew_ids, m, P, xy, tvar, base, wild, scales[a] ** 2, xa, ya, yawa
                )
                anew = (
                    whole
                    - 0.5 * trust * qa
                    - 0.5 * la
                    - 0.5 * np.log(determinant3(La))
                    + (1.5 - ka) * np.log(2 * np.pi)
                )
                alike[h] = np.logaddexp(alike[h], anew - np.log(len(scales)))
    return log, out, information, matched, scale, alike


OFF, LEAST = 13.8, 3
"""Squared deviations, about the usual ones of the placement, from which a landmark may be no sighting of its tree, and landmarks that stay matched."""
REPLACED, BESIDE = 0.5, 0.3
"""Share of felled trees that are replaced, and how far from the stump per axis, m."""
PARTINGS = 4
"""Times that they are parted and the placement is aligned without them."""


@njit(cache=True, error_model="numpy")
def part_kernel(matched, tree_of, rows, ids, aside, x, y, yaw, marks, trees, base, trust, seen, so):
    """Of the `matched` landmarks (K,) and the trees `tree_of` (n,) of all, those that lie so far from their trees that they are something else, and the
    trees were missed: a felled tree, and another planted beside its stump. The number of those that stay, which fill `rows`; `ids` (n,)
    are the trees of all, -1 of what was parted, and `aside` (n,) what each costs as something else: of what was parted, as planted beside.
    """
    k = len(matched)
    m, var, tree, other = marks.m, marks.var, marks.tree, marks.other
    xy, tvar = trees.xy, trees.var
    c, s = np.cos(yaw), np.sin(yaw)
    off, d2 = np.empty(k), np.empty(k)
    ids[:], aside[:] = tree_of, other
    for a in range(k):
        i = matched[a]
        ex = xy[ids[i], 0] - x - c * m[i, 0] + s * m[i, 1]
        ey = xy[ids[i], 1] - y - s * m[i, 0] - c * m[i, 1]
        d2[a] = ex * ex + ey * ey
        off[a] = d2[a] / (var[i] + base + tvar[ids[i]])
    usual = max(quantile(off, 0.5) / 1.386, 1.0)  # the median of a chi-square with two degrees of freedom
    left, n = k, 0
    for a in range(k):
        i = matched[a]
        rows[n] = i
        n += 1
        if off[a] < OFF * usual or left <= LEAST:
            continue
        V = usual * (var[i] + base + tvar[ids[i]])
        u, v = int(m[i, 0] - so[0]), int(m[i, 1] - so[1])
        chance = 0.02
        if 0 <= u < seen.shape[0] and 0 <= v < seen.shape[1]:
            chance = max(chance, seen[u, v])
        good = tree[i] + np.log(chance / (1.0 - chance)) - 0.5 * trust * off[a] / usual - np.log(2 * np.pi * V)
        good -= diameter_kernel(
            marks.diameter[i], marks.diameter_var[i], trees.diameter[ids[i]], trees.diameter_mean, trees.diameter_sd
        )
        planted = tree[i] + np.log(REPLACED) - 0.5 * d2[a] / (V + BESIDE**2) - np.log(2 * np.pi * (V + BESIDE**2))
        planted = np.logaddexp(other[i], planted)
        if good < planted:
            ids[i], aside[i] = -1, planted
            left -= 1
            n -= 1
    return n


@njit(cache=True, error_model="numpy")
def fixed_kernel(x, y, yaw, ids, other, marks, trees, grid, seen, so, centre, reach):
    """Log chance of what is a tree and what is something else, `other` (n,), and of the trees in view to have been seen or missed."""
    total = 0.0
    for i in range(len(ids)):
        if ids[i] < 0:
            total += other[i]
        else:
            total += marks.tree[i] - diameter_kernel(
                marks.diameter[i], marks.diameter_var[i], trees.diameter[ids[i]], trees.diameter_mean, trees.diameter_sd
            )
    return total + views_kernel(x, y, yaw, ids, trees.xy, grid, seen, so, centre, reach)


@njit(cache=True, error_model="numpy")
def align_kernel(rows, ids, m, P, xy, tvar, base, wild, noise, x, y, yaw):
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
    W = forward_kernel(C, J)
    A, g, q = np.zeros((3, 3)), np.zeros(3), 0.0
    for a in range(2 * k):
        for u in range(3):
            g[u] += W[a, u] * W[a, 3]
            for v in range(3):
                A[u, v] += W[a, u] * W[a, v]
        q += W[a, 3] * W[a, 3]
    d = solve3(A, -g)
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


@njit(cache=True, error_model="numpy")
def forward_kernel(C, B):
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


@njit(cache=True, error_model="numpy")
def views_kernel(x, y, yaw, ids, xy, grid, seen, so, centre, reach):
    """Log chance of the mapped trees in view to have been seen or missed as they were."""
    origin, bucket, buckets, start, member = grid.origin, grid.bucket, grid.buckets, grid.start, grid.member
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
