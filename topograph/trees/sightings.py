"""What each keyframe saw of each tree: all detections around a keyframe, brought into it and averaged."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from topograph.geometry import Array, inverse, inverse_cov, transform
from topograph.motion import Motion
from topograph.trees.detections import Detections


@dataclass(frozen=True, slots=True, kw_only=True)
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


BLOCK = 50_000
"""Detections that are moved at once: their poses alone are larger than they are."""


@dataclass(frozen=True, slots=True)
class AtKeyframes:
    """The detections as their keyframes have them: what does not depend on which tree they are of.

    Attributes:
        keyframe: (N,) nearest in time.
        p: (N, 3) in the keyframe's base frame, m; `information` (N, 3, 3), weighed by belief.
        late: (N, 3) as of `Sightings`.
    """

    keyframe: NDArray[np.int64]
    p: Array
    information: Array
    late: Array

    @staticmethod
    def of(detections: Detections, keyframes_ns: NDArray[np.int64], motion: Motion) -> AtKeyframes:
        """Brought there by dead reckoning."""
        keyframe = nearest_keyframe(detections.stamps_ns, keyframes_ns)
        keyframe_T_odom = inverse(motion.at(keyframes_ns)[keyframe])
        now = keyframe_T_odom @ motion.at(detections.stamps_ns)
        later = keyframe_T_odom @ motion.at(detections.stamps_ns + DELAY_NS)
        n, believed = len(detections), detections.believed
        p, moved, information = np.empty((n, 3)), np.empty((n, 3)), np.empty((n, 3, 3))
        for at in range(0, n, BLOCK):
            rows = slice(at, at + BLOCK)
            T, then = now[detections.scan[rows]], later[detections.scan[rows]]
            p[rows] = transform(T, detections.p[rows])
            moved[rows] = (transform(then, detections.p[rows]) - p[rows]) / (DELAY_NS * 1e-9)
            R = T[:, :3, :3]
            information[rows] = inverse_cov(R @ detections.cov[rows] @ np.swapaxes(R, 1, 2))
            information[rows] *= believed[rows, None, None]
        return AtKeyframes(keyframe[detections.scan], p, information, moved)

    def gather(self, tree: NDArray[np.int64], *, independent: float = 0.25) -> Sightings:
        """Sightings of the detections with `tree` (N,) >= 0.

        Detections of one tree at one keyframe are averaged by their information; since their errors are alike, only a
        share `independent` of each further one counts.
        """
        keep = np.flatnonzero(tree >= 0)
        if not len(keep):
            none = np.zeros(0, np.int64)
            return Sightings(
                keyframe=none, tree=none, p=np.zeros((0, 3)), cov=np.zeros((0, 3, 3)), count=none, late=np.zeros((0, 3))
            )
        label = self.keyframe[keep] * (int(tree.max()) + 1) + tree[keep]
        order = np.argsort(label, kind="stable")
        first = np.flatnonzero(np.diff(label[order], prepend=-1))
        rows = keep[order]
        count = np.diff(first, append=len(rows))
        information = self.information[rows]
        total = np.add.reduceat(information, first)
        weighted = np.add.reduceat((information @ self.p[rows][:, :, None])[..., 0], first)
        cov = inverse_cov(total)
        mean = (cov @ weighted[..., None])[..., 0]
        effective = 1 + independent * (count - 1)
        late = np.add.reduceat(self.late[rows], first) / count[:, None]
        rows = rows[first]
        return Sightings(
            keyframe=self.keyframe[rows],
            tree=tree[rows],
            p=mean,
            cov=cov * (count / effective)[:, None, None],
            count=count,
            late=late,
        )


def gather(
    detections: Detections, tree: NDArray[np.int64], keyframes_ns: NDArray[np.int64], motion: Motion
) -> Sightings:
    """Sightings of the detections with `tree` (N,) >= 0, see `AtKeyframes.gather`."""
    return AtKeyframes.of(detections, keyframes_ns, motion).gather(tree)
