"""Nodes from landmarks: axis and foot, diameter, viewpoints; then edges and rows."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from topograph.bags import Trunks
from topograph.estimate import Estimate
from topograph.geometry import Array, Datum
from topograph.topomap.clouds import register
from topograph.topomap.edges import TopomapConfig, among
from topograph.topomap.map import TREE, TopoMap, Viewpoint
from topograph.topomap.rows import find_rows
from topograph.trees import Detections, Existence, Shapes


def build(
    estimate: Estimate,
    detections: Detections,
    trunks: Sequence[Trunks],
    map_T_scan: Array,
    existence: Existence,
    s: Shapes,
    datum: Datum | None,
    config: TopomapConfig,
    meta: dict[str, str],
) -> TopoMap:
    """The map of an estimate, whose trees have shapes `s`. `trunks` are the scans' trunks with their clouds;
    `detections.source` counts in them.
    """
    n, tree = len(estimate.trees), estimate.tree
    foot = estimate.trees - s.axis * (s.height / np.maximum(s.axis[:, 2], 0.3))[:, None]
    cov = estimate.tree_cov.copy()
    # The foot lies `height` below what was measured: the lean's error carries over.
    cov[:, [0, 1], [0, 1]] += (s.place_var + s.height**2 * s.slope_var + _no_cylinder(s.diameter) ** 2)[:, None]
    viewpoints = _viewpoints(foot, tree, detections, trunks, map_T_scan, config)
    is_tree = existence.kind == TREE
    edges = among(foot[:, :2], is_tree, config)
    row = np.full(n, -1, np.int64)
    row[is_tree] = find_rows(foot[is_tree, :2], estimate.map_T_robot[:, :2, 3])
    return TopoMap(
        datum=datum,
        ids=np.arange(1, n + 1),
        p=foot,
        cov=cov,
        axis=s.axis,
        diameter=s.diameter,
        first_branch=_first_branch(n, viewpoints, s.axis),
        sightings=np.bincount(tree[tree >= 0], minlength=n),
        score=existence.score,
        row=row,
        kind=existence.kind,
        kind_probability=existence.probability,
        stems=s.stems,
        edges=edges,
        lengths=np.linalg.norm(foot[edges[:, 0]] - foot[edges[:, 1]], axis=1),
        viewpoints=viewpoints,
        stamps_ns=estimate.stamps_ns,
        map_T_robot=estimate.map_T_robot,
        datum_cov=estimate.datum_cov,
        meta=meta,
    )


def _no_cylinder(diameter: Array) -> Array:
    """Sigma (T,) of the axis of trunks that are the less a cylinder the thicker they are, m: lobes, flares, hollows."""
    return np.asarray(0.06 * np.maximum(np.nan_to_num(diameter) - 0.25, 0.0))


def _viewpoints(
    foot: Array, tree: NDArray[np.int64], detections: Detections, trunks: Sequence[Trunks], map_T_scan: Array,
    config: TopomapConfig,
) -> tuple[Viewpoint, ...]:  # fmt: skip
    clouds = [c for t in trunks for c in (t.clouds or [np.zeros((0, 3), np.float32)] * len(t))]
    if not any(map(len, clouds)):
        return ()
    clouds = [clouds[k] for k in detections.source.tolist()]
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
