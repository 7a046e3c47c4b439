"""How right a localization is, and how right it is about itself."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from topograph.evaluate.frames import WorldInMap
from topograph.evaluate.metrics import Metric
from topograph.evaluate.truth import Truth
from topograph.geometry import Array, Stamps, interpolate, wrap, yaw_of
from topograph.localize import Report

WRONG = 1.0
"""A committed position farther than this from the truth is a wrong commit, m."""


@dataclass(frozen=True, slots=True)
class LocalizationErrors:
    """Errors of the committed scans: `stamps_ns` (K,), `xy` (K, 2) m, `z` (K,) m, `yaw` (K,) rad, `nees` (K,) of x and y."""

    stamps_ns: Stamps
    xy: Array
    z: Array
    yaw: Array
    nees: Array


def localization_errors(reports: Sequence[Report], truth: Truth, world: WorldInMap) -> LocalizationErrors:
    """Errors of committed poses against the truth's path, which `world` brings into the map; those that it covers."""
    fixes = [r.fix for r in reports if r.fix is not None and covered(truth, r.fix.stamp_ns)]
    if not fixes:
        return LocalizationErrors(np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros(0), np.zeros(0), np.zeros(0))
    stamps = np.array([f.stamp_ns for f in fixes], np.int64)
    world_T_robot = interpolate(truth.stamps_ns, truth.world_T_robot, stamps)
    true = world.points(world_T_robot[:, :3, 3])
    poses = np.array([f.map_T_robot for f in fixes])
    error = poses[:, :3, 3] - true
    cov = np.array([f.cov[3:5, 3:5] for f in fixes])
    nees = np.full(len(fixes), np.nan)
    known = np.isfinite(cov).all(axis=(1, 2))
    nees[known] = np.einsum("ki,kij,kj->k", error[known, :2], np.linalg.inv(cov[known]), error[known, :2])
    return LocalizationErrors(
        stamps, error[:, :2], error[:, 2], wrap(yaw_of(poses) - yaw_of(world_T_robot) - world.turn), nees
    )


COVER_NS = 20_000_000


def covered(truth: Truth, stamp_ns: int) -> bool:
    """The truth's path says where the robot was then."""
    ns = truth.stamps_ns
    return len(ns) > 1 and bool(ns[0] - COVER_NS <= stamp_ns <= ns[-1] + COVER_NS)


def path_errors(stamps_ns: Stamps, poses: Array, truth: Truth, world: WorldInMap) -> Array:
    """Horizontal distances (K,) of poses (N, 4, 4) in the map from the truth's path, m, of those that it covers."""
    inside = np.array([covered(truth, int(s)) for s in stamps_ns], bool)
    if not inside.any():
        return np.zeros(0)
    true = interpolate(truth.stamps_ns, truth.world_T_robot, stamps_ns[inside])[:, :3, 3]
    return np.asarray(np.linalg.norm((poses[inside, :3, 3] - world.points(true))[:, :2], axis=1))


def localization_metrics(
    reports: Sequence[Report], distance: Sequence[float], update_ms: Sequence[float], errors: LocalizationErrors | None
) -> list[Metric]:
    """Figures of a localized run; those against the truth only when `errors` are there."""
    committed = np.array([r.fix is not None for r in reports])
    out = [Metric("scans", len(reports)), Metric("distance driven", float(distance[-1]) if len(distance) else 0.0, "m")]
    first = int(np.argmax(committed)) if committed.any() else -1
    out.append(Metric("distance to the first pose", float(distance[first]) if first >= 0 else np.nan, "m", "lower"))
    if first >= 0:
        out.append(Metric("share with a pose after the first", float(committed[first:].mean()), "", "higher"))
        lost = np.flatnonzero(committed[:-1] & ~committed[1:])
        out.append(Metric("times lost", len(lost), "", "lower"))
        tracking = np.array([r.state == "tracking" for r in reports[first:]])
        out.append(Metric("share tracked by trees after the first", float(tracking.mean()), "", "higher"))
        widest = max((max(r.along, r.across) for r in reports if r.fix is not None), default=np.nan)
        out.append(Metric("largest stated deviation (1 σ)", float(widest), "m", "lower"))
    if len(update_ms) > 1:
        out.append(Metric("update median", float(np.median(update_ms[1:])), "ms", "lower"))
    if errors is None or not len(errors.stamps_ns):
        return out
    off = np.hypot(*errors.xy.T)
    yaw = np.degrees(np.abs(errors.yaw))
    wrong = off > WRONG
    out += [
        Metric("position error mean", float(off.mean()), "m", "lower"),
        Metric("|x| error mean", float(np.abs(errors.xy[:, 0]).mean()), "m", "lower"),
        Metric("|y| error mean", float(np.abs(errors.xy[:, 1]).mean()), "m", "lower"),
        Metric("position error 99 %", float(np.percentile(off, 99)), "m", "lower"),
        Metric("position error max", float(off.max()), "m", "lower"),
        Metric("heading error mean", float(yaw.mean()), "deg", "lower"),
        Metric("heading error 99 %", float(np.percentile(yaw, 99)), "deg", "lower"),
        Metric("height error sd", float(errors.z.std()), "m", "lower"),
        Metric("wrong poses", int(wrong.sum()), "", "lower"),
    ]
    known = errors.nees[np.isfinite(errors.nees)]
    if len(known):
        out.append(Metric("NEES of x and y (2 is right)", float(known.mean())))
    return out
