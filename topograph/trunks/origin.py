"""Where a cloud was seen from, when it was moved out of the LiDAR's frame before it was recorded."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from topograph.bags import Scan
from topograph.geometry import Array, inverse, transform

LEAST = 2000
"""Points that show whether there are rings."""
BIN = 0.05
"""Of elevation, degrees."""
MOST = 0.98
"""Share of the points whose bins are counted."""
RINGS, CLEARER = 0.25, 0.6
"""Share of the elevations between the lowest and the highest that these bins take, below which there are rings; and of the share about the cloud's own frame
(16 to 32 lasers about their own frame 0.02 to 0.2, about the base's or an IMU's 0.6 to 0.9, less over a plane, whose circles are rings about all that is
above their middle; a LiDAR without rings 0.7 about any)."""
NEAR = 0.5
"""Returns nearer to where the LiDAR may be are the robot's, or none that a driver has left at the origin, m."""


def lidar_of(scan: Scan, base_T_frame: Array, frames: Mapping[str, Array]) -> tuple[str, Array] | None:
    """Name and pose in the scan's frame (4, 4) of the one of the `frames`, whose poses (4, 4) in the base are known, that its points were seen from; None: its own."""
    back = inverse(base_T_frame)
    others = {name: back @ T for name, T in frames.items() if name != scan.frame}
    name = seen_from(scan.xyz, others)
    return None if name is None else (name, others[name])


def moved_back(scan: Scan, frame_T_lidar: Array) -> Scan:
    """The scan in the axes of the LiDAR that is at (4, 4) in its frame."""
    return replace(scan, xyz=transform(inverse(frame_T_lidar), scan.xyz).astype(np.float32))


def seen_from(xyz: NDArray[np.float32], frame_T_lidar: Mapping[str, Array]) -> str | None:
    """Name of the frame about which points (N, 3) lie in rings, and clearly more so than about their own, of those with poses (4, 4) in that; else None."""
    found: dict[str, float] = {}
    for name, T in frame_T_lidar.items():
        far = _beyond(xyz, T[:3, 3])
        if len(far) >= LEAST:
            about = spread(transform(inverse(T), far))
            if about < min(RINGS, CLEARER * spread(far)):
                found[name] = about
    return min(found, key=lambda k: found[k], default=None)


def in_rings(xyz: NDArray[np.float32]) -> bool:
    """Whether points (N, 3) lie in rings about their own frame; True where they are too few to tell."""
    far = _beyond(xyz, np.zeros(3))
    return len(far) < LEAST or spread(far) < RINGS


def _beyond(xyz: NDArray[np.float32], eye: Array) -> Array:
    p = np.asarray(xyz[np.isfinite(xyz).all(axis=1)], float)
    return np.asarray(p[np.linalg.norm(p - eye, axis=1) > NEAR])


def spread(p: Array) -> float:
    """Share of the elevations that points (N, 3) take of those between their lowest and highest: little where they lie in rings."""
    elevation = np.degrees(np.arctan2(p[:, 2], np.hypot(p[:, 0], p[:, 1])))
    low, high = np.percentile(elevation, [1.0, 99.0])
    count, _ = np.histogram(elevation, np.arange(low - BIN, high + 2 * BIN, BIN))
    full = np.cumsum(np.sort(count)[::-1])
    return float((np.searchsorted(full, MOST * full[-1]) + 1) / len(count))
