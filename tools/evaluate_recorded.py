"""The front end and the map on recorded data, beside the thesis's front end. Each plot is judged by a score that was trained on
scenes and on the other plot (and on the street), never on its own.

python tools/evaluate_recorded.py stems [--seed 2001] [--poses 20]
python tools/evaluate_recorded.py drives [--seed 2001]     runs through recorded trees: mapped, then localized without GNSS
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np
import recordings as rec
import woods

from topograph import localize_bags, map_bags
from topograph.config import Config
from topograph.errors import InsufficientDataError
from topograph.evaluate import Truth, world_in_map
from topograph.evaluate.localization import localization_errors
from topograph.evaluate.metrics import match
from topograph.geometry import from_xyz_rpy
from topograph.simulate import DriveConfig, SensorConfig
from topograph.topomap import TopoMap
from topograph.trunks import ThesisTrunksConfig, TrunksConfig
from topograph.trunks.detector import Detector
from topograph.trunks.frontend import Detect
from topograph.trunks.thesis import ThesisDetector

MOUNTS = {
    "level": (0.0, 0.0, 1.0, 0.0, 0.0, 0.0),
    "upside down": (0.0, 0.0, 1.0, np.pi, 0.0, 0.0),
    "tilted 15°": (0.0, 0.0, 1.0, 0.0, np.radians(15), 0.0),
    "tilted 30°": (0.0, 0.0, 1.0, np.radians(-21), np.radians(21), 0.0),
    "0.3 m": (0.0, 0.0, 0.3, 0.0, 0.0, 0.0),
    "2.5 m": (0.0, 0.0, 2.5, 0.0, 0.0, 0.0),
}


def held_out(name: str) -> Path:
    """A score that was trained on the other plot and not on this one."""
    return Path(__file__).resolve().parent.parent / "tests" / "promises" / f"score_without_{name}.json"


def stems(seed: int, n: int, thesis: bool, held: bool) -> None:
    """Table of recall and precision a sweep, then the map of the level VLP-16 sweeps at their true poses."""
    for name in ("pine_plot", "lpine1"):
        plot = rec.Plot(name)
        for sensor, elevation in rec.SENSORS.items():
            for mount, pose in MOUNTS.items():
                if sensor != "VLP-16" and mount != "level":
                    continue
                T = from_xyz_rpy(*pose)
                looks = plot.looks(n, seed, elevation, T)
                rivals: dict[str, Detect] = {
                    "ours": Detector(T, TrunksConfig(score=str(held_out(name)) if held else ""))
                }
                if thesis and mount == "level":
                    rivals["thesis"] = ThesisDetector(T, ThesisTrunksConfig())
                for who, detect in rivals.items():
                    trunks = [detect(k.scan, np.zeros(6)) for k in looks]
                    r = rec.judge(plot, looks, trunks)
                    print(
                        f"{name:<10} {sensor:<9} {mount:<12} {who:<7} recall {r.recall:.3f}  precision {r.precision:.3f} "
                        f"(within the outline {r.right / max(r.inside, 1):.3f})  {r.shown / n:.1f} shown, {r.found / n:.1f} found a sweep",
                        flush=True,
                    )
                    if who == "ours" and mount == "level":
                        show_map(plot, looks, trunks)


def show_map(plot: rec.Plot, looks, trunks) -> None:
    """The map of the looks at their true poses against the axes in the cloud."""
    m = rec.map_at(np.array([k.plot_T_base for k in looks]), trunks, Config())
    tree = m.kind == 0
    slope, offset = plot.axes[:, 0], plot.axes[:, 1]
    i, j = match(m.p[tree, :2], plot.stems[:, :2], rec.GATE)
    p, h = m.p[tree][i], m.height[tree][i]
    e = np.linalg.norm(p[:, :2] - slope[j] * h[:, None] - offset[j], axis=1)
    listed = np.linalg.norm(p[:, :2] - plot.stems[j, :2], axis=1)
    d = m.diameter[tree][i] - plot.stems[j, 2]
    print(
        f"           map: {tree.sum()} trees, {(~tree).sum()} posts; {len(i)} of {len(plot.stems)} stems; error to the cloud's axes mean {100 * e.mean():.1f} max {100 * e.max():.1f} cm, "
        f"to the list {100 * listed.mean():.1f} cm; diameters {100 * d.mean():+.1f} ± {100 * d.std():.1f} cm"
    )


PLOTS = ("mls_pine_plot", "pine_plot", "lpine1")
CHEST = 0.8
"""Height above ground at which trees are compared, m."""
PLANTINGS = ("grid", "olive", "bare", "forest")


def drives(seed: int, seconds: float, keep: Path | None, only: list[str]) -> None:
    """Each plot as it is and each planting of its trees: a run with RTK mapped, another without GNSS localized in it."""
    labels = {f"{d} of {n}" if d else n for n in PLOTS for d in ("", *PLANTINGS)}
    if set(only) - labels:
        raise SystemExit(f"{sorted(set(only) - labels)}: no such wood; there are {sorted(labels)}")
    with tempfile.TemporaryDirectory() as folder:
        for name in PLOTS:
            for design in ("", *PLANTINGS):
                label = f"{design} of {name}" if design else name
                if only and label not in only:
                    continue
                wood = woods.planting(name, design, seed) if design else woods.plot(name)
                score = "" if name == "mls_pine_plot" else str(held_out(name))
                one_wood(label, wood, seed, seconds, Config(trunks=TrunksConfig(score=score)), keep or Path(folder))


def one_wood(label: str, wood: woods.Wood, seed: int, seconds: float, config: Config, folder: Path) -> None:
    """Two runs through a wood."""
    bags = []
    for run in (1, 2):
        bag = folder / f"{label.replace(' ', '_')}_{seed}_{seconds:.0f}s_{run}.bag"
        if not (bag.exists() and bag.with_suffix(".truth").exists()):
            bag.unlink(missing_ok=True)
            speed = 0.9 if wood.ground else 0.6  # between stems a robot turns sharply
            try:
                wood.record(bag, seed, DriveConfig(run=run, speed=speed, laps=3, longest_s=seconds), SensorConfig(gnss="rtk" if run == 1 else "none"))  # fmt: skip
            except ValueError as e:
                print(f"{label:<24} no drive: {e}", flush=True)
                return
        bags.append(bag)
    try:
        topo = map_bags(bags[0], config=config)
    except InsufficientDataError as e:
        print(f"{label:<24} no map: {e}", flush=True)
        return
    truth = Truth.load(bags[0].with_suffix(".truth"))
    print(f"{label:<24} {against(topo, truth, wood)}  {topo.meta['verdict']} {topo.meta['why']}", flush=True)
    replay = localize_bags(topo, bags[1], config=config)
    path = Truth.load(bags[1].with_suffix(".truth"))
    off = np.linalg.norm(localization_errors(replay.reports, path, world_in_map(topo, path)).xy, axis=1)
    if not len(off):
        print(f"{'':<24} never found; {replay.reports[-1].state if replay.reports else ''}", flush=True)
        return
    print(
        f"{'':<24} localized in {len(off) / max(len(replay.reports), 1):.2f} of the scans; mean {100 * off.mean():.1f}, 99 % {100 * np.percentile(off, 99):.1f}, worst {100 * off.max():.1f} cm",
        flush=True,
    )


def against(topo: TopoMap, truth: Truth, wood: woods.Wood) -> str:
    """A map's figures: trees and posts, precision within the outline, recall of what 20 scans show with 5 returns, errors at 0.8 m."""
    trees = topo.trees()
    at, cov = at_chest(trees, truth)
    true = stems_at_chest(truth)
    i, j = match(at, true, rec.GATE)
    rest = np.setdiff1d(np.arange(len(at)), i)
    k, _ = match(at[rest], wood.unlisted, rec.GATE)
    rest = np.delete(rest, k)
    within = ((at[rest] > wood.outline[0]) & (at[rest] < wood.outline[1])).all(axis=1)
    rest, beyond = rest[within], int((~within).sum())
    if not len(i):
        return f"trees {len(at)}, none at a stem"
    shown = (truth.returns >= 5).sum(axis=0) >= 20
    e = at[i] - true[j]
    d = np.linalg.norm(e, axis=1)
    nees = np.einsum("ni,nij,nj->n", e, np.linalg.inv(cov[i]), e)
    lean = trees.axis[i, :2] / trees.axis[i, 2:] - truth.axes[j, :2] / truth.axes[j, 2:]
    thick = trees.diameter[i] - truth.diameters[j]
    false = [(*np.round(at[r], 1).tolist(), round(float(trees.kind_probability[r]), 2)) for r in rest]
    return (
        f"trees {len(at)} posts {len(topo) - len(at)}  right {len(i)} false {len(rest)} {false} at unlisted stems {len(k)} beyond the outline {beyond}  recall {shown[j].sum()}/{shown.sum()} of {len(true)}  "
        f"error mean {100 * d.mean():.1f} worst {100 * d.max():.1f} cm (offset {100 * e[:, 0].mean():+.1f} {100 * e[:, 1].mean():+.1f})  NEES {nees.mean():.1f}  "
        f"lean rms {np.sqrt((lean**2).mean()):.3f}  diameter {100 * thick.mean():+.1f} ± {100 * thick.std():.1f} cm"
    )


