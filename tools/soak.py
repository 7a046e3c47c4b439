"""Hours of tracking: is memory flat, and does the error stay?  python tools/soak.py [--hours 8] [--hz 10]

The graph of one hypothesis (localize/hypothesis.py) is fed the sightings of a robot that drives in circles; simulated hours pass as fast as they
can be computed. Prints memory, error and time of an update every half hour.
"""

from __future__ import annotations

import argparse
import resource
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from test_hypothesis import World, off

from topograph.localize.config import LocalizeConfig


def main() -> None:
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--hours", type=float, default=8.0)
    p.add_argument("--hz", type=float, default=10.0)
    a = p.parse_args()
    world = World(1)
    h = world.begin(LocalizeConfig(trunk_sigma=0.0))
    every = int(1800 * a.hz)
    errors, ms = [], []
    for k in range(int(a.hours * 3600 * a.hz)):
        step = world.step()
        began = time.perf_counter()
        h.step(*step)
        ms.append(1e3 * (time.perf_counter() - began))
        errors.append(float(np.hypot(*off(h, world)[:2])))
        if (k + 1) % every == 0:
            mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
            print(f"{(k + 1) / a.hz / 3600:4.1f} h  peak {mb:6.0f} MB  error {100 * np.mean(errors):.2f} cm, at most {100 * max(errors):.1f}  "
                  f"update {np.median(ms):.2f} ms, 99 % {np.percentile(ms, 99):.2f}, factors {len(h._factors)}", flush=True)  # fmt: skip
            errors, ms = [], []


if __name__ == "__main__":
    main()
