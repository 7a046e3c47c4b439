"""Scenes for training and trials, drawn at random: orchards, yards and woods with and without crowns, any sensor, any mounting.

Training uses seeds below 100,000, validation from 100,000 on, reports from 200,000 on.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from topograph.bags import Scan
from topograph.geometry import Array, from_xyz_rpy, inverse, transform
from topograph.simulate import DESIGNS, OrchardConfig, SensorConfig
from topograph.simulate.lidar import Sweep, sweep
from topograph.simulate.orchard import Orchard, plant
from topograph.simulate.sensors import mounting

HDL64 = tuple(np.radians(np.r_[np.linspace(2.0, -8.33, 32), np.linspace(-8.83, -24.33, 32)]))
SENSORS: dict[str, dict[str, Any]] = {
    "VLP-16": {"rings": 16, "fov": (-0.2618, 0.2618), "columns": 1808, "range_sigma": 0.03},
    "OS1-16": {"rings": 16, "fov": (-0.3927, 0.3927), "columns": 1024, "range_sigma": 0.02},
    "XT32": {"rings": 32, "fov": (-0.2793, 0.2618), "columns": 2000, "range_sigma": 0.01},
    "OS1-64": {"rings": 64, "fov": (-0.3927, 0.3927), "columns": 1024, "range_sigma": 0.02},
    "OS0-32": {"rings": 32, "fov": (-0.7854, 0.7854), "columns": 1024, "range_sigma": 0.02},
    "HDL-64": {"rings": 64, "elevation": HDL64, "columns": 900, "range_sigma": 0.02},
    "OS1-128": {"rings": 128, "fov": (-0.3927, 0.3927), "columns": 1024, "range_sigma": 0.02},
}


PLAIN = 0.5
"""Share of scenes that are one of the designs, and share of sensors that are the common one in its common place."""


@dataclass(frozen=True)
class Look:
    """One sweep: as the front end gets it, and the truth. Trees are in the base's frame at the stamp."""

    scan: Scan
    swept: Sweep
    base_T_lidar: Array
    twist: Array
    base_xyz: Array
    feet: Array
    axes: Array
    posts: Array
    orchard: Orchard


def sensor_of(rng: np.random.Generator) -> SensorConfig:
    """A sensor with a mounting."""
    weights = np.array([0.4, 0.1, 0.12, 0.14, 0.1, 0.1, 0.04])
    name = rng.choice(list(SENSORS), p=weights / weights.sum())
    height = rng.uniform(0.3, 2.5) if rng.random() < 0.5 else rng.uniform(0.7, 1.3)
    roll, pitch = rng.normal(0, 0.02, 2)
    if rng.random() < 0.3:
        a, b = rng.uniform(0, np.radians(30)), rng.uniform(0, 2 * np.pi)
        roll, pitch = a * np.cos(b), a * np.sin(b)
    if rng.random() < 0.1:
        roll += np.pi
    mount = (rng.uniform(-0.3, 0.4), rng.uniform(-0.2, 0.2), height, roll, pitch, rng.uniform(-np.pi, np.pi))
    return SensorConfig(
        **SENSORS[name],
        mount=mount,
        ring_bias=rng.uniform(0, 0.015),
        divergence=rng.uniform(0.0, 0.002),
        dropout=float(rng.choice([0.02, rng.uniform(0, 0.4)])),
        bark=float(rng.uniform(0, 2)),
    )


HARD_FROM, HARD = 900, ("hedgerow", "trellis", "young", "old_olive", "steep")
"""Training seeds from which on, below `ODD_FROM`, only the designs are drawn in which single sweeps err most."""


ODD_FROM = 1200
"""Training seeds from which on the sensor hangs low or steeply, amid undergrowth: there single sweeps miss stems that are near."""


def odd_sensor(rng: np.random.Generator) -> SensorConfig:
    """A sensor that hangs at knee height, or turned by up to 35 degrees."""
    drawn = sensor_of(rng)
    assert drawn.mount is not None  # sensor_of draws one
    x, y, _, _, _, yaw = drawn.mount
    if rng.random() < 0.55:
        height, roll, pitch = rng.uniform(0.2, 0.65), *rng.normal(0, 0.03, 2)
    else:
        a, b = rng.uniform(np.radians(12), np.radians(35)), rng.uniform(0, 2 * np.pi)
        height, roll, pitch = rng.uniform(0.4, 2.2), a * np.cos(b), a * np.sin(b)
    if rng.random() < 0.1:
        roll += np.pi
    common = {"elevation": (), **SENSORS["VLP-16"]} if rng.random() < 0.3 else {}
    return replace(drawn, **common, mount=(x, y, height, roll, pitch, yaw))


