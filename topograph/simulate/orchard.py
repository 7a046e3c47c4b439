"""A seeded orchard: ground, trees, and what stands between them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from topograph.geometry import Array
from topograph.simulate.config import OrchardConfig
from topograph.simulate.ground import Ground, lay_out
from topograph.simulate.growth import Build, Shapes


@dataclass(frozen=True, slots=True, kw_only=True)
class Orchard:
    """The scene and its trees (feet (N, 3) on the ground, axes (N, 3), diameters (N,), stems (N,)).

    Attributes:
        walkers: (W, 4) start and velocity of people who walk to and fro.
        posts: (P, 3) feet of posts and poles: what stands still and is no tree.
    """

    config: OrchardConfig
    ground: Ground
    shapes: Shapes
    trees: Array
    axes: Array
    diameters: Array
    stems: NDArray[np.int64]
    walkers: Array
    posts: Array


def plant(config: OrchardConfig, seed: int) -> Orchard:
    """An orchard of a design; equal seeds give equal orchards."""
    rng = np.random.default_rng([seed, 17])
    places = places_of(config, rng)
    ground = lay_out(config, places, rng)
    build = Build(ground, rng)
    trees = [build.tree(config, xy, i) for i, xy in enumerate(places)]
    build.clutter(config, places)
    walkers = build.walkers(config, places)
    return Orchard(
        config=config,
        ground=ground,
        shapes=build.shapes(),
        trees=np.array([t[0] for t in trees]),
        axes=np.array([t[1] for t in trees]),
        diameters=np.array([t[2] for t in trees]),
        stems=np.array([t[3] for t in trees], np.int64),
        walkers=walkers,
        posts=np.array(build.posts, float).reshape(-1, 3),
    )


def places_of(config: OrchardConfig, rng: np.random.Generator) -> Array:
    """Where a design plants its trees, (N, 2)."""
    i, j = np.meshgrid(np.arange(config.columns), np.arange(config.rows), indexing="ij")
    xy = np.stack([i.ravel() * config.tree_spacing, j.ravel() * config.row_spacing], axis=1).astype(float)
    if config.layout == "wild":
        return _wild(config, rng, len(xy))
    if config.layout == "irregular":
        xy[:, 0] += 0.5 * config.tree_spacing * (j.ravel() % 2)
    xy += np.clip(rng.normal(0, config.jitter, xy.shape), -2.2 * config.jitter, 2.2 * config.jitter)
    return np.asarray(xy[rng.random(len(xy)) >= config.gaps])


def _wild(config: OrchardConfig, rng: np.random.Generator, n: int) -> Array:
    """Trees anywhere, none nearer to another than half the spacing, none in the robot's lanes."""
    size = np.array([(config.columns - 1) * config.tree_spacing, (config.rows - 1) * config.row_spacing])
    out: list[Array] = []
    for _ in range(60 * n):
        p = rng.uniform(0.0, size)
        lane = (p[1] / config.row_spacing) % 1.0
        if abs(lane - 0.5) < 0.9 / config.row_spacing:
            continue
        if all(np.hypot(*(p - q)) > 0.5 * config.tree_spacing for q in out):
            out.append(p)
        if len(out) == n:
            break
    return np.array(out)
