"""Recorded data that ships with gtsam, through `factors/`."""

from pathlib import Path

import gtsam
import numpy as np
import pytest
import scipy.io

import factors
from factors import Kernel
from topograph.estimate.solver import optimised
from topograph.geometry import fit_rigid_2d

DATA = Path(gtsam.__file__).parent / "Data"


@pytest.mark.slow
def test_plaza2_range_only() -> None:
    """A mower with four radio beacons (Djugash): ranges over-read by a common factor, found without ground truth."""
    dr = np.loadtxt(DATA / "Plaza2_DR.txt")
    td = np.loadtxt(DATA / "Plaza2_TD.txt")
    mat = scipy.io.loadmat(DATA / "Plaza2_.mat")
    gt = mat["GT"]
    path = [gt[0, 1:4] + [0, 0, np.pi]]  # this file's headings are reversed
    for d, a in dr[:, 1:3]:
        x, y, t = path[-1]
        path.append(np.array([x + d * np.cos(t + a / 2), y + d * np.sin(t + a / 2), t + a]))
    poses = np.array(path)
    t_nodes = np.concatenate([[gt[0, 0]], dr[:, 0]])
    keep = np.unique(
        np.concatenate([np.arange(0, len(t_nodes), 3), np.searchsorted(t_nodes, td[:, 0]).clip(0, len(t_nodes) - 1)])
    )
    nodes, times = poses[keep], t_nodes[keep]
    beacons = {int(b): n for n, b in enumerate(np.unique(td[:, 2]))}

    def solve(scale: float) -> tuple[float, np.ndarray]:
        g, v = gtsam.NonlinearFactorGraph(), gtsam.Values()
        g.add(gtsam.PriorFactorPose2(0, gtsam.Pose2(*nodes[0]), factors.sigmas([1e-3, 1e-3, 1e-3])))
        for k, p in enumerate(nodes):
            v.insert(k, gtsam.Pose2(*p))
        for k in range(len(nodes) - 1):
            step = gtsam.Pose2(*nodes[k]).between(gtsam.Pose2(*nodes[k + 1]))
            d, dt = np.hypot(step.x(), step.y()), times[k + 1] - times[k]
            sigma = [0.03 * np.sqrt(d) + 1e-3, 0.02 * np.sqrt(d) + 1e-3, 0.01 * np.sqrt(dt) + 1e-4]
            g.add(factors.odometry_2d(k, k + 1, step.x(), step.y(), step.theta(), sigma))
        huber = Kernel("huber", 1.345)
        at = np.searchsorted(times, td[:, 0]).clip(0, len(times) - 1)
        for k, (_, _, b, r) in zip(at.tolist(), td, strict=True):
            g.add(factors.range_2d(k, 10_000 + beacons[int(b)], scale * r, 0.5, huber))
        for b, n in beacons.items():
            mine = td[:, 2] == b
            v.insert(10_000 + n, _trilaterate(nodes[at[mine], :2], scale * td[mine, 3]))
        out = optimised(g, v, 60)
        xy = gtsam.utilities.extractPose2(out)[:, :2]
        return g.error(out), xy

    scales = np.array([0.92, 0.93, 0.94, 0.95])
    costs = np.array([solve(s)[0] for s in scales])
    a, b, _ = np.polyfit(scales, costs, 2)
    scale = -b / (2 * a)
    assert 0.930 < scale < 0.940
    _, xy = solve(scale)
    true = np.stack([np.interp(times, gt[:, 0], gt[:, k]) for k in (1, 2)], axis=1)
    x, y, yaw = fit_rigid_2d(xy, true)
    c, s = np.cos(yaw), np.sin(yaw)
    e = xy @ np.array([[c, s], [-s, c]]) + [x, y] - true
    ate = np.sqrt(np.mean(np.sum(e**2, axis=1)))
    assert ate <= 0.30


def _trilaterate(p: np.ndarray, r: np.ndarray) -> np.ndarray:
    """Beacon (2,) nearest to agreeing with ranges from dead-reckoned places: the best of many starts, robustly."""
    from scipy.optimize import least_squares

    centre = p.mean(0)
    starts = [centre + 40 * np.array([np.cos(a), np.sin(a)]) for a in np.linspace(0, 2 * np.pi, 8, endpoint=False)]

    def off(q: np.ndarray) -> np.ndarray:
        return np.linalg.norm(p - q, axis=1) - r

    fits = [least_squares(off, s, loss="soft_l1") for s in starts]
    return min(fits, key=lambda f: f.cost).x


@pytest.mark.slow
def test_victoria_park_with_associations() -> None:
    """6969 poses, 151 trees, associations given: incremental first (batch from odometry ends in a wrong minimum)."""
    isam = gtsam.ISAM2(_isam_params())
    graph, pending, estimate = gtsam.NonlinearFactorGraph(), gtsam.NonlinearFactorGraph(), gtsam.Values()
    fresh = gtsam.Values()
    known: set[int] = {0}
    prior = gtsam.PriorFactorPose2(0, gtsam.Pose2(), factors.sigmas([1e-4] * 3))
    pending.add(prior)
    graph.add(prior)
    fresh.insert(0, gtsam.Pose2())
    last = {0: gtsam.Pose2()}
    steps = 0
    for line in (DATA / "victoria_park.txt").read_text().splitlines():
        w = line.split()
        if w[0] == "ODOMETRY":
            i, j = int(w[1]), int(w[2])
            x, y, a = map(float, w[3:6])
            if steps % 25 == 0 and fresh.size():
                isam.update(pending, fresh)
                pending, fresh = gtsam.NonlinearFactorGraph(), gtsam.Values()
                estimate = isam.calculateEstimate()
                last = {i: estimate.atPose2(i)}
            steps += 1
            f = factors.odometry_2d(i, j, x, y, a, [0.1, 0.1, 0.02])
            last = {j: last[i].compose(gtsam.Pose2(x, y, a))}
            fresh.insert(j, last[j])
            known.add(j)
        else:
            i, j = int(w[1]), int(w[2])
            x, y = float(w[3]), float(w[4])
            f = factors.trunk_2d(i, j, float(np.arctan2(y, x)), float(np.hypot(x, y)), [0.05, 0.5], Kernel("none"))
            if j not in known:
                known.add(j)
                fresh.insert(j, last[i].transformFrom(np.array([x, y])))
        pending.add(f)
        graph.add(f)
    isam.update(pending, fresh)
    for _ in range(3):
        isam.update()
    out = optimised(graph, isam.calculateEstimate(), 100, 1e-8)
    assert graph.error(out) <= 463.5


def _isam_params() -> gtsam.ISAM2Params:
    p = gtsam.ISAM2Params()
    p.setRelinearizeThreshold(0.1)
    p.relinearizeSkip = 1
    return p