def overgrown(orchard: OrchardConfig, rng: np.random.Generator) -> OrchardConfig:
    """The same design with dead branches, shrubs and weeds about its trunks."""
    return replace(
        orchard,
        branches=max(orchard.branches, int(rng.integers(0, 16))),
        shrubs=max(orchard.shrubs, float(rng.uniform(0.0, 0.2))),
        weeds=max(orchard.weeds, float(rng.uniform(0.0, 0.25))),
        suckers=max(orchard.suckers, float(rng.uniform(0.0, 0.4))),
    )


def orchard_like(seed: int, rng: np.random.Generator) -> OrchardConfig:
    """One of the simulator's designs with other trees: what orchards mostly look like is seen more often in training."""
    names = HARD if HARD_FROM <= seed < ODD_FROM else tuple(DESIGNS)
    design = DESIGNS[str(rng.choice(names))]
    thick = float(rng.uniform(0.8, 1.25))
    return replace(
        design,
        rows=min(design.rows, 4),
        columns=min(design.columns, 10),
        diameter=(thick * design.diameter[0], thick * design.diameter[1]),
        lean=design.lean * float(rng.uniform(0.6, 1.4)),
        crown=design.crown * float(rng.uniform(0.5, 1.2)),
        suckers=design.suckers * float(rng.uniform(0.5, 1.5)),
        slope=design.slope * float(rng.uniform(0.3, 1.2)),
        weeds=design.weeds * float(rng.uniform(0.3, 1.5)),
    )


def orchard_of(rng: np.random.Generator) -> OrchardConfig:
    """A design of random trees and random clutter."""

    def some(chance: float, low: float, high: float) -> float:
        return float(rng.uniform(low, high)) if rng.random() < chance else 0.0

    thin = float(np.exp(rng.uniform(np.log(0.04), np.log(0.8))))
    base = [(0.5, 2.5), (2.0, 5.0), (4.0, 8.0)][rng.choice(3, p=[0.5, 0.3, 0.2])]
    layout = str(rng.choice(["grid", "irregular", "hedgerow", "wild"], p=[0.4, 0.25, 0.15, 0.2]))
    spacing = float(rng.uniform(0.8, 2.5) if layout == "hedgerow" else np.exp(rng.uniform(np.log(2.0), np.log(12.0))))
    spacing = max(spacing, 5.0 * thin)
    low = float(rng.uniform(base[0], base[0] + 0.6 * (base[1] - base[0])))
    yard = rng.random() < 0.45
    return OrchardConfig(
        layout=layout,
        rows=int(rng.integers(1, 6)),
        columns=int(rng.integers(2, 8)) * (3 if layout == "hedgerow" else 1),
        row_spacing=float(max(rng.uniform(2.5, 9.0), 5.0 * thin)),
        tree_spacing=spacing,
        jitter=float(rng.uniform(0.02, 0.1) * spacing),
        gaps=float(rng.uniform(0, 0.2)),
        slope=float(rng.uniform(0, 0.22)),
        roughness=float(rng.uniform(0.01, 0.1)),
        lean=float(rng.uniform(0.01, 0.18)),
        multi_stem=float(some(0.6, 0.05, 0.5)),
        diameter=(thin, thin * float(rng.uniform(1.2, 2.2))),
        canopy_base=(low, float(rng.uniform(low, base[1]))),
        grass=float(rng.uniform(0, 0.35)),
        weeds=some(0.7, 0.0, 0.2),
        suckers=some(0.6, 0.05, 0.5),
        posts=int(rng.integers(0, 16)),
        poles=int(rng.integers(0, 2)),
        people=int(rng.integers(0, 8)),
        walkers=int(rng.integers(0, 4)),
        vehicles=int(rng.integers(0, 2)),
        hedges=int(rng.integers(0, 2)),
        crown=float([0.0, rng.uniform(0.1, 0.5), 1.0][rng.choice(3, p=[0.35, 0.25, 0.4])]),
        branches=int(rng.integers(0, 14)) if rng.random() < 0.6 else 0,
        bend=some(0.5, 0.0, 0.05),
        flare=some(0.4, 0.0, 0.3),
        lobes=some(0.3, 0.2, 0.8),
        mound=some(0.3, 0.05, 0.2),
        shrubs=some(0.6, 0.0, 0.15),
        trellis=some(0.5, 4.0, 8.0) if layout == "hedgerow" else 0.0,
        walls=int(rng.integers(0, 7)) if yard else 0,
        cars=int(rng.integers(0, 10)) if yard else 0,
        fences=int(rng.integers(0, 3)) if yard else 0,
        lamps=int(rng.integers(0, 3)) if yard else 0,
        signs=int(rng.integers(0, 6)) if yard else 0,
    )


