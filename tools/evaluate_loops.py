"""Loops that the trees alone close: simulated runs without GNSS, trunk detections, several alleys and laps; python tools/evaluate_loops.py [--seeds N] [--first SEED]

Wheels are poor (3 % and 10 % of scale, six slips a minute); each run with the gyro, and without it. Map and path are laid rigidly onto the truth, since
nothing says where they are; what counts is whether they are whole: errors, trees that stand twice, trees that none is. "reckoned" is dead reckoning
alone, laid onto the truth in the same way.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from topograph.config import Config
from topograph.evaluate import Truth
from topograph.evaluate.frames import align_se3
from topograph.geometry import interpolate, transform
from topograph.pipeline import audited, read_run, solve_run, topo_map
from topograph.simulate import DESIGNS, DriveConfig, OrchardConfig, SensorConfig, record

SIZES = {"grid": (10, 12), "olive": (8, 8), "steep": (8, 8), "bare": (8, 8), "forest": (8, 12)}
"""Design -> rows and trees a row: some ten minutes' drive."""
UPRIGHT = replace(DESIGNS["grid"], lean=0.0, gaps=0.0, multi_stem=0.0)
LATTICES = {
    f"lattice{row:.0f}x{tree:.0f}": replace(
        UPRIGHT, row_spacing=row, tree_spacing=tree, jitter=0.05, rows=8, columns=10
    )
    for row, tree in [(6.0, 6.0), (6.0, 4.0), (8.0, 8.0)]
}
"""Planted to 5 cm: what is laid a row or a tree too far fits nearly as well. Not run unless named."""


def main() -> None:
    """One line a run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("designs", nargs="*", default=[])
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--first", type=int, default=4001)
    parser.add_argument("--keep", type=Path, help="folder in which the bags stay for another time")
    a = parser.parse_args()
    print(
        "design seed sensors   nodes twice none missed  tree mean max [m]   path rms max [m]   reckoned rms  loops slid  CPU s  verdict"
    )
    with tempfile.TemporaryDirectory() as scratch:
        for design in a.designs or list(SIZES):
            for seed in range(a.first, a.first + a.seeds):
                bag = (a.keep or Path(scratch)) / f"loops_{design}_{seed}.bag"
                bag.parent.mkdir(parents=True, exist_ok=True)
                if not bag.exists():
                    record(
                        bag, seed, planted(design), DriveConfig(longest_s=600.0),
                        SensorConfig(detections=True, gnss="none", sweep_hz=5.0, wheel_scale=0.03, yaw_scale=0.1, slip=6.0),
                    )  # fmt: skip
                for without_imu in (False, True):
                    print(
                        f"{design:<8} {seed} {'wheels' if without_imu else 'wheels, gyro':<13}",
                        judged(bag, without_imu),
                        flush=True,
                    )


def planted(design: str) -> OrchardConfig:
    """The orchard of a name."""
    if design in LATTICES:
        return LATTICES[design]
    rows, columns = SIZES[design]
    return replace(DESIGNS[design], rows=rows, columns=columns)


def judged(bag: Path, without_imu: bool) -> str:
    """Map a bag and compare."""
    truth, config = Truth.load(bag.with_suffix(".truth")), Config()
    bags = replace(config.bags, topic_imu="none") if without_imu else config.bags
    config = replace(config, bags=replace(bags, topic_fix="none", topic_heading="none"))
    began = time.process_time()
    solved = solve_run(read_run([bag], config), config)
    topo = topo_map(solved, config, {}, clouds=False)
    seconds = time.process_time() - began
    at = interpolate(truth.stamps_ns, truth.world_T_robot, topo.stamps_ns)
    world_T_map = align_se3(topo.map_T_robot[:, :3, 3], at[:, :3, 3])
    off = np.linalg.norm((transform(world_T_map, topo.map_T_robot[:, :3, 3]) - at[:, :3, 3])[:, :2], axis=1)
    reckoned = solved.motion.at(topo.stamps_ns)[:, :3, 3]
    drift = np.linalg.norm((transform(align_se3(reckoned, at[:, :3, 3]), reckoned) - at[:, :3, 3])[:, :2], axis=1)
    trees = transform(world_T_map, topo.trees().p)[:, :2]
    d, which = (np.asarray(k) for k in cKDTree(truth.trees[:, :2]).query(trees))
    near = d < 1.5
    hit = np.unique(which[near])
    seen = np.flatnonzero((truth.returns >= 1).sum(axis=0) >= 10) if len(truth.returns) else np.arange(len(truth.trees))
    verdict = audited(solved)
    return (
        f"{len(trees):4d} {int(near.sum()) - len(hit):4d} {int((~near).sum()):4d} {len(np.setdiff1d(seen, hit)):4d}   "
        f"{d[near].mean() if near.any() else np.nan:7.3f} {d[near].max(initial=0.0):6.3f}     {np.sqrt(np.mean(off**2)):7.3f} {off.max():6.3f}    "
        f"{np.sqrt(np.mean(drift**2)):7.2f}   {solved.loops.closed:4d} {solved.loops.slid:4.1f} {seconds:6.1f}  {verdict.word} {' '.join(f.name for f in verdict.findings)}"
    )


if __name__ == "__main__":
    main()