def at_chest(trees: TopoMap, truth: Truth) -> tuple[np.ndarray, np.ndarray]:
    """Trees of a map at `CHEST` in the truth's frame (T, 2), m, and their covariances (T, 2, 2), m²."""
    p, cov = trees.above_ground(CHEST)
    return truth.datum.to_enu(trees.datum.to_geodetic(p))[:, :2], cov[:, :2, :2]


def stems_at_chest(truth: Truth) -> np.ndarray:
    """The truth's trees at `CHEST` (N, 2), m."""
    return np.asarray(truth.trees[:, :2] + CHEST * truth.axes[:, :2] / truth.axes[:, 2:])


def main() -> None:
    """Words of the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["stems", "drives"])
    parser.add_argument("only", nargs="*", help="drives: of these alone, as they are printed")
    parser.add_argument("--seed", type=int, default=2001, help="of the poses; below 1000 were looked at while building")
    parser.add_argument("--poses", type=int, default=20)
    parser.add_argument("--thesis", action="store_true")
    parser.add_argument(
        "--shipped", action="store_true", help="the shipped score, which other sweeps of these plots trained"
    )
    parser.add_argument("--seconds", type=float, default=60.0, help="of a drive")
    parser.add_argument("--keep", type=Path, help="folder in which the bags of drives stay")
    a = parser.parse_args()
    if a.what == "drives":
        drives(a.seed, a.seconds, a.keep, a.only)
    else:
        stems(a.seed, a.poses, a.thesis, not a.shipped)


if __name__ == "__main__":
    main()