def looks(seed: int, n: int, orchard: OrchardConfig | None = None, sensor: SensorConfig | None = None) -> list[Look]:
    """`n` sweeps of the scene of a seed, from random places at random speeds; design and sensor may be given."""
    rng = np.random.default_rng([seed, 71])
    drawn_sensor, drawn_orchard = sensor_of(rng), orchard_of(rng)
    if rng.random() < PLAIN or HARD_FROM <= seed < 100_000:
        drawn_orchard = orchard_like(seed, rng)
    if rng.random() < PLAIN:
        drawn_sensor = SensorConfig()
    if ODD_FROM <= seed < 100_000:
        drawn_sensor = odd_sensor(rng)
        drawn_orchard = overgrown(drawn_orchard if rng.random() < PLAIN else orchard_of(rng), rng)
    sensor, orchard = sensor or drawn_sensor, orchard or drawn_orchard
    scene = plant(orchard, seed)
    return [_look(scene, sensor, seed * 1000 + k, rng) for k in range(n)]


def _look(scene: Orchard, sensor: SensorConfig, seed: int, rng: np.random.Generator) -> Look:
    low, high = scene.trees[:, :2].min(0) - 6.0, scene.trees[:, :2].max(0) + 6.0
    for _ in range(100):
        xy = rng.uniform(low, high)
        clear = np.hypot(*(scene.trees[:, :2] - xy).T) - 0.5 * scene.diameters
        if clear.min() > 0.7 and not _in_box(scene, xy):
            break
    yaw, g = rng.uniform(-np.pi, np.pi), scene.ground
    c, s = np.cos(yaw), np.sin(yaw)
    z = {d: float(g.at(xy + np.array(d))) for d in [(0.3 * c, 0.3 * s), (-0.3 * c, -0.3 * s), (-0.3 * s, 0.3 * c), (0.3 * s, -0.3 * c)]}  # fmt: skip
    front, back, left, right = z.values()
    world_T_base = from_xyz_rpy(xy[0], xy[1], float(np.mean([front, back, left, right])), np.arctan2(left - right, 0.6), -np.arctan2(front - back, 0.6), yaw)  # fmt: skip
    base_T_lidar = mounting(sensor)
    moving = rng.random() < 0.7
    twist = np.array([rng.uniform(0, 1.5), 0, 0, 0, 0, rng.normal(0, 0.2)]) * moving
    span = sensor.sweep_s
    t = (np.arange(sensor.columns) / sensor.columns - 1.0) * span  # stamped at its end
    turn = twist[5] * t
    step = np.stack([from_xyz_rpy(twist[0] * np.cos(0.5 * a) * k, twist[0] * np.sin(0.5 * a) * k, 0, 0, 0, a) for k, a in zip(t, turn, strict=True)])  # fmt: skip
    swept = sweep(scene, sensor, world_T_base @ step @ base_T_lidar, float(rng.uniform(0, 40)), seed)
    offset = (swept.time - np.float32(span)).astype(np.float32)
    scan = Scan(
        stamp_ns=1,
        frame="lidar",
        xyz=swept.xyz,
        ring=swept.ring.astype(np.int32),
        offset=offset,
        intensity=swept.intensity,
    )
    known = twist + np.array([0.01, 0.002, 0, 0, 0, 0.005]) * rng.normal(size=6) * moving
    base = transform(base_T_lidar, swept.xyz.astype(float))
    u = twist[:3] + np.cross(np.broadcast_to(twist[3:], base.shape), base)
    base = base + offset[:, None] * u + 0.5 * offset[:, None] ** 2 * np.cross(np.broadcast_to(twist[3:], u.shape), u)
    T = inverse(world_T_base)
    return Look(
        scan,
        swept,
        base_T_lidar,
        known,
        base,
        transform(T, scene.trees),
        scene.axes @ T[:3, :3].T,
        transform(T, scene.posts),
        scene,
    )


def _in_box(scene: Orchard, xy: Array) -> bool:
    b = scene.shapes.boxes
    if not len(b):
        return False
    d = xy - b[:, :2]
    c, s = np.cos(b[:, 6]), np.sin(b[:, 6])
    x, y = c * d[:, 0] + s * d[:, 1], -s * d[:, 0] + c * d[:, 1]
    return bool(((np.abs(x) < b[:, 3] + 0.4) & (np.abs(y) < b[:, 4] + 0.4)).any())
