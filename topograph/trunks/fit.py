"""A chain of runs -> the trunk's axis, diameter and covariance."""

from __future__ import annotations

import numpy as np
from numba import njit

from topograph.compiled import quantile
from topograph.trunks.ground import ground_at
from topograph.trunks.runs import COUNT, HEIGHT, PX, PY, PZ, RANGE, WIDTH

# Columns of a fit. The axis is stated with a prior on its lean, as a single scan must; slope and width are what was
# measured, with their precisions, so that many scans can be added up and the prior applied once.
X, Y, Z, AXIS_X, AXIS_Y, AXIS_Z, DIAMETER, ABOVE, RADIAL, TANGENTIAL, LEAN_SIGMA, POINTS, RINGS, FAR = range(14)
LINE_X, LINE_Y, LEVER, SLOPE_X, SLOPE_Y, SLOPE_WEIGHT, WIDE, WIDE_SIGMA, STEMS, SPREAD, LINE_RMS = range(14, 25)
OUT_SIZE = 25
"""x, y, z at the reference height, axis (3), diameter, height above ground, radial and tangential sigma, lean sigma, points,
rings, range, bearing x, y, z less the mean height of the returns, measured slope (2) and its information, measured width
and its sigma, stems, spread of the rings' widths, rms of the rings about the axis."""
LEAN_SIGMA_PRIOR = 0.12
"""Of one scan's prior on a trunk's lean, rad."""
RING_SIGMA = 0.035
"""Of one return's place across the axis, m: range noise and bark."""
ALIKE = 6.0
"""Returns of one ring share their error: so many count as one."""
STRAIGHT, BENDS = 0.9, 0.25
"""Height up to which a trunk is taken for straight, and over which it may bend, m."""
TAPER = 0.12
"""A trunk's radius shrinks by this share per metre upwards: butts are swollen. Unheeded, trunks seem to lean away from where
they are seen from."""
CHEST = 0.8
"""Height at which the radius is that of the diameter, m."""
PUSH = 0.83
"""The mean return of a cylinder lies π/4 of its radius before the axis; mixed pixels at the edges take away the rest."""


@njit(cache=True, error_model="numpy")
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
    out = np.empty(2)
    out[0], out[1] = gain * quantile(lean[0, :n], 0.5), gain * quantile(lean[1, :n], 0.5)
    return out


@njit(cache=True, error_model="numpy")
def members(chain):
    """Heads (C,) of the chains, their runs one after the other (K,) from below upwards, and the ends (C+1,)."""
    k = chain.shape[0]
    place = np.full(k, -1, np.int64)
    c = 0
    for i in range(k):
        if chain[i] == i:
            place[i] = c
            c += 1
    ends = np.zeros(c + 1, np.int64)
    for i in range(k):
        ends[place[chain[i]] + 1] += 1
    for q in range(c):
        ends[q + 1] += ends[q]
    fill = ends[:-1].copy()
    heads, order = np.empty(c, np.int64), np.empty(k, np.int64)
    for i in range(k):
        q = place[chain[i]]
        if chain[i] == i:
            heads[q] = i
        order[fill[q]] = i
        fill[q] += 1
    return heads, order, ends


@njit(cache=True, error_model="numpy")
def widths_of(runs, mine, step, far):
    """Measured diameter, its sigma and the spread of the rings' widths; rings far from the median do not count.

    The silhouette's edges are tangents: with half angle a and mean range r of the visible face, R = r sin a / (1 - π/4 sin a).
    """
    n = mine.shape[0]
    w = np.empty(n)
    for q in range(n):
        s = np.sin(min(0.5 * runs[mine[q], WIDTH] / max(runs[mine[q], RANGE], 0.3), 1.0))
        w[q] = 2.0 * runs[mine[q], RANGE] * s / (1.0 - 0.785 * s)
    middle = quantile(w, 0.5)
    ws, w2, wn = 0.0, 0.0, 0.0
    for q in range(n):
        if abs(w[q] - middle) < 0.5 * middle + step * far:
            ws += w[q]
            w2 += w[q] ** 2
            wn += 1.0
    mean = ws / max(wn, 1.0)
    spread = np.sqrt(max(w2 / max(wn, 1.0) - mean**2, 0.0))
    sigma = np.sqrt((0.45 * step * far) ** 2 + 0.03**2) / np.sqrt(max(wn, 1.0)) + 0.012
    return mean, sigma, spread, w


