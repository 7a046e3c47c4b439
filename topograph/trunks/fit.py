"""A chain of runs -> the trunk's axis, diameter and covariance, and the features that tell trees from other things."""

from __future__ import annotations

import numpy as np
from numba import njit

from topograph.trunks.ground import ground_at
from topograph.trunks.runs import (
    COUNT,
    FIRST,
    FREE,
    HEIGHT,
    LAST,
    PX,
    PY,
    PZ,
    RANGE,
    RING,
    WIDTH,
    look_around,
)

FEATURES = (
    "range", "rings", "points", "diameter", "width_spread", "rough", "line_rms", "lean", "free", "lowest", "highest",
    "canopy", "undergrowth", "top_visible", "fill", "taper", "depth_slope", "ring_gap", "overhead", "close_by",
    "covered_near", "covered", "beside", "diameter_held",
)  # fmt: skip
OUT_SIZE = 16
"""x, y, z, axis (3), diameter, height, radial and tangential sigma, lean sigma, points, rings, range, bearing x, y."""


RANGE_EDGES = (5.0, 10.0, 20.0)
"""Classes of range that covariances are calibrated in, m."""


@njit(cache=True)
def vertical(runs, chain, most):
    """Which way trunks grow, as horizontal metres per metre of height (2,), in the base's frame: the median lean of what
    several rings cross, drawn to zero where there is little of it. On a slope the base is tilted and the trees are not.
    """
    k = runs.shape[0]
    lean = np.zeros((2, most))
    n = 0
    count, height = np.zeros(k), np.zeros(k)
    mx, my, zz, zx, zy = np.zeros(k), np.zeros(k), np.zeros(k), np.zeros(k), np.zeros(k)
    for i in range(k):
        c, w = chain[i], runs[i, COUNT]
        count[c] += w
        height[c] += w * runs[i, PZ]
        mx[c] += w * runs[i, PX]
        my[c] += w * runs[i, PY]
    for i in range(k):
        c, w = chain[i], runs[i, COUNT]
        dz = runs[i, PZ] - height[c] / count[c]
        zz[c] += w * dz * dz
        zx[c] += w * dz * (runs[i, PX] - mx[c] / count[c])
        zy[c] += w * dz * (runs[i, PY] - my[c] / count[c])
    for c in range(k):
        # More than 0.3 m of spread over more than a dozen returns: the slope is known to a few degrees.
        if count[c] >= 12 and zz[c] > 0.09 * count[c] and n < most:
            lx, ly = zx[c] / zz[c], zy[c] / zz[c]
            if lx * lx + ly * ly < 0.25:
                lean[0, n], lean[1, n] = lx, ly
                n += 1
    if n < 3:
        return np.zeros(2)
    gain = n / (n + 2.0)
    return np.array([gain * np.median(lean[0, :n]), gain * np.median(lean[1, :n])])


