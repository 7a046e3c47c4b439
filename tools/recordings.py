"""The recorded data of ../shared/data as trials: real stems under virtual sweeps, and the street.

A library for `tools/evaluate_recorded.py` and `tests/promises/`; nothing here is trained or tuned.
"""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from types import ModuleType

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from topograph.bags import Scan, Trunks
from topograph.config import Config
from topograph.evaluate.metrics import match
from topograph.geometry import Array, align_se3, from_quaternion, from_xyz_rpy, inverse, log, transform
from topograph.motion import Motion
from topograph.pipeline import read_run, solve_run, topo_map
from topograph.topomap import TopoMap
from topograph.trees import Detections, exists, follow, refine, relevelled, screen, shapes, tabulate
from topograph.trunks import TrunksConfig, fit
from topograph.trunks.detector import candidates

DATA = Path(__file__).resolve().parent.parent.parent / "shared" / "data"
HEIGHT = 1.0
"""Of the sensor above the ground, m."""
GATE = 0.5
"""A trunk is at a stem when it is within this of the stem's listed place, m."""
SENSORS = {"VLP-16": np.arange(-15.0, 16.0, 2.0), "64 rings": np.linspace(-22.5, 22.5, 64)}


def module(name: str) -> ModuleType:
    """A script of the shared data."""
    spec = importlib.util.spec_from_file_location(name, DATA / f"{name}.py")
    if spec is None or spec.loader is None:
        raise FileNotFoundError(DATA / f"{name}.py")
    out = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(out)
    return out


@dataclass(frozen=True)
class Look:
    """A virtual sweep: the scan, plot_T_base, and which stems it shows with 5 returns at 0.25-1.7 m."""

    scan: Scan
    plot_T_base: Array
    visible: NDArray[np.bool_]


class Plot:
    """A recorded cloud of real stems.

    Attributes:
        stems: (M, 3) listed x, y at 0.8 m and diameter.
    """

    def __init__(self, name: str) -> None:
        self.sweeps = module("virtual_sweeps")
        self.name = name
        self.points, self.stems = self.sweeps.load(name)
        with np.load(DATA / "real_stems" / f"{name}.npz", allow_pickle=False) as f:
            self.made = f["made_ground"] if "made_ground" in f else np.zeros(len(self.points), bool)
        self.low, self.high = self.stems[:, :2].min(0), self.stems[:, :2].max(0)

    @cached_property
    def _floor(self) -> tuple[Array | None, cKDTree | None, Array]:
        if self.made.any():
            q = self.points[self.made]
            plane = np.linalg.lstsq(np.c_[q[:, :2], np.ones(len(q))], q[:, 2], rcond=None)[0]
            return plane, None, np.zeros(0)
        low = self.points[self.points[:, 2] < 1.5]
        return None, cKDTree(low[:, :2]), low[:, 2]

    @property
    def unlisted(self) -> Array:
        """(U, 2) stems that stand in the cloud and not in the list: neither to be found nor wrong."""
        return np.array([UNLISTED]) if self.name == "lpine1" else np.zeros((0, 2))

    def ground(self, xy: Array) -> float:
        """Height of the ground at (2,); NaN where nothing is recorded."""
        plane, tree, z = self._floor
        if plane is not None:
            return float(plane @ [xy[0], xy[1], 1.0])
        assert tree is not None
        near = tree.query_ball_point(xy, 0.4)
        return float(np.percentile(z[near], 5)) if len(near) > 3 else np.nan

    @cached_property
    def axes(self) -> Array:
        """(M, 2, 2): slope and offset of x and y over height above ground, by circles in slices of the cloud.

        The listed places are a hand's breadth off these at 0.8 m: on them, centimetres cannot be judged.
        """
        heights = np.arange(0.2, 2.3, 0.15)
        out = []
        for x, y, d in self.stems:
            near = (np.hypot(self.points[:, 0] - x, self.points[:, 1] - y) < 0.6) & ~self.made
            q, g = self.points[near], self.ground(np.array([x, y]))
            row = np.array([_centre(q[np.abs(q[:, 2] - g - h) < 0.1][:, :2], np.array([x, y]), d) for h in heights])
            A, w = np.c_[heights, np.ones(len(heights))], np.ones(len(heights))
            for _ in range(6):
                line = np.linalg.lstsq(A * w[:, None], row * w[:, None], rcond=None)[0]
                w = 1.0 / (1.0 + (np.linalg.norm(row - A @ line, axis=1) / 0.02) ** 2)
            out.append(line)
        return np.array(out)

    def looks(self, n: int, seed: int, elevation: Array, mount: Array | None = None) -> list[Look]:
        """`n` sweeps from random places between the stems; `mount` is base_T_lidar (4, 4), level 1 m up when None."""
        rng = np.random.default_rng(seed)
        mount = from_xyz_rpy(0, 0, HEIGHT, 0, 0, 0) if mount is None else mount
        tolerance = min(0.4, 0.5 * float(np.median(np.diff(elevation))))
        out: list[Look] = []
        for _ in range(50 * n):
            if len(out) == n:
                break
            xy, yaw = rng.uniform(self.low, self.high), rng.uniform(-np.pi, np.pi)
            g = self.ground(xy)
            if np.hypot(*(self.stems[:, :2] - xy).T).min() < 0.9 or np.isnan(g):
                continue
            plot_T_base = from_xyz_rpy(xy[0], xy[1], g, 0, 0, yaw)
            T = plot_T_base @ mount
            # The sensor may hang anyhow: the cloud is turned into its frame, where the caster looks from the origin.
            local = (self.points - T[:3, 3]) @ T[:3, :3]
            xyz, ring = self.sweeps.sweep(local, np.zeros(3), 0.0, np.random.default_rng(seed * 1000 + len(out)), elevation, tolerance_deg=tolerance)  # fmt: skip
            scan = Scan(stamp_ns=1 + len(out) * 10**8, frame="lidar", xyz=xyz, ring=ring, offset=None, intensity=None)
            out.append(Look(scan, plot_T_base, self._shown(transform(T, xyz.astype(float)))))
        return out

    def _shown(self, seen: Array) -> NDArray[np.bool_]:
        count = []
        for x, y, d in self.stems:
            g = self.ground(np.array([x, y]))
            near = np.hypot(seen[:, 0] - x, seen[:, 1] - y) < 0.5 * d + 0.12
            h = seen[near, 2] - (0.0 if np.isnan(g) else g)
            count.append(((h > 0.25) & (h < 1.7)).sum())
        return np.array(count) >= 5


