"""The ground of a simulated scene."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter

from topograph.geometry import Array
from topograph.simulate.config import OrchardConfig

CELL = 0.25
"""Grid of the ground, m."""


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


def lay_out(config: OrchardConfig, places: Array, rng: np.random.Generator) -> Ground:
    """A ramp with waves and grass, and the mounds that trees at `places` (N, 2) stand on."""
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
    if config.mound > 0:
        for px, py in places:  # a hump of half a metre's width
            i, j = np.abs(y - py) < 2.0, np.abs(x - px) < 2.0
            d2 = (y[i, None] - py) ** 2 + (x[None, j] - px) ** 2
            height[np.ix_(i, j)] += config.mound * np.exp(-0.5 * d2 / 0.45**2)
    return Ground(low, height, grass)
