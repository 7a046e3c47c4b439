"""Random search for the thesis front end's parameters on training bags: the baseline gets a fair chance.

    python tools/tune_thesis.py TRAIN_DIR [SETS]

The best set by F1 goes by hand into `ThesisTrunksConfig`. Seed 0 draws the sets; the bags are those of train_score.py.
"""

from __future__ import annotations

import sys
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np

from topograph.bags import Recording, Scan
from topograph.bags.config import BagsConfig
from topograph.evaluate import Truth, trunk_metrics
from topograph.trunks import ThesisTrunksConfig
from topograph.trunks.thesis import ThesisDetector

SCANS = 6
ONLY_POINTS = BagsConfig(topic_imu="none", topic_odometry="none", topic_fix="none", topic_heading="none")


def some_scans(bag: Path) -> tuple[Truth, np.ndarray, list[Scan]]:
    """Truth, mounting and a few scans of a bag."""
    with Recording([bag], ONLY_POINTS) as r:
        scans = [m for n, (_, m) in enumerate(r.messages(["points"])) if n % 60 == 30 and isinstance(m, Scan)]
        return Truth.load(bag.with_name(bag.stem + ".truth")), r.frames.get("velodyne"), scans[:SCANS]


def f1(config: ThesisTrunksConfig, data: list[tuple[Truth, np.ndarray, list[Scan]]]) -> tuple[float, float, float]:
    """F1, precision and recall within 20 m."""
    right = found = hit = shown = 0.0
    for truth, mount, scans in data:
        detector = ThesisDetector(mount, config)
        trunks = [detector(s, np.zeros(6)) for s in scans]
        _, table = trunk_metrics(truth, np.array([s.stamp_ns for s in scans]), [t.p for t in trunks])
        for row in table[:2]:
            right += row["precision"] * row["found"]
            found += row["found"]
            hit += row["recall"] * row["visible"]
            shown += row["visible"]
    p, r = right / max(found, 1), hit / max(shown, 1)
    return 2 * p * r / max(p + r, 1e-9), p, r


def main(folder: Path, sets: int) -> None:
    """Draw, score, print the best."""
    data = [some_scans(b) for b in sorted(folder.glob("*0.bag"))]
    rng = np.random.default_rng(0)
    best = (0.0, 0.0, 0.0)
    for n in range(sets):
        low = rng.uniform(-1.2, -0.1)
        config = replace(
            ThesisTrunksConfig(),
            z_min=low, z_max=low + rng.uniform(0.2, 1.2), normal_neighbours=int(rng.integers(8, 30)),
            plane_distance=rng.uniform(0.1, 0.5), plane_angle=rng.uniform(15, 60), radius=rng.uniform(0.15, 0.6),
            radius_neighbours=int(rng.integers(3, 16)), mean_neighbours=int(rng.integers(5, 25)),
            deviations=rng.uniform(0.5, 3.0), cluster_distance=rng.uniform(0.15, 0.6),
            cluster_angle=rng.uniform(15, 80), cluster_min=int(rng.integers(5, 40)), cluster_max=int(rng.integers(80, 1000)),
        )  # fmt: skip
        score = f1(config, data)
        if score > best:
            best = score
            print(n, f"F1 {score[0]:.3f} P {score[1]:.3f} R {score[2]:.3f}", asdict(config), flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 140)
