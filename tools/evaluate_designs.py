"""Sweeps and maps of every design of the simulator, each by itself: python tools/evaluate_designs.py [DESIGN...] [--seeds 5]

LiDAR runs (VLP-16, 5 sweeps a second), mapped from the bag as `topograph map` does. Seeds from 3001 on; nothing was tuned on
them. Worst seeds are shown beside the means, since an orchard is mapped once and not on average.
"""

from __future__ import annotations

import argparse
import tempfile
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from topograph.config import Config
from topograph.evaluate import Truth, trunk_metrics
from topograph.evaluate.metrics import match, visible
from topograph.geometry import interpolate
from topograph.pipeline import read_run, solve_run, topo_map
from topograph.simulate import DESIGNS, DriveConfig, SensorConfig, record

EDGES = (0.0, 10.0, 20.0, 30.0)


@dataclass
class Result:
    """One run: the sweeps' table; the map's counts; errors (M, 2) at foot and 0.8 m, squared normalised (M,), lean pairs and
    diameter pairs (M, 2) of estimate and truth, and of trees seen within 10 m."""

    table: list[dict[str, float]]
    found: int
    right: int
    shown: int
    recalled: int
    foot: np.ndarray
    breast: np.ndarray
    nees: np.ndarray
    lean: np.ndarray
    diameter: np.ndarray
    posts: int
    note: str


def run(job: tuple[str, int], seconds: float, keep: Path | None = None) -> Result:
    """Simulate, map, compare. Bags in the folder `keep` are taken from there, or left there."""
    design, seed = job
    with tempfile.TemporaryDirectory() as folder:
        bag = (keep or Path(folder)) / f"{design}_{seed}_{seconds:.0f}s.bag"
        bag.parent.mkdir(parents=True, exist_ok=True)
        if not bag.exists():
            whole_bag = bag.with_name("of_" + bag.name)
            record(whole_bag, seed, DESIGNS[design], DriveConfig(longest_s=seconds), SensorConfig(sweep_hz=5.0))
            whole_bag.with_suffix(".truth").rename(bag.with_suffix(".truth"))
            whole_bag.rename(bag)
        truth = Truth.load(bag.with_suffix(".truth"))
        config = Config()
        read = read_run([bag], config)
        solved = solve_run(read, config)
        whole = topo_map(solved, config, {})
    stamps = np.array([t.stamp_ns for t in read.trunks])
    _, table = trunk_metrics(truth, stamps, [t.p[t.score >= 0] for t in read.trunks], edges=EDGES)
    topo = whole.trees()
    assert topo.datum is not None
    true = topo.datum.to_enu(truth.datum.to_geodetic(truth.trees))
    i, j = match(topo.p[:, :2], true[:, :2])
    seen = visible(truth)
    e = topo.p[i] - true[j]
    chest = 0.8 * (topo.axis[i, :2] / topo.axis[i, 2:] - truth.axes[j, :2] / truth.axes[j, 2:])
    single = truth.stems[j] == 1
    nees = np.einsum("ni,nij,nj->n", e[:, :2], np.linalg.inv(topo.cov[i][:, :2, :2]), e[:, :2])
    lean = np.stack([topo.axis[i, :2] / topo.axis[i, 2:], truth.axes[j, :2] / truth.axes[j, 2:]], axis=-1)[
        single
    ].reshape(-1, 2)
    near = np.min(np.linalg.norm(interpolate(truth.stamps_ns, truth.world_T_robot, stamps)[:, None, :2, 3] - truth.trees[None, :, :2], axis=2), axis=0)  # fmt: skip
    close = single & (near[j] < 10.0)
    wrong = sorted(set(range(len(topo))) - set(i.tolist()))
    missed = sorted(set(np.flatnonzero(seen).tolist()) - set(j.tolist()))
    far = np.linalg.norm(e[:, :2], axis=1)
    note = f"false {[(np.round(topo.p[k, :2], 1).tolist(), int(topo.sightings[k])) for k in wrong]} missed {[(int((truth.returns[:, k] >= 5).sum()), round(float(truth.diameters[k]), 2)) for k in missed]} far {[(round(float(far[k]), 2), int(truth.stems[j[k]]), int(topo.sightings[i[k]])) for k in np.flatnonzero(far > 0.1)]}"  # fmt: skip
    return Result(
        table=table, found=len(topo), right=len(i), shown=int(seen.sum()), recalled=int(seen[j].sum()),
        foot=e[:, :2], breast=e[:, :2] + chest, nees=nees, lean=lean,
        diameter=np.stack([topo.diameter[i], truth.diameters[j]], axis=1)[close], posts=int((~whole.is_tree).sum()), note=note,
    )  # fmt: skip


def slope(pairs: np.ndarray) -> float:
    """Estimate over truth, about the truth's mean, by least squares."""
    t = pairs[:, 1] - pairs[:, 1].mean()
    return float(t @ (pairs[:, 0] - pairs[:, 0].mean()) / max(t @ t, 1e-12))


def main() -> None:
    """One block a design."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("designs", nargs="*", default=[])
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--first", type=int, default=3001)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument(
        "--keep",
        type=Path,
        help="folder in which the bags stay for another time (about 120 MB each); empty it when the simulator changes",
    )
    parser.add_argument("-v", "--verbose", action="store_true")
    a = parser.parse_args()
    designs = a.designs or list(DESIGNS)
    jobs = [(d, a.first + k) for d in designs for k in range(a.seeds)]
    print(
        f"{'design':<10} map P  (worst) R  (worst)  foot mean max  0.8 m  NEES   lean   diameter slope, RMSE   sweeps P, R by 10 m"
    )
    with ProcessPoolExecutor(2) as pool:
        results = list(pool.map(partial(run, seconds=a.seconds, keep=a.keep), jobs))
    for n, d in enumerate(designs):
        r = results[n * a.seeds : (n + 1) * a.seeds]
        p, q = [k.right / max(k.found, 1) for k in r], [k.recalled / max(k.shown, 1) for k in r]
        foot = np.concatenate([np.linalg.norm(k.foot, axis=1) for k in r])
        breast = np.concatenate([np.linalg.norm(k.breast, axis=1) for k in r])
        diameter = np.concatenate([k.diameter for k in r])
        cells = []
        for b in range(3):
            rows = [k.table[b] for k in r]
            found, shown = sum(t["found"] for t in rows), sum(t["visible"] for t in rows)
            right, hit = sum(t["precision"] * t["found"] for t in rows), sum(t["recall"] * t["visible"] for t in rows)
            cells.append(f"{right / max(found, 1):.2f} {hit / max(shown, 1):.2f}")
        total = sum(k.right for k in r) / max(sum(k.found for k in r), 1)
        recall = sum(k.recalled for k in r) / max(sum(k.shown for k in r), 1)
        print(
            f"{d:<10} {total:.3f} ({min(p):.2f}) {recall:.3f} ({min(q):.2f})  {100 * foot.mean():4.1f} {100 * foot.max():5.1f}  {100 * breast.mean():4.1f}  "
            f"{np.mean(np.concatenate([k.nees for k in r])):5.2f}  {slope(np.concatenate([k.lean for k in r])):5.2f}  {slope(diameter):5.2f} {100 * np.sqrt(np.mean((diameter[:, 0] - diameter[:, 1]) ** 2)):4.1f} cm   "
            + "  ".join(cells), flush=True,
        )  # fmt: skip
        if a.verbose:
            for k in r:
                print("    ", k.note, "posts", k.posts)


if __name__ == "__main__":
    main()
