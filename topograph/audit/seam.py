"""Are the trees on both sides of each moment the same ones? Where they are not, dead reckoning broke, and two maps lie side by side."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from topograph.audit.verdict import Finding
from topograph.estimate import Problem

SEAM = 0.35
"""Share of the trees around a moment that are seen on both sides of it, below which they are other ones (clean: 0.72 and more in simulated runs at 5 scans
a second and at 1, 0.79 in a forest, 0.43 where a single layer of a LiDAR tells twigs from trunks badly; where the turn of a robot without
a gyro was off by 8 and 14 degrees: 0.1 and 0.32)."""
REACHES = (2, 4)
"""Keyframes on each side, each of which has to say so: a sensor that looks ahead alone shows others within a few of them as it turns."""
IN_VIEW = 10
"""Trees on each side below which chance makes seams."""
STEP = 1.5
"""Where more was driven unseen between two keyframes, others are in view, m."""
HELD = 10.0
"""Fixes nearer than this hold the path whatever the trees say, m driven."""


def seam(problem: Problem) -> Iterator[Finding]:
    """Does the run fall apart at a moment which no fixes hold together?"""
    driven = problem.motion.distance_at(problem.stamps_ns)
    if len(driven) < 2:
        return
    held = driven[problem.fixes.keyframe]
    free = np.diff(driven) < STEP
    if len(held):
        held = np.sort(held)
        near = np.searchsorted(held, driven[1:])
        before, after = held[np.maximum(near - 1, 0)], held[np.minimum(near, len(held) - 1)]
        free &= np.minimum(np.abs(driven[1:] - before), np.abs(after - driven[1:])) > HELD
    share, least = np.zeros(len(free)), np.full(len(free), IN_VIEW)
    for reach in REACHES:
        both, fewer = common(problem.sightings.keyframe, problem.sightings.tree, len(driven), reach)
        share = np.maximum(share, both[1:] / np.maximum(fewer[1:], 1))
        least = np.minimum(least, fewer[1:])
    share = np.where(free & (least >= IN_VIEW), share, 1.0)
    worst = int(np.argmin(share))
    if share[worst] < SEAM:
        seconds = (problem.stamps_ns[worst + 1] - problem.motion.stamps_ns[0]) * 1e-9
        yield Finding(
            name="seam", value=1.0 - float(share[worst]), bound=1.0 - SEAM, unit="",
            sentence=f"at {seconds:.0f} s only {100 * share[worst]:.0f} % of the trees in view are seen on after it, though the robot has hardly moved: dead reckoning "
            "broke there (a turn on slipping wheels without a gyro?), and what was mapped before and after may lie askew; an IMU or GNSS holds it together",
        )  # fmt: skip


def common(
    keyframe: NDArray[np.int64], tree: NDArray[np.int64], keyframes: int, reach: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """For each of K `keyframes`: how many trees are seen both in the `reach` keyframes before it and in those from it on (K,), and how many are on that side
    which shows fewer (K,). `keyframe` (M,), `tree` (M,) of each sighting. Linear in them.
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
