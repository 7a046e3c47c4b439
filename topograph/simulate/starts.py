"""Orchards of any size in the plane, and drives through them as trunk detections: localization by the thousand starts.

The world differs from the map as real ones do: the map has errors, some trees are gone, some are new; trunks hide each
other; detections miss, invent and are noisy; odometry has a scale error, noise and a heading that wanders.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from topograph.geometry import Array, wrap


@dataclass(frozen=True, slots=True)
class StartsConfig:
    """A family of worlds. Lengths in m.

    Attributes:
        layout: "grid" or "irregular" (hexagonal).
        trees: about how many; `spacing` between them, `row_spacing` between rows.
        jitter: planting error per axis; `gaps` share of empty places.
        felled, new: share of mapped trees that are gone, and of trees that are not mapped; `replanted`: of mapped trees that are gone and
            replaced by another 0.3 to 0.5 m aside.
        map_sigma: the map's error per axis; `diameter`, `diameter_sd` of the population.
        view, sigma, miss, clutter: range of detection, its noise per axis, share missed, share of false ones among all.
        diameter_sigma: of a measured diameter; NaN measures none.
        step: distance between scans; `scale`, `white` of odometry (shares), `wander` of the heading (rad per √m).
    """

    layout: str = "grid"
    trees: int = 100
    spacing: float = 6.0
    row_spacing: float = 6.0
    jitter: float = 0.15
    gaps: float = 0.05
    felled: float = 0.02
    new: float = 0.02
    replanted: float = 0.0
    map_sigma: float = 0.03
    diameter: float = 0.27
    diameter_sd: float = 0.0
    view: float = 15.0
    sigma: float = 0.05
    miss: float = 0.2
    clutter: float = 0.1
    diameter_sigma: float = float("nan")
    step: float = 0.5
    scale: float = 0.02
    white: float = 0.02
    wander: float = 0.007


SCENARIOS: dict[str, StartsConfig] = {
    "A": StartsConfig(),
    "B": StartsConfig(jitter=0.05),
    "C": StartsConfig(jitter=0.30),
    "D": StartsConfig(layout="irregular", spacing=7.0, row_spacing=6.06, jitter=1.0, gaps=0.12),
    "E": StartsConfig(jitter=0.05, gaps=0.0, sigma=0.10, miss=0.3, clutter=0.2),
    "F": StartsConfig(view=8.0, miss=0.3),
    "H": StartsConfig(view=8.0, miss=0.3, clutter=0.2),  # the 8 m bar
    "Fo": StartsConfig(layout="irregular", spacing=7.0, row_spacing=6.06, jitter=1.0, gaps=0.12, view=8.0, miss=0.3),
    "G": StartsConfig(jitter=0.05, view=25.0, sigma=0.10),
    "T": StartsConfig(
        layout="irregular",
        trees=24,
        spacing=7.0,
        row_spacing=6.06,
        jitter=1.0,
        gaps=0.12,
        view=8.0,
        sigma=0.10,
        map_sigma=0.05,
    ),
}


@dataclass(frozen=True, slots=True)
class World:
    """`trees` (N, 2) that stand, with `diameters` (N,); the map's `mapped` (M, 2) and `mapped_diameters` (M,); `true` (M,)
    places of the mapped trees."""

    trees: Array
    diameters: Array
    mapped: Array
    mapped_diameters: Array
    true: Array


@dataclass(frozen=True, slots=True, kw_only=True)
class Step:
    """One scan: the true pose (3,), odometry's motion since the last (3,) in the robot's frame, its length, detections
    (N, 2) in the robot's frame, diameters (N,), and (N,) the tree of each, -1 for false ones."""

    pose: Array
    motion: Array
    distance: float
    p: Array
    diameter: Array
    source: Array


def world(config: StartsConfig, rng: np.random.Generator) -> World:
    """A world and its map."""
    c = config
    wanted = c.trees / (1.0 - c.gaps)
    side = int(np.round(np.sqrt(wanted)))
    columns = int(np.ceil(wanted / max(side, 1)))
    i, j = np.divmod(np.arange(side * columns), columns)
    xy = np.stack([j * c.spacing, i * c.row_spacing], axis=1).astype(float)
    if c.layout == "irregular":
        xy[:, 0] += 0.5 * c.spacing * (i % 2)
    xy += rng.normal(0, c.jitter, xy.shape) if c.jitter > 0 else 0.0
    xy = xy[rng.random(len(xy)) >= c.gaps]
    diameters = np.clip(rng.normal(c.diameter, c.diameter_sd, len(xy)), 0.05, None)
    mapped = xy + rng.normal(0, c.map_sigma, xy.shape)
    stands = rng.random(len(xy)) >= c.felled
    n_new = rng.binomial(len(xy), c.new)
    low, high = xy.min(0) - 3.0, xy.max(0) + 3.0
    now = xy
    if c.replanted > 0:
        aside, way = rng.uniform(0.3, 0.5, len(xy)), rng.uniform(-np.pi, np.pi, len(xy))
        moved = np.stack([aside * np.cos(way), aside * np.sin(way)], axis=1)
        now = xy + moved * (rng.random(len(xy)) < c.replanted)[:, None]
    new = rng.uniform(low, high, (n_new, 2))
    return World(
        np.concatenate([now[stands], new]),
        np.concatenate([diameters[stands], np.clip(rng.normal(c.diameter, c.diameter_sd, n_new), 0.05, None)]),
        mapped,
        diameters + (rng.normal(0, 0.01, len(xy)) if c.diameter_sd > 0 else 0.0),
        xy,
    )


