"""What the graph of a long run costs: time and memory by keyframes; python tools/bench_graph.py [--keyframes 10000 30000 100000]

A path to and fro between rows of trees 5 m apart, half a metre between keyframes, eight sightings each, RTK at every fifth. Each size in a process of
its own, so that its peak is its own, with the memory settings of the command line; the floor is what the problem's arrays hold.
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import time

import numpy as np
from scipy.spatial import cKDTree

from topograph.cli.common import thrifty
from topograph.estimate import EstimateConfig, Fixes, Headings, Problem, graph
from topograph.geometry import Datum, inverse, planar, transform
from topograph.motion import Motion, MotionConfig
from topograph.trees import Detections, Sightings

STEP, GAP, SEEN, SIGMA = 0.5, 5.0, 8, 0.05
"""m between keyframes, m between trees, trees seen of each, m."""


def problem(n: int) -> Problem:
    """A long run of `n` keyframes."""
    rng = np.random.default_rng(0)
    row = round(np.sqrt(n * STEP * GAP) / STEP)  # keyframes a row: the orchard is a square
    k = np.arange(n)
    along, line = k % row, k // row
    back = line % 2 == 1
    xy = np.column_stack([np.where(back, row - 1 - along, along) * STEP, line * GAP])
    poses = np.array([planar(x, y, np.pi if b else 0.0) for (x, y), b in zip(xy, back, strict=True)])
    gx, gy = np.meshgrid(np.arange(0, row * STEP + GAP, GAP), (np.arange(line.max() + 2) - 0.5) * GAP)
    trees = np.column_stack([gx.ravel(), gy.ravel(), np.zeros(gx.size)])
    _, j = cKDTree(trees[:, :2]).query(xy, SEEN)
    which, frame = np.asarray(j).ravel(), np.repeat(k, SEEN)
    size = len(which)
    p = transform(inverse(poses)[frame], trees[which]) + SIGMA * rng.normal(size=(size, 3))
    cov = np.tile(SIGMA**2 * np.eye(3, dtype=np.float32), (size, 1, 1))
    stamps = k * 500_000_000
    step = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1))])
    turned = np.concatenate([[0.0], np.cumsum(np.pi * (np.diff(line) > 0))])
    motion = Motion(stamps_ns=stamps, odom_T_robot=poses, distance=step, turned=turned, gyro=True, wheels=True)
    zero = np.zeros(size)
    detections = Detections(
        stamps_ns=stamps, scan=frame, p=p, cov=cov, axis=np.tile([0.0, 0.0, 1.0], (size, 1)), height=zero, diameter=zero + 0.2,
        score=zero, kinds=np.full((size, 3), np.nan), measured=np.zeros((size, 6)), stems=np.ones(size, np.int64),
        source=np.arange(size), free=np.zeros((0, 360), np.uint32), eye=np.zeros((n, 3)),
    )  # fmt: skip
    sightings = Sightings(
        keyframe=frame, tree=which, p=p, cov=cov, count=np.ones(size, np.int64), late=np.zeros((size, 3))
    )
    at = k[::5]
    fixes = Fixes(
        keyframe=at, map_p_antenna=poses[at, :3, 3] + 0.02 * rng.normal(size=(len(at), 3)), cov=np.tile(4e-4 * np.eye(3), (len(at), 1, 1)),
        keyframe_p_antenna=np.zeros((len(at), 3)), late=np.zeros((len(at), 3)),
    )  # fmt: skip
    none = Headings(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros(0), np.zeros(0))
    return Problem(
        stamps_ns=stamps, odom_T_robot=poses, step_sigma=motion.sigma(MotionConfig(), stamps), motion=motion, motion_config=MotionConfig(),
        inertial=None, fixes=fixes, headings=none, datum=Datum(45.0, 8.0, 100.0), detections=detections, sightings=sightings,
        n_trees=len(trees),
    )  # fmt: skip


def peak() -> float:
    """Of this process, MB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def one(n: int) -> None:
    """Solve one size and print its line."""
    thrifty()
    p = problem(n)
    floor, began = peak(), time.process_time()
    e = graph.solve(p, EstimateConfig())
    off = np.linalg.norm((e.map_T_robot[:, :3, 3] - p.odom_T_robot[:, :3, 3])[:, :2], axis=1)
    print(f"{n:9,d} keyframes {p.n_trees:7,d} trees  {time.process_time() - began:6.0f} s  {peak():6.0f} MB (arrays {floor:.0f})  path {100 * off.mean():.1f} cm", flush=True)  # fmt: skip


def main() -> None:
    """Each size in a process of its own."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--keyframes", type=int, nargs="+", default=[10_000, 30_000, 100_000])
    parser.add_argument("--one", action="store_true", help=argparse.SUPPRESS)
    a = parser.parse_args()
    for n in a.keyframes:
        if a.one:
            one(n)
        else:
            subprocess.run([sys.executable, __file__, "--one", "--keyframes", str(n)], check=True)


if __name__ == "__main__":
    main()