@njit(cache=True)
def fit_chains(
    p,
    r,
    h,
    runs,
    label,
    chain,
    plane,
    grid,
    above,
    beside,
    eye,
    step,
    top,
    reference,
    prior_d,
    prior_s,
    thinnest,
    widest,
):
    """Trunks (C, OUT_SIZE), features (C, len(FEATURES)) and the chain (C,) that each came from.

    The mean return of a cylinder of radius R lies π/4·R before its axis; R comes from the width of all rings
    together. So every point helps to place the axis, and no free circle is fitted (a free fit is worse than the
    centroid at 3 cm of noise).
    """
    k = runs.shape[0]
    out = np.empty((k, OUT_SIZE))
    feature = np.empty((k, 24))
    name = np.empty(k, np.int64)
    n_out = 0
    members = np.empty(k, np.int64)
    up = vertical(runs, chain, 64)
    over, side = np.zeros(5), np.zeros(5)
    for c in range(k):
        if chain[c] != c:
            continue
        n, points = 0, 0.0
        for i in range(c, k):
            if chain[i] == c:
                members[n] = i
                n += 1
                points += runs[i, COUNT]
        if points < 3 or (n == 1 and points < 4):
            continue
        # Diameter: what n firings cover, less what the beam's own width adds; pooled over the rings.
        far = 0.0
        for q in range(n):
            far += runs[members[q], RANGE] * runs[members[q], COUNT]
        far /= points
        widths = np.empty(n)
        for q in range(n):
            widths[q] = runs[members[q], WIDTH]
        middle = np.median(widths)
        ws, w2, wn = 0.0, 0.0, 0.0
        for q in range(n):
            if abs(widths[q] - middle) < 0.5 * middle + step * far:
                ws += widths[q]
                w2 += widths[q] ** 2
                wn += 1.0
        mean_width = ws / max(wn, 1.0)
        spread = np.sqrt(max(w2 / max(wn, 1.0) - mean_width**2, 0.0))
        sigma_w = np.sqrt((0.45 * step * far) ** 2 + 0.03**2) / np.sqrt(max(wn, 1.0)) + 0.012
        measured = mean_width
        gain = prior_s**2 / (prior_s**2 + sigma_w**2)
        diameter = prior_d + gain * (measured - prior_d)
        if measured > widest or measured < -0.5:
            continue
        diameter = min(max(diameter, thinnest), widest)
        sigma_d = np.sqrt(gain) * sigma_w
        radius = 0.5 * diameter
        # Ring centres on the axis, then a line through them; lean is held by a prior.
        cx, cy, cz, cw = np.empty(n), np.empty(n), np.empty(n), np.empty(n)
        for q in range(n):
            i = members[q]
            dx, dy = runs[i, PX] - eye[0], runs[i, PY] - eye[1]
            d = np.sqrt(dx * dx + dy * dy)
            push = 0.83 * radius  # π/4, and the edges that mixed pixels take away
            cx[q], cy[q], cz[q] = runs[i, PX] + dx / d * push, runs[i, PY] + dy / d * push, runs[i, PZ]
            # A ring that is much wider or narrower than the others is partly hidden, or not only trunk.
            odd = (widths[q] - mean_width) / (0.05 + step * far)
            cw[q] = min(runs[i, COUNT], 12.0) / (1.0 + odd * odd)
        x0, y0, lx, ly = 0.0, 0.0, 0.0, 0.0
        zm, wsum = 0.0, 0.0
        lean_precision = 0.0
        for turn in range(3):
            wsum, zm, xm, ym = 0.0, 0.0, 0.0, 0.0
            for q in range(n):
                wsum += cw[q]
                zm += cw[q] * cz[q]
                xm += cw[q] * cx[q]
                ym += cw[q] * cy[q]
            zm, xm, ym = zm / wsum, xm / wsum, ym / wsum
            szz, szx, szy = 0.0, 0.0, 0.0
            for q in range(n):
                dz = cz[q] - zm
                szz += cw[q] * dz * dz
                szx += cw[q] * dz * (cx[q] - xm)
                szy += cw[q] * dz * (cy[q] - ym)
            noise = 0.035**2 * 6.0  # of one ring's centre, in the units of the weights
            lean_precision = szz + noise / 0.12**2
            lx = (szx + noise / 0.12**2 * up[0]) / lean_precision
            ly = (szy + noise / 0.12**2 * up[1]) / lean_precision
            x0, y0 = xm, ym
            if turn < 2:
                for q in range(n):
                    ex = cx[q] - x0 - lx * (cz[q] - zm)
                    ey = cy[q] - y0 - ly * (cz[q] - zm)
                    e2 = (ex * ex + ey * ey) / 0.06**2
                    cw[q] = cw[q] / (1.0 + e2) if turn == 0 else cw[q]
        line2, rough2, rough_n = 0.0, 0.0, 0.0
        lowest, highest, free = 1e9, -1e9, 0.0
        for q in range(n):
            i = members[q]
            ex = cx[q] - x0 - lx * (cz[q] - zm)
            ey = cy[q] - y0 - ly * (cz[q] - zm)
            line2 += ex * ex + ey * ey
            lowest, highest = min(lowest, runs[i, HEIGHT]), max(highest, runs[i, HEIGHT])
            free += runs[i, FREE]
            for m in range(int(runs[i, FIRST]), int(runs[i, LAST]) + 1):
                if label[m] != i:
                    continue
                ax, ay = x0 + lx * (p[m, 2] - zm), y0 + ly * (p[m, 2] - zm)
                dx, dy = p[m, 0] - ax, p[m, 1] - ay
                rough2 += (np.sqrt(dx * dx + dy * dy) - radius) ** 2
                rough_n += 1.0
        ground = ground_at(x0, y0, plane, grid)
        z_ref = ground + reference
        # Beyond the rings seen the axis is not known better than its lean.
        z_at = min(max(z_ref, zm - 1.2), zm + 1.2)
        px, py = x0 + lx * (z_at - zm), y0 + ly * (z_at - zm)
        size = np.sqrt(lx * lx + ly * ly + 1.0)
        lean_var = noise / lean_precision
        lever2 = (z_at - zm) ** 2 * lean_var
        radial = np.sqrt(0.035**2 / points + (0.785 * 0.5 * sigma_d) ** 2 + lever2 + 0.012**2)
        tangential = np.sqrt((0.3 * step * far) ** 2 / n + 0.02**2 / n + lever2 + 0.012**2)
        row = out[n_out]
        row[0], row[1], row[2] = px, py, z_at
        row[3], row[4], row[5] = lx / size, ly / size, 1.0 / size
        row[6], row[7] = diameter, z_at - ground
        row[8], row[9], row[10] = radial, tangential, np.sqrt(lean_var)
        row[11], row[12], row[13] = points, n, far
        d = np.sqrt((px - eye[0]) ** 2 + (py - eye[1]) ** 2)
        row[14], row[15] = (px - eye[0]) / d, (py - eye[1]) / d
        # Features.
        look_around(above, px + 1.5 * lx, py + 1.5 * ly, 0.35, 0.9, 1.6, over)
        look_around(beside, px, py, 0.5, 0.9, 1.3, side)
        f = feature[n_out]
        seen_top = eye[2] + d * top - ground
        upper, lower, nu, nl = 0.0, 0.0, 0.0, 0.0
        for q in range(n):
            if cz[q] > zm:
                upper += widths[q]
                nu += 1.0
            else:
                lower += widths[q]
                nl += 1.0
        first, last = members[0], members[n - 1]
        f[0], f[1], f[2] = np.log(far), np.log(n), np.log(points)
        f[3], f[4] = measured, spread
        f[5] = np.sqrt(rough2 / max(rough_n, 1.0))
        f[6] = np.sqrt(line2 / n)
        f[7] = np.sqrt((lx - up[0]) ** 2 + (ly - up[1]) ** 2)
        f[8] = free / (2.0 * n)
        f[9], f[10] = lowest, highest
        f[11], f[12] = np.log(1.0 + over[1] + over[2]), np.log(1.0 + side[1] + side[2])
        f[13] = min(seen_top, 5.0)
        f[14] = points * step * far / max(n * measured, 0.03)
        f[15] = (upper / nu - lower / nl) if nu > 0 and nl > 0 else 0.0
        f[16] = (runs[last, RANGE] - runs[first, RANGE]) / max(highest - lowest, 0.3)
        f[17] = (runs[last, RING] - runs[first, RING] + 1.0) / n
        f[18] = np.log(1.0 + over[0])
        f[19] = np.log(1.0 + max(side[0] - points, 0.0))
        f[20], f[21] = over[3], over[4]
        f[22] = side[3] + side[4]
        f[23] = diameter
        name[n_out] = c
        n_out += 1
    return out[:n_out], feature[:n_out], name[:n_out]