@njit(cache=True, error_model="numpy")
def axis_of(runs, mine, w, mean_width, radius, eye, step, far, up, row):
    """A line through the rings' centres, into `row`; lean is held by a prior about `up`. Returns the mean height."""
    n = mine.shape[0]
    cx, cy, cz, cw = np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    for q in range(n):
        i = mine[q]
        dx, dy = runs[i, PX] - eye[0], runs[i, PY] - eye[1]
        d = np.sqrt(dx * dx + dy * dy)
        push = PUSH * radius * (1.0 - TAPER * (runs[i, HEIGHT] - CHEST))
        cx[q], cy[q], cz[q] = runs[i, PX] + dx / d * push, runs[i, PY] + dy / d * push, runs[i, PZ]
        # A ring that is much wider or narrower than the others is partly hidden, or not only trunk.
        odd = (w[q] - mean_width) / (0.05 + step * far)
        # Trunks bend: the axis wanted is that of the lower part, which ends at the foot.
        high = max(runs[i, HEIGHT] - STRAIGHT, 0.0) / BENDS
        cw[q] = min(runs[i, COUNT], 12.0) / ((1.0 + odd * odd) * (1.0 + high * high))
    prior = RING_SIGMA**2 * ALIKE / LEAN_SIGMA_PRIOR**2
    szz, szx, szy, zm, xm, ym, lx, ly = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for turn in range(3):
        total, zm, xm, ym = 0.0, 0.0, 0.0, 0.0
        for q in range(n):
            total += cw[q]
            zm += cw[q] * cz[q]
            xm += cw[q] * cx[q]
            ym += cw[q] * cy[q]
        zm, xm, ym = zm / total, xm / total, ym / total
        szz, szx, szy = 0.0, 0.0, 0.0
        for q in range(n):
            dz = cz[q] - zm
            szz += cw[q] * dz * dz
            szx += cw[q] * dz * (cx[q] - xm)
            szy += cw[q] * dz * (cy[q] - ym)
        lx, ly = (szx + prior * up[0]) / (szz + prior), (szy + prior * up[1]) / (szz + prior)
        if turn == 0:
            # What is odd is judged against what was measured: against the prior, the ends of a leaning trunk were odd.
            free = 0.1 * prior
            mx, my = (szx + free * up[0]) / (szz + free), (szy + free * up[1]) / (szz + free)
            for q in range(n):
                ex, ey = cx[q] - xm - mx * (cz[q] - zm), cy[q] - ym - my * (cz[q] - zm)
                cw[q] /= 1.0 + (ex * ex + ey * ey) / 0.06**2
    line2 = 0.0
    for q in range(n):
        ex, ey = cx[q] - xm - lx * (cz[q] - zm), cy[q] - ym - ly * (cz[q] - zm)
        line2 += ex * ex + ey * ey
    size = np.sqrt(lx * lx + ly * ly + 1.0)
    row[X], row[Y], row[Z] = xm, ym, zm
    row[AXIS_X], row[AXIS_Y], row[AXIS_Z] = lx / size, ly / size, 1.0 / size
    row[LEAN_SIGMA] = RING_SIGMA * np.sqrt(ALIKE / (szz + prior))
    row[SLOPE_X] = szx / szz if szz > 1e-9 else up[0]
    row[SLOPE_Y] = szy / szz if szz > 1e-9 else up[1]
    row[SLOPE_WEIGHT] = szz / (RING_SIGMA**2 * ALIKE)
    row[LINE_RMS] = np.sqrt(line2 / n)


