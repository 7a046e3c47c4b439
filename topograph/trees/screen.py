"""What cannot be a landmark: tracks that move, tracks that ride along, and tracks that hardly ever looked like a column.

A tree stands still in the world for longer than it is followed. Nothing of this looks at a single scan.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from topograph.geometry import Array, transform
from topograph.motion import Motion
from topograph.trees.detections import Detections

DRIFT = 0.05
"""Share of the distance driven that dead reckoning may put a still thing off while it is followed."""
SWAY = 0.25
"""A still thing's place may differ so much between its first and last sightings, m: bark, lean, another side of it."""
TURN_DRIFT = 0.02
"""The same per radian turned, at one metre of range, rad."""
TURN_DRIFT_WHEELS = 0.2
"""The same where no gyro measures turns, rad."""
DOUBT = -0.7
"""Mean log-odds (tree or post) below which a track is not a column."""


@dataclass(frozen=True, slots=True)
class Screened:
    """Which detections (N,) may be landmarks, and how many tracks moved, rode along or were no columns."""

    keep: NDArray[np.bool_]
    moved: int
    doubted: int


def screen(detections: Detections, track: NDArray[np.int64], motion: Motion) -> Screened:
    """Judge the tracks (N,) of `detections`."""
    d = detections
    n = int(track.max(initial=-1)) + 1
    if n == 0:
        return Screened(np.zeros(0, bool), 0, 0)
    # Where fixes stand in for wheels, what seems to move may be the robot.
    moving = _moving(d, track, n, motion) if motion.wheels else np.zeros(n, bool)
    doubted = np.zeros(n, bool)
    odds = column_odds(d.kinds)
    told = np.isfinite(odds)
    if told.any():
        count = np.bincount(track[told], minlength=n)
        mean = np.bincount(track[told], odds[told], minlength=n) / np.maximum(count, 1)
        doubted = (count > 0) & (mean < DOUBT)
    hits = np.bincount(track, minlength=n)
    return Screened(~(moving | doubted)[track], int(moving.sum()), int((doubted & ~moving & (hits > 2)).sum()))


def column_odds(kinds: Array) -> Array:
    """Log-odds (N,) of tree or post against all else; NaN where unknown."""
    with np.errstate(invalid="ignore"):
        return np.asarray(np.logaddexp(kinds[:, 0], kinds[:, 1]) - kinds[:, 2])


def _moving(d: Detections, track: NDArray[np.int64], n: int, motion: Motion) -> NDArray[np.bool_]:
    """Tracks (n,) whose last sightings lie elsewhere than the first by more than dead reckoning and a trunk explain."""
    place = transform(motion.at(d.stamps_ns)[d.scan], d.p)[:, :2]
    driven, turned = motion.distance_at(d.stamps_ns)[d.scan], motion.turned_at(d.stamps_ns)[d.scan]
    order = np.lexsort((d.scan, track))
    ends = np.searchsorted(track[order], np.arange(n + 1))
    out = np.zeros(n, bool)
    sigma = np.sqrt(0.5 * (d.cov[:, 0, 0] + d.cov[:, 1, 1]))
    for k in np.flatnonzero(np.diff(ends) >= 4):
        rows = order[ends[k] : ends[k + 1]]
        third = max(len(rows) // 4, 1)
        first, last = rows[:third], rows[-third:]
        shift = float(np.linalg.norm(np.median(place[last], axis=0) - np.median(place[first], axis=0)))
        far = float(np.median(np.linalg.norm(d.p[rows, :2], axis=1)))
        noise = 3.0 * float(np.median(sigma[rows])) / np.sqrt(third)
        drift = DRIFT * float(driven[rows[-1]] - driven[rows[0]])
        drift += (TURN_DRIFT if motion.gyro else TURN_DRIFT_WHEELS) * far * float(turned[rows[-1]] - turned[rows[0]])
        out[k] = shift > SWAY + noise + drift
    return out