def _centre(slice_: Array, start: Array, diameter: float) -> Array:
    """Centre (2,) of the circle in a slice (K, 2), near `start`."""
    c = start
    for turn in range(4):
        off = np.abs(np.linalg.norm(slice_ - c, axis=1) - 0.5 * diameter)
        w = slice_[off < (0.16 if turn == 0 else 0.06)]
        if len(w) < 6:
            break
        s = np.linalg.lstsq(np.c_[2 * w, np.ones(len(w))], (w**2).sum(1), rcond=None)[0]
        if np.hypot(*(s[:2] - c)) < 0.4:
            c = s[:2]
    return np.asarray(c)


@dataclass(frozen=True)
class SweepResult:
    """Counts over sweeps: stems shown, shown and found, trunks found, found at a stem; `inside` the stems' outline."""

    shown: int
    hit: int
    found: int
    right: int
    inside: int

    @property
    def recall(self) -> float:
        """Of the stems shown."""
        return self.hit / max(self.shown, 1)

    @property
    def precision(self) -> float:
        """Of all trunks but those at stems that the list lacks."""
        return self.right / max(self.found, 1)


def judge(plot: Plot, looks: list[Look], trunks: list[Trunks]) -> SweepResult:
    """Trunks that their scan believes in (score >= 0), against the stems of each look."""
    shown = hit = found = right = inside = 0
    for look, t in zip(looks, trunks, strict=True):
        w = transform(look.plot_T_base, t.p[t.score >= 0]) if len(t) else np.zeros((0, 3))
        i, j = match(w[:, :2], plot.stems[:, :2], GATE)
        rest = np.setdiff1d(np.arange(len(w)), i)
        k, _ = match(w[rest, :2], plot.unlisted, GATE)
        w = np.delete(w, rest[k], axis=0)
        shown += int(look.visible.sum())
        hit += int(look.visible[j].sum())
        found += len(w)
        right += len(i)
        inside += int(((w[:, :2] > plot.low - GATE) & (w[:, :2] < plot.high + GATE)).all(1).sum())
    return SweepResult(shown, hit, found, right, inside)


@dataclass(frozen=True)
class Mapped:
    """A map at known poses: points on the axes (T, 3) at `height` (T,) above ground, kinds with their probability, diameters, stated sigma (T,)."""

    p: Array
    height: Array
    foot: Array
    kind: NDArray[np.int64]
    probability: Array
    diameter: Array
    sigma: Array


