"""Figures with their units. Trees are matched to truth one to one; nothing is aligned unless it says so."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree

from topograph.evaluate.frames import world_in_map
from topograph.evaluate.truth import Truth
from topograph.geometry import Array, Datum, Stamps, align_se3, interpolate, inverse, log, transform
from topograph.topomap import TopoMap

MATCH_GATE = 1.0
"""A node farther than this from every tree is a false one, m."""


@dataclass(frozen=True, slots=True)
class Metric:
    """One figure. `better` is "lower", "higher" or ""; `unit` is SI or empty."""

    name: str
    value: float
    unit: str = ""
    better: str = ""

    @property
    def plain(self) -> float | int | None:
        """The value as JSON has it."""
        return plain(self.value)


def plain(value: float) -> float | int | None:
    """A number as JSON has it: None for what is none, whole ones without a point."""
    if not math.isfinite(value):
        return None
    return int(value) if float(value).is_integer() and abs(value) < 1e15 else float(value)


def match(found: Array, true: Array, gate: float = MATCH_GATE) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Indices (M,), (M,) of found (N, 2) and true (K, 2) positions that are one: nearest together in sum, where a pair further
    apart than `gate` costs no more than the gate (the assignment of GOSPA, Rahmathullah et al. 2017). If it cost more, a false
    node at one end of a dense row would push all others onto their neighbours.
    """
    if len(found) == 0 or len(true) == 0:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    return _assign(np.linalg.norm(found[:, None] - true[None], axis=2), gate)


