"""What tells trees from posts and from everything else, of each candidate."""

from __future__ import annotations

import numpy as np
from numba import njit

from topograph.trunks.fit import (
    ABOVE,
    AXIS_X,
    AXIS_Y,
    AXIS_Z,
    DIAMETER,
    FAR,
    LINE_RMS,
    POINTS,
    RINGS,
    SPREAD,
    WIDE,
    X,
    Y,
    Z,
    heights_of,
)
from topograph.trunks.passage import (
    AXIS_HIT,
    AXIS_PASS,
    BINS,
    CROWN_HIT,
    CROWN_SEEN,
    SEEN_SIZE,
    TOP,
    TRUNK_HIT,
    TRUNK_PASS,
    TRUNK_RINGS,
    crossings,
    look_at,
)
from topograph.trunks.patch import BEAMS, HIGH_NAMES, PATCH_NAMES, PATCH_SIZE, look_at_patch
from topograph.trunks.runs import FIRST, FREE, LAST, RANGE, RING, WIDTH, look_around

FEATURES = (
    "range", "rings", "points", "width", "width_spread", "rough", "line_rms", "lean", "free", "lowest", "highest",
    "taper", "depth_slope", "fill", "ring_gap", "undergrowth", "close_by", "beside", "slant", "bow", "holes",
    "trunk_passed", "trunk_met", "axis_met", "axis_seen", "crown", "crown_seen", "top",
    "canopy", "overhead", "covered_near", "covered", *PATCH_NAMES,
)  # fmt: skip
"""Lengths in m; counts as logarithms. From `axis_met` to `covered`: what is above trunk height, 0 where nothing looked
there. Then the patch: what the beams met around it, see patch.py."""
OVERHEAD = (
    "axis_met", "axis_seen", "crown", "crown_seen", "top", "canopy", "overhead", "covered_near", "covered", *HIGH_NAMES,
)  # fmt: skip
"""Features that need beams above the trunk: left out at random in training, so that no tree needs a crown."""

# Columns of FEATURES.
(
    _RANGE, _RINGS, _POINTS, _WIDTH, _SPREAD, _ROUGH, _LINE_RMS, _LEAN, _FREE, _LOWEST, _HIGHEST,
    _TAPER, _DEPTH_SLOPE, _FILL, _RING_GAP, _UNDERGROWTH, _CLOSE_BY, _BESIDE, _SLANT, _BOW, _HOLES,
    _TRUNK_PASSED, _TRUNK_MET, _AXIS_MET, _AXIS_SEEN, _CROWN, _CROWN_SEEN, _TOP,
    _CANOPY, _OVERHEAD, _COVERED_NEAR, _COVERED,
) = range(32)  # fmt: skip
_COUNT, _PATCH = len(FEATURES), len(FEATURES) - PATCH_SIZE
BEHIND = 0.25
"""A return so far behind a run, between its ends, went through it, m."""


@njit(cache=True, error_model="numpy")
def describe(p, r, runs, label, order, ends, fits, name, near, tangent, R, eye, above, beside, up, step):
    """Features (C, len(FEATURES)) of the trunks `fits` (C, OUT_SIZE)."""
    out = np.zeros((len(fits), _COUNT))
    crossed = np.empty((4, len(tangent)), np.float32)
    slopes = tangent.astype(np.float32)
    around = np.concatenate((near[:, BINS - BEAMS :], near, near[:, :BEAMS]), axis=1)
    work = np.empty((2, BEAMS), np.int32)
    for c in range(len(fits)):
        a, f = fits[c], out[c]
        mine = order[ends[name[c]] : ends[name[c] + 1]]
        lx, ly, radius = a[AXIS_X] / a[AXIS_Z], a[AXIS_Y] / a[AXIS_Z], 0.5 * a[DIAMETER]
        lowest, highest = heights_of(runs, mine)
        f[_RANGE], f[_RINGS], f[_POINTS] = np.log(a[FAR]), np.log(a[RINGS]), np.log(a[POINTS])
        f[_WIDTH], f[_SPREAD], f[_LINE_RMS] = a[WIDE], a[SPREAD], a[LINE_RMS]
        f[_LEAN] = np.sqrt((lx - up[0]) ** 2 + (ly - up[1]) ** 2)
        f[_LOWEST], f[_HIGHEST] = lowest, highest
        f[_FILL] = min(a[POINTS] * step * a[FAR] / max(a[RINGS] * a[WIDE], 0.03), 3.0)
        _ladder(runs, mine, highest - lowest, f)
        _surface(p, r, runs, label, mine, a, lx, ly, radius, f)
        _around(above, beside, a, lx, ly, radius, f)
        if crossings(slopes, R, eye, a[X], a[Y], a[Z], lx, ly, crossed):
            _beams(near, crossed, a[Z] - a[ABOVE], radius, highest, f)
            look_at_patch(around, crossed, a[Z] - a[ABOVE], radius, work, f[_PATCH:])
        else:
            f[_TRUNK_PASSED] = -1.0  # rings that run along columns tell nothing: outside of what was trained on
    return out


