"""The search for placements, compiled. numba types the arguments by itself."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from topograph.geometry import Array


class Marks(NamedTuple):
    """Landmarks as kernels take them: see `search.Landmarks`; each (n,), `m` (n, 2)."""

    m: Array
    var: Array
    diameter: Array
    diameter_var: Array
    tree: Array
    other: Array


class Prior(NamedTuple):
    """What is known beforehand of where the landmarks' frame lies: `at` (3,) x, y, yaw, covariance `cov` (2, 2) of the place, m², deviation
    `yaw_sigma` of the yaw, rad; from 1e9 on: nothing is known, of the place neither."""

    at: Array
    cov: Array
    yaw_sigma: float


class Trees(NamedTuple):
    """The map's trees and the raster that finds the nearest: see `index.MapIndex`."""

    xy: Array
    var: Array
    diameter: Array
    diameter_mean: float
    diameter_sd: float
    origin: Array
    cell: float
    nearest: NDArray[np.int32]


class Grid(NamedTuple):
    """Coarse cells and the trees in them: see `index.MapIndex`."""

    origin: Array
    bucket: float
    buckets: NDArray[np.int64]
    start: NDArray[np.int32]
    member: NDArray[np.int32]


@njit(cache=True, error_model="numpy")
def fill_kernel(nearest, xy, low, cell, reach):
    best = np.full(nearest.shape, 1e18, np.float32)
    for t in range(len(xy)):
        cx = int((xy[t, 0] - low[0]) / cell)
        cy = int((xy[t, 1] - low[1]) / cell)
        for i in range(max(cx - reach, 0), min(cx + reach + 1, nearest.shape[0])):
            for j in range(max(cy - reach, 0), min(cy + reach + 1, nearest.shape[1])):
                dx = low[0] + (i + 0.5) * cell - xy[t, 0]
                dy = low[1] + (j + 0.5) * cell - xy[t, 1]
                d = dx * dx + dy * dy
                if d < best[i, j]:
                    best[i, j] = d
                    nearest[i, j] = t