def _assign(d: Array, gate: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    i, j = linear_sum_assignment(np.minimum(d, gate))
    ok = d[i, j] < gate
    return i[ok].astype(np.int64), j[ok].astype(np.int64)


def visible(truth: Truth, least: int = 8) -> NDArray[np.bool_]:
    """(N,) trees that at least `least` scans showed with 5 returns or more; all, where the truth has no returns."""
    if len(truth.returns) == 0:
        return np.ones(len(truth.trees), bool)
    return np.asarray((truth.returns >= 5).sum(axis=0) >= least)


def tree_errors(
    topo: TopoMap, truth: Truth, gate: float = MATCH_GATE
) -> tuple[NDArray[np.int64], NDArray[np.int64], Array]:
    """Matched rows of the map's trees and of the truth, and errors (M, 3) of the feet in the map frame, m; see `world_in_map`."""
    topo = topo.trees()
    true = world_in_map(topo, truth).points(truth.trees)
    i, j = match(topo.p[:, :2], true[:, :2], gate)
    return i, j, topo.p[i] - true[j]


def map_metrics(topo: TopoMap, truth: Truth) -> list[Metric]:
    """Precision, recall, errors, doubles, diameters, consistency of the covariances."""
    topo = topo.trees()
    if not len(truth.trees):
        return [Metric("trees", len(topo)), doubles(topo)]
    i, j, e = tree_errors(topo, truth)
    error = np.linalg.norm(e[:, :2], axis=1)
    seen = visible(truth)
    out = [
        Metric("trees", len(topo)),
        Metric("tree precision", len(i) / max(len(topo), 1), "", "higher"),
        Metric("tree recall", float(seen[j].sum() / max(seen.sum(), 1)), "", "higher"),
    ]
    if len(i):
        d = topo.diameter[i] - truth.diameters[j]  # NaN where the truth has none
        single = (truth.stems[j] == 1) & np.isfinite(d)
        out += [
            Metric("tree error mean", float(error.mean()), "m", "lower"),
            Metric("tree error median", float(np.median(error)), "m", "lower"),
            Metric("tree error max", float(error.max()), "m", "lower"),
            Metric("tree height error mean", float(np.abs(e[:, 2]).mean()), "m", "lower"),
        ]
        if single.any():
            out.append(Metric("diameter RMSE", float(np.sqrt(np.mean(d[single] ** 2))), "m", "lower"))
        c = topo.cov[i][:, :2, :2]
        if np.isfinite(c).all():
            nees = np.einsum("ni,nij,nj->n", e[:, :2], np.linalg.inv(c), e[:, :2])
            out.append(Metric("tree NEES (2 dof)", float(nees.mean())))
    return out + [doubles(topo)]


def doubles(topo: TopoMap, nearer: float = 1.0) -> Metric:
    """Share of trees that have another one nearer than `nearer` m."""
    topo = topo.trees()
    if len(topo) < 2:
        return Metric("doubles", 0.0, "", "lower")
    distance, _ = cKDTree(topo.p[:, :2]).query(topo.p[:, :2], k=2)  # the first is the tree itself
    return Metric("doubles", float((np.asarray(distance)[:, 1] < nearer).mean()), "", "lower")


def path_metrics(
    stamps_ns: Stamps,
    poses: Array,
    datum: Datum | None,
    true_ns: Stamps,
    true_poses: Array,
    true_datum: Datum | None,
) -> list[Metric]:
    """Error of a path. With both datums known it is compared as it is; else after the best rigid motion (ATE)."""
    if len(true_ns) < 2:
        return []
    inside = (stamps_ns >= true_ns[0] - 10_000_000) & (stamps_ns <= true_ns[-1] + 10_000_000)
    if inside.sum() < 3:
        return []
    true = interpolate(true_ns, true_poses, stamps_ns[inside])
    found = poses[inside]
    if datum is not None and true_datum is not None:
        p = datum.to_enu(true_datum.to_geodetic(true[:, :3, 3]))
        turn = np.abs(log(inverse(true) @ found)[:, 2])
        e = found[:, :3, 3] - p
        return [
            Metric("path error mean (horizontal)", float(np.linalg.norm(e[:, :2], axis=1).mean()), "m", "lower"),
            Metric("path error max (horizontal)", float(np.linalg.norm(e[:, :2], axis=1).max()), "m", "lower"),
            Metric("path error RMSE (vertical)", float(np.sqrt(np.mean(e[:, 2] ** 2))), "m", "lower"),
            Metric("heading error RMSE", float(np.sqrt(np.mean(turn**2))), "rad", "lower"),
        ]
    moved = transform(align_se3(found[:, :3, 3], true[:, :3, 3]), found[:, :3, 3])
    e = np.linalg.norm(moved - true[:, :3, 3], axis=1)
    return [
        Metric("path ATE RMSE (SE(3) aligned)", float(np.sqrt(np.mean(e**2))), "m", "lower"),
        Metric("path ATE max (SE(3) aligned)", float(e.max()), "m", "lower"),
    ]


def truth_metrics(topo: TopoMap, stamps_ns: Stamps, map_T_robot: Array, truth: Truth) -> list[Metric]:
    """All that the truth says of a map and of the path (K,), (K, 4, 4) that it was made with."""
    true_datum = truth.datum if topo.datum is not None else None
    path = path_metrics(stamps_ns, map_T_robot, topo.datum, truth.stamps_ns, truth.world_T_robot, true_datum)
    return map_metrics(topo, truth) + path


def fix_metrics(antenna: Array, fix: Array, sigma: Array) -> list[Metric]:
    """Horizontal distance of the path's antenna (H, 3) from fixes (H, 3) that were withheld; `sigma` (H,) as stated.

    A fix is a jump, and left out, when it is further than five stated deviations plus 5 m from the median of the
    nine fixes around it: a rule that does not look at the path.
    """
    if len(fix) == 0:
        return []
    window = np.clip(np.arange(len(fix))[:, None] + np.arange(-4, 5), 0, len(fix) - 1)
    calm = np.median(fix[window, :2], axis=1)
    jump = np.linalg.norm(fix[:, :2] - calm, axis=1) > 5.0 + 5.0 * sigma
    d = np.linalg.norm((antenna - fix)[~jump, :2], axis=1)
    return [
        Metric("held-out fixes RMS", float(np.sqrt(np.mean(d**2))), "m", "lower"),
        Metric("held-out fixes median", float(np.median(d)), "m", "lower"),
        Metric("held-out fixes", len(d)),
        Metric("held-out fixes left out as jumps", int(jump.sum())),
    ]


def trunk_metrics(
    truth: Truth,
    stamps_ns: Stamps,
    p: list[Array],
    *,
    edges: tuple[float, ...] = (0.0, 10.0, 20.0, 30.0),
    gate: float = 0.5,
) -> tuple[list[Metric], list[dict[str, float]]]:
    """Precision and recall per sweep and by range (the thesis's Table 5.1, with recall).

    `p` are trunks (n, 3) in `base_link` of each scan. A tree counts as visible with 5 returns; of two trunks at one
    tree, one is wrong. Errors are taken at the trunk's own height.
    """
    index = {int(s): k for k, s in enumerate(truth.scan_stamps_ns)}
    bins = len(edges) - 1
    hit, shown, found, right = (np.zeros(bins) for _ in range(4))
    radial: list[list[float]] = [[] for _ in range(bins)]
    across: list[list[float]] = [[] for _ in range(bins)]
    for s, q in zip(stamps_ns.tolist(), p, strict=True):
        if s not in index:
            continue
        T = inverse(interpolate(truth.stamps_ns, truth.world_T_robot, [s])[0])
        foot, axis = transform(T, truth.trees), truth.axes @ T[:3, :3].T
        far = np.hypot(foot[:, 0], foot[:, 1])
        seen = truth.returns[index[s]] >= 5
        at = foot[None, :, :2] + ((q[:, None, 2] - foot[None, :, 2]) / axis[None, :, 2])[..., None] * axis[None, :, :2]
        d = np.linalg.norm(q[:, None, :2] - at, axis=2) if len(q) else np.zeros((0, len(foot)))
        i, j = _assign(d, gate)
        matched = np.zeros(len(foot), bool)
        matched[j] = True
        own = np.zeros(len(q), bool)
        own[i] = True
        reach = np.hypot(q[:, 0], q[:, 1])
        for b in range(bins):
            here = (far >= edges[b]) & (far < edges[b + 1])
            shown[b] += (seen & here).sum()
            hit[b] += (seen & here & matched).sum()
            mine = (reach >= edges[b]) & (reach < edges[b + 1])
            found[b] += mine.sum()
            right[b] += (mine & own).sum()
        for a, t in zip(i, j, strict=True):
            b = int(np.searchsorted(edges, far[t], side="right")) - 1
            if 0 <= b < bins and truth.stems[t] == 1:
                line = at[a, t] / max(float(np.linalg.norm(at[a, t])), 1e-9)
                e = q[a, :2] - at[a, t]
                radial[b].append(float(e @ line))
                across[b].append(float(line[0] * e[1] - line[1] * e[0]))
    table = [
        {
            "from": edges[b], "to": edges[b + 1], "visible": shown[b], "found": found[b],
            "precision": right[b] / max(found[b], 1), "recall": hit[b] / max(shown[b], 1),
            "radial_bias": float(np.mean(radial[b])) if radial[b] else np.nan,
            "radial_sd": float(np.std(radial[b])) if radial[b] else np.nan,
            "tangential_sd": float(np.std(across[b])) if across[b] else np.nan,
        }
        for b in range(bins)
    ]  # fmt: skip
    out = [
        Metric("trunk precision", float(right.sum() / max(found.sum(), 1)), "", "higher"),
        Metric("trunk recall", float(hit.sum() / max(shown.sum(), 1)), "", "higher"),
    ]
    return out, table
