"""Drives through recorded trees: clouds of real stems stand in for the simulator's shapes, under its robot, sensors and clocks.

Two kinds of wood. A *plot* is a recorded cloud, ground and understory with it: "lpine1" as it is; in the other two, which a hundred points on a square
metre show, the bark is closed between its points (`_closed`), and nine in ten returns of stems come from what is so made. A *planting* is an orchard's design
in which each tree is one of a plot's, cut out and turned about its axis, each of them several times; the ground between is the simulator's. A beam is a
cell of 0.2 degrees here, wider than a VLP-16's: diameters come out thicker by what it covers.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import recordings as rec
from numba import njit
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, gaussian_filter, gaussian_filter1d
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import dijkstra

from topograph.evaluate import Truth
from topograph.geometry import Array
from topograph.simulate import DESIGNS, DriveConfig, SensorConfig
from topograph.simulate.detections import DetectionNoise
from topograph.simulate.drive import Drive, along, drive
from topograph.simulate.ground import CELL, Ground, lay_out
from topograph.simulate.growth import TRUNK, Shapes
from topograph.simulate.lidar import TRACED, Sweep, elevations, sweep
from topograph.simulate.orchard import Orchard, places_of
from topograph.simulate.record import record_in

REACH = 1.0
"""What is cut out with a tree, from its axis, m; half the distance to the next tree at most."""
TALL = 8.0
"""What is taken of a cloud, from the ground, m; a VLP-16 sees no higher within 26 m."""
CLEAR = 0.7
"""From the robot's middle to what stands, m."""
TOUCH = 0.3
"""From the robot's middle to what stands, m, at the least."""
NOTHING, CAST = -2, -3
"""In the place of a tree's number: no return; the ground's, as the simulator cast it, with noise and all."""
LOWEST = 0.03
"""Share of a cell's points that lie below its low point."""
LOW = 0.1
"""Points so far above the ground are the ground's, m."""
FLATTEST = 0.02
"""Beams that are flatter meet the ground nowhere near, rad."""
LANE = 0.25
"""To the right of the cheapest way, m: where it leads back, there is a bend and no cusp."""
WIDE, TIGHTEST = 0.5, 0.15
"""Radius of a turn, m, that is taken at once, and that is taken where there is no other: what doubles back is no way for a robot that does not reverse."""


