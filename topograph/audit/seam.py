"""Are the trees on both sides of each moment the same ones? Where they are not, dead reckoning broke, and two maps lie side by side."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from scipy.stats import binom

from topograph.audit.checks import AWAY, from_path
from topograph.audit.verdict import Finding
from topograph.estimate import Estimate, Problem
from topograph.geometry import Array

SEAM = 0.35
"""Share of the trees around a moment that are seen on both sides of it, below which they are other ones (clean: 0.72 and more in simulated runs at 5 scans
a second and at 1, 0.67 in those of another author, 0.79 in a forest, 0.43 where a single layer of a LiDAR tells twigs from trunks badly; where the turn of
a robot without a gyro was off by 8 and 14 degrees: 0.1 and 0.32)."""
CHANCE = 0.01
"""That so few go on somewhere in a run in which trees go on as they usually do there."""
REACHES = (2, 4)
"""Keyframes on each side, each of which has to say so."""
IN_VIEW = 6
"""Trees on each side, at least."""
STEP, VIEW = 1.5, 0.25
"""Where more was driven unseen between two keyframes, in m and in the usual distance of a tree, others are in view."""
FIELD = 1 / 3
"""Share of the field of view that a sensor may turn by between two keyframes, and show the same trees."""
HELD, SHARP = 10.0, 1.0
"""Believed fixes within so many m driven on both sides, each known to so many m, hold the path whatever the trees say."""


def seam(problem: Problem, estimate: Estimate) -> Iterator[Finding]:
    """Does the run fall apart at a moment which no fixes hold together?"""
    n, s = len(problem.stamps_ns), problem.sightings
    if n < 2 or not len(s):
        return
    driven = problem.motion.distance_at(problem.stamps_ns)
    step, turn = np.diff(driven), np.diff(problem.motion.turned_at(problem.stamps_ns))
    usual = float(np.median(np.linalg.norm(s.p[:, :2], axis=1)))
    free = (step < max(STEP, VIEW * usual)) & (turn < FIELD * _field(s.p))
    # What is cut apart by a gap is no neighbour: as many empty keyframes lie between as are looked at.
    row = np.arange(n) + max(REACHES) * np.concatenate([[0], np.cumsum(~free)])
    counts = [common(row[s.keyframe], s.tree, int(row[-1]) + 1, reach) for reach in REACHES]
    both, fewer = np.swapaxes(counts, 0, 1)[..., row[1:]]  # (reaches, K - 1)
    goes_on = both / np.maximum(fewer, 1)
    enough = free & (fewer >= IN_VIEW)
    if not enough.any(axis=1).all():
        return
    usually = np.array([[np.median(share[asked])] for share, asked in zip(goes_on, enough, strict=True)])
    chance = binom.cdf(both, fewer, usually) * enough.sum(axis=1, keepdims=True)
    falls_apart = (enough & (chance < CHANCE)).all(axis=0) & ~_held(problem, estimate, driven)
    share = np.where(falls_apart, goes_on.max(axis=0), 1.0)
    worst = int(np.argmin(share))
    if share[worst] < SEAM:
        seconds = (problem.stamps_ns[worst + 1] - problem.motion.stamps_ns[0]) * 1e-9
        gyro = problem.motion.gyro
        why = "scans were lost, the LiDAR was knocked, the recording paused" if gyro else "a turn on wheels that slip"
        yield Finding(
            name="seam", value=1.0 - float(share[worst]), bound=1.0 - SEAM, unit="",
            sentence=f"at {seconds:.0f} s ({driven[worst + 1]:.0f} m driven) the trees in view before and after are hardly the same ({both[-1, worst]} of {fewer[-1, worst]}), though "
            f"the robot moved {step[worst]:.1f} m: dead reckoning may have broken there ({why}), and what was mapped before and after may lie askew; "
            f"{'GNSS' if gyro else 'an IMU or GNSS'} holds it together",
        )  # fmt: skip


def _field(p: Array) -> float:
    """Field of view in which things are seen at (M, 3) in the robot's frame, rad: all but the widest gap of their bearings."""
    bearing = np.sort(np.arctan2(p[:, 1], p[:, 0]))
    return float(2.0 * np.pi - np.diff(np.append(bearing, bearing[0] + 2.0 * np.pi)).max())


def _held(problem: Problem, estimate: Estimate, driven: Array) -> NDArray[np.bool_]:
    """(K-1,) steps between keyframes with fixes before and after that the path believes."""
    away, sigma = from_path(problem, estimate)
    believed = np.linalg.norm(away, axis=1) < np.maximum(AWAY[0], AWAY[1] * sigma)
    good = np.sort(driven[problem.fixes.keyframe[believed & (sigma < SHARP)]])
    if not len(good):
        return np.zeros(len(driven) - 1, bool)
    before = np.searchsorted(good, driven[:-1], side="right") - 1
    after = np.searchsorted(good, driven[1:], side="left")
    near = (before >= 0) & (driven[:-1] - good[np.maximum(before, 0)] < HELD)
    return np.asarray(near & (after < len(good)) & (good[np.minimum(after, len(good) - 1)] - driven[1:] < HELD))


def common(
    keyframe: NDArray[np.int64], tree: NDArray[np.int64], keyframes: int, reach: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """For each of K `keyframes`: how many trees are seen both in the `reach` keyframes before it and in those from it on (K,), and how many are on that side
    which shows fewer (K,). `keyframe` (M,), `tree` (M,) of each sighting. Sorts them once.
    """
    pair = np.unique(tree * keyframes + keyframe)
    if not len(pair):
        return np.zeros(keyframes, np.int64), np.zeros(keyframes, np.int64)
    f, t = pair % keyframes, pair // keyframes
    goes_on = np.append(t[1:] == t[:-1], False)
    after = np.where(goes_on, np.append(f[1:], 0), keyframes + reach)
    earlier = np.where(np.roll(goes_on, 1), np.roll(f, 1), -reach - 1)
    before = _covered(f + 1, np.minimum(f + reach, after), keyframes)
    since = _covered(np.maximum(f - reach + 1, earlier + 1), f, keyframes)
    g = after[goes_on]
    f = f[goes_on]
    both = _covered(np.maximum(f + 1, g - reach + 1), np.minimum(f + reach, g), keyframes)
    return both, np.minimum(before, since)


def _covered(first: NDArray[np.int64], last: NDArray[np.int64], n: int) -> NDArray[np.int64]:
    """(n,) how many of the intervals from `first` to `last`, both within, hold each of 0..n-1."""
    first, last = np.maximum(first, 0), np.minimum(last, n - 1)
    some = first <= last
    steps = np.bincount(first[some], minlength=n + 1) - np.bincount(last[some] + 1, minlength=n + 1)
    return np.asarray(np.cumsum(steps)[:n], np.int64)
