"""Casts the beams of a spinning LiDAR into the orchard, column by column as the robot moves."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from topograph.geometry import Array
from topograph.simulate.config import SensorConfig
from topograph.simulate.ground import CELL
from topograph.simulate.growth import GRASS, GROUND, METAL, TRUNK, WOOD, Shapes, person
from topograph.simulate.orchard import Orchard
from topograph.simulate.sensors import mounting

_BINS = 720
TRACED = 1.75
"""Height up to which returns of a trunk are labelled as trunk, m."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Sweep:
    """Returns of one sweep in firing order: xyz (N, 3) in the moving sensor's frame, ring, seconds since the
    sweep began, intensity, the tree hit (branches too; -1: none) and the material (-1: a mixed pixel)."""

    xyz: NDArray[np.float32]
    ring: NDArray[np.uint16]
    time: NDArray[np.float32]
    intensity: NDArray[np.float32]
    tree: NDArray[np.int32]
    material: NDArray[np.int8]


def elevations(config: SensorConfig) -> tuple[Array, NDArray[np.int64]]:
    """Elevation (R,) in rad of each laser in firing order, and its ring. Velodyne fires low and high in turn."""
    n = config.rings
    angles = np.array(config.elevation) if config.elevation else np.linspace(config.fov[0], config.fov[1], n)
    order = np.arange(n).reshape(2, n // 2).T.ravel() if n % 2 == 0 else np.arange(n)
    return angles[order], order


def sweep(orchard: Orchard, config: SensorConfig, world_T_lidar: Array, time_s: float, seed: int) -> Sweep:
    """One sweep; `world_T_lidar` (columns, 4, 4) is the sensor's pose at each firing."""
    angles, order = elevations(config)
    shapes = orchard.shapes
    robot = world_T_lidar[len(world_T_lidar) // 2] @ np.linalg.inv(mounting(config))
    moving = [
        part
        for x, y, vx, vy in orchard.walkers
        for part in _walker(orchard, np.array([x, y]), np.array([vx, vy]), time_s)
    ]
    for k in range(orchard.config.companions):
        moving += _companion(orchard, robot, k, time_s)
    cylinders = shapes.cylinders
    if config.mast:
        foot = robot[:3, :3] @ [-0.6, 0.3, 0.3] + robot[:3, 3]
        mast = [*foot, *robot[:3, 2], 1.8, 0.03, 0.03, METAL, -1]
        cylinders = np.concatenate([cylinders, [mast]])
    blobs = np.concatenate([shapes.blobs, np.array(moving).reshape(-1, 9)])
    centre = world_T_lidar[len(world_T_lidar) // 2, :3, 3]
    lists = [_near(a, centre, size, config.max_range) for a, size in _bounds(Shapes(cylinders, blobs, shapes.boxes))]
    g = orchard.ground
    bias = config.ring_bias * np.random.default_rng([17, config.rings]).normal(size=len(angles))
    xyz, laser, column, intensity, tree, material = _cast(
        np.ascontiguousarray(world_T_lidar), angles, bias, cylinders, blobs, shapes.boxes, *lists,
        g.origin, g.height, g.grass, config.max_range, config.range_sigma, config.dropout, config.divergence, config.bark, seed,
    )  # fmt: skip
    per_column = config.sweep_s / config.columns
    time = (column + laser / (1.5 * len(angles))) * per_column
    ring = len(angles) - 1 - order[laser] if config.from_top else order[laser]
    out = Sweep(
        xyz=xyz,
        ring=ring.astype(np.uint16),
        time=time.astype(np.float32),
        intensity=intensity,
        tree=tree,
        material=material,
    )
    if config.twice:
        every = np.repeat(np.arange(len(xyz)), 2)
        out = Sweep(
            xyz=out.xyz[every],
            ring=out.ring[every],
            time=out.time[every],
            intensity=out.intensity[every],
            tree=out.tree[every],
            material=out.material[every],
        )
    return out


def _companion(orchard: Orchard, robot: Array, number: int, time_s: float) -> list[list[float]]:
    """A person who keeps a place beside the robot, swaying a little with the steps."""
    x, y = orchard.config.beside
    sway = 0.06 * np.sin(2.1 * time_s + number)
    xy = (robot[:3, :3] @ [x + sway, y * (-1) ** number, 0.0] + robot[:3, 3])[:2]
    return person(np.array([*xy, float(orchard.ground.at(xy))]), 1.5 * time_s)


def _walker(orchard: Orchard, start: Array, velocity: Array, time_s: float) -> list[list[float]]:
    back_and_forth = 20.0 * (1 - np.abs((time_s / 20.0) % 2 - 1))
    xy = start + velocity * back_and_forth
    return person(
        np.array([*xy, float(orchard.ground.at(xy))]), float(np.arctan2(velocity[1], velocity[0])) + np.pi / 2
    )


def _bounds(s: Shapes) -> list[tuple[Array, Array]]:
    """Centre (N, 3) and bounding radius (N,) of each kind of shape."""
    c = s.cylinders
    return [
        (
            c[:, :3] + 0.5 * c[:, 6:7] * c[:, 3:6],
            0.5 * c[:, 6] * np.hypot(c[:, 3], c[:, 4]) + np.maximum(c[:, 7], c[:, 8]),
        ),
        (s.blobs[:, :3], np.maximum(s.blobs[:, 3], s.blobs[:, 4])),
        (s.boxes[:, :3], np.hypot(s.boxes[:, 3], s.boxes[:, 4])),
    ]


def _near(centres: Array, eye: Array, radius: Array, most: float) -> NDArray[np.int32]:
    """(bins, K) indices of the shapes in each sector of the compass, -1 padded; the eye may move by a metre."""
    d = centres[:, :2] - eye[:2]
    distance = np.hypot(d[:, 0], d[:, 1])
    reach = radius + 0.6
    half = np.where(distance > reach, np.arcsin(np.clip(reach / np.maximum(distance, 1e-9), 0, 1)), np.pi)
    bearing = np.arctan2(d[:, 1], d[:, 0])
    lists: list[list[int]] = [[] for _ in range(_BINS)]
    for k in np.argsort(distance):
        if distance[k] - reach[k] > most:
            continue
        first = int(np.floor((bearing[k] - half[k] + np.pi) / (2 * np.pi) * _BINS))
        last = int(np.floor((bearing[k] + half[k] + np.pi) / (2 * np.pi) * _BINS))
        for b in range(first, min(last, first + _BINS - 1) + 1):
            lists[b % _BINS].append(int(k))
    out = np.full((_BINS, max(1, max(map(len, lists)))), -1, np.int32)
    for b, row in enumerate(lists):
        out[b, : len(row)] = row
    return out


@njit(cache=True)
def _ground_at(x, y, origin, height):
    gx, gy = (x - origin[0]) / CELL, (y - origin[1]) / CELL
    ny, nx = height.shape
    j, i = min(max(int(gx), 0), nx - 2), min(max(int(gy), 0), ny - 2)
    u, v = gx - j, gy - i
    return (1 - v) * ((1 - u) * height[i, j] + u * height[i, j + 1]) + v * (
        (1 - u) * height[i + 1, j] + u * height[i + 1, j + 1]
    )


@njit(cache=True)
def _cylinder(o, d, c):
    """Distance along the ray to a tapered cylinder, or a negative number."""
    ox, oy, oz = o[0] - c[0], o[1] - c[1], o[2] - c[2]
    da = d[0] * c[3] + d[1] * c[4] + d[2] * c[5]
    oa = ox * c[3] + oy * c[4] + oz * c[5]
    slope = (c[8] - c[7]) / c[6]
    px, py, pz = d[0] - da * c[3], d[1] - da * c[4], d[2] - da * c[5]
    qx, qy, qz = ox - oa * c[3], oy - oa * c[4], oz - oa * c[5]
    r0 = c[7] + slope * oa
    a = px * px + py * py + pz * pz - (slope * da) ** 2
    b = px * qx + py * qy + pz * qz - slope * da * r0
    k = qx * qx + qy * qy + qz * qz - r0 * r0
    disc = b * b - a * k
    if disc <= 0 or a <= 1e-12:
        return -1.0
    t = (-b - np.sqrt(disc)) / a
    h = oa + t * da
    if t <= 0 or h < 0 or h > c[6]:
        return -1.0
    return t


@njit(cache=True)
def _blob(o, d, e):
    """Distance to a random leaf on the chord through a porous ellipsoid, or a negative number."""
    a = (d[0] / e[3]) ** 2 + (d[1] / e[4]) ** 2 + (d[2] / e[5]) ** 2
    x, y, z = o[0] - e[0], o[1] - e[1], o[2] - e[2]
    b = x * d[0] / e[3] ** 2 + y * d[1] / e[4] ** 2 + z * d[2] / e[5] ** 2
    k = (x / e[3]) ** 2 + (y / e[4]) ** 2 + (z / e[5]) ** 2 - 1
    disc = b * b - a * k
    if disc <= 0:
        return -1.0
    root = np.sqrt(disc)
    t0, t1 = max((-b - root) / a, 0.0), (-b + root) / a
    t = t0 + np.random.exponential(1.0) / e[6]
    return t if t < t1 else -1.0


@njit(cache=True)
def _box(o, d, q):
    c, s = np.cos(q[6]), np.sin(q[6])
    x, y, z = o[0] - q[0], o[1] - q[1], o[2] - q[2]
    ro = (c * x + s * y, -s * x + c * y, z)
    rd = (c * d[0] + s * d[1], -s * d[0] + c * d[1], d[2])
    t0, t1 = 0.0, 1e9
    for k in range(3):
        if abs(rd[k]) < 1e-12:
            if abs(ro[k]) > q[3 + k]:
                return -1.0
            continue
        a, b = (-q[3 + k] - ro[k]) / rd[k], (q[3 + k] - ro[k]) / rd[k]
        t0, t1 = max(t0, min(a, b)), min(t1, max(a, b))
    if t0 >= t1:
        return -1.0
    t = t0 + np.random.exponential(1.0) / q[7]
    return t if t < t1 else -1.0


@njit(cache=True)
def _trace(o, d, cyl, blob, box, near_c, near_b, near_x, origin, height, grass, most):
    """Distance, material and tree of the first thing on a ray; distance `most` when there is none."""
    best, material, tree = most, -1, -1
    b = int((np.arctan2(d[1], d[0]) + np.pi) / (2 * np.pi) * _BINS) % _BINS
    for k in range(near_c.shape[1]):
        i = near_c[b, k]
        if i < 0:
            break
        t = _cylinder(o, d, cyl[i])
        if 0 < t < best:
            best, material, tree = t, int(cyl[i, 9]), int(cyl[i, 10])
    for k in range(near_b.shape[1]):
        i = near_b[b, k]
        if i < 0:
            break
        t = _blob(o, d, blob[i])
        if 0 < t < best:
            best, material, tree = t, int(blob[i, 7]), -1
    for k in range(near_x.shape[1]):
        i = near_x[b, k]
        if i < 0:
            break
        t = _box(o, d, box[i])
        if 0 < t < best:
            best, material, tree = t, int(box[i, 8]), -1
    # The ground: march with steps that shrink as it comes near; grass stops some rays on the way.
    t, previous = 0.3, 0.0
    grass_left = np.random.exponential(0.35)
    while t < best:
        x, y, z = o[0] + t * d[0], o[1] + t * d[1], o[2] + t * d[2]
        above = z - _ground_at(x, y, origin, height)
        if above <= 0:
            low, high = previous, t
            for _ in range(12):
                m = 0.5 * (low + high)
                if o[2] + m * d[2] - _ground_at(o[0] + m * d[0], o[1] + m * d[1], origin, height) > 0:
                    low = m
                else:
                    high = m
            if high < best:
                best, material, tree = high, GROUND, -1
            break
        step = max(0.08, 0.5 * above)
        if above < 0.6:
            blade = _ground_at(x, y, origin, grass)
            if above < blade:
                grass_left -= min(step, 0.1) * (1.2 - above / max(blade, 1e-6))
                step = min(step, 0.1)
                if grass_left < 0:
                    best, material, tree = t, GRASS, -1
                    break
            else:
                step = min(step, 0.2)
        if d[2] > 0.25 and above > 8:
            break
        previous = t
        t += step
    return best, material, tree


@njit(cache=True)
def _cast(poses, angles, bias, cyl, blob, box, near_c, near_b, near_x, origin, height, grass,
          most, sigma, dropout, divergence, rough, seed):  # fmt: skip
    np.random.seed(seed)
    columns, lasers = poses.shape[0], angles.shape[0]
    n_max = columns * lasers
    xyz = np.empty((n_max, 3), np.float32)
    laser_of, column_of = np.empty(n_max, np.int64), np.empty(n_max, np.int64)
    intensity, tree_of = np.empty(n_max, np.float32), np.empty(n_max, np.int32)
    material_of = np.empty(n_max, np.int8)
    reflect = np.array([35.0, 25.0, 22.0, 14.0, 30.0, 60.0, 40.0, 35.0, 45.0])
    n = 0
    for col in range(columns):
        T = poses[col]
        o = T[:3, 3].copy()
        R = T[:3, :3].copy()
        for las in range(lasers):
            azimuth = -2.0 * np.pi * (col + las / (1.5 * lasers)) / columns
            s = np.array(
                [
                    np.cos(angles[las]) * np.cos(azimuth),
                    np.cos(angles[las]) * np.sin(azimuth),
                    np.sin(angles[las]),
                ]
            )
            d = R @ s
            side = np.array([-d[1], d[0], 0.0])
            a = divergence * np.random.uniform(-1.0, 1.0)
            d1 = d + a * side
            d1[2] += divergence * np.random.uniform(-1.0, 1.0)
            d1 /= np.sqrt((d1 * d1).sum())
            t, material, tree = _trace(o, d1, cyl, blob, box, near_c, near_b, near_x, origin, height, grass, most)
            d2 = d - a * side
            d2 /= np.sqrt((d2 * d2).sum())
            mixed = False
            if np.random.random() < 0.5:  # the beam's other half: mixed pixels at edges
                t2, m2, tree2 = _trace(o, d2, cyl, blob, box, near_c, near_b, near_x, origin, height, grass, most)
                if m2 >= 0 and material >= 0 and 0.1 < abs(t2 - t) < 1.5 and np.random.random() < 0.5:
                    w = np.random.random()
                    t = w * t + (1 - w) * t2
                    tree = -1
                    mixed = True
                elif m2 >= 0 and t2 < t:
                    t, material, tree = t2, m2, tree2
            if material < 0 or t >= most or t < 0.5:
                continue
            if np.random.random() < dropout + 0.3 * (t / most) ** 2:
                continue
            bark = 0.0
            if tree >= 0:
                z = o[2] + t * d[2]
                bark = 0.008 * np.sin(9.0 * z + tree) + 0.006 * np.sin(23.0 * z + 7.0 * np.arctan2(d[1], d[0]))
            r = t + rough * bark + bias[las] + sigma * np.random.standard_normal()
            r = 0.002 * np.round(r / 0.002)
            for k in range(3):
                xyz[n, k] = r * s[k]
            laser_of[n], column_of[n] = las, col
            intensity[n] = max(0.0, min(255.0, reflect[material] * np.random.uniform(0.4, 1.6)))
            tree_of[n] = tree
            if material == TRUNK:  # a trunk is what can be traced; above it is wood as the branches are
                x, y, z = o[0] + t * d[0], o[1] + t * d[1], o[2] + t * d[2]
                if z - _ground_at(x, y, origin, height) > TRACED:
                    material = WOOD
            material_of[n] = -1 if mixed else material
            n += 1
    return xyz[:n], laser_of[:n], column_of[:n], intensity[:n], tree_of[:n], material_of[:n]
