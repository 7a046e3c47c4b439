"""What the thesis's chapter 5 counts, for any method: it cannot tell which one is ours."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from topograph.evaluate.frames import WorldInMap, world_in_map
from topograph.evaluate.localization import WRONG, LocalizationErrors, covered, localization_errors
from topograph.evaluate.metrics import Metric, match, visible
from topograph.evaluate.truth import Truth
from topograph.geometry import Array, align_se3, interpolate, inverse, transform
from topograph.localize import Report
from topograph.topomap import TopoMap

GATES = (0.5, 1.0, 2.5)
"""A node is of a tree up to so far from it, m; the last is as far as the thesis's worst node (2.14 m) needs."""
HEIGHT = 0.8
"""Trunks are looked at so high above ground, m; a method that knows no axis stands there, not at the foot."""


@dataclass(frozen=True, slots=True, kw_only=True)
class NodeErrors:
    """Nodes of a map against the truth's trees, as matched within the widest gate.

    Attributes:
        node, tree: (M,) rows of the map's trees and of the truth.
        foot: (M, 2) errors at the foot, m; `above` (M, 2) at 0.8 m.
        nodes: how many there are; `seen` (T,) trees that the run showed.
    """

    node: NDArray[np.int64]
    tree: NDArray[np.int64]
    foot: Array
    above: Array
    nodes: int
    seen: NDArray[np.bool_]


def node_errors(topo: TopoMap, truth: Truth, gate: float = GATES[-1], world: WorldInMap | None = None) -> NodeErrors:
    """Thesis eq. 5.2, node by node (Fig. 5.8); matched at 0.8 m. `world`: the truth in the map, where it is known already."""
    topo = topo.trees()
    world = world_in_map(topo, truth) if world is None else world
    true, lifted = world.points(truth.trees), world.points(truth.trees + truth.axes * HEIGHT)
    above = topo.p + topo.axis * (HEIGHT / np.maximum(topo.axis[:, 2:], 0.3))
    i, j = match(above[:, :2], lifted[:, :2], gate)
    return NodeErrors(
        node=i,
        tree=j,
        foot=(topo.p[i] - true[j])[:, :2],
        above=(above[i] - lifted[j])[:, :2],
        nodes=len(topo),
        seen=visible(truth),
    )


def node_metrics(topo: TopoMap, truth: Truth) -> list[Metric]:
    """Errors by gate, clipped nowhere: each gate has its own precision and recall beside it."""
    out = [Metric("nodes", len(topo.trees()))]
    world = world_in_map(topo, truth)
    found = [node_errors(topo, truth, gate, world) for gate in GATES]
    for gate, e in zip(GATES, found, strict=True):
        out += [
            Metric(f"precision ({gate:g} m)", len(e.node) / max(e.nodes, 1), "", "higher"),
            Metric(f"recall ({gate:g} m)", float(e.seen[e.tree].sum() / max(e.seen.sum(), 1)), "", "higher"),
        ]
    e = found[-1]
    if len(e.node):
        for name, at in (("at 0.8 m", e.above), ("at the foot", e.foot)):
            d = np.hypot(*at.T)
            out += [
                Metric(f"tree error {name}, mean", float(d.mean()), "m", "lower"),
                Metric(f"tree error {name}, min", float(d.min()), "m", "lower"),
                Metric(f"tree error {name}, max", float(d.max()), "m", "lower"),
            ]
    return out


@dataclass(frozen=True, slots=True)
class Sight:
    """One scan from above, as Fig. 5.6 shows it: trees (T, 2) in `base_link`, and by method trunks (N, 3) and which are right (N,)."""

    trees: Array
    trunks: dict[str, tuple[Array, NDArray[np.bool_]]]


def sight(truth: Truth, stamp_ns: int, trunks: dict[str, Array], gate: float = 0.5) -> Sight:
    """The scan at `stamp_ns` with the trunks (N, 3) of each method; one is right within `gate` m of a tree that no nearer one has."""
    T = inverse(interpolate(truth.stamps_ns, truth.world_T_robot, [stamp_ns])[0])
    trees = transform(T, truth.trees + truth.axes * HEIGHT)[:, :2]
    out = {}
    for name, p in trunks.items():
        right = np.zeros(len(p), bool)
        right[match(p[:, :2], trees, gate)[0]] = True
        out[name] = (p, right)
    return Sight(trees, out)


