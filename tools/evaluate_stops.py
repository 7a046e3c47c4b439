"""Stop and go, the thesis's way of recording: maps and poses of runs that stand every two metres, at several rates of scans.

    python tools/evaluate_stops.py [--first SEED] [--seeds N] [--lidar] [designs]

A first run with GNSS is mapped, a second one without GNSS is localized in its map; both stand for two seconds every 2 m. With --lidar the scans are
sweeps (slow), else recorded detections. "stops" are scans that are taken while the robot stands, alone.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import NamedTuple

import numpy as np

from topograph.config import Config
from topograph.evaluate import Truth, world_in_map
from topograph.evaluate.localization import localization_errors
from topograph.evaluate.metrics import tree_errors
from topograph.pipeline import localize_bags, read_run, solve_run, topo_map
from topograph.simulate import DESIGNS, DriveConfig, SensorConfig, record
from topograph.topomap import TopoMap

RATES = {"10 Hz": 10.0, "2 Hz": 2.0, "1 Hz": 1.0, "stops": 2.0}
LONGEST_S = 240.0


def main() -> None:
    """One line a design and rate, over the seeds."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("designs", nargs="*", default=[])
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--first", type=int, default=15001)
    parser.add_argument("--lidar", action="store_true")
    a = parser.parse_args()
    print(
        "design   scans   trees mean [cm] NEES   scans lost wrong   position mean, 99 % [cm]   heading mean [deg]   NEES of poses, by seed"
    )
    for design in a.designs or ["olive", "grid"]:
        for name, rate in RATES.items():
            rows = [
                run(design, seed, rate, at_stops=name == "stops", lidar=a.lidar)
                for seed in range(a.first, a.first + a.seeds)
            ]
            trees, tree_nees, off, yaw = (
                np.concatenate([getattr(r, k) for r in rows]) for k in ("trees", "tree_nees", "off", "yaw")
            )
            scans, lost = sum(r.scans for r in rows), sum(r.lost for r in rows)
            print(
                f"{design:<8} {name:<6}  {100 * trees.mean():6.2f} {np.nanmean(tree_nees):13.2f}   {scans:5d} {lost:4d} {int((off > 0.5).sum()):5d}   "
                f"{100 * off.mean():8.2f} {100 * np.percentile(off, 99):8.2f} {np.degrees(yaw).mean():20.3f}         "
                f"{' '.join(f'{np.nanmean(r.nees):.2f}' for r in rows)}",
                flush=True,
            )


class Result(NamedTuple):
    """Of one orchard: errors of `trees`, m, and their NEES; of poses, `off` m and `yaw` rad, and their NEES; `scans` after the first pose, and how
    many of them are `lost`."""

    trees: np.ndarray
    tree_nees: np.ndarray
    off: np.ndarray
    yaw: np.ndarray
    nees: np.ndarray
    scans: int
    lost: int


def run(design: str, seed: int, rate: float, *, at_stops: bool, lidar: bool) -> Result:
    """Map the first run, localize the second."""
    with tempfile.TemporaryDirectory() as folder:
        bags = [Path(folder) / f"r{k}.bag" for k in (1, 2)]
        for k, bag in enumerate(bags):
            record(
                bag, seed, DESIGNS[design], DriveConfig(run=k + 1, stop_every=2.0, scans_at_stops=at_stops, longest_s=LONGEST_S),
                SensorConfig(detections=not lidar, gnss="rtk" if k == 0 else "none", sweep_hz=rate),
            )  # fmt: skip
        config = Config()
        topo = topo_map(solve_run(read_run([bags[0]], config), config), config, {}, clouds=False)
        e, nees = tree_misfit(topo, Truth.load(bags[0].with_suffix(".truth")))
        truth = Truth.load(bags[1].with_suffix(".truth"))
        replay = localize_bags(topo, [bags[1]], config)
        errors = localization_errors(replay.reports, truth, world_in_map(topo, truth))
        known = np.array([r.fix is not None for r in replay.reports])
        after = known[int(np.argmax(known)) :] if known.any() else known
        off, yaw = np.hypot(*errors.xy.T), np.abs(errors.yaw)
        return Result(e, nees, off, yaw, errors.nees, len(after), int((~after).sum()))


def tree_misfit(topo: TopoMap, truth: Truth) -> tuple[np.ndarray, np.ndarray]:
    """Horizontal errors (M,) of the trees, m, and their normalized squares."""
    i, _, e = tree_errors(topo, truth)
    xy = e[:, :2]
    return np.linalg.norm(xy, axis=1), np.einsum("ki,kij,kj->k", xy, np.linalg.inv(topo.trees().cov[i][:, :2, :2]), xy)


if __name__ == "__main__":
    main()
