"""The figures that the README claims, over seeds that were not used for tuning (1001 and up).

    python tools/evaluate.py map --runs 10 --work DIR          LiDAR runs, RTK
    python tools/evaluate.py map --runs 10 --gnss degraded     LiDAR runs, degraded GNSS
    python tools/evaluate.py nees --runs 100                   consistency, on simulated detections
    python tools/evaluate.py degraded --runs 20                degraded GNSS, on simulated detections

Prints mean, spread over runs, and the worst run. Tuning used seeds below 1000.
"""

from __future__ import annotations

import argparse
import json
import shutil
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.stats import chi2

from topograph.config import Config
from topograph.evaluate import Truth, map_metrics, truth_metrics
from topograph.evaluate.metrics import tree_errors
from topograph.pipeline import baseline, read_run, solve_run, topo_map
from topograph.simulate import DESIGNS, DriveConfig, SensorConfig, record

SHOWN = ("tree precision", "tree recall", "tree error mean", "tree error max", "diameter RMSE", "tree NEES (2 dof)",
         "path error mean (horizontal)", "thesis: tree error mean", "thesis / graph")  # fmt: skip


def one(bag: Path, seed: int, design: str, sensor: SensorConfig, run: int) -> dict[str, float]:
    """All metrics of one run; simulates it if it is not there."""
    orchard = replace(DESIGNS[design], lean=0.0, multi_stem=0.0) if sensor.detections else design
    truth_folder = bag.with_name(bag.stem + ".truth")
    if bag.exists():
        truth = Truth.load(truth_folder)
    else:
        truth = record(bag, seed, orchard, DriveConfig(run=run), sensor)
    config = Config()
    solved = solve_run(read_run([bag], config), config)
    topo = topo_map(solved, config, {})
    e = solved.estimate
    out = {m.name: m.value for m in truth_metrics(topo, e.stamps_ns, e.map_T_robot, truth)}
    theirs = {m.name: m.value for m in map_metrics(baseline(solved, config)[1], truth)}
    out["thesis: tree error mean"] = theirs["tree error mean"]
    out["thesis / graph"] = theirs["tree error mean"] / out["tree error mean"]
    i, _, error = tree_errors(topo, truth)
    cov = topo.cov[i][:, :2, :2]
    out["one tree's NEES"] = float(error[0, :2] @ np.linalg.inv(cov[0]) @ error[0, :2])
    return out


def main() -> None:
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("what", choices=["map", "nees", "degraded"], nargs="?", default="nees")
    p.add_argument("--runs", type=int, default=10)
    p.add_argument("--first", type=int, default=1001)
    p.add_argument("--design", default="grid", choices=sorted(DESIGNS))
    p.add_argument("--gnss", default="rtk")
    p.add_argument("--work", type=Path, help="keep (and reuse) the simulated bags here")
    p.add_argument("--json", type=Path)
    a = p.parse_args()
    work = a.work or Path(tempfile.mkdtemp())
    work.mkdir(parents=True, exist_ok=True)
    gnss = "degraded" if a.what == "degraded" else a.gnss
    sensor = SensorConfig(gnss=gnss, detections=a.what != "map", compression="none" if a.what == "map" else "zstd")
    rows = []
    for seed in range(a.first, a.first + a.runs):
        bag = work / (f"{a.design}_{seed}.bag" if a.what == "map" else f"{a.what}_{a.design}_{seed}")
        rows.append(one(bag, seed, a.design, sensor, 1 + (seed % 2 if a.what != "map" else 0)))
        print(seed, {k: round(rows[-1][k], 3) for k in SHOWN}, flush=True)
        if a.work is None:
            shutil.rmtree(bag) if bag.is_dir() else bag.unlink()
    print(f"\n{a.what}, design {a.design}, gnss {gnss}, {a.runs} runs, seeds {a.first}-{a.first + a.runs - 1}")
    for k in (*SHOWN, "one tree's NEES"):
        v = np.array([r[k] for r in rows])
        print(f"  {k:<32} mean {v.mean():8.4f}  sd {v.std():8.4f}  min {v.min():8.4f}  max {v.max():8.4f}")
    low, high = chi2.ppf([0.025, 0.975], 2 * a.runs) / a.runs
    print(f"  95 % band of the mean NEES of {a.runs} independent runs: {low:.2f} - {high:.2f}")
    if a.json:
        a.json.write_text(json.dumps(rows, indent=1) + "\n")
    if a.work is None:
        shutil.rmtree(work)


if __name__ == "__main__":
    main()