@njit(cache=True, error_model="numpy", fastmath=True)
def seed_kernel(marks, order, pa, pb, trees, best, bound, map_sigma, prior):
    """Placements (K, 3) by the pairs of trees `pa`, `pb` as far apart as the first two landmarks in `order`, their losses (K,), and the
    best loss so far; dropped when `bound` behind it. `marks.other` is what a landmark costs that is no mapped tree.
    A `prior` adds what the distance from it costs; where a pair alone tells the pose badly, it costs the less.
    """
    m, var, other, dia, dia_var = marks.m, marks.var, marks.other, marks.diameter, marks.diameter_var
    xy, tvar, tdia, dmean, dsd = trees.xy, trees.var, trees.diameter, trees.diameter_mean, trees.diameter_sd
    origin, cell, nearest = trees.origin, trees.cell, trees.nearest
    n = len(m)
    out = np.empty((1024, 3))
    losses = np.empty(1024)
    count = 0
    i, j = order[0], order[1]
    base = map_sigma * map_sigma
    near = prior.yaw_sigma < 1e9
    volume = np.empty(n)
    floor = np.empty(n)  # the least that a landmark can cost: then a running loss only rises
    for q in range(n):
        volume[q] = np.log(2 * np.pi * (var[q] + base))
        floor[q] = min(-other[q], volume[q])
    ex, ey = m[j, 0] - m[i, 0], m[j, 1] - m[i, 1]
    for s in range(2 * len(pa)):
        if s % 2 == 0:
            a, b = pa[s // 2], pb[s // 2]
        else:
            b, a = pa[s // 2], pb[s // 2]
        # Weighted means and moments of the matches so far (Horn's closed form in the plane).
        wi, wj = 1.0 / (var[i] + base + tvar[a]), 1.0 / (var[j] + base + tvar[b])
        W = wi + wj
        mx, my = (wi * m[i, 0] + wj * m[j, 0]) / W, (wi * m[i, 1] + wj * m[j, 1]) / W
        tx, ty = (wi * xy[a, 0] + wj * xy[b, 0]) / W, (wi * xy[a, 1] + wj * xy[b, 1]) / W
        fx, fy = xy[b, 0] - xy[a, 0], xy[b, 1] - xy[a, 1]
        w2 = wi * wj / W
        dot, cross = w2 * (ex * fx + ey * fy), w2 * (ex * fy - ey * fx)
        inertia = w2 * (ex * ex + ey * ey)
        h = np.sqrt(dot * dot + cross * cross)
        c, sn = dot / h, cross / h
        loss = diameter_kernel(dia[i], dia_var[i], tdia[a], dmean, dsd) + diameter_kernel(
            dia[j], dia_var[j], tdia[b], dmean, dsd
        )
        gap = np.sqrt(fx * fx + fy * fy) - np.sqrt(ex * ex + ey * ey)
        loss += 3.0 * np.log(1.0 + gap * gap * w2 / 4.0)
        loss += volume[i] - floor[i] + volume[j] - floor[j]
        away = 0.0
        if near:
            away = away_kernel(prior, tx - c * mx + sn * my, ty - sn * mx - c * my, c, sn, mx, my, W, inertia)
            loss += away
            if loss > best + bound:
                continue
        u0, u1 = a, b
        for o in range(2, n):
            k = order[o]
            rx, ry = m[k, 0] - mx, m[k, 1] - my
            px, py = tx + c * rx - sn * ry, ty + sn * rx + c * ry
            gx, gy = int((px - origin[0]) / cell), int((py - origin[1]) / cell)
            t = -1
            if px > origin[0] and py > origin[1] and gx < nearest.shape[0] and gy < nearest.shape[1]:
                t = nearest[gx, gy]
            cost = -other[k]
            hit = False
            if t >= 0 and t != u0 and t != u1:
                vx, vy = xy[t, 0] - px, xy[t, 1] - py
                own = var[k] + base + tvar[t]
                V = own + 1.0 / W + (rx * rx + ry * ry) / inertia
                d2 = vx * vx + vy * vy
                # ln of (own / (own - tvar)) to first order
                matched = 3.0 * np.log(1.0 + d2 / (4.0 * V)) + volume[k] + tvar[t] / own
                matched += diameter_kernel(dia[k], dia_var[k], tdia[t], dmean, dsd)
                if matched < cost:
                    cost = matched
                    hit = d2 < 16.0 * V
            loss += cost - floor[k]
            if loss > best + bound:
                break
            if hit:
                w = 1.0 / own
                f = W * w / (W + w)
                qx, qy = xy[t, 0] - tx, xy[t, 1] - ty
                dot += f * (rx * qx + ry * qy)
                cross += f * (rx * qy - ry * qx)
                inertia += f * (rx * rx + ry * ry)
                W += w
                mx += rx * w / W
                my += ry * w / W
                tx += qx * w / W
                ty += qy * w / W
                h = np.sqrt(dot * dot + cross * cross)
                c, sn = dot / h, cross / h
        if near:
            loss += away_kernel(prior, tx - c * mx + sn * my, ty - sn * mx - c * my, c, sn, mx, my, W, inertia) - away
        if loss > best + bound:
            continue
        if loss < best:
            best = loss
        if count == len(out):
            keep = 0
            for q in range(count):
                if losses[q] < best + bound:
                    out[keep, 0], out[keep, 1], out[keep, 2] = out[q, 0], out[q, 1], out[q, 2]
                    losses[keep] = losses[q]
                    keep += 1
            count = keep
            if 2 * keep > len(out):
                more, more_losses = np.empty((2 * len(out), 3)), np.empty(2 * len(out))
                for q in range(count):
                    more[q, 0], more[q, 1], more[q, 2] = out[q, 0], out[q, 1], out[q, 2]
                    more_losses[q] = losses[q]
                out, losses = more, more_losses
        out[count, 0] = tx - c * mx + sn * my
        out[count, 1] = ty - sn * mx - c * my
        out[count, 2] = np.arctan2(sn, c)
        losses[count] = loss
        count += 1
    return out[:count].copy(), losses[:count].copy(), best


@njit(cache=True, error_model="numpy")
def away_kernel(prior, x, y, c, s, mx, my, W, inertia):
    """What a placement (x, y; cosine and sine of its yaw) costs by its distance from the prior. It is known to 1/W about the mean (mx, my) of its
    landmarks and to 1/inertia in yaw."""
    turn = 1.0 / inertia
    own = 1.0 / W + (mx * mx + my * my) * turn
    xx, yy, xy = prior.cov[0, 0] + own, prior.cov[1, 1] + own, prior.cov[0, 1]
    dx, dy = x - prior.at[0], y - prior.at[1]
    ca, sa = np.cos(prior.at[2]), np.sin(prior.at[2])
    d = np.arctan2(s * ca - c * sa, c * ca + s * sa)
    place = (yy * dx * dx - 2.0 * xy * dx * dy + xx * dy * dy) / (xx * yy - xy * xy)
    return 0.5 * place + 0.5 * d * d / (prior.yaw_sigma * prior.yaw_sigma + turn)


@njit(cache=True, error_model="numpy")
def diameter_kernel(d, v, D, mean, sd):
    """Negative log ratio of a diameter under the tree's own and under the population's; bounded, for trees grow."""
    if not (d == d and D == D) or sd <= 0.0:
        return 0.0
    pop = sd * sd + v
    # The tree's own diameter is known to within v as well.
    ratio = 0.5 * (d - D) ** 2 / v - 0.5 * (d - mean) ** 2 / pop - 0.5 * np.log(pop / v)
    return min(ratio, 3.0)


@njit(cache=True, error_model="numpy")
def distinct_kernel(pose, loss, centre, most):
    """Rows of the best `most` placements that differ, and the weight of the others relative to the last kept."""
    kept = np.empty(most, np.int64)
    at = np.empty((most, 3))
    n = 0
    rest = 0.0
    for i in range(len(pose)):
        c, s = np.cos(pose[i, 2]), np.sin(pose[i, 2])
        x, y = pose[i, 0] + c * centre[0] - s * centre[1], pose[i, 1] + s * centre[0] + c * centre[1]
        same = False
        for k in range(n):
            if abs(x - at[k, 0]) < 0.5 and abs(y - at[k, 1]) < 0.5:
                turn = abs((pose[i, 2] - at[k, 2] + np.pi) % (2 * np.pi) - np.pi)
                if turn < 0.1:
                    same = True
                    break
        if same:
            continue
        if n < most:
            kept[n] = i
            at[n, 0], at[n, 1], at[n, 2] = x, y, pose[i, 2]
            n += 1
        else:
            rest += np.exp(loss[kept[n - 1]] - loss[i])
    return kept[:n].copy(), rest


@njit(cache=True, error_model="numpy")
def within_kernel(at, reach, xy, grid):
    """Rows (K,) of the trees `xy` (T, 2) within `reach` m of a place (2,)."""
    origin, bucket, buckets, start, member = grid.origin, grid.bucket, grid.buckets, grid.start, grid.member
    out = np.empty(64, np.int64)
    n = 0
    x0, x1 = (
        int(max(0.0, (at[0] - reach - origin[0]) / bucket)),
        int(min(buckets[0] - 1.0, (at[0] + reach - origin[0]) / bucket)),
    )
    y0, y1 = (
        int(max(0.0, (at[1] - reach - origin[1]) / bucket)),
        int(min(buckets[1] - 1.0, (at[1] + reach - origin[1]) / bucket)),
    )
    for bx in range(x0, x1 + 1):
        for by in range(y0, y1 + 1):
            cell = bx * buckets[1] + by
            for q in range(start[cell], start[cell + 1]):
                t = member[q]
                if (xy[t, 0] - at[0]) ** 2 + (xy[t, 1] - at[1]) ** 2 <= reach * reach:
                    if n == len(out):
                        more = np.empty(2 * n, np.int64)
                        for i in range(n):
                            more[i] = out[i]
                        out = more
                    out[n] = t
                    n += 1
    return out[:n].copy()