@njit(cache=True, error_model="numpy")
def _ladder(runs, mine, height, f):
    """How the runs follow each other upwards."""
    n = mine.shape[0]
    free, upper, lower, nu, nl = 0.0, 0.0, 0.0, 0.0, 0.0
    middle = 0.5 * (mine[0] + mine[n - 1])
    for q in range(n):
        i = mine[q]
        free += runs[i, FREE]
        if i > middle:
            upper += runs[i, WIDTH]
            nu += 1.0
        else:
            lower += runs[i, WIDTH]
            nl += 1.0
    first, last = mine[0], mine[n - 1]
    f[_FREE] = free / (2.0 * n)
    f[_TAPER] = (upper / nu - lower / nl) if nu > 0 and nl > 0 else 0.0
    f[_DEPTH_SLOPE] = (runs[last, RANGE] - runs[first, RANGE]) / max(height, 0.3)
    f[_RING_GAP] = (runs[last, RING] - runs[first, RING] + 1.0) / n


@njit(cache=True, error_model="numpy")
def _surface(p, r, runs, label, mine, a, lx, ly, radius, f):
    """The face that is seen: how far from a cylinder, turned to a side, hollow or bulging, and how much shines through.

    A face that is turned away is farther on one side, a trunk on both; leaves let beams through.
    """
    rough, count, between, holes = 0.0, 0.0, 0.0, 0.0
    slant, bow, weight = 0.0, 0.0, 0.0
    sums, counts = np.zeros(3), np.zeros(3)
    for q in range(mine.shape[0]):
        i = mine[q]
        begin, stop = int(runs[i, FIRST]), int(runs[i, LAST])
        third = max((stop - begin + 1) / 3.0, 1.0)
        sums[:], counts[:] = 0.0, 0.0
        for m in range(begin, stop + 1):
            between += 1.0
            if label[m] != i:
                holes += r[m] > runs[i, RANGE] + BEHIND
                continue
            part = min(int((m - begin) / third), 2)
            sums[part] += r[m]
            counts[part] += 1.0
            dx, dy = p[m, 0] - a[X] - lx * (p[m, 2] - a[Z]), p[m, 1] - a[Y] - ly * (p[m, 2] - a[Z])
            rough += (np.sqrt(dx * dx + dy * dy) - radius) ** 2
            count += 1.0
        if counts.min() > 0:
            left, centre, right = sums[0] / counts[0], sums[1] / counts[1], sums[2] / counts[2]
            slant += (right - left) * counts.sum()
            bow += (0.5 * (left + right) - centre) * counts.sum()
            weight += counts.sum()
    f[_ROUGH] = np.sqrt(rough / max(count, 1.0))
    f[_SLANT], f[_BOW] = abs(slant) / max(weight, 1.0), bow / max(weight, 1.0)
    f[_HOLES] = holes / max(between, 1.0)


@njit(cache=True, error_model="numpy")
def _around(above, beside, a, lx, ly, radius, f):
    """What stands beside it, and what hangs over it: a canopy is all around its trunk."""
    side = np.zeros(5)
    look_around(beside, a[X], a[Y], 0.5 + radius, 0.9 + radius, 1.3 + radius, side)
    f[_UNDERGROWTH] = np.log(1.0 + side[1] + side[2])
    f[_CLOSE_BY] = np.log(1.0 + max(side[0] - a[POINTS], 0.0))
    f[_BESIDE] = side[3] + side[4]
    look_around(above, a[X] + 1.5 * lx, a[Y] + 1.5 * ly, 0.35 + radius, 0.9 + radius, 1.6 + radius, side)
    f[_CANOPY], f[_OVERHEAD] = np.log(1.0 + side[1] + side[2]), np.log(1.0 + side[0])
    f[_COVERED_NEAR], f[_COVERED] = side[3], side[4]


@njit(cache=True, error_model="numpy")
def _beams(near, crossed, ground, radius, highest, f):
    """What the beams say that did not hit it: see `look_at`."""
    seen = np.zeros(SEEN_SIZE)
    look_at(near, crossed, ground, radius, highest, seen)
    f[_TRUNK_PASSED] = seen[TRUNK_PASS] / max(seen[TRUNK_HIT] + seen[TRUNK_PASS], 1.0)
    f[_TRUNK_MET] = seen[TRUNK_HIT] / max(seen[TRUNK_RINGS], 1.0)
    looked = seen[AXIS_HIT] + seen[AXIS_PASS]
    f[_AXIS_MET], f[_AXIS_SEEN] = seen[AXIS_HIT] / max(looked, 1.0), np.log(1.0 + looked)
    f[_CROWN], f[_CROWN_SEEN] = seen[CROWN_HIT] / max(seen[CROWN_SEEN], 1.0), np.log(1.0 + seen[CROWN_SEEN])
    f[_TOP] = seen[TOP]
