"""Nodes from landmarks: axis and foot, diameter, viewpoints; then edges and rows."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from topograph.estimate import Estimate
from topograph.geometry import Array, Datum
from topograph.session import Scans
from topograph.topomap.clouds import register
from topograph.topomap.edges import TopomapConfig, among
from topograph.topomap.map import TREE, TopoMap, Viewpoint
from topograph.topomap.rows import find_rows
from topograph.topomap.sessions import Seen, SessionRecord
from topograph.trees import Detections, Existence, Shapes, grounds
from topograph.trunks import LEAST_CLOUD


def build(
    estimate: Estimate,
    detections: Detections,
    scans: Scans | None,
    map_T_scan: Array,
    existence: Existence,
    s: Shapes,
    datum: Datum | None,
    config: TopomapConfig,
    meta: dict[str, str],
    session: SessionRecord | None = None,
) -> TopoMap:
    """The map of an estimate, whose trees have shapes `s`. `scans` have the trunks' clouds, where these are wanted;
    `detections.source` counts in them.
    """
    n, tree = len(estimate.trees), estimate.tree
    ground, ground_sigma = grounds(detections, tree, map_T_scan, n)
    height = np.where(np.isfinite(ground), estimate.trees[:, 2] - ground, s.height)
    along = s.axis / np.maximum(s.axis[:, 2:], 0.3)
    foot = estimate.trees - height[:, None] * along
    cov = estimate.tree_cov.copy()
    # The foot lies `height` below what was measured: the lean's error carries over, and the ground's, along the axis.
    cov[:, [0, 1], [0, 1]] += (s.place_var + height**2 * s.slope_var + _no_cylinder(s.diameter) ** 2)[:, None]
    cov += np.nan_to_num(ground_sigma)[:, None, None] ** 2 * (along[:, :, None] * along[:, None, :])
    viewpoints = _viewpoints(foot, tree, detections, scans, map_T_scan, config)
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
        lean_sigma=np.sqrt(s.slope_var),
        known_at=height,
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
        sessions=() if session is None else (session,),
        session=np.zeros(len(estimate.stamps_ns), np.int64),
        seen=Seen.none() if session is None else _seen(n, tree, detections, existence.passed),
    )


def _seen(n: int, tree: NDArray[np.int64], detections: Detections, passed: NDArray[np.int64]) -> Seen:
    """Each of `n` trees in the map's one session."""
    used = tree >= 0
    ns = detections.stamps_ns[detections.scan[used]]
    first, last = np.full(n, np.iinfo(np.int64).max), np.zeros(n, np.int64)
    np.minimum.at(first, tree[used], ns)
    np.maximum.at(last, tree[used], ns)
    count = np.bincount(tree[used], minlength=n)
    return Seen(
        tree=np.arange(n),
        session=np.zeros(n, np.int64),
        count=count,
        first_ns=np.where(count > 0, first, 0),
        last_ns=last,
        passed=passed,
    )


def _no_cylinder(diameter: Array) -> Array:
    """Sigma (T,) of the axis of trunks that are the less a cylinder the thicker they are, m: lobes, flares, hollows."""
    return np.asarray(0.06 * np.maximum(np.nan_to_num(diameter) - 0.25, 0.0))


def _viewpoints(
    foot: Array, tree: NDArray[np.int64], detections: Detections, scans: Scans | None, map_T_scan: Array,
    config: TopomapConfig,
) -> tuple[Viewpoint, ...]:  # fmt: skip
    if scans is None or not len(scans.points):
        return ()
    source = detections.source
    size = np.diff(scans.cloud_ends)[source]
    shown = np.flatnonzero((tree >= 0) & (size >= LEAST_CLOUD))
    shown = shown[np.lexsort((-size[shown], tree[shown]))]  # tree by tree, the fullest first
    ends = np.searchsorted(tree[shown], np.arange(len(foot) + 1))
    out: list[Viewpoint] = []
    for j in range(len(foot)):
        mine = shown[ends[j] : ends[j + 1]]
        v = map_T_scan[detections.scan[mine], :3, 3] - foot[j]  # eq. 4.13
        v[:, 2] = 0.0  # views differ by side, not by the slope between robot and tree
        v /= np.maximum(np.linalg.norm(v, axis=1, keepdims=True), 1e-9)
        for direction, rows in _sides(v, config.viewpoint_cosine):
            parts = []
            for i in mine[rows[: config.clouds_per_viewpoint]].tolist():
                T = map_T_scan[detections.scan[i]]
                parts.append((scans.cloud(source[i]) @ T[:3, :3].T + T[:3, 3] - foot[j]).astype(np.float32))
            out.append(Viewpoint(j, direction, register(parts, config.voxel)))
    return tuple(out)


def _sides(v: Array, cosine: float) -> list[tuple[Array, NDArray[np.int64]]]:
    """Unit vectors `v` (N, 3) in groups: the first that no earlier one is near (inner product above `cosine`) begins a group, and each
    belongs to the nearest of those that began one.
    """
    centres: list[int] = []
    alike = np.full((len(v), 0), -1.0)
    while len(far := np.flatnonzero(alike.max(axis=1, initial=-1.0) <= cosine)):
        centres.append(int(far[0]))
        alike = np.column_stack([alike, v @ v[far[0]]])
        alike[far[0], -1] = 2.0  # its own, whatever rounding says
    group = alike.argmax(axis=1) if centres else np.zeros(0, np.int64)
    return [(v[c], np.flatnonzero(group == k)) for k, c in enumerate(centres)]


def _first_branch(n: int, viewpoints: Sequence[Viewpoint], axes: Array) -> Array:
    """Height (T,) at which the bare trunk ends, where it ends within what was traced (1.5 m); else NaN."""
    out = np.full(n, np.nan)
    for v in viewpoints:
        if len(v.cloud) > 30:
            out[v.tree] = np.fmax(out[v.tree], np.percentile(v.cloud @ axes[v.tree], 98))
    return np.where((out > 0.4) & (out < 1.5), out, np.nan)