@dataclass(frozen=True, slots=True)
class Start:
    """One start somewhere in a run (thesis 5.4.3, Fig. 5.14).

    Attributes:
        scan: where it began.
        distance: driven until the first pose, m; NaN where the run ended before.
        error: of that pose, m.
        trees: trunks in view on the way, median.
    """

    scan: int
    distance: float
    error: float
    trees: int

    @property
    def wrong(self) -> bool:
        return bool(self.error > WRONG)


def start_of(
    scan: int,
    reports: Sequence[Report],
    distance: Sequence[float],
    trunks: Sequence[int],
    truth: Truth,
    world: WorldInMap,
) -> Start:
    """What a replay that began at `scan` and ended with its first pose says."""
    trees = int(np.median(trunks)) if len(trunks) else 0
    last = reports[-1] if reports else None
    if last is None or last.fix is None or not covered(truth, last.fix.stamp_ns):
        return Start(scan, float("nan"), float("nan"), trees)
    errors = localization_errors([last], truth, world)
    return Start(scan, float(distance[-1]), float(np.hypot(*errors.xy[0])), trees)


def start_metrics(starts: Sequence[Start]) -> list[Metric]:
    """Convergence as the thesis reports it, over the starts that came to a right pose, and the count of those that did not."""
    right = np.array([s.distance for s in starts if np.isfinite(s.distance) and not s.wrong])
    out = [
        Metric("starts", len(starts)),
        Metric("starts that ended wrong", sum(s.wrong for s in starts), "", "lower"),
        Metric("starts without an end", sum(not np.isfinite(s.distance) for s in starts), "", "lower"),
    ]
    if len(right):
        out += [
            Metric("convergence mean", float(right.mean()), "m", "lower"),
            Metric("convergence sd", float(right.std()), "m", "lower"),
            Metric("convergence min", float(right.min()), "m", "lower"),
            Metric("convergence max", float(right.max()), "m", "lower"),
        ]
    return out


def ate(stamps_ns: Array, poses: Array, truth: Truth, *, aligned: bool = True) -> float:
    """Root mean square of the absolute trajectory error (Sturm et al. 2012), m; `aligned` by SE(3) before."""
    inside = np.array([covered(truth, int(s)) for s in stamps_ns], bool)
    true = interpolate(truth.stamps_ns, truth.world_T_robot, stamps_ns[inside])[:, :3, 3]
    found = poses[inside, :3, 3]
    if aligned:
        found = transform(align_se3(found, true), found)
    return float(np.sqrt(np.mean(np.sum((found - true) ** 2, axis=1))))


def rpe(stamps_ns: Array, poses: Array, truth: Truth, delta: int = 1) -> float:
    """Root mean square of the relative pose error's translation over `delta` poses (Sturm et al. 2012), m."""
    inside = np.array([covered(truth, int(s)) for s in stamps_ns], bool)
    true = interpolate(truth.stamps_ns, truth.world_T_robot, stamps_ns[inside])
    found = poses[inside]
    e = inverse(inverse(true[:-delta]) @ true[delta:]) @ (inverse(found[:-delta]) @ found[delta:])
    return float(np.sqrt(np.mean(np.sum(e[:, :3, 3] ** 2, axis=1))))


def error_metrics(errors: LocalizationErrors) -> list[Metric]:
    """Fig. 5.11's figures: means of |x|, |y| and of the distance; worst; share of poses more than 1 m off."""
    if not len(errors.stamps_ns):
        return []
    off = np.hypot(*errors.xy.T)
    return [
        Metric("distance error mean", float(off.mean()), "m", "lower"),
        Metric("|x| error mean", float(np.abs(errors.xy[:, 0]).mean()), "m", "lower"),
        Metric("|y| error mean", float(np.abs(errors.xy[:, 1]).mean()), "m", "lower"),
        Metric("distance error max", float(off.max()), "m", "lower"),
        Metric("heading error mean", float(np.degrees(np.abs(errors.yaw)).mean()), "deg", "lower"),
        Metric("share of poses wrong", float((off > WRONG).mean()), "", "lower"),
    ]