@njit(cache=True, error_model="numpy")
def fit_chains(runs, heads, order, ends, plane, grid, eye, step, up, reference, prior_d, prior_s, thinnest, widest):
    """Trunks (C, OUT_SIZE) and the number (C,) of the chain that each came from.

    The mean return of a cylinder of radius R lies π/4·R before its axis; R comes from the width of all rings
    together. So every point helps to place the axis, and no free circle is fitted (a free fit is worse than the
    centroid at 3 cm of noise).
    """
    out = np.empty((len(heads), OUT_SIZE))
    name = np.empty(len(heads), np.int64)
    m = 0
    for c in range(len(heads)):
        mine = order[ends[c] : ends[c + 1]]
        n, points, far = mine.shape[0], 0.0, 0.0
        for q in range(n):
            points += runs[mine[q], COUNT]
            far += runs[mine[q], RANGE] * runs[mine[q], COUNT]
        if points < 3 or (n == 1 and points < 4):
            continue
        far /= points
        measured, sigma_w, spread, w = widths_of(runs, mine, step, far)
        if measured > widest:
            continue
        gain = prior_s**2 / (prior_s**2 + sigma_w**2)
        diameter = min(max(prior_d + gain * (measured - prior_d), thinnest), widest)
        sigma_d = np.sqrt(gain) * sigma_w
        row = out[m]
        axis_of(runs, mine, w, measured, 0.5 * diameter, eye, step, far, up, row)
        lx, ly, zm = row[AXIS_X] / row[AXIS_Z], row[AXIS_Y] / row[AXIS_Z], row[Z]
        ground = ground_at(row[X], row[Y], plane, grid)
        # Beyond the rings seen the axis is not known better than its lean.
        z_at = min(max(ground + reference, zm - 1.2), zm + 1.2)
        row[X] += lx * (z_at - zm)
        row[Y] += ly * (z_at - zm)
        row[Z], row[LEVER], row[ABOVE] = z_at, z_at - zm, z_at - ground
        row[DIAMETER] = diameter
        row[RADIAL] = np.sqrt(RING_SIGMA**2 / points + (0.785 * 0.5 * sigma_d) ** 2 + 0.012**2)
        row[TANGENTIAL] = np.sqrt((0.3 * step * far) ** 2 / n + 0.02**2 / n + 0.012**2)
        row[POINTS], row[RINGS], row[FAR] = points, n, far
        dx, dy = row[X] - eye[0], row[Y] - eye[1]
        d = np.sqrt(dx * dx + dy * dy)
        row[LINE_X], row[LINE_Y] = dx / d, dy / d
        row[WIDE], row[WIDE_SIGMA], row[SPREAD], row[STEMS] = measured, sigma_w, spread, 1.0
        name[m] = c
        m += 1
    return out[:m], name[:m]


@njit(cache=True, error_model="numpy")
def foot_distance(a, b):
    """Distance of two fits where their axes meet the ground, or at the height of their points where that is less, m."""
    ha, hb = a[ABOVE] / max(a[AXIS_Z], 0.3), b[ABOVE] / max(b[AXIS_Z], 0.3)
    fx = a[X] - ha * a[AXIS_X] - b[X] + hb * b[AXIS_X]
    fy = a[Y] - ha * a[AXIS_Y] - b[Y] + hb * b[AXIS_Y]
    dx, dy = a[X] - b[X], a[Y] - b[Y]
    return np.sqrt(min(fx * fx + fy * fy, dx * dx + dy * dy))


NOT_ONE = 0.12
"""A post and a tree are two things when their axes are further from each other than this, m."""


@njit(cache=True, error_model="numpy")
def suppress(out, score, post, distance):
    """Group (C,) of each trunk: those that stand within `distance` m of a better one are its stems or its pieces; a thick
    trunk has its pieces within its radius. A `post` (C,) beside a tree is no piece of it: 1, -1 surely none, 0 who knows.
    """
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
            dx, dy = out[i, X] - out[j, X], out[i, Y] - out[j, Y]
            if group[j] >= 0 or abs(dx) + abs(dy) > 3.0:
                continue
            if post[i] * post[j] < 0 and dx * dx + dy * dy > NOT_ONE**2:
                continue
            if foot_distance(out[i], out[j]) < distance + 0.4 * max(out[i, DIAMETER] - 0.2, 0.0):
                group[j] = i
    return group


BRANCH = 0.15
"""Besides the distance between rings, what begins so much higher than the trunk beside it is a branch, m."""