def map_at(poses: Array, trunks: list[Trunks], config: Config) -> Mapped:
    """What the mapper makes of trunks when the path (S, 4, 4) is known."""
    d = Detections.of(trunks)
    distance = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1))]
    motion = Motion(
        stamps_ns=d.stamps_ns,
        odom_T_robot=poses,
        distance=distance,
        turned=np.zeros(len(distance)),
        gyro=True,
        wheels=True,
    )
    track, held_T_robot = follow(d, motion, config.trees, config.motion)
    keep = screen(d, track, motion, held_T_robot).keep
    d, track = d.select(keep), np.unique(track[keep], return_inverse=True)[1]
    seen = transform(poses[d.scan], d.p)
    variance = d.sigma**2
    t = tabulate(d, track, poses, distance)
    tree = refine(t, np.arange(len(t.hits)), config.trees)[track]
    n = int(tree.max(initial=-1)) + 1
    total = np.bincount(tree, 1.0 / variance, n)
    s = shapes(d, tree, poses, n)
    seen = transform(poses[d.scan], relevelled(d, tree, poses, s).p)
    place = np.stack([np.bincount(tree, seen[:, k] / variance, n) / total for k in range(3)], axis=1)
    e = exists(d, tree, poses, place, config.trees)
    foot = place - s.axis * (s.height / s.axis[:, 2])[:, None]
    ok = np.flatnonzero(e.ok)
    return Mapped(
        place[ok], s.height[ok], foot[ok], e.kind[ok], e.probability[ok], s.diameter[ok], 1.0 / np.sqrt(total[ok])
    )


def labels() -> Array:
    """Hand labels of the street's upright things: (L, 4) x, y (m, frame of kiss64.tum), kind 0 tree, 1 post, 2 other, sure."""
    file = Path(__file__).resolve().parent.parent / "tests" / "promises" / "street_labels.csv"
    rows = [line.split(",") for line in file.read_text().splitlines()[1:]]
    return np.array([[float(r[0]), float(r[1]), ("tree", "post", "other").index(r[2]), float(r[4])] for r in rows])


def street_map(bag: Path, config: Config) -> TopoMap:
    """The map of a street bag, in the frame of kiss64.tum."""
    run = read_run([bag], config)
    topo = topo_map(solve_run(run, config), config, {})
    path = np.loadtxt(DATA / "street_avenue" / "kiss64.tum")
    ends = np.loadtxt(DATA / "street_avenue" / "stamps_ns.txt", dtype=np.int64)[:, 1]
    at = np.stack([np.interp(topo.stamps_ns, ends, path[:, k]) for k in (1, 2, 3)], axis=1)
    kiss_T_map = align_se3(topo.map_T_robot[:, :3, 3], at)
    return replace(topo, p=transform(kiss_T_map, topo.p))


def street_bag(out: Path, every_ring: int, first: int = 0, last: int = 300) -> Path:
    """A bag of the street's clouds with every n-th ring and the reference path as odometry."""
    if not out.exists():
        words = ["--every-ring", str(every_ring), "--from", str(first), "--to", str(last), "--odometry"]
        subprocess.run([sys.executable, str(DATA / "street_bag.py"), str(out), *words], check=True)
    return out


def called_tree(topo: TopoMap, gate: float = 1.0) -> tuple[int, int, list[tuple[float, float, str]]]:
    """Nodes of kind tree within 25 m of the path, how many of them are labelled trees, and the others as x, y, what."""
    known = labels()
    near, _ = cKDTree(np.loadtxt(DATA / "street_avenue" / "kiss64.tum")[:, 1:3]).query(topo.p[:, :2])
    nodes = topo.p[(topo.kind == 0) & (near < 25.0), :2]
    d = np.linalg.norm(nodes[:, None] - known[None, :, :2], axis=2)
    best = d.argmin(axis=1) if len(nodes) else np.zeros(0, int)
    wrong = []
    for k, j in enumerate(best):
        if not (d[k, j] < gate and known[j, 2] == 0) and not (d[k][known[:, 2] == 0] < gate).any():
            what = ("tree", "post", "other")[int(known[j, 2])] if d[k, j] < gate else "nothing labelled"
            wrong.append((float(nodes[k, 0]), float(nodes[k, 1]), what))
    return len(nodes), len(nodes) - len(wrong), wrong


