"""A seeded orchard: ground, trees, and what stands between them, as shapes that rays can hit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from topograph.geometry import Array
from topograph.simulate.config import OrchardConfig

CELL = 0.25
"""Grid of the ground, m."""

# Materials, for intensities and labels.
TRUNK, LEAF, GRASS, GROUND, WOOD, METAL, PERSON = range(7)


@dataclass(frozen=True, slots=True)
class Ground:
    """Heights (ny, nx) of the bare ground and of the grass above it, on a grid of `CELL` from `origin`."""

    origin: Array
    height: Array
    grass: Array

    def at(self, xy: Array) -> Array:
        """Ground height (...) at positions (..., 2), bilinear."""
        g = (np.asarray(xy) - self.origin) / CELL
        ny, nx = self.height.shape
        j = np.clip(g[..., 0].astype(int), 0, nx - 2)
        i = np.clip(g[..., 1].astype(int), 0, ny - 2)
        u, v = g[..., 0] - j, g[..., 1] - i
        h = self.height
        return np.asarray(
            (1 - v) * ((1 - u) * h[i, j] + u * h[i, j + 1]) + v * ((1 - u) * h[i + 1, j] + u * h[i + 1, j + 1])
        )


@dataclass(frozen=True, slots=True)
class Shapes:
    """What rays hit.

    Attributes:
        cylinders: (C, 11) foot xyz, unit axis xyz, length, radius at the foot, at the top, material, tree id or -1.
        blobs: (B, 9) porous ellipsoids: centre xyz, radii xyz, hits per metre, material, tree id or -1.
        boxes: (X, 9) centre xyz, half sizes xyz, yaw, hits per metre, material.
    """

    cylinders: Array
    blobs: Array
    boxes: Array


@dataclass(frozen=True, slots=True)
class Orchard:
    """The scene and its trees (feet (N, 3) on the ground, axes (N, 3), diameters (N,), stems (N,))."""

    config: OrchardConfig
    ground: Ground
    shapes: Shapes
    trees: Array
    axes: Array
    diameters: Array
    stems: NDArray[np.int64]
    walkers: Array


def plant(config: OrchardConfig, seed: int) -> Orchard:
    """An orchard of a design; equal seeds give equal orchards."""
    rng = np.random.default_rng([seed, 17])
    places = _places(config, rng)
    ground = _ground(config, places, rng)
    build = _Build(ground, rng)
    trees = [build.tree(config, xy, i) for i, xy in enumerate(places)]
    build.clutter(config, places)
    walkers = build.walkers(config, places)
    feet = np.array([t[0] for t in trees])
    return Orchard(
        config,
        ground,
        build.shapes(),
        feet,
        np.array([t[1] for t in trees]),
        np.array([t[2] for t in trees]),
        np.array([t[3] for t in trees], np.int64),
        walkers,
    )


def _places(config: OrchardConfig, rng: np.random.Generator) -> Array:
    i, j = np.meshgrid(np.arange(config.columns), np.arange(config.rows), indexing="ij")
    xy = np.stack([i.ravel() * config.tree_spacing, j.ravel() * config.row_spacing], axis=1).astype(float)
    if config.layout == "irregular":
        xy[:, 0] += 0.5 * config.tree_spacing * (j.ravel() % 2)
    xy += np.clip(rng.normal(0, config.jitter, xy.shape), -2.2 * config.jitter, 2.2 * config.jitter)
    return np.asarray(xy[rng.random(len(xy)) >= config.gaps])


def _ground(config: OrchardConfig, places: Array, rng: np.random.Generator) -> Ground:
    low, high = places.min(0) - 70.0, places.max(0) + 70.0
    nx, ny = ((high - low) / CELL).astype(int) + 2
    x = low[0] + CELL * np.arange(nx)
    y = low[1] + CELL * np.arange(ny)

    def waves(length: float) -> Array:
        w = gaussian_filter(rng.normal(size=(ny, nx)), length / CELL, mode="wrap")
        return np.asarray(w / w.std())

    height = -np.tan(config.slope) * x[None, :] + 0.03 * y[:, None]
    height = height + config.roughness * (2.0 * waves(6.0) + 0.5 * waves(1.5)) + 0.01 * waves(0.3)
    grass = config.grass * np.clip(0.5 + 0.7 * waves(2.0), 0.0, 2.0)
    return Ground(low, height, grass)


class _Build:
    """Collects shapes; one method per kind of thing."""

    def __init__(self, ground: Ground, rng: np.random.Generator) -> None:
        self.ground, self.rng = ground, rng
        self.cylinders: list[list[float]] = []
        self.blobs: list[list[float]] = []
        self.boxes: list[list[float]] = []

    def shapes(self) -> Shapes:
        return Shapes(
            np.array(self.cylinders, float).reshape(-1, 11),
            np.array(self.blobs, float).reshape(-1, 9),
            np.array(self.boxes, float).reshape(-1, 9),
        )

    def _foot(self, xy: Array) -> Array:
        return np.array([xy[0], xy[1], float(self.ground.at(np.asarray(xy)))])

    def _direction(self, tilt: float) -> Array:
        t = np.clip(self.rng.normal(0, tilt, 2), -2.5 * tilt, 2.5 * tilt)
        d = np.array([t[0], t[1], 1.0])
        return np.asarray(d / np.linalg.norm(d))

    def _cylinder(
        self, foot: Array, axis: Array, length: float, r0: float, r1: float, material: int, tree: int = -1
    ) -> None:
        self.cylinders.append([*foot, *axis, length, r0, r1, material, tree])

    def tree(self, config: OrchardConfig, xy: Array, number: int) -> tuple[Array, Array, float, int]:
        """Trunk, stems, branches, canopy and suckers; returns foot, axis, diameter at 0.8 m, stems."""
        rng = self.rng
        foot, axis = self._foot(xy), self._direction(config.lean)
        r = 0.5 * rng.uniform(*config.diameter)
        fork = rng.uniform(*config.canopy_base)
        stems = 1
        sunk = foot - 0.3 * axis
        if rng.random() < config.multi_stem:
            stems = int(rng.integers(2, 4))
            low = rng.uniform(0.25, 0.6)
            self._cylinder(sunk, axis, low + 0.3, 1.25 * r, 1.1 * r, TRUNK, number)
            turn = rng.uniform(0, 2 * np.pi)
            for k in range(stems):
                a = turn + 2 * np.pi * k / stems + rng.normal(0, 0.2)
                d = axis + rng.uniform(0.18, 0.38) * np.array([np.cos(a), np.sin(a), 0.0])
                d /= np.linalg.norm(d)
                self._cylinder(foot + low * axis, d, fork - low + 0.4, 0.72 * r, 0.55 * r, TRUNK, number)
        else:
            bend = self._direction(0.4 * config.lean + 0.02) - [0, 0, 1]
            middle = rng.uniform(0.9, 1.2)
            upper = axis + bend
            upper /= np.linalg.norm(upper)
            self._cylinder(sunk, axis, middle + 0.3, 1.12 * r, 0.97 * r, TRUNK, number)
            self._cylinder(
                foot + middle * axis, upper, max(fork - middle, 0.1) + 0.3, 0.97 * r, 0.85 * r, TRUNK, number
            )
        top = foot + fork * axis
        for _ in range(int(rng.integers(2, 5))):
            d = self._direction(0.6)
            self._cylinder(top, d, rng.uniform(0.8, 1.6), 0.4 * r, 0.2 * r, WOOD)
        spread = rng.uniform(1.0, 1.9) if config.layout != "hedgerow" else rng.uniform(0.6, 0.9)
        crown = rng.uniform(0.9, 1.5)
        self.blobs.append([*(top + [0, 0, crown]), spread, spread, crown, rng.uniform(0.8, 2.0), LEAF, -1])
        for _ in range(int(rng.integers(2, 6))):  # hanging branches, down to trunk height
            a, far = rng.uniform(0, 2 * np.pi), rng.uniform(0.5, 1.0) * spread
            c = top + [far * np.cos(a), far * np.sin(a), rng.uniform(-0.7, 0.2)]
            self.blobs.append([*c, *rng.uniform(0.15, 0.5, 3), rng.uniform(0.8, 2.5), LEAF, -1])
        if rng.random() < config.suckers:
            for _ in range(int(rng.integers(2, 9))):
                a, far = rng.uniform(0, 2 * np.pi), r + rng.uniform(0.0, 0.12)
                base = self._foot(np.asarray(xy) + far * np.array([np.cos(a), np.sin(a)]))
                self._cylinder(base, self._direction(0.25), rng.uniform(0.3, 1.0), 0.008, 0.006, LEAF)
            self.blobs.append([*(foot + [0, 0, 0.25]), 0.3, 0.3, 0.3, rng.uniform(0.3, 1.2), LEAF, -1])
        return foot, axis, 2 * r, stems

    def _anywhere(self, places: Array, clear: float) -> Array:
        low, high = places.min(0) - 4, places.max(0) + 4
        for _ in range(200):
            xy = self.rng.uniform(low, high)
            if np.min(np.hypot(*(places - xy).T)) > clear:
                return np.asarray(xy)
        return np.asarray(xy)

    def clutter(self, config: OrchardConfig, places: Array) -> None:
        """Posts, poles, standing people, vehicles, hedges, weeds."""
        rng = self.rng
        for _ in range(config.posts):
            self._cylinder(self._foot(self._anywhere(places, 0.9)) - [0, 0, 0.2], self._direction(0.03),
                           rng.uniform(1.3, 2.2) + 0.2, r := rng.uniform(0.035, 0.06), r, WOOD)  # fmt: skip
        for _ in range(config.poles):
            self._cylinder(self._foot(self._anywhere(places, 1.5)) - [0, 0, 0.2], self._direction(0.01),
                           rng.uniform(5, 8), r := rng.uniform(0.08, 0.14), r, METAL)  # fmt: skip
        for _ in range(config.people):
            self.blobs.extend(person(self._foot(self._anywhere(places, 1.2)), rng.uniform(0, 2 * np.pi)))
        for _ in range(config.vehicles):
            c = self._foot(places.min(0) - rng.uniform(5, 8, 2)) + [0, 0, 0.9]
            self.boxes.append([*c, 2.1, 0.9, 0.7, rng.uniform(0, np.pi), 1e3, METAL])
        for _ in range(config.hedges):
            side = places.max(0)[1] + rng.uniform(4, 7)
            c = self._foot(np.array([places[:, 0].mean(), side])) + [0, 0, 0.7]
            self.boxes.append([*c, 0.4 * np.ptp(places[:, 0]), 0.5, 0.9, 0.0, 4.0, LEAF])
        area = np.prod(np.ptp(places, axis=0) + 8)
        for _ in range(int(config.weeds * area)):
            r = rng.uniform(0.1, 0.35)
            c = self._foot(self._anywhere(places, 0.3)) + [0, 0, rng.uniform(0.1, 0.6) * r]
            self.blobs.append([*c, r, r, rng.uniform(0.2, 0.8), rng.uniform(0.8, 4.0), GRASS, -1])

    def walkers(self, config: OrchardConfig, places: Array) -> Array:
        """(W, 4) start x, y and velocity x, y of walking people."""
        return np.array(
            [[*self._anywhere(places, 1.5), *(self.rng.normal(0, 0.5, 2))] for _ in range(config.walkers)]
        ).reshape(-1, 4)


def person(foot: Array, turn: float) -> list[list[float]]:
    """Ellipsoids (legs, torso, head) of somebody who stands at `foot`."""
    side = 0.11 * np.array([np.cos(turn), np.sin(turn), 0.0])
    solid = 60.0
    return [
        [*(foot + side + [0, 0, 0.42]), 0.085, 0.085, 0.45, solid, PERSON, -1],
        [*(foot - side + [0, 0, 0.42]), 0.085, 0.085, 0.45, solid, PERSON, -1],
        [*(foot + [0, 0, 1.15]), 0.2, 0.2, 0.38, solid, PERSON, -1],
        [*(foot + [0, 0, 1.63]), 0.1, 0.1, 0.14, solid, PERSON, -1],
    ]