@njit(cache=True, error_model="numpy")
def merge_stems(fits, odds, group, lowest, highest):
    """Rows (B,) of the best of each group, and their fits (B, OUT_SIZE): stems of one tree meet at its foot, and their
    mean, by points, stands for the tree. A stem is as thick as a third of the best, stands beside it, and its log-odds of
    being a tree, `odds` (C,), are positive and half of the best's. It begins as low, of the rings `lowest` to `highest` (C,) m above ground that
    show them, as the best does: what begins higher is a branch, and no part of where the trunk stands.
    """
    n = len(group)
    best = np.empty(n, np.int64)
    out = np.empty((n, OUT_SIZE))
    b = 0
    for i in range(n):
        if group[i] != i:
            continue
        best[b] = i
        for q in range(OUT_SIZE):
            out[b, q] = fits[i, q]
        total, stems = 0.0, 0
        mean, lever, above = np.zeros(6), 0.0, 0.0
        for j in range(n):
            if group[j] != i or fits[j, WIDE] < 0.33 * fits[i, WIDE]:
                continue
            if j != i and odds[j] <= max(0.5 * odds[i], 0.0):
                continue
            if lowest[j] > lowest[i] + BRANCH + (highest[i] - lowest[i]) / max(fits[i, RINGS] - 1.0, 1.0):
                continue
            total += fits[j, POINTS]
            stems += 1
            lever += fits[j, POINTS] * fits[j, LEVER]
            above += fits[j, POINTS] * fits[j, ABOVE]
            for q in range(6):
                mean[q] += fits[j, POINTS] * fits[j, q]
        if stems > 1:
            size = np.sqrt(mean[3] ** 2 + mean[4] ** 2 + mean[5] ** 2)
            for q in range(6):
                out[b, q] = mean[q] / (total if q < 3 else size)
            out[b, RADIAL] = np.hypot(out[b, RADIAL], 0.05)
            out[b, TANGENTIAL] = np.hypot(out[b, TANGENTIAL], 0.05)
            out[b, LEVER], out[b, ABOVE] = lever / total, above / total
            out[b, SLOPE_WEIGHT], out[b, LEAN_SIGMA] = 0.0, LEAN_SIGMA_PRIOR  # the mean of stems is no axis measured
            out[b, STEMS] = stems
        b += 1
    return best[:b], out[:b]


@njit(cache=True, error_model="numpy")
def gather(wanted, n_groups, chain, runs, label, first, last):
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
        for m in range(int(runs[i, first]), int(runs[i, last]) + 1):
            if label[m] == i:
                out[fill[g]] = m
                fill[g] += 1
    return out, ends


@njit(cache=True, error_model="numpy")
def covariances(fits, scales):
    """Covariances (N, 3, 3) turned from the line of sight into the base's axes; `scales` (N, 2) on the radial and
    tangential deviations. What the lean adds at the height of the point is as uncertain in all directions.
    """
    n = fits.shape[0]
    out = np.zeros((n, 3, 3))
    for i in range(n):
        radial, tangential = (fits[i, RADIAL] * scales[i, 0]) ** 2, (fits[i, TANGENTIAL] * scales[i, 1]) ** 2
        lever = (fits[i, LEVER] * fits[i, LEAN_SIGMA]) ** 2
        c, s = fits[i, LINE_X], fits[i, LINE_Y]
        out[i, 0, 0] = radial * c * c + tangential * s * s + lever
        out[i, 1, 1] = radial * s * s + tangential * c * c + lever
        out[i, 0, 1] = out[i, 1, 0] = (radial - tangential) * c * s
        for a in range(3):
            out[i, a, a] += 1e-6
            for b in range(3):
                out[i, a, b] += LEAN_SIGMA_PRIOR**2 * fits[i, AXIS_X + a] * fits[i, AXIS_X + b]
    return out


@njit(cache=True, error_model="numpy")
def heights_of(runs, mine):
    """Lowest and highest ring of a chain above the ground, m."""
    low, high = 1e9, -1e9
    for q in range(mine.shape[0]):
        low, high = min(low, runs[mine[q], HEIGHT]), max(high, runs[mine[q], HEIGHT])
    return low, high
