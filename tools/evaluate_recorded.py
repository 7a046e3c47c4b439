"""The front end and the map on recorded data, beside the thesis's front end. Each plot is judged by a score that was trained on
scenes and on the other plot (and on the street), never on its own.

python tools/evaluate_recorded.py stems [--seed 2001] [--poses 20]
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import recordings as rec

from topograph.config import Config
from topograph.evaluate.metrics import match
from topograph.geometry import from_xyz_rpy
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


def main() -> None:
    """Words of the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["stems"])
    parser.add_argument("--seed", type=int, default=2001, help="of the poses; below 1000 were looked at while building")
    parser.add_argument("--poses", type=int, default=20)
    parser.add_argument("--thesis", action="store_true")
    parser.add_argument(
        "--shipped", action="store_true", help="the shipped score, which other sweeps of these plots trained"
    )
    a = parser.parse_args()
    stems(a.seed, a.poses, a.thesis, not a.shipped)


if __name__ == "__main__":
    main()