def stem_candidates(name: str, n: int, seed: int) -> tuple[Array, Array, Array]:
    """Features, classes (0 tree, 2 other, -1 unclear) and sweeps of candidates in `n` sweeps of a plot, by any sensor in any mounting."""
    plot, rng = Plot(name), np.random.default_rng([seed, 5])
    X, y, sweep = [], [], []
    for k in range(n):
        elevation = [SENSORS["VLP-16"], SENSORS["64 rings"], np.linspace(-16, 15, 32)][rng.choice(3, p=[0.6, 0.2, 0.2])]
        tilt, turn = rng.uniform(0, STEEPEST) * (rng.random() < 0.6), rng.uniform(0, 2 * np.pi)
        roll, pitch = tilt * np.cos(turn) + np.pi * (rng.random() < 0.1), tilt * np.sin(turn)
        height = rng.uniform(0.2, 0.65) if rng.random() < KNEE_HIGH else rng.uniform(0.25, 2.5)
        mount = from_xyz_rpy(0, 0, height, roll, pitch, 0)
        for look in plot.looks(1, seed + k, elevation, mount):
            c = candidates(look.scan, mount, np.zeros(6), TrunksConfig())
            p = transform(look.plot_T_base, c.fits[:, :3])
            above = np.clip(c.fits[:, fit.ABOVE], 0.2, 2.3)[:, None, None]
            at = plot.axes[None, :, 0] * above + plot.axes[None, :, 1]
            near = (np.linalg.norm(p[:, None, :2] - at, axis=2) - 0.5 * plot.stems[None, :, 2]).min(axis=1)
            unlisted = (
                np.hypot(p[:, 0] - UNLISTED[0], p[:, 1] - UNLISTED[1]) if name == "lpine1" else np.full(len(p), 9.0)
            )
            inside = ((p[:, :2] > plot.low - 0.3) & (p[:, :2] < plot.high + 0.3)).all(axis=1)
            X.append(c.features)
            y.append(np.where(near < 0.12, 0, np.where((near > 0.5) & inside & (unlisted > 1.2), 2, -1)))
            sweep.append(np.full(len(p), k))
    return np.concatenate(X), np.concatenate(y), np.concatenate(sweep)


STEEPEST = 0.55
"""Tilt of a mounting, rad."""
KNEE_HIGH = 0.3
"""Share of mountings that hang at knee height, where most is hidden and most is missed."""
UNLISTED = (1.95, 5.6)
"""A stem with low branches that stands in lpine1's cloud and not in its list, m."""


def street_candidates(first: int, last: int, every_ring: int) -> tuple[Array, Array, Array]:
    """Features, classes and sweeps of candidates in sweeps of the street, by the hand labels; places drift by up to 0.3 m."""
    known = labels()
    path = np.loadtxt(DATA / "street_avenue" / "kiss64.tum")
    poses = from_quaternion(path[:, 1:4], path[:, 4:])
    mount = from_xyz_rpy(0, 0, 1.9, 0, 0, 0)
    X, y, sweep = [], [], []
    for k, (start, end, xyz, ring, t) in enumerate(module("street_bag").sweeps(first, last, every_ring), first):
        step = log(inverse(poses[max(k - 1, 0)]) @ poses[k]) / ((end - start) * 1e-9) if k else np.zeros(6)
        scan = Scan(
            stamp_ns=end,
            frame="lidar",
            xyz=xyz.astype(np.float32),
            ring=ring.astype(np.int32),
            offset=(t - (end - start) * 1e-9).astype(np.float32),
            intensity=None,
        )
        c = candidates(scan, mount, np.concatenate([step[3:], step[:3]]), TrunksConfig())
        p = transform(poses[k] @ inverse(mount), c.fits[:, :3])
        d = np.linalg.norm(p[:, None, :2] - known[None, :, :2], axis=2)
        kind, near = known[d.argmin(axis=1), 2].astype(int), d.min(axis=1)
        upright = d[:, known[:, 2] < 2].min(axis=1)
        sure = known[d.argmin(axis=1), 3] > 0
        label = np.where((near < 0.45) & (kind < 2) & sure, kind, np.where(upright > 1.3, 2, -1))
        far = np.hypot(*(p[:, :2] - poses[k, :2, 3]).T)
        sharp = far < np.where(label == 0, 30.0, 22.0)
        X.append(c.features[sharp])
        y.append(label[sharp])
        sweep.append(np.full(len(y[-1]), k))
    return np.concatenate(X), np.concatenate(y), np.concatenate(sweep)