def drive(
    w: World, config: StartsConfig, rng: np.random.Generator, length: float, jump_at: float = np.inf,
    jump: Array | None = None,
) -> Iterator[Step]:  # fmt: skip
    """A drive of `length` metres from a random place and heading to random places in the orchard, never through a tree.

    At `jump_at` metres the robot is carried by `jump` (3,) (x, y, yaw in the world), or to a random place, unnoticed.
    """
    c = config
    tree = cKDTree(w.trees)
    low, high = w.true.min(0), w.true.max(0)  # anywhere in the mapped orchard
    pose = _place(rng, low, high, tree)
    scale = rng.normal(0, c.scale)
    goal = rng.uniform(low, high)
    driven, jumped = 0.0, False
    motion, distance = np.zeros(3), 0.0
    while True:
        p, diameter, source = _scan(w, tree, pose, c, rng)
        yield Step(pose=pose.copy(), motion=motion, distance=distance, p=p, diameter=diameter, source=source)
        if driven >= length - 1e-9:
            return
        if driven >= jump_at and not jumped:
            jumped = True
            pose = _place(rng, low, high, tree) if jump is None else pose + jump
        if np.hypot(*(goal - pose[:2])) < 3.0 or rng.random() < 0.01:
            goal = rng.uniform(low, high)
        turn = _steer(pose, goal, tree, rng) * c.step
        true = np.array([c.step * np.cos(turn / 2), c.step * np.sin(turn / 2), turn])
        cs, sn = np.cos(pose[2]), np.sin(pose[2])
        pose = pose + [cs * true[0] - sn * true[1], sn * true[0] + cs * true[1], turn]
        noise = rng.normal(0, 1, 3) * [c.white * c.step, c.white * c.step, c.wander * np.sqrt(c.step)]
        motion = true * [1 + scale, 1 + scale, 1.0] + noise
        driven += c.step
        distance = c.step


def _place(rng: np.random.Generator, low: Array, high: Array, tree: cKDTree) -> Array:
    while True:
        xy = rng.uniform(low, high)
        if tree.query(xy)[0] > 0.8:
            return np.array([*xy, rng.uniform(-np.pi, np.pi)])


def _steer(pose: Array, goal: Array, tree: cKDTree, rng: np.random.Generator) -> float:
    """Curvature, 1/m: towards the goal, wandering a little, around trees ahead."""
    ahead = pose[:2] + 1.6 * np.array([np.cos(pose[2]), np.sin(pose[2])])
    near = tree.query_ball_point(ahead, 0.9)
    if near:
        d = tree.data[near[0]] - pose[:2]
        side = np.cos(pose[2]) * d[1] - np.sin(pose[2]) * d[0]
        return -0.8 if side > 0 else 0.8
    to = np.arctan2(goal[1] - pose[1], goal[0] - pose[0])
    turn = float(wrap(to - pose[2]))
    return float(np.clip(0.5 * turn, -0.4, 0.4) + rng.normal(0, 0.05))


def _scan(
    w: World, tree: cKDTree, pose: Array, c: StartsConfig, rng: np.random.Generator
) -> tuple[Array, Array, Array]:
    rows = np.array(tree.query_ball_point(pose[:2], c.view), dtype=int)
    d = w.trees[rows] - pose[:2]
    cs, sn = np.cos(pose[2]), np.sin(pose[2])
    p = np.stack([cs * d[:, 0] + sn * d[:, 1], -sn * d[:, 0] + cs * d[:, 1]], axis=1)
    reach, bearing = np.hypot(p[:, 0], p[:, 1]), np.arctan2(p[:, 1], p[:, 0])
    order = np.argsort(reach)
    half = 0.5 * w.diameters[rows] / np.maximum(reach, 0.5)
    apart = np.abs(wrap(bearing[order, None] - bearing[None, order]))
    hidden = np.tril(apart < half[None, order], -1).any(axis=1)
    keep = order[~hidden & (rng.random(len(order)) >= c.miss)]
    n = len(keep)
    n_false = rng.binomial(max(n, 1), c.clutter / (1.0 - c.clutter)) if c.clutter > 0 else 0
    r, a = c.view * np.sqrt(rng.random(n_false)), rng.uniform(-np.pi, np.pi, n_false)
    seen = np.concatenate([p[keep] + rng.normal(0, c.sigma, (n, 2)), np.stack([r * np.cos(a), r * np.sin(a)], axis=1)])
    true_d = np.concatenate([w.diameters[rows[keep]], rng.normal(c.diameter, max(c.diameter_sd, 0.03), n_false)])
    diameter = true_d + (rng.normal(0, c.diameter_sigma, len(true_d)) if np.isfinite(c.diameter_sigma) else np.nan)
    return seen, diameter, np.concatenate([rows[keep], np.full(n_false, -1)])
