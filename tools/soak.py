"""Hours of tracking: is memory flat, and does the error stay?

    python tools/soak.py [--hours 8] [--hz 10]
    python tools/soak.py --map MAP.gpkg --run RUN.bag [--hours 8]

Without a map, the graph of one hypothesis (localize/hypothesis.py) is fed the sightings of a robot that drives in circles. With one, the
localizer is fed a recorded run over and over: at each repetition the robot is carried back to where the run begins, and must be found
there (take a run that ends elsewhere). Simulated hours pass as fast as they can be computed; memory, error and time of an update are printed every half hour.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from test_hypothesis import World, off

from topograph import store
from topograph.bags import Imu, Odometry, Trunks
from topograph.config import Config
from topograph.geometry import Array
from topograph.localize import Localizer
from topograph.localize.config import LocalizeConfig
from topograph.pipeline.read import hear

HALF_HOUR_S = 1800.0


def resident_mb() -> float:
    """Memory of this process now, MB."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096 / 1e6


def circles(hours: float, hz: float) -> None:
    """One hypothesis, alone."""
    world = World(1)
    h = world.begin(LocalizeConfig(trunk_sigma=0.0))
    every = int(HALF_HOUR_S * hz)
    errors, ms = [], []
    for k in range(int(hours * 3600 * hz)):
        step = world.step()
        began = time.perf_counter()
        h.step(*step)
        ms.append(1e3 * (time.perf_counter() - began))
        errors.append(float(np.hypot(*off(h, world)[:2])))
        if (k + 1) % every == 0:
            print(f"{(k + 1) / hz / 3600:4.1f} h  {resident_mb():6.0f} MB  error {100 * np.mean(errors):.2f} cm, at most {100 * max(errors):.1f}  "
                  f"update {np.median(ms):.2f} ms, 99 % {np.percentile(ms, 99):.2f}, factors {len(h._factors)}", flush=True)  # fmt: skip
            errors, ms = [], []


def over_and_over(map_file: Path, bag: Path, hours: float) -> None:
    """The localizer, with all that belongs to it."""
    config = Config()
    heard = hear([bag], config)
    imu = heard.session.mounts.get("imu")
    localizer = Localizer(
        store.load(map_file),
        config.localize,
        child_T_robot=heard.session.child_T_robot,
        robot_R_imu=None if imu is None else imu[:3, :3],
    )
    stamps = [m.stamp_ns for m in heard.messages]
    lap_ns = max(stamps) - min(stamps) + 1_000_000_000
    shift, told_ns, states, ms = 0, 0, Counter[str](), list[float]()
    first: dict[int, list[Array]] = {}
    lap = 0
    while shift < hours * 3600e9:
        waiting: list[Imu | Odometry] = []
        for message in heard.messages:
            m = replace(message, stamp_ns=message.stamp_ns + shift)
            if not isinstance(m, Trunks):
                waiting.append(m)
                continue
            began = time.perf_counter()
            fix = localizer.update(m, waiting)
            ms.append(1e3 * (time.perf_counter() - began))
            waiting = []
            states[localizer.report.state if localizer.report is not None else "none"] += 1
            if fix is not None:  # the first is the reference of the others
                first.setdefault(message.stamp_ns, []).append(fix.map_T_robot[:2, 3])
        shift += lap_ns
        lap += 1
        if shift - told_ns >= HALF_HOUR_S * 1e9 or shift >= hours * 3600e9:
            told_ns = shift
            apart = [np.hypot(*(q - p[0])) for p in first.values() for q in p[1:]]
            share = states["tracking"] / max(states.total(), 1)
            print(f"{shift / 3600e9:4.1f} h  {resident_mb():6.0f} MB  lap {lap}, tracking {100 * share:.1f} % of the scans, "
                  f"poses apart from the first of each scan {100 * np.median(apart or [np.nan]):.1f} cm, at most {100 * max(apart, default=np.nan):.1f}  "
                  f"update {np.median(ms):.2f} ms, 99 % {np.percentile(ms, 99):.2f}", flush=True)  # fmt: skip
            first = {k: p[:1] for k, p in first.items()}
            states, ms = Counter(), []


def main() -> None:
    """Words of the command line."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--hours", type=float, default=8.0)
    p.add_argument("--hz", type=float, default=10.0)
    p.add_argument("--map", type=Path)
    p.add_argument("--run", type=Path)
    a = p.parse_args()
    if (a.map is None) != (a.run is None):
        p.error("--map and --run belong together")
    if a.map is None:
        circles(a.hours, a.hz)
    else:
        over_and_over(a.map, a.run, a.hours)


if __name__ == "__main__":
    main()
