"""What each keyframe saw of each tree: all detections around a keyframe, brought into it and averaged."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from topograph.geometry import Array, inverse, transform
from topograph.motion import Motion
from topograph.trees.detections import Detections


@dataclass(frozen=True, slots=True)
class Sightings:
    """M sightings.

    Attributes:
        keyframe, tree: (M,) indices.
        p: (M, 3) in the keyframe's base frame, m; `cov` (M, 3, 3).
        count: (M,) detections averaged.
        late: (M, 3) change of `p` per second that the scans' clock would run late, m/s.
    """

    keyframe: NDArray[np.int64]
    tree: NDArray[np.int64]
    p: Array
    cov: Array
    count: NDArray[np.int64]
    late: Array

    def __len__(self) -> int:
        return len(self.tree)


def nearest_keyframe(stamps: NDArray[np.int64], keyframes_ns: NDArray[np.int64]) -> NDArray[np.int64]:
    """Index (S,) of the keyframe nearest in time to each stamp."""
    right = np.clip(np.searchsorted(keyframes_ns, stamps), 1, max(len(keyframes_ns) - 1, 1))
    if len(keyframes_ns) == 1:
        return np.zeros(len(stamps), np.int64)
    left = right - 1
    return np.where(stamps - keyframes_ns[left] <= keyframes_ns[right] - stamps, left, right)


DELAY_NS = 50_000_000
"""Over which the change of a sighting with its scan's clock is taken."""


def gather(
    detections: Detections,
    tree: NDArray[np.int64],
    keyframes_ns: NDArray[np.int64],
    motion: Motion,
    *,
    independent: float = 0.25,
) -> Sightings:
    """Sightings of the detections with `tree` (N,) >= 0.

    Detections of one tree at one keyframe are averaged by their information; since their errors are alike, only a
    share `independent` of each further one counts.
    """
    keep = np.flatnonzero(tree >= 0)
    keyframe_of_scan = nearest_keyframe(detections.stamps_ns, keyframes_ns)
    odom_T_scan, odom_T_keyframe = motion.at(detections.stamps_ns), motion.at(keyframes_ns)
    keyframe_T_scan = inverse(odom_T_keyframe[keyframe_of_scan]) @ odom_T_scan
    T = keyframe_T_scan[detections.scan[keep]]
    p = transform(T, detections.p[keep])
    later = inverse(odom_T_keyframe[keyframe_of_scan]) @ motion.at(detections.stamps_ns + DELAY_NS)
    moved = (transform(later[detections.scan[keep]], detections.p[keep]) - p) / (DELAY_NS * 1e-9)
    R = T[:, :3, :3]
    information = np.linalg.inv(R @ detections.cov[keep] @ np.swapaxes(R, 1, 2))
    information *= detections.believed[keep, None, None]
    keyframe = keyframe_of_scan[detections.scan[keep]]
    label = keyframe * (int(tree.max(initial=0)) + 1) + tree[keep]
    _, first, index, count = np.unique(label, return_index=True, return_inverse=True, return_counts=True)
    m = len(first)
    total, weighted = np.zeros((m, 3, 3)), np.zeros((m, 3))
    np.add.at(total, index, information)
    np.add.at(weighted, index, (information @ p[:, :, None])[..., 0])
    mean = np.linalg.solve(total, weighted[..., None])[..., 0] if m else np.zeros((0, 3))
    late = np.stack([np.bincount(index, moved[:, k], m) for k in range(3)], axis=1) / np.maximum(count, 1)[:, None]
    effective = 1 + independent * (count - 1)
    cov = np.linalg.inv(total) * (count / effective)[:, None, None] if m else np.zeros((0, 3, 3))
    return Sightings(keyframe[first], tree[keep][first], np.asarray(mean, float), np.asarray(cov, float), count, late)
