"""Nodes from landmarks: axis and foot, diameter, viewpoints; then edges and rows."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from topograph.bags import Trunks
from topograph.estimate import Estimate
from topograph.geometry import Array, Datum
from topograph.topomap.clouds import register
from topograph.topomap.edges import TopomapConfig, neighbours
from topograph.topomap.map import TopoMap, Viewpoint
from topograph.topomap.rows import find_rows
from topograph.trees import Detections


def build(
    estimate: Estimate,
    detections: Detections,
    trunks: Sequence[Trunks],
    map_T_scan: Array,
    score: Array,
    datum: Datum | None,
    config: TopomapConfig,
    meta: dict[str, str],
) -> TopoMap:
    """The map of an estimate. `trunks` are the scans' trunks with their clouds, in the order of `detections`."""
    n = len(estimate.trees)
    tree, axes, hits = estimate.tree, np.zeros((n, 3)), np.zeros(n, np.int64)
    diameter, height, spread = np.full(n, np.nan), np.zeros(n), np.zeros(n)
    map_axis = (map_T_scan[detections.scan, :3, :3] @ detections.axis[:, :, None])[..., 0]
    order = np.argsort(tree, kind="stable")
    ends = np.searchsorted(tree[order], np.arange(n + 1))
    for j in range(n):
        mine = order[ends[j] : ends[j + 1]]
        hits[j] = len(mine)
        axes[j], spread[j] = _axis(map_axis[mine], detections.p[mine])
        known = detections.diameter[mine][np.isfinite(detections.diameter[mine])]
        diameter[j] = np.median(known) if len(known) else np.nan
        above = detections.height[mine][np.isfinite(detections.height[mine])]
        height[j] = np.median(above) if len(above) else 0.0
    foot = estimate.trees - axes * (height / np.maximum(axes[:, 2], 0.3))[:, None]
    cov = estimate.tree_cov.copy()
    # The foot lies `height` below what was measured: the lean's error carries over.
    lean_var = (height * np.hypot(0.02, 0.4 * spread)) ** 2
    cov[:, [0, 1], [0, 1]] += lean_var[:, None]
    viewpoints = _viewpoints(foot, tree, detections, trunks, map_T_scan, config)
    edges = neighbours(foot[:, :2], config)
    return TopoMap(
        datum, np.arange(1, n + 1), foot, cov, axes, diameter, _first_branch(n, viewpoints, axes), hits, score,
        find_rows(foot[:, :2], estimate.map_T_robot[:, :2, 3]), edges,
        np.linalg.norm(foot[edges[:, 0]] - foot[edges[:, 1]], axis=1), viewpoints, estimate.stamps_ns,
        estimate.map_T_robot, estimate.datum_cov, meta,
    )  # fmt: skip


def _axis(axes: Array, p: Array) -> tuple[Array, float]:
    """Axis (3,) of one tree and its uncertainty, rad, from sightings' axes (N, 3) in the map frame, seen at `p` (N, 3).

    From afar one or two rings cross a trunk and its lean is a guess; the nearest third of the sightings decides.
    """
    if len(axes) == 0:
        return np.array([0.0, 0.0, 1.0]), 0.1
    far = np.hypot(p[:, 0], p[:, 1])
    near = axes[far <= max(float(np.percentile(far, 33)), 4.0)]
    mean = np.median(near, axis=0)
    # Stems and bends: the views do not agree on one axis, however many they are.
    spread = 1.4826 * float(np.median(np.linalg.norm(near[:, :2] - mean[:2], axis=1))) / 1.177
    return np.asarray(mean / np.linalg.norm(mean)), spread


def _viewpoints(
    foot: Array, tree: NDArray[np.int64], detections: Detections, trunks: Sequence[Trunks], map_T_scan: Array,
    config: TopomapConfig,
) -> tuple[Viewpoint, ...]:  # fmt: skip
    clouds = [c for t in trunks for c in (t.clouds or [np.zeros((0, 3), np.float32)] * len(t))]
    if len(clouds) != len(tree) or not any(map(len, clouds)):
        return ()
    size = np.array([len(c) for c in clouds])
    out: list[Viewpoint] = []
    for j in range(len(foot)):
        mine = np.flatnonzero((tree == j) & (size >= 8))
        mine = mine[np.argsort(-size[mine], kind="stable")]
        v = map_T_scan[detections.scan[mine], :3, 3] - foot[j]  # eq. 4.13
        v[:, 2] = 0.0  # views differ by side, not by the slope between robot and tree
        v /= np.maximum(np.linalg.norm(v, axis=1, keepdims=True), 1e-9)
        centres: list[Array] = []
        members: list[list[int]] = []
        for i, d in zip(mine.tolist(), v, strict=True):
            similar = [float(d @ c) for c in centres]
            k = int(np.argmax(similar)) if similar else -1
            if k >= 0 and similar[k] > config.viewpoint_cosine:
                if len(members[k]) < config.clouds_per_viewpoint:
                    members[k].append(i)
            else:
                centres.append(d)
                members.append([i])
        for c, group in zip(centres, members, strict=True):
            parts = []
            for i in group:
                T = map_T_scan[detections.scan[i]]
                parts.append((clouds[i] @ T[:3, :3].T + T[:3, 3] - foot[j]).astype(np.float32))
            out.append(Viewpoint(j, c, register(parts, config.voxel)))
    return tuple(out)


def _first_branch(n: int, viewpoints: Sequence[Viewpoint], axes: Array) -> Array:
    """Height (T,) at which the bare trunk ends, where it ends within what was traced (1.5 m); else NaN."""
    out = np.full(n, np.nan)
    for v in viewpoints:
        if len(v.cloud) > 30:
            out[v.tree] = np.fmax(out[v.tree], np.percentile(v.cloud @ axes[v.tree], 98))
    return np.where((out > 0.4) & (out < 1.5), out, np.nan)