@njit(cache=True)
def suppress(out, score, distance):
    """Group (C,) of each trunk: those within `distance` m of a better one are its stems or its pieces."""
    n = out.shape[0]
    group = np.full(n, -1, np.int64)
    order = np.argsort(-score)
    for a in range(n):
        i = order[a]
        if group[i] >= 0:
            continue
        group[i] = i
        for b in range(a + 1, n):
            j = order[b]
            if group[j] < 0 and (out[i, 0] - out[j, 0]) ** 2 + (out[i, 1] - out[j, 1]) ** 2 < distance * distance:
                group[j] = i
    return group


@njit(cache=True)
def merge_stems(fits, odds, group):
    """Rows (B,) of the best of each group, and their fits (B, OUT_SIZE): stems of one tree meet at its foot, and their
    mean, by points, stands for the tree.
    """
    n = len(group)
    best = np.empty(n, np.int64)
    out = np.empty((n, OUT_SIZE))
    b = 0
    for i in range(n):
        if group[i] != i:
            continue
        best[b] = i
        out[b] = fits[i]
        total, stems = 0.0, 0
        mean = np.zeros(6)
        for j in range(n):
            if group[j] == i and odds[j] > 0.5 * odds[i]:
                total += fits[j, 11]
                stems += 1
                for q in range(6):
                    mean[q] += fits[j, 11] * fits[j, q]
        if stems > 1:
            size = np.sqrt(mean[3] ** 2 + mean[4] ** 2 + mean[5] ** 2)
            for q in range(6):
                out[b, q] = mean[q] / (total if q < 3 else size)
            out[b, 8] = np.hypot(out[b, 8], 0.05)
            out[b, 9] = np.hypot(out[b, 9], 0.05)
        b += 1
    return best[:b], out[:b]


@njit(cache=True)
def gather(wanted, n_groups, chain, runs, label):
    """Indices of the points of chains by group: `wanted` (K,) is the group of each chain or -1. Flat (M,), ends (G+1,)."""
    k = runs.shape[0]
    ends = np.zeros(n_groups + 1, np.int64)
    for i in range(k):
        g = wanted[chain[i]]
        if g >= 0:
            ends[g + 1] += int(runs[i, COUNT])
    for g in range(n_groups):
        ends[g + 1] += ends[g]
    fill = ends[:-1].copy()
    out = np.empty(ends[n_groups], np.int64)
    for i in range(k):
        g = wanted[chain[i]]
        if g < 0:
            continue
        for m in range(int(runs[i, FIRST]), int(runs[i, LAST]) + 1):
            if label[m] == i:
                out[fill[g]] = m
                fill[g] += 1
    return out, ends


@njit(cache=True)
def covariances(fits, radial_factor, tangential_factor):
    """Covariances (N, 3, 3) turned from the line of sight into the base's axes, with the calibration by range."""
    n = fits.shape[0]
    out = np.zeros((n, 3, 3))
    for i in range(n):
        cls = 0
        while cls < 3 and fits[i, 13] >= RANGE_EDGES[cls]:
            cls += 1
        radial, tangential = (fits[i, 8] * radial_factor[cls]) ** 2, (fits[i, 9] * tangential_factor[cls]) ** 2
        c, s = fits[i, 14], fits[i, 15]
        out[i, 0, 0] = radial * c * c + tangential * s * s
        out[i, 1, 1] = radial * s * s + tangential * c * c
        out[i, 0, 1] = out[i, 1, 0] = (radial - tangential) * c * s
        for a in range(3):
            out[i, a, a] += 1e-6
            for b in range(3):
                out[i, a, b] += 0.12**2 * fits[i, 3 + a] * fits[i, 3 + b]
    return out
