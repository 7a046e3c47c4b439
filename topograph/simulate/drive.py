"""Drives a robot through an orchard: the thesis's three runs (5.3) as smooth paths on uneven ground."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.ndimage import gaussian_filter1d

from topograph.geometry import Array, Stamps, interpolate, se3
from topograph.simulate.config import DriveConfig
from topograph.simulate.orchard import Orchard

STEP_S = 0.01
START_NS = 1_690_000_000_000_000_000


@dataclass(frozen=True, slots=True)
class Drive:
    """True poses `world_T_robot` (M, 4, 4) every `STEP_S`, at `stamps_ns` (M,), and the distance driven (M,), m."""

    stamps_ns: Stamps
    world_T_robot: Array
    distance: Array

    def at(self, stamps_ns: Stamps) -> Array:
        """Poses (K, 4, 4) at any stamps."""
        return interpolate(self.stamps_ns, self.world_T_robot, stamps_ns)


def drive(orchard: Orchard, config: DriveConfig, seed: int) -> Drive:
    """The drive of one run; equal seeds give equal drives."""
    rng = np.random.default_rng([seed, 23, config.run])
    return along(orchard, _smooth(np.concatenate([_waypoints(orchard, config.run)] * config.laps), rng), config)


def along(orchard: Orchard, line: Array, config: DriveConfig) -> Drive:
    """The drive along a line (K, 2), m."""
    s_line = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))])
    s = _distance(float(s_line[-1]), config)
    s = s[: int(config.longest_s / STEP_S)]
    xy = np.stack([np.interp(s, s_line, line[:, k]) for k in range(2)], axis=1)
    ahead = np.stack([np.interp(s + 0.25, s_line, line[:, k]) for k in range(2)], axis=1)
    behind = np.stack([np.interp(s - 0.25, s_line, line[:, k]) for k in range(2)], axis=1)
    yaw = np.unwrap(np.arctan2(*(ahead - behind).T[::-1]))
    stamps = START_NS + (np.arange(len(s)) * int(STEP_S * 1e9)).astype(np.int64)
    return Drive(stamps, _on_ground(orchard, xy, yaw), s)


def _waypoints(orchard: Orchard, run: int) -> Array:
    c = orchard.config
    first, last = -3.0, (c.columns - 1) * c.tree_spacing + 3.0
    last += 0.5 * c.tree_spacing if c.layout == "irregular" else 0.0
    alleys = [(k + 0.5) * c.row_spacing for k in range(max(c.rows - 1, 1))]
    if len(alleys) == 3:
        alleys = [alleys[0], alleys[2]]  # the thesis: down, around, and back on a parallel path
    if len(alleys) % 2:
        alleys.append(alleys[-1] + c.row_spacing)
    points: list[tuple[float, float]] = []
    if run in (1, 2):
        for k, y in enumerate(alleys):
            points += [(first, y), (last, y)] if k % 2 == 0 else [(last, y), (first, y)]
        points += [(first - 1.5, alleys[0] + 0.5), (first, alleys[0])]
        xy = np.array(points)
        return xy[::-1] if run == 2 else xy
    if c.layout in ("hedgerow", "wild"):  # too narrow to cross a row: weave within the alley
        x = np.linspace(first, last, 40)
        sides = [np.stack([x, y + 0.7 * np.sin(x)], axis=1) for y in alleys[:2]]
        return np.concatenate([sides[0], sides[1][::-1], sides[0][:1]])
    crossings = first + 3.0 + c.tree_spacing * (np.arange(c.columns + 1) - 0.5)
    half = 0.5 * c.row_spacing
    rows = [1, min(2, c.rows - 1)] if c.rows > 2 else [0, c.rows - 1]
    out: list[tuple[float, float]] = []
    for k, row in enumerate(rows):
        # Cross each row midway between its trees.
        shift = 0.5 * c.tree_spacing * (row % 2) if c.layout == "irregular" else 0.0
        zigzag = [(xi + shift, row * c.row_spacing + half * (-1) ** i) for i, xi in enumerate(crossings)]
        middle = [((a[0] + b[0]) / 2, (a[1] + b[1]) / 2) for a, b in pairwise(zigzag)]
        mixed = [p for pair in zip(zigzag, middle, strict=False) for p in pair] + [zigzag[-1]]
        out += mixed if k == 0 else mixed[::-1]
    out += [(first - 1.5, out[0][1]), out[0]]
    return np.array(out)


def _smooth(points: Array, rng: np.random.Generator) -> Array:
    keep = np.concatenate([[True], np.hypot(*np.diff(points, axis=0).T) > 1e-6])
    points = points[keep]
    s = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
    fine = np.arange(0, s[-1], 0.05)
    line = np.stack([np.interp(fine, s, points[:, k]) for k in range(2)], axis=1)
    wander = gaussian_filter1d(rng.normal(size=line.shape), 40, axis=0) * 0.15 * np.sqrt(40) * 1.9
    return np.asarray(gaussian_filter1d(line, 18, axis=0, mode="nearest") + wander)


def _distance(length: float, config: DriveConfig) -> Array:
    """Distance driven at each step: a pause at the start, gentle ramps, stops when asked."""
    stops = np.arange(config.stop_every, length, config.stop_every) if config.stop_every > 0 else np.zeros(0)
    s, v, wait, next_stop, rest = [0.0], 0.0, 3.0, 0, 2.0
    while s[-1] < length - 0.02:
        if wait > 0:
            wait -= STEP_S
            s.append(s[-1])
            continue
        end = stops[next_stop] if next_stop < len(stops) else length
        if end - s[-1] < 0.02 and next_stop < len(stops):
            next_stop += 1
            wait, v = config.stop_s, 0.0
            continue
        v = min(v + 0.5 * STEP_S, config.speed, np.sqrt(2 * 0.5 * max(end - s[-1], 0.0)) + 0.02)
        s.append(s[-1] + v * STEP_S)
    s += [s[-1]] * int(rest / STEP_S)
    return gaussian_filter1d(np.array(s), 10, mode="nearest")


def _on_ground(orchard: Orchard, xy: Array, yaw: Array) -> Array:
    """Poses of a four-wheeled robot whose wheels stand on the ground, with the suspension's smoothing."""
    c, s = np.cos(yaw), np.sin(yaw)
    h = {}
    for dx in (-0.26, 0.26):
        for dy in (-0.28, 0.28):
            wheel = xy + np.stack([c * dx - s * dy, s * dx + c * dy], axis=1)
            h[dx, dy] = gaussian_filter1d(orchard.ground.at(wheel), 6, mode="nearest")
    z = sum(h.values()) / 4
    pitch_slope = (h[0.26, 0.28] + h[0.26, -0.28] - h[-0.26, 0.28] - h[-0.26, -0.28]) / (4 * 0.26)
    roll_slope = (h[0.26, 0.28] + h[-0.26, 0.28] - h[0.26, -0.28] - h[-0.26, -0.28]) / (4 * 0.28)
    x_axis = np.stack([c, s, pitch_slope], axis=1)
    y_axis = np.stack([-s, c, roll_slope], axis=1)
    x_axis /= np.linalg.norm(x_axis, axis=1, keepdims=True)
    z_axis = np.cross(x_axis, y_axis)
    z_axis /= np.linalg.norm(z_axis, axis=1, keepdims=True)
    y_axis = np.cross(z_axis, x_axis)
    return se3(np.stack([x_axis, y_axis, z_axis], axis=2), np.column_stack([xy, z]))
