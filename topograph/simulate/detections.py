"""Trunk detections without a LiDAR: what a front end would say of one scan, for runs by the thousand."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from topograph.geometry import Array, inverse, transform, wrap
from topograph.simulate.orchard import Orchard


@dataclass(frozen=True, slots=True)
class DetectionNoise:
    """sigma along and across the line of sight per metre of range beyond `near` (m); misses and clutter per scan."""

    sigma: float = 0.03
    growth: float = 0.0015
    miss: float = 0.15
    clutter: float = 0.4
    view: float = 15.0


def detect(
    orchard: Orchard, world_T_robot: Array, noise: DetectionNoise, rng: np.random.Generator
) -> tuple[Array, Array, Array]:
    """Points (N, 3) in base_link, diameters (N,) and axes (N, 3) of the trunks seen, nearer ones hiding farther ones."""
    p = transform(inverse(world_T_robot), orchard.trees + 0.8 * orchard.axes)
    axes = orchard.axes @ world_T_robot[:3, :3]
    far = np.hypot(p[:, 0], p[:, 1])
    bearing = np.arctan2(p[:, 1], p[:, 0])
    half = 0.5 * orchard.diameters / np.maximum(far, 0.5)
    keep: list[int] = []
    for i in np.argsort(far):
        if far[i] > noise.view or far[i] < 0.7 or rng.random() < noise.miss:
            continue
        hidden = [j for j in keep if abs(wrap(bearing[i] - bearing[j])) < half[j]]
        if not hidden:
            keep.append(int(i))
    sigma = noise.sigma + noise.growth * far[keep]
    seen = p[keep] + rng.normal(size=(len(keep), 3)) * np.column_stack([sigma, sigma, sigma])
    diameters = orchard.diameters[keep] + rng.normal(0, 0.03, len(keep))
    seen_axes = axes[keep] + rng.normal(0, 0.05, (len(keep), 3))
    n = rng.poisson(noise.clutter)
    r, a = noise.view * np.sqrt(rng.random(n)), rng.uniform(0, 2 * np.pi, n)
    ghosts = np.column_stack([r * np.cos(a), r * np.sin(a), rng.normal(0.8, 0.2, n)])
    out = np.concatenate([seen, ghosts])
    out_axes = np.concatenate([seen_axes, np.tile([0.0, 0.0, 1.0], (n, 1))])
    out_axes /= np.linalg.norm(out_axes, axis=1, keepdims=True)
    return out, np.clip(np.concatenate([diameters, rng.uniform(0.05, 0.4, n)]), 0.04, None), out_axes
