"""What cannot be a landmark: tracks that move, tracks that ride along, and tracks that hardly ever looked like a column.

A tree stands still in the world for longer than it is followed. Nothing of this looks at a single scan.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from topograph.geometry import Array, transform
from topograph.motion import Motion
from topograph.trees.detections import Detections
from topograph.trunks.score import column_odds

DRIFT = 0.05
"""Share of the distance driven that dead reckoning may put a still thing off while it is followed."""
NOISE = 0.35
"""What noise may explain at most, m: a thing whose place is known no better marks none."""
GROUPS = 4
"""Parts of a track, in time, that are compared."""
SWAY = 0.3
"""A still thing's place may differ so much between parts of its track, m: another side of it, another stem."""
TURN_DRIFT = 0.02
"""The same per radian turned, at one metre of range, rad."""
TURN_DRIFT_WHEELS = 0.2
"""The same where no gyro measures turns, rad."""
DOUBT = -0.7
"""Mean log-odds (tree or post) below which a track is not a column."""


@dataclass(frozen=True, slots=True)
class Screened:
    """Which detections (N,) may be landmarks, how many tracks moved, rode along or were no columns, and the share of the detections
    that were of moving ones."""

    keep: NDArray[np.bool_]
    moved: int
    doubted: int
    moving: float


def screen(detections: Detections, track: NDArray[np.int64], motion: Motion, held_T_robot: Array) -> Screened:
    """Judge the tracks (N,) of `detections`, seen from `held_T_robot` (S, 4, 4), as `follow` has it: what the wheels put off is not what moves."""
    d = detections
    n = int(track.max(initial=-1)) + 1
    if n == 0:
        return Screened(np.zeros(0, bool), 0, 0, 0.0)
    # Where fixes stand in for wheels, what seems to move may be the robot.
    moving = _moving(d, track, n, motion, held_T_robot) if motion.wheels else np.zeros(n, bool)
    doubted = np.zeros(n, bool)
    told = np.isfinite(d.kinds).all(axis=1)
    if told.any():
        count = np.bincount(track[told], minlength=n)
        mean = np.bincount(track[told], column_odds(d.kinds[told]), minlength=n) / np.maximum(count, 1)
        doubted = (count > 0) & (mean < DOUBT)
    hits = np.bincount(track, minlength=n)
    return Screened(
        ~(moving | doubted)[track],
        int(moving.sum()),
        int((doubted & ~moving & (hits > 2)).sum()),
        float(moving[track].mean()),
    )


def _moving(d: Detections, track: NDArray[np.int64], n: int, motion: Motion, held_T_robot: Array) -> NDArray[np.bool_]:
    """Tracks (n,) of which two parts lie further apart than dead reckoning and a trunk explain."""
    place = transform(held_T_robot[d.scan], d.p)[:, :2]
    far = np.linalg.norm(d.p[:, :2], axis=1)
    mean_far = (np.bincount(track, far, n) / np.maximum(np.bincount(track, minlength=n), 1))[track]
    bend = TURN_DRIFT if motion.gyro else TURN_DRIFT_WHEELS
    drift = DRIFT * motion.distance_at(d.stamps_ns)[d.scan] + bend * mean_far * motion.turned_at(d.stamps_ns)[d.scan]
    return parts_apart(place, d, track, n, drift, SWAY)


def parts_apart(
    place: Array, d: Detections, label: NDArray[np.int64], n: int, drift: Array, sway: float
) -> NDArray[np.bool_]:
    """Labels (n,) of whose sightings at `place` (N, 2) two parts in time lie further apart than `sway`, their noise and the
    difference of `drift` (N,) between them, m. A sighting whose `label` (N,) is negative is of none.
    """
    order = np.lexsort((d.scan, label))
    order = order[label[order] >= 0]
    label = label[order]
    ends = np.searchsorted(label, np.arange(n + 1))
    count = np.diff(ends)
    long = np.flatnonzero(count >= GROUPS)
    rank = np.arange(len(order)) - np.repeat(ends[:-1], count)  # of a sighting in its label, in time
    size, more = np.repeat(count // GROUPS, count), np.repeat(count % GROUPS, count)  # the first parts have one more
    part = np.where(
        rank < more * (size + 1), rank // (size + 1), more + (rank - more * (size + 1)) // np.maximum(size, 1)
    )
    group = label * GROUPS + part
    # Wide on purpose (metres along a leaning axis are taken as they come): wheels that slip move still things, too.
    place, spread = place[order], np.sqrt(0.5 * (d.cov[order, 0, 0] + d.cov[order, 1, 1]))
    middle = np.stack([_medians(place[:, k], group, n * GROUPS) for k in range(2)], axis=1).reshape(n, GROUPS, 2)
    way = _medians(drift[order], group, n * GROUPS).reshape(n, GROUPS)
    sigma = _medians(spread, label, n)[long]
    noise = np.minimum(3.0 * sigma / np.sqrt(count[long] / GROUPS), NOISE)
    out = np.zeros(n, bool)
    for i, j in combinations(range(GROUPS), 2):
        apart = np.linalg.norm(middle[long, j] - middle[long, i], axis=1)
        out[long] |= apart > sway + noise + np.abs(way[long, j] - way[long, i])
    return out


def _medians(values: Array, label: NDArray[np.int64], n: int) -> Array:
    """Median (n,) of the values (N,) of each label; NaN where there is none, or one of them is NaN."""
    v = values[np.lexsort((values, label))]  # NaN last
    count = np.bincount(label, minlength=n)
    begin = np.cumsum(count) - count
    out = np.full(n, np.nan)
    some = np.flatnonzero(count)
    last = v[begin[some] + count[some] - 1]
    middle = 0.5 * (v[begin[some] + (count[some] - 1) // 2] + v[begin[some] + count[some] // 2])
    out[some] = np.where(np.isnan(last), np.nan, middle)
    return out
