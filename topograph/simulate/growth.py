"""What grows in a scene and what stands in it, as shapes that rays can hit: one method per kind of thing."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.spatial import ConvexHull

from topograph.geometry import Array
from topograph.simulate.config import OrchardConfig
from topograph.simulate.ground import Ground

# Materials, for intensities and labels.
TRUNK, LEAF, GRASS, GROUND, WOOD, METAL, PERSON, POST, WALL = range(9)

SEGMENT = 0.5
"""Length of the straight pieces of a bent trunk, m."""


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


class Build:
    """Collects shapes."""

    def __init__(self, ground: Ground, rng: np.random.Generator) -> None:
        self.ground, self.rng = ground, rng
        self.cylinders: list[list[float]] = []
        self.blobs: list[list[float]] = []
        self.boxes: list[list[float]] = []
        self.posts: list[Array] = []

    def shapes(self) -> Shapes:
        return Shapes(
            np.array(self.cylinders, float).reshape(-1, 11),
            np.array(self.blobs, float).reshape(-1, 9),
            np.array(self.boxes, float).reshape(-1, 9),
        )

    def foot(self, xy: Array) -> Array:
        """The point of the ground at `xy`."""
        return np.array([xy[0], xy[1], float(self.ground.at(np.asarray(xy)))])

    def direction(self, tilt: float) -> Array:
        """A unit vector that is upright but for a tilt of sigma `tilt`."""
        t = np.clip(self.rng.normal(0, tilt, 2), -2.5 * tilt, 2.5 * tilt)
        d = np.array([t[0], t[1], 1.0])
        return np.asarray(d / np.linalg.norm(d))

    def cylinder(
        self, foot: Array, axis: Array, length: float, r0: float, r1: float, material: int, tree: int = -1
    ) -> None:
        self.cylinders.append([*foot, *axis, length, r0, r1, material, tree])

    def tree(self, config: OrchardConfig, xy: Array, number: int) -> tuple[Array, Array, float, int]:
        """Trunk, stems, branches, canopy and suckers; returns foot, axis, diameter at 0.8 m, stems."""
        rng = self.rng
        foot, axis = self.foot(xy), self.direction(config.lean)
        r = 0.5 * rng.uniform(*config.diameter)
        fork = rng.uniform(*config.canopy_base)
        stems = 1
        sunk = foot - 0.3 * axis
        top = foot + fork * axis
        if rng.random() < config.multi_stem:
            stems = int(rng.integers(2, 4))
            low = rng.uniform(0.25, 0.6)
            self.cylinder(sunk, axis, low + 0.3, 1.25 * r, 1.1 * r, TRUNK, number)
            turn = rng.uniform(0, 2 * np.pi)
            for k in range(stems):
                a = turn + 2 * np.pi * k / stems + rng.normal(0, 0.2)
                d = axis + rng.uniform(0.18, 0.38) * np.array([np.cos(a), np.sin(a), 0.0])
                d /= np.linalg.norm(d)
                self.cylinder(foot + low * axis, d, min(fork, 2.5) - low + 0.4, 0.72 * r, 0.55 * r, TRUNK, number)
        elif config.bend > 0 or fork > 2.5:
            axis, top = self._bent(config, foot, axis, r, fork, number)
        else:
            bend = self.direction(0.4 * config.lean + 0.02) - [0, 0, 1]
            middle = rng.uniform(0.9, 1.2)
            upper = axis + bend
            upper /= np.linalg.norm(upper)
            self.cylinder(sunk, axis, middle + 0.3, 1.12 * r, 0.97 * r, TRUNK, number)
            self.cylinder(foot + middle * axis, upper, max(fork - middle, 0.1) + 0.3, 0.97 * r, 0.85 * r, TRUNK, number)
        if config.flare > 0:
            self.cylinder(sunk, axis, 0.3 + 0.45, (1.1 + config.flare) * r, 1.08 * r, TRUNK, number)
        outline = [np.array([0.0, 0.0, r])]
        if config.lobes > 0 and rng.random() < config.lobes:  # ribs: the trunk's outline is no circle
            for a in rng.uniform(0, 2 * np.pi, int(rng.integers(1, 4))):
                out = 0.35 * r * np.array([np.cos(a), np.sin(a), 0.0])
                self.cylinder(sunk + out, axis, min(fork, 1.6) + 0.3, 0.85 * r, 0.7 * r, TRUNK, number)
                outline.append(np.array([out[0], out[1], 0.77 * r]))
        for _ in range(config.branches):  # stubs and dead branches on the bare trunk
            h = rng.uniform(0.3, max(fork, 0.5))
            d = self.direction(0.3) - [0, 0, 1.0] + 1.5 * np.array([*rng.normal(0, 1, 2), 0.0])
            d /= np.linalg.norm(d)
            self.cylinder(foot + h / fork * (top - foot), d, rng.uniform(0.15, 1.3), 0.012, 0.006, WOOD, number)
        for _ in range(int(rng.integers(2, 5))):
            d = self.direction(0.6)
            self.cylinder(top, d, rng.uniform(0.8, 1.6), 0.4 * r, 0.2 * r, WOOD, number)
        self._crown(config, top)
        if rng.random() < config.suckers:
            for _ in range(int(rng.integers(2, 9))):
                a, far = rng.uniform(0, 2 * np.pi), r + rng.uniform(0.0, 0.12)
                base = self.foot(np.asarray(xy) + far * np.array([np.cos(a), np.sin(a)]))
                self.cylinder(base, self.direction(0.25), rng.uniform(0.3, 1.0), 0.008, 0.006, LEAF)
            self.blobs.append([*(foot + [0, 0, 0.25]), 0.3, 0.3, 0.3, rng.uniform(0.3, 1.2), LEAF, -1])
        middle_of, diameter = _girth(np.array(outline))
        return foot + [*middle_of, 0.0], axis, diameter, stems

    def _bent(
        self, config: OrchardConfig, foot: Array, axis: Array, r: float, fork: float, number: int
    ) -> tuple[Array, Array]:
        """A trunk of straight pieces, each a little off the one below; its chord up to 1.3 m, and its top."""
        d, at, chord = axis, foot, axis
        h = 0.0
        self.cylinder(foot - 0.3 * axis, axis, 0.3, 1.12 * r, 1.1 * r, TRUNK, number)
        while h < fork + 0.3:
            thick = r * max(1.1 - 0.12 * h, 0.6) if fork < 3 else r * max(1.03 - 0.035 * h, 0.5)
            self.cylinder(at, d, SEGMENT + 0.02, thick, 0.97 * thick, TRUNK, number)
            at = at + SEGMENT * d
            h += SEGMENT
            if abs(h - 1.5) < 0.3:
                chord = (at - foot) / np.linalg.norm(at - foot)
            d = d + [*self.rng.normal(0, config.bend + 1e-3, 2), 0.0] + 0.1 * (axis - d)
            d /= np.linalg.norm(d)
        return chord, at

    def _crown(self, config: OrchardConfig, top: Array) -> None:
        rng = self.rng
        spread = rng.uniform(1.0, 1.9) if config.layout != "hedgerow" else rng.uniform(0.6, 0.9)
        crown = rng.uniform(0.9, 1.5)
        dense = rng.uniform(0.8, 2.0)
        if config.crown > 0:
            self.blobs.append([*(top + [0, 0, crown]), spread, spread, crown, config.crown * dense, LEAF, -1])
        if config.crown <= 0:  # twigs
            for _ in range(int(rng.integers(4, 10))):
                self.cylinder(top, self.direction(0.8), rng.uniform(0.5, 1.6), 0.01, 0.005, WOOD)
            return
        for _ in range(int(rng.integers(2, 6))):  # hanging branches, down to trunk height
            a, far = rng.uniform(0, 2 * np.pi), rng.uniform(0.5, 1.0) * spread
            c = top + [far * np.cos(a), far * np.sin(a), rng.uniform(-0.7, 0.2)]
            self.blobs.append([*c, *rng.uniform(0.15, 0.5, 3), config.crown * rng.uniform(0.8, 2.5), LEAF, -1])

    def _anywhere(self, places: Array, clear: float) -> Array:
        low, high = places.min(0) - 4, places.max(0) + 4
        for _ in range(200):
            xy = self.rng.uniform(low, high)
            if np.min(np.hypot(*(places - xy).T)) > clear:
                return np.asarray(xy)
        return np.asarray(xy)

    def post(self, xy: Array, height: float, radius: float, tilt: float) -> None:
        """A post or pole in the ground."""
        foot = self.foot(xy)
        self.posts.append(foot)
        self.cylinder(foot - [0, 0, 0.2], self.direction(tilt), height + 0.2, radius, radius, POST)

    def clutter(self, config: OrchardConfig, places: Array) -> None:
        """Posts, poles, standing people, vehicles, hedges, weeds."""
        rng = self.rng
        for _ in range(config.posts):
            self.post(self._anywhere(places, 0.9), rng.uniform(1.3, 2.2), rng.uniform(0.035, 0.06), 0.03)
        for _ in range(config.poles):
            self.post(self._anywhere(places, 1.5), rng.uniform(5, 8), rng.uniform(0.05, 0.1), 0.01)
        for _ in range(config.people):
            self.blobs.extend(person(self.foot(self._anywhere(places, 1.2)), rng.uniform(0, 2 * np.pi)))
        for _ in range(config.vehicles):
            c = self.foot(places.min(0) - rng.uniform(5, 8, 2)) + [0, 0, 0.9]
            self.boxes.append([*c, 2.1, 0.9, 0.7, rng.uniform(0, np.pi), 1e3, METAL])
        for _ in range(config.hedges):
            side = places.max(0)[1] + rng.uniform(4, 7)
            c = self.foot(np.array([places[:, 0].mean(), side])) + [0, 0, 0.7]
            self.boxes.append([*c, 0.4 * np.ptp(places[:, 0]), 0.5, 0.9, 0.0, 4.0, LEAF])
        area = np.prod(np.ptp(places, axis=0) + 8)
        for _ in range(int(config.weeds * area)):
            r = rng.uniform(0.1, 0.35)
            c = self.foot(self._anywhere(places, 0.3)) + [0, 0, rng.uniform(0.1, 0.6) * r]
            self.blobs.append([*c, r, r, rng.uniform(0.2, 0.8), rng.uniform(0.8, 4.0), GRASS, -1])
        for _ in range(int(config.shrubs * area)):
            self._shrub(self._anywhere(places, 0.6))
        if config.trellis > 0:
            self._trellis(config, places)
        self._yard(config, places)

    def _shrub(self, xy: Array) -> None:
        """Thin stems that part from one foot, leaves around them: as high as a trunk, and no tree."""
        rng, foot, high = self.rng, self.foot(xy), self.rng.uniform(0.5, 2.4)
        thick = rng.uniform(0.006, 0.02)
        for _ in range(int(rng.integers(3, 12))):
            self.cylinder(foot, self.direction(0.35), high, thick, 0.4 * thick, LEAF)
        for _ in range(int(rng.integers(1, 4))):
            r = rng.uniform(0.1, 0.6)
            c = foot + [*rng.normal(0, 0.15, 2), rng.uniform(0.3, 0.9) * high]
            self.blobs.append([*c, r, r, rng.uniform(0.2, 0.6) * high, rng.uniform(0.5, 8.0), LEAF, -1])

    def _trellis(self, config: OrchardConfig, places: Array) -> None:
        """Posts along the rows, two wires between them."""
        rng = self.rng
        height, radius = rng.uniform(1.5, 2.6), rng.uniform(0.03, 0.06)
        for row in range(config.rows):
            y = row * config.row_spacing
            xs = np.arange(-1.0, (config.columns - 1) * config.tree_spacing + config.trellis, config.trellis)
            feet = [np.array([x, y + rng.normal(0, 0.03)]) for x in xs]
            for xy in feet:
                self.post(xy, height, radius * (1.4 if xy is feet[0] or xy is feet[-1] else 1.0), 0.02)
            for a, b in pairwise(feet):
                for h in (0.8, 0.95 * height):
                    p, q = self.foot(a) + [0, 0, h], self.foot(b) + [0, 0, h]
                    length = float(np.linalg.norm(q - p))
                    self.cylinder(p, (q - p) / length, length, 0.003, 0.003, METAL)

    def _outside(self, places: Array, near: float, far: float) -> Array:
        """A place around the trees, `near` to `far` m outside their outline."""
        low, high = places.min(0), places.max(0)
        side, off = int(self.rng.integers(4)), self.rng.uniform(near, far)
        x, y = self.rng.uniform(low, high)
        return np.array([(x, low[1] - off), (x, high[1] + off), (low[0] - off, y), (high[0] + off, y)][side])

    def _yard(self, config: OrchardConfig, places: Array) -> None:
        rng = self.rng
        for _ in range(config.walls):
            for _ in range(20):  # no tree grows through a wall
                c = self.foot(self._outside(places, 3.0, 12.0)) + [0, 0, 1.5]
                half = [rng.uniform(0.4, 6.0), rng.uniform(0.2, 4.0), rng.uniform(1.2, 3.5)]
                yaw = rng.uniform(0, np.pi)
                d = (places - c[:2]) @ np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
                if (np.abs(d) > np.array(half[:2]) + 1.0).any(axis=1).all():
                    self.boxes.append([*c, *half, yaw, 1e3, WALL])
                    break
        for _ in range(config.cars):
            xy, yaw = self._outside(places, 1.5, 9.0), rng.uniform(0, np.pi)
            foot = self.foot(xy)
            self.boxes.append([*(foot + [0, 0, 0.6]), 2.1, 0.85, 0.35, yaw, 1e3, METAL])
            self.boxes.append([*(foot + [0, 0, 1.2]), 1.2, 0.75, 0.3, yaw, rng.uniform(1, 30), METAL])
            for a in (-1.3, 1.3):  # wheels
                for b in (-0.75, 0.75):
                    c, s = np.cos(yaw), np.sin(yaw)
                    w = foot + [c * a - s * b, s * a + c * b, 0.32]
                    self.boxes.append([*w, 0.3, 0.1, 0.3, yaw, 1e3, METAL])
        for _ in range(config.fences):
            middle = self.foot(self._outside(places, 2.0, 8.0)) + [0, 0, 0.6]
            length, turn = float(rng.uniform(4.0, 10.0)), float(rng.uniform(0, np.pi))
            self.boxes.append([*middle, length, 0.02, rng.uniform(0.5, 0.9), turn, rng.uniform(3, 12), METAL])
            for t in np.arange(-length, length + 0.1, 2.5):
                at = middle[:2] + t * np.array([np.cos(turn), np.sin(turn)])
                self.post(at, rng.uniform(1.1, 1.5), 0.04, 0.01)
        for _ in range(config.lamps):
            self.post(self._outside(places, 0.5, 8.0), rng.uniform(4, 9), rng.uniform(0.04, 0.09), 0.005)
        for _ in range(config.signs):
            xy = self._outside(places, 0.5, 8.0)
            self.post(xy, rng.uniform(2.0, 2.8), rng.uniform(0.025, 0.04), 0.01)
            c = self.foot(xy) + [0, 0, rng.uniform(1.7, 2.5)]
            self.boxes.append([*c, 0.3, 0.02, 0.3, rng.uniform(0, np.pi), 1e3, METAL])

    def walkers(self, config: OrchardConfig, places: Array) -> Array:
        """(W, 4) start x, y and velocity x, y of walking people."""
        return np.array(
            [[*self._anywhere(places, 1.5), *(self.rng.normal(0, 0.5, 2))] for _ in range(config.walkers)]
        ).reshape(-1, 4)


def _girth(circles: Array) -> tuple[Array, float]:
    """Centre (2,) of the area that circles (K, 3) x, y, radius cover together, and the diameter that a tape around them reads."""
    if len(circles) == 1:
        return circles[0, :2], 2.0 * float(circles[0, 2])
    reach = np.abs(circles[:, :2]).max() + circles[:, 2].max()
    grid = np.stack(np.meshgrid(*2 * [np.linspace(-reach, reach, 101)]), axis=-1).reshape(-1, 2)
    inside = (np.linalg.norm(grid[:, None] - circles[None, :, :2], axis=2) < circles[:, 2]).any(axis=1)
    turn = np.linspace(0, 2 * np.pi, 60, endpoint=False)
    rim = circles[:, None, :2] + circles[:, None, 2:] * np.stack([np.cos(turn), np.sin(turn)], axis=1)[None]
    return grid[inside].mean(axis=0), float(ConvexHull(rim.reshape(-1, 2)).area / np.pi)


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
