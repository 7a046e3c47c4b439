"""The trunk front end against the truth, on simulated bags that were not trained or tuned on.

    python tools/evaluate_front_end.py BAG... [--every N] [--front-end thesis] [--shuffle] [--no-time]

Per sweep: precision and recall by range (the thesis's Table 5.1), bias and spread, the normalised error of the stated
covariances. Per map: the same trunks put together with the true poses. `--shuffle` takes ring and order away (an
unorganised cloud), `--no-time` the time of each point. Truth folders lie beside the bags.
"""

from __future__ import annotations

import argparse
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
from recordings import map_at

from topograph.bags import Imu, Odometry, Recording, Scan, Trunks
from topograph.config import Config
from topograph.evaluate import Truth, trunk_metrics
from topograph.evaluate.metrics import match
from topograph.geometry import interpolate, inverse, transform
from topograph.trunks.frontend import FrontEnd

EDGES = (0.0, 10.0, 20.0, 30.0)


@dataclass
class Result:
    """One bag: the table's rows, squared normalised errors (N, 2): range, value; and the map's figures."""

    name: str
    table: list[dict[str, float]]
    nees: np.ndarray
    found: int
    right: int
    trees: int
    errors: np.ndarray
    diameters: np.ndarray
    centred: np.ndarray


def run(bag: Path, every: int, front_end: Literal["organised", "thesis"], shuffle: bool, no_time: bool) -> Result:
    """Detect in every n-th sweep of a bag and compare."""
    truth = Truth.load(bag.with_name(bag.stem + ".truth"))
    rng = np.random.default_rng(0)
    config = Config()
    trunks: list[Trunks] = []
    with Recording([bag]) as r:
        trunks_config = replace(config.trunks, front_end=front_end)
        door, pending, n = FrontEnd(r.frames.get, r.frames.find, trunks_config, config.thesis_trunks), [], 0
        for _, m in r.messages():
            if not isinstance(m, Scan):
                if isinstance(m, (Odometry, Imu)):
                    door.hear(m)
                continue
            pending.append(m)
            if len(pending) < 2:
                continue
            s = pending.pop(0)
            n += 1
            if n % every:
                continue
            if shuffle:
                order = rng.permutation(len(s.xyz))
                s = Scan(
                    stamp_ns=s.stamp_ns,
                    frame=s.frame,
                    xyz=s.xyz[order],
                    ring=None,
                    offset=None if s.offset is None else s.offset[order],
                    intensity=None,
                )
            if no_time:
                s = replace(s, offset=None)
            trunks.append(door.see(s))
    stamps = np.array([t.stamp_ns for t in trunks])
    _, table = trunk_metrics(truth, stamps, [t.p[t.score >= 0] for t in trunks], edges=EDGES)
    return Result(bag.stem, table, nees_of(truth, trunks), *mapped(truth, trunks, config))


def nees_of(truth: Truth, trunks: list[Trunks]) -> np.ndarray:
    """Range and normalised squared error (N, 2) of trunks on single-stemmed trees, at the trunk's height."""
    out = []
    for t in trunks:
        T = inverse(interpolate(truth.stamps_ns, truth.world_T_robot, [t.stamp_ns])[0])
        foot, axis = transform(T, truth.trees), truth.axes @ T[:3, :3].T
        for p, cov in zip(t.p, t.cov, strict=True):
            at = foot[:, :2] + ((p[2] - foot[:, 2]) / axis[:, 2])[:, None] * axis[:, :2]
            e = p[:2] - at
            j = int(np.argmin(np.hypot(*e.T)))
            if np.hypot(*e[j]) < 0.3 and truth.stems[j] == 1:
                out.append([np.hypot(*p[:2]), e[j] @ np.linalg.solve(cov[:2, :2], e[j])])
    return np.array(out).reshape(-1, 2)


def mapped(truth: Truth, trunks: list[Trunks], config: Config):
    """Trees found, right, there; errors (M, 2) and diameter errors (M,), with the true poses as the path."""
    poses = interpolate(truth.stamps_ns, truth.world_T_robot, np.array([t.stamp_ns for t in trunks]))
    m = map_at(poses, trunks, config)
    trees = m.kind == 0
    shown = truth.returns.sum(axis=0) >= 200
    height = m.height[trees][:, None]
    i, j = match(m.p[trees, :2], (truth.trees + truth.axes * (0.8 / truth.axes[:, 2:]))[:, :2])
    at = truth.trees[j, :2] + truth.axes[j, :2] / truth.axes[j, 2:] * height[i]
    error = m.p[trees][i, :2] - at
    return int(trees.sum()), len(i), int(np.isin(np.flatnonzero(shown), j).sum()) + 10000 * int(shown.sum()), error, m.diameter[trees][i] - truth.diameters[j], error - error.mean(0)  # fmt: skip


def main() -> None:
    """Print one line a bag and range, then the totals."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("bags", nargs="+", type=Path)
    p.add_argument("--every", type=int, default=2)
    p.add_argument("--front-end", default="organised", choices=["organised", "thesis"])
    p.add_argument("--shuffle", action="store_true")
    p.add_argument("--no-time", action="store_true")
    a = p.parse_args()
    job = partial(run, every=a.every, front_end=a.front_end, shuffle=a.shuffle, no_time=a.no_time)
    with ProcessPoolExecutor(2) as pool:
        results = list(pool.map(job, a.bags))
    total = np.zeros((len(EDGES) - 1, 4))
    for r in results:
        for b, row in enumerate(r.table):
            total[b] += [row["visible"], row["found"], row["precision"] * row["found"], row["recall"] * row["visible"]]
        cells = "  ".join(
            f"P {x['precision']:.3f} R {x['recall']:.3f} ({100 * x['radial_bias']:+.1f} ± {100 * x['radial_sd']:.1f}, {100 * x['tangential_sd']:.1f} cm)"
            for x in r.table
        )
        seen, there = r.trees % 10000, r.trees // 10000
        e = np.hypot(*r.errors.T)
        print(
            f"{r.name:<14} {cells}\n{'':<14} map: {r.right}/{r.found} right, {seen}/{there} of the trees, mean {100 * e.mean():.1f} cm, max {100 * e.max():.1f}, "
            f"diameter RMSE {100 * np.sqrt(np.mean(r.diameters**2)):.1f} cm"
        )
    nees = np.concatenate([r.nees for r in results])
    print("range     precision  recall   normalised error (2)")
    for b in range(len(EDGES) - 1):
        here = (nees[:, 0] >= EDGES[b]) & (nees[:, 0] < EDGES[b + 1])
        value = np.mean(nees[here, 1]) if here.any() else np.nan
        print(
            f"{EDGES[b]:>2.0f}-{EDGES[b + 1]:<2.0f} m  {total[b, 2] / max(total[b, 1], 1):9.3f} {total[b, 3] / max(total[b, 0], 1):8.3f} {value:10.2f}"
        )
    e = np.concatenate([np.hypot(*r.errors.T) for r in results])
    print(
        f"all       {total[:, 2].sum() / total[:, 1].sum():9.3f} {total[:, 3].sum() / total[:, 0].sum():8.3f}   maps: precision {sum(r.right for r in results) / sum(r.found for r in results):.3f} "
        f"recall {sum(r.trees % 10000 for r in results) / sum(r.trees // 10000 for r in results):.3f} mean error {100 * e.mean():.1f} cm "
        f"diameter RMSE {100 * np.sqrt(np.mean(np.concatenate([r.diameters for r in results]) ** 2)):.1f} cm"
    )


if __name__ == "__main__":
    main()