@dataclass(frozen=True)
class Wood:
    """Recorded points (N, 3) in a scene, each of the tree `of` (N,), -1 of none; `above` of the ground (N,).

    Attributes:
        ground: the scene's ground returns beams (plantings); else the ground is among the points.
        outline: (2, 2) lowest and highest x, y within which all trees are listed.
        unlisted: (U, 2) stems that are known to stand there and whose place is not good enough to judge by.
        tolerance: of a point from a beam's elevation, rad: wider where the cloud is thin.
    """

    scene: Orchard
    points: Array
    of: NDArray[np.int32]
    above: Array
    ground: bool
    outline: Array
    unlisted: Array
    tolerance: float

    def look(self, scene: Orchard, sensor: SensorConfig, world_T_lidar: Array, time_s: float, seed: int) -> Sweep:
        """One sweep, as `lidar.sweep`."""
        angles, order = elevations(sensor)
        n = len(angles)
        nearest = np.full((sensor.columns, n), np.inf)
        hit = np.full((sensor.columns, n), NOTHING, np.int32)
        if self.ground:
            s = sweep(scene, sensor, world_T_lidar, time_s, seed)
            slot = s.time / (sensor.sweep_s / sensor.columns)
            column = np.floor(slot + 1e-3).astype(int)
            laser = np.rint((slot - column) * 1.5 * n).astype(int)
            nearest[column, laser] = np.linalg.norm(s.xyz, axis=1)
            hit[column, laser] = CAST
        eye = world_T_lidar[len(world_T_lidar) // 2, :3, 3]
        near = np.hypot(*(self.points[:, :2] - eye[:2]).T) < sensor.max_range
        rng = np.random.default_rng(seed)
        rank = np.argsort(angles)
        above = self.above[near]
        whose = np.where(above < TRACED, self.of[near], -1).astype(np.int32)  # as the simulator labels trunks
        _beams(self.points[near], whose, above < LOW, np.ascontiguousarray(world_T_lidar), angles, rank, self.tolerance, nearest, hit)  # fmt: skip
        column, laser = np.nonzero(hit != NOTHING)
        cast = hit[column, laser] == CAST  # with its noise and what was left out
        keep = (rng.random(len(column)) > sensor.dropout) | cast
        column, laser, cast = column[keep], laser[keep], cast[keep]
        r = nearest[column, laser]
        r = np.where(cast, r, r + rng.normal(0.0, sensor.range_sigma, len(r)))
        tree = np.where(cast, -1, hit[column, laser])
        azimuth = -2.0 * np.pi * (column + laser / (1.5 * n)) / sensor.columns
        e = angles[laser]
        xyz = r[:, None] * np.stack([np.cos(e) * np.cos(azimuth), np.cos(e) * np.sin(azimuth), np.sin(e)], axis=1)
        return Sweep(
            xyz=xyz.astype(np.float32),
            ring=order[laser].astype(np.uint16),
            time=((column + laser / (1.5 * n)) * (sensor.sweep_s / sensor.columns)).astype(np.float32),
            intensity=np.full(len(r), 20.0, np.float32),
            tree=tree,
            material=np.where(tree >= 0, TRUNK, -1).astype(np.int8),
        )

    def way(self, seed: int, run: DriveConfig) -> Drive:
        """A way between the trees: the design's own in a planting, else one that keeps clear of what stands there."""
        if self.ground:
            return drive(self.scene, run, seed)
        low, high = self.outline
        step = 0.15
        n = np.ceil((high - low) / step).astype(int)
        stands = (self.above > 0.3) & (self.above < 1.4)
        cell = ((self.points[stands, :2] - low) / step).astype(int)
        inside = ((cell >= 0) & (cell < n)).all(axis=1)
        count = np.zeros(n)
        np.add.at(count, tuple(cell[inside].T), 1.0)
        free = step * distance_transform_edt(count < 4)
        rng = np.random.default_rng([seed, 23, run.run])
        room = np.argwhere(free > CLEAR)
        roads = _roads(free)
        best, least = np.zeros((0, 2)), np.inf
        for _ in range(250):
            stops = room[_spread(room, int(rng.integers(3, 8)), rng)]
            line = np.concatenate([_between(roads, free.shape, a, b)[:-1] for a, b in zip(stops, np.roll(stops, -1, axis=0), strict=True)])  # fmt: skip
            xy = low + step * (gaussian_filter1d(line.astype(float), 5, axis=0, mode="wrap") + 0.5)
            ahead = np.roll(xy, -3, axis=0) - np.roll(xy, 3, axis=0)
            right = ahead[:, ::-1] * [1.0, -1.0] / np.maximum(np.hypot(*ahead.T), 1e-6)[:, None]
            xy = gaussian_filter1d(xy + LANE * right, 3, axis=0, mode="wrap")
            d = np.roll(xy, -1, axis=0) - xy
            turn = np.angle(np.exp(1j * np.diff(np.arctan2(d[:, 1], d[:, 0])))) / np.maximum(np.hypot(*d[1:].T), 1e-3)
            at = np.clip(((xy - low) / step).astype(int), 0, n - 1)
            if np.abs(turn).max() < least and free[tuple(at.T)].min() > TOUCH:
                best, least = xy, float(np.abs(turn).max())
            if least < 1.0 / WIDE:
                break
        if least > 1.0 / TIGHTEST:
            raise ValueError("no round tour that touches nothing and has no cusp")
        return along(self.scene, np.concatenate([best] * run.laps), run)

    def record(self, path: Path, seed: int, run: DriveConfig, sensor: SensorConfig) -> Truth:
        """A bag of a drive, with its truth beside it."""
        way = self.way(seed, run)
        return record_in(path, self.scene, way, seed, run, sensor, DetectionNoise(), look=self.look)


def _spread(room: NDArray[np.int64], n: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Indices of `n` cells that lie far from each other, in the order of a round tour."""
    chosen = [int(rng.integers(len(room)))]
    for _ in range(n - 1):
        d = np.min([np.hypot(*(room - room[k]).T) for k in chosen], axis=0)
        far = np.flatnonzero(d > 0.7 * d.max())
        chosen.append(int(rng.choice(far)))
    p = room[chosen]
    turn = np.arctan2(*(p - p.mean(axis=0)).T)
    return np.array(chosen)[np.argsort(turn)]


def _roads(free: Array) -> csr_array:
    """Prices of the steps between neighbouring cells of a raster that are `free` (R, C) for so many m; what is nearer to a thing than `CLEAR` is dear."""
    rows, columns = free.shape
    price = 1.0 + 40.0 * np.clip(CLEAR + 0.3 - free, 0.0, None) ** 2 + 1e3 * (free < 0.45)
    index = np.arange(rows * columns).reshape(rows, columns)
    start, end, cost = [], [], []
    for di, dj in ((0, 1), (1, 0), (1, 1), (1, -1)):
        p = index[: rows - di, max(-dj, 0) : columns - max(dj, 0)].ravel()
        q = p + di * columns + dj
        start.append(p)
        end.append(q)
        cost.append(np.hypot(di, dj) * 0.5 * (price.ravel()[p] + price.ravel()[q]))
    g = coo_array((np.concatenate(cost), (np.concatenate(start), np.concatenate(end))), shape=(index.size, index.size))
    return g.tocsr()


def _between(roads: csr_array, shape: tuple[int, ...], a: NDArray[np.int64], b: NDArray[np.int64]) -> NDArray[np.int64]:
    """Cells (K, 2) of the cheapest way from a to b in a raster of that shape."""
    start, end = (int(np.ravel_multi_index(tuple(c), shape)) for c in (a, b))
    _, table = dijkstra(roads, directed=False, indices=[start], return_predecessors=True)
    before = table[0]
    way = [end]
    while before[way[-1]] >= 0:
        way.append(int(before[way[-1]]))
    return np.stack(np.unravel_index(way[::-1], shape), axis=1)


@njit(cache=True)
def _beams(points, of, low, poses, angles, rank, tolerance, nearest, hit):
    """Lowers `nearest` (columns, lasers) to the points that lie in each beam of the moving sensor, and says whose they are.

    A point stands for its surface where the beam meets that: as far away in the horizontal, as high where it is of the ground (`low`).
    """
    columns, lasers = nearest.shape
    middle = poses[columns // 2]
    for k in range(len(points)):
        p = points[k]
        T = middle
        column, laser = 0, 0
        for _ in range(3):
            d = p - T[:3, 3]
            x = T[0, 0] * d[0] + T[1, 0] * d[1] + T[2, 0] * d[2]
            y = T[0, 1] * d[0] + T[1, 1] * d[1] + T[2, 1] * d[2]
            z = T[0, 2] * d[0] + T[1, 2] * d[1] + T[2, 2] * d[2]
            r = np.sqrt(x * x + y * y + z * z)
            if r < 0.5:
                break
            e = np.arcsin(z / r)
            first, last = 0, lasers - 1
            while last - first > 1:
                m = (first + last) // 2
                if angles[rank[m]] <= e:
                    first = m
                else:
                    last = m
            laser = rank[first] if e - angles[rank[first]] < angles[rank[last]] - e else rank[last]
            column = int(np.rint(-np.arctan2(y, x) / (2.0 * np.pi) * columns - laser / (1.5 * lasers))) % columns
            T = poses[column]
        if r < 0.5 or abs(e - angles[laser]) > tolerance:
            continue
        a = angles[laser]
        if not low[k]:
            r *= np.cos(e) / np.cos(a)
        elif abs(a) > FLATTEST:
            r *= np.sin(e) / np.sin(a)
        if r < nearest[column, laser]:
            nearest[column, laser] = r
            hit[column, laser] = of[k]


def _scene(ground: Ground, feet: Array, axes: Array, diameters: Array) -> Orchard:
    empty = Shapes(np.zeros((0, 11)), np.zeros((0, 9)), np.zeros((0, 9)))
    return Orchard(
        config=replace(DESIGNS["grid"], walkers=0, people=0),
        ground=ground,
        shapes=empty,
        trees=feet,
        axes=axes,
        diameters=diameters,
        stems=np.ones(len(feet), np.int64),
        walkers=np.zeros((0, 4)),
        posts=np.zeros((0, 3)),
    )


def _lines(plot: rec.Plot) -> tuple[Array, Array]:
    """Feet (M, 3) and axes (M, 3) of a plot's stems, by circles in slices of its cloud."""
    slope, offset = plot.axes[:, 0], plot.axes[:, 1]
    ground = np.array([plot.ground(xy) for xy in offset])
    axes = np.column_stack([slope, np.ones(len(slope))])
    return np.column_stack([offset, ground]), axes / np.linalg.norm(axes, axis=1, keepdims=True)


def _relief(points: Array) -> Ground:
    """The ground under a cloud: a cubic surface through the low points of cells, with what those near it leave, smoothed."""
    low = points[:, :2].min(axis=0) - 2.0
    n = np.ceil((points[:, :2].max(axis=0) + 2.0 - low) / CELL).astype(int) + 1
    cell = np.rint((points[:, :2] - low) / CELL).astype(int)
    key = cell[:, 1] * n[0] + cell[:, 0]
    order = np.lexsort((points[:, 2], key))
    first = np.flatnonzero(np.r_[True, np.diff(key[order]) != 0])
    count = np.diff(np.r_[first, len(order)])
    z = points[order[first + (LOWEST * count).astype(int)], 2]
    k = key[order[first]]
    x, y = 2.0 * (k % n[0]) / n[0] - 1.0, 2.0 * (k // n[0]) / n[1] - 1.0
    w, A = np.ones(len(k)), _cubic(x, y)
    for _ in range(60):  # most cells hold no ground: what lies above the surface says little, what lies below much
        surface = np.linalg.lstsq(A * w[:, None], z * w, rcond=None)[0]
        off = z - A @ surface
        w = np.where(off < 0, 1.0 / np.hypot(1.0, off / 0.3), 1.0 / (1.0 + (off / 0.12) ** 2))
    good = np.abs(off) < 0.15
    weight, rest = np.zeros(n[::-1]), np.zeros(n[::-1])
    weight.ravel()[k[good]] = 1.0
    rest.ravel()[k[good]] = off[good]
    height = gaussian_filter(rest, 2.0) / np.maximum(gaussian_filter(weight, 2.0), 0.05)
    gx, gy = np.meshgrid(2.0 * np.arange(n[0]) / n[0] - 1.0, 2.0 * np.arange(n[1]) / n[1] - 1.0)
    height += (_cubic(gx.ravel(), gy.ravel()) @ surface).reshape(gx.shape)
    return Ground(low, height, np.zeros(n[::-1]))


def _cubic(x: Array, y: Array) -> Array:
    return np.stack([x**a * y**b for a in range(4) for b in range(4 - a)], axis=1)


def plot(name: str) -> Wood:
    """A recorded plot: "pine_plot", "lpine1" or "mls_pine_plot"."""
    if name == "mls_pine_plot":
        points, line, unlisted = _mobile()
        ground = _relief(points)
        foot = line[:, 2:4] - 0.8 * line[:, 4:6]
        feet = np.column_stack([foot, ground.at(foot)])
        axes = np.column_stack([line[:, 4:6], np.ones(len(line))])
        axes /= np.linalg.norm(axes, axis=1, keepdims=True)
        diameters, tolerance = line[:, 0], np.radians(0.4)
        outline = np.array([points[:, :2].min(axis=0), points[:, :2].max(axis=0)])
    else:
        p = rec.Plot(name)
        points, unlisted = p.points, p.unlisted
        feet, axes = _lines(p)
        diameters, tolerance = p.stems[:, 2], np.radians(0.15 if name == "lpine1" else 0.4)
        outline = np.array([p.low - 1.5, p.high + 1.5])
        ground = _relief(points[p.made] if p.made.any() else points)
    above = points[:, 2] - ground.at(points[:, :2])
    points, above = points[above < TALL], above[above < TALL]
    line = feet[:, None, :2] + above[None, :, None] * (axes[:, :2] / axes[:, 2:])[:, None]
    off = np.linalg.norm(points[None, :, :2] - line, axis=2)
    mine = off.argmin(axis=0)
    of = np.where(off.min(axis=0) < 0.5 * diameters[mine] + 0.08, mine, -1).astype(np.int32)
    if name != "lpine1":
        bark = [_closed(points[of == k], above[of == k], feet[k], axes[k], diameters[k]) for k in range(len(feet))]
        points = np.concatenate([points, *bark])
        above = points[:, 2] - ground.at(points[:, :2])
        of = np.concatenate([of, np.repeat(np.arange(len(bark)), [len(b) for b in bark])]).astype(np.int32)
    return Wood(_scene(ground, feet, axes, diameters), points, of, above, False, outline, unlisted, tolerance)


GRAIN = 0.015
"""Between points of a closed surface, m: less than what a beam of 3 mrad is wide at 5 m."""


def _closed(points: Array, above: Array, foot: Array, axis: Array, diameter: float) -> Array:
    """A thinly recorded stem's surface (K, 3), closed between its points.

    A hundred points on a square metre let most beams through, to the stem's far side. The distance from the axis is smoothed over
    a hand's breadth, as far round and as high as the stem was recorded. What lies further from the middle of the distances than 6 cm is no bark.
    """
    q = points[:, :2] - foot[:2] - above[:, None] * (axis[:2] / axis[2])
    r, turn = np.hypot(q[:, 0], q[:, 1]), np.arctan2(q[:, 1], q[:, 0])
    good = np.abs(r - np.median(r)) < 0.06
    if good.sum() < 30:
        return np.zeros((0, 3))
    r, turn, above, base = r[good], turn[good], above[good], (points[:, 2] - above)[good]
    n = int(np.ceil(np.pi * diameter / GRAIN))
    theta, h = np.linspace(-np.pi, np.pi, n, endpoint=False), np.arange(0.1, min(above.max(), 6.0), GRAIN)
    off = np.abs(np.angle(np.exp(1j * (theta[:, None] - turn[None, :]))))
    wide = np.exp(-0.5 * (off * 0.5 * diameter / 0.05) ** 2)
    tall = np.exp(-0.5 * ((h[:, None] - above[None, :]) / 0.07) ** 2)
    weight = tall @ wide.T
    radius = (tall * r) @ wide.T / np.maximum(weight, 1e-9)
    i, k = np.nonzero(weight > 0.7)
    xy = foot[:2] + h[i, None] * (axis[:2] / axis[2]) + radius[i, k, None] * np.stack([np.cos(theta[k]), np.sin(theta[k])], axis=1)  # fmt: skip
    return np.column_stack([xy, h[i] + np.median(base)])


def planting(name: str, design: str, seed: int) -> Wood:
    """A design of the simulator, of trees cut out of a plot."""
    source = plot(name)
    rng = np.random.default_rng([seed, 17])
    config = replace(DESIGNS[design], mound=0.0, walkers=0, people=0)
    places = places_of(config, rng)
    ground = lay_out(config, places, rng)
    trees = source.scene
    apart = np.linalg.norm(trees.trees[:, None, :2] - trees.trees[None, :, :2], axis=2) + 99.0 * np.eye(
        len(trees.trees)
    )
    # A bush beside a stem would be cut into a column: only stems that stand free are taken.
    trunk = (source.above > 0.3) & (source.above < 1.6)
    free = np.array([_crowd(source, k, trunk) < CROWDED for k in range(len(trees.trees))])
    points, of, feet, axes, which = [], [], [], [], rng.choice(np.flatnonzero(free), len(places))
    for i, (xy, k) in enumerate(zip(places, which, strict=True)):
        q = source.points - [*trees.trees[k, :2], 0.0]
        off = np.hypot(*(q[:, :2] - source.above[:, None] * (trees.axes[k, :2] / trees.axes[k, 2])).T)
        mine = (off < min(REACH, 0.5 * apart[k].min())) & (source.above > 0.12) & (source.above < TALL)
        q = np.column_stack([q[mine, :2], source.above[mine]])
        c, s = np.cos(turn := rng.uniform(-np.pi, np.pi)), np.sin(turn)
        R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        foot = np.array([*xy, float(ground.at(xy))])
        points.append(q @ R.T + foot)
        of.append(np.where(source.of[mine] == k, i, -1))
        feet.append(foot)
        axes.append(R @ trees.axes[k])
    scene = replace(_scene(ground, np.array(feet), np.array(axes), trees.diameters[which]), config=config)
    cloud = np.concatenate(points)
    outline = np.array([places.min(axis=0) - 5.0, places.max(axis=0) + 5.0])
    return Wood(scene, cloud, np.concatenate(of).astype(np.int32), cloud[:, 2] - ground.at(cloud[:, :2]), True, outline, np.zeros((0, 2)), source.tolerance)  # fmt: skip


CROWDED = 0.05
"""Points around a stem, within `REACH`, for each on it, at trunk height, from which it does not stand free."""


def _crowd(wood: Wood, k: int, trunk: NDArray[np.bool_]) -> float:
    off = np.hypot(*(wood.points[trunk, :2] - wood.scene.trees[k, :2]).T)
    mine = wood.of[trunk] == k
    return float(((off < REACH) & ~mine).sum() / max(mine.sum(), 1))


def _mobile() -> tuple[Array, Array, Array]:
    """The mobile scanner's plot: points (N, 3) from its corner, stems that show as circles at five heights or more (M, 6:
    diameter, residual, x, y at 0.8 m, slope in x and y), and other stems there (U, 2)."""
    import laspy

    las = laspy.read(rec.DATA / "mls_pine_plot.laz")
    points = np.column_stack([las.x, las.y, las.z])
    points -= points.min(axis=0)
    file = Path(__file__).resolve().parent.parent / "tests" / "promises" / "mls_stems.csv"
    rows = np.loadtxt(file, delimiter=",", skiprows=1)
    good = rows[:, 0] > 0
    return points, rows[good], rows[~good, 2:4]
