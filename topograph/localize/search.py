"""All rigid placements of a submap on the map, seeded by pairs of landmarks, best first.

Every pair of trees as far apart as an anchor pair of landmarks is a seed: linear in the size of the map. A seed is
scored landmark by landmark and dropped once it is `bound` nats behind the best.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numba import njit

from topograph.geometry import Array
from topograph.localize.config import LocalizeConfig
from topograph.localize.index import MapIndex


@dataclass(frozen=True, slots=True, kw_only=True)
class Landmarks:
    """A submap's landmarks as the search sees them.

    Attributes:
        m: (n, 2) in the submap's frame, m; `cov` (2n, 2n) joint.
        var: (n,) per axis with the rigid motion of the whole taken out (S-transform, Baarda 1973), m².
        diameter, diameter_var: (n,) m or NaN, m².
        tree: (n,) log chance of its hits and misses if it is a mapped tree that was seen.
        other: (n,) log density, 1/m², of things with its hits and misses that are not in the map.
        lasting: (n,) chance that it is a mapped tree, before any search.
    """

    m: Array
    cov: Array
    var: Array
    diameter: Array
    diameter_var: Array
    tree: Array
    other: Array
    lasting: Array

    def __len__(self) -> int:
        return len(self.m)


@dataclass(frozen=True, slots=True)
class Found:
    """Placements by rising loss: `pose` (M, 3) x, y, yaw of the submap's frame in the map, `loss` (M,) nats; `rest`, how many
    more were as good as the last one, and `seeds` tried."""

    pose: Array
    loss: Array
    rest: float
    seeds: int


def spread(m: Array, cov: Array) -> Array:
    """Variances (n,) per axis of landmarks (n, 2) when the submap may be moved rigidly to fit best (S-transform)."""
    n = len(m)
    J = np.zeros((2 * n, 3))
    d = m - m.mean(0)
    J[0::2, 0] = J[1::2, 1] = 1.0
    J[0::2, 2], J[1::2, 2] = -d[:, 1], d[:, 0]
    w = 1.0 / np.maximum(np.diag(cov), 1e-8)
    S = np.eye(2 * n) - J @ np.linalg.solve((J.T * w) @ J + 1e-9 * np.eye(3), J.T * w)
    v = np.einsum("ij,jk,ik->i", S, cov, S)
    return np.asarray(np.maximum(0.5 * (v[0::2] + v[1::2]), 1e-6))


SLICE = 8_000
"""Pairs of trees that are tried at once while tracking: some ten milliseconds."""
FEWER = 40
"""Placements that are weighed with their full covariance while tracking; those beyond count as rivals all the same."""


def search(marks: Landmarks, index: MapIndex, config: LocalizeConfig) -> Found:
    """Placements within `config.bound` nats of the best."""
    for found in searching(marks, index, config, len(index.length) + 1, config.modes):
        if found is not None:
            return found
    raise AssertionError("a search ends with what it found")


def searching(
    marks: Landmarks, index: MapIndex, config: LocalizeConfig, size: int = SLICE, modes: int = FEWER
) -> Iterator[Found | None]:
    """`search` in slices of so many pairs of trees: None while it goes on, then what it found."""
    pairs = _anchors(marks, index, config)
    poses: list[Array] = []
    losses: list[Array] = []
    best, seeds, tried, missed = np.inf, 0, 0, 1.0
    order_all = np.argsort(marks.var - 0.02 * marks.lasting)
    alone = marks.tree - marks.other  # what a landmark costs that is no mapped tree
    typical = float(np.sum(np.maximum(alone - np.log(2 * np.pi * (marks.var + config.map_sigma**2)), 0.0)))
    for used, (i, j, p_both, low, high) in enumerate(pairs):
        if missed < config.anchors and (best < 0.5 * typical or used >= 6):
            break
        order = np.concatenate([[i, j], order_all[(order_all != i) & (order_all != j)]]).astype(np.int64)
        for at in range(low, high, size):
            a, b = index.a[at : min(at + size, high)], index.b[at : min(at + size, high)]
            if len(a) > 5000:  # neighbours after each other: the raster's cells are still in the processor's cache
                near = np.argsort(index.place[a], kind="stable")
                a, b = a[near], b[near]
            pose, loss, best = _seed(
                marks.m, marks.var, marks.diameter, marks.diameter_var, marks.other - marks.tree, order,
                a, b, index.xy, index.var, index.diameter, index.diameter_mean,
                index.diameter_sd, index.origin, index.cell, index.nearest, best, config.bound, config.map_sigma,
            )  # fmt: skip
            poses.append(pose)
            losses.append(loss)
            tried += len(a)
            if tried >= size:
                tried = 0
                yield None
        seeds += 2 * (high - low)
        missed *= 1.0 - p_both
    if not poses:
        yield Found(np.zeros((0, 3)), np.zeros(0), 0.0, 0)
        return
    pose, loss = np.concatenate(poses), np.concatenate(losses)
    good = loss < best + config.bound
    pose, loss = pose[good], loss[good]
    rows = np.argsort(loss)
    if len(rows) > 20000:
        rows = rows[:20000]
    kept, rest = _distinct(pose[rows], loss[rows], marks.m.mean(0), modes)
    yield Found(pose[rows][kept], loss[rows][kept], rest * (len(loss) / max(len(rows), 1)), seeds)


def _anchors(marks: Landmarks, index: MapIndex, config: LocalizeConfig) -> list[tuple[int, int, float, int, int]]:
    """Pairs (i, j) of landmarks, the chance that both are mapped trees, and the range of tree pairs as far apart.

    First pairs of disjoint landmarks, the surest first: never those with the fewest candidates, for an odd distance is
    the mark of a false detection.
    """
    n = len(marks)
    if n < 2 or not len(index.length):
        return []
    a, b = np.triu_indices(n, 1)
    d = marks.m[a] - marks.m[b]
    length = np.hypot(d[:, 0], d[:, 1])
    u = d / np.maximum(length, 1e-6)[:, None]
    block = marks.cov.reshape(n, 2, n, 2)
    V = block[a, :, a] + block[b, :, b] - block[a, :, b] - block[b, :, a]
    var = np.einsum("pi,pij,pj->p", u, V, u) + 2 * (config.map_sigma**2 + float(np.median(index.var)))
    slack = 3.6 * 1.4 * np.sqrt(np.maximum(var, 1e-8))
    low = np.searchsorted(index.length, (length - slack).astype(np.float32))
    high = np.searchsorted(index.length, (length + slack).astype(np.float32))
    usable = (length > 1.0) & (high > low) & (length + slack < float(index.length[-1]) + 0.5)
    # A landmark whose distances to the others the map hardly knows is likely none of its trees.
    known = np.zeros(n)
    total = np.zeros(n)
    np.add.at(known, a, usable)
    np.add.at(known, b, usable)
    within = length < float(index.length[-1])
    np.add.at(total, a, within)
    np.add.at(total, b, within)
    q = marks.lasting * np.clip((known + 1) / (total + 1), 0.05, 1.0)
    both = q[a] * q[b]
    # Long pairs hold the heading; many candidates cost time.
    value = np.log(np.maximum(both, 1e-9)) + 0.1 * np.log(length + 1) - 0.08 * np.log(high - low + 1.0)
    value[~usable] = -np.inf
    out: list[tuple[int, int, float, int, int]] = []
    busy = np.zeros(n, np.int64)
    for limit in (1, 2, 4):
        for k in np.argsort(-value):
            if not np.isfinite(value[k]):
                break
            i, j = int(a[k]), int(b[k])
            if busy[i] < limit and busy[j] < limit and not any(o[:2] == (i, j) for o in out):
                busy[i] += 1
                busy[j] += 1
                out.append((i, j, float(both[k]), int(low[k]), int(high[k])))
    return out[:12]


@njit(cache=True, fastmath=True)
def _seed(
    m,
    var,
    dia,
    dia_var,
    other,
    order,
    pa,
    pb,
    xy,
    tvar,
    tdia,
    dmean,
    dsd,
    origin,
    cell,
    nearest,
    best,
    bound,
    map_sigma,
):
    n = len(m)
    out = np.empty((1024, 3))
    losses = np.empty(1024)
    count = 0
    i, j = order[0], order[1]
    base = map_sigma * map_sigma
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
        loss = _diameter(dia[i], dia_var[i], tdia[a], dmean, dsd) + _diameter(dia[j], dia_var[j], tdia[b], dmean, dsd)
        gap = np.sqrt(fx * fx + fy * fy) - np.sqrt(ex * ex + ey * ey)
        loss += 3.0 * np.log(1.0 + gap * gap * w2 / 4.0)
        loss += volume[i] - floor[i] + volume[j] - floor[j]
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
                matched += _diameter(dia[k], dia_var[k], tdia[t], dmean, dsd)
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
        if loss > best + bound:
            continue
        if loss < best:
            best = loss
        if count == len(out):
            keep = 0
            for q in range(count):
                if losses[q] < best + bound:
                    out[keep] = out[q]
                    losses[keep] = losses[q]
                    keep += 1
            count = keep
            if 2 * keep > len(out):
                more = np.empty((2 * len(out), 3))
                more[:count] = out[:count]
                more_losses = np.empty(2 * len(out))
                more_losses[:count] = losses[:count]
                out, losses = more, more_losses
        out[count, 0] = tx - c * mx + sn * my
        out[count, 1] = ty - sn * mx - c * my
        out[count, 2] = np.arctan2(sn, c)
        losses[count] = loss
        count += 1
    return out[:count].copy(), losses[:count].copy(), best


@njit(cache=True)
def _diameter(d, v, D, mean, sd):
    """Negative log ratio of a diameter under the tree's own and under the population's; bounded, for trees grow."""
    if not (d == d and D == D) or sd <= 0.0:
        return 0.0
    pop = sd * sd + v
    # The tree's own diameter is known to within v as well.
    ratio = 0.5 * (d - D) ** 2 / v - 0.5 * (d - mean) ** 2 / pop - 0.5 * np.log(pop / v)
    return min(ratio, 3.0)


@njit(cache=True)
def _distinct(pose, loss, centre, most):
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
