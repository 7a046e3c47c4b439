"""Speed, as ratios side by side in one run: reading, deserialising, our front end.

    python tools/bench.py [BAG] [--write]

Without BAG a short run is simulated. `--write` replaces the committed baseline (tools/bench_baseline.json). A metric
that the baseline has and this run lacks is a failure. Rivals: the floor (read and deserialise the same clouds).
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from topograph.bags import Recording, Scan
from topograph.bags.config import BagsConfig
from topograph.simulate import DriveConfig, SensorConfig, record
from topograph.trunks import TrunksConfig
from topograph.trunks.detector import Detector, candidates, warm_up

BASELINE = Path(__file__).with_name("bench_baseline.json")


def best(work, times: int = 3) -> float:
    """Least CPU seconds of several tries: other jobs on the machine only ever add."""
    out = []
    for _ in range(times):
        began = time.process_time()
        work()
        out.append(time.process_time() - began)
    return min(out)


def measure(bag: Path) -> dict[str, float]:
    config = BagsConfig(topic_imu="none", topic_odometry="none", topic_fix="none", topic_heading="none")
    warm_up()
    with Recording([bag], config) as r:
        reader = r._readers[0]
        connections = [c for c in reader.connections if c.topic == r.chosen["points"]]

        def floor() -> None:
            for c, _, raw in reader.messages(connections=connections):
                reader.deserialize(raw, c.msgtype)

        scans = [m for _, m in r.messages(["points"]) if isinstance(m, Scan)]
        mount = r.frames.get(scans[0].frame)
        detector = Detector(mount, TrunksConfig())
        twist = np.zeros(6)
        n = len(scans)
        floor_s = best(floor) / n
        decode_s = best(lambda: [None for _ in r.messages(["points"])]) / n
        geometry_s = best(lambda: [candidates(s, mount, twist, TrunksConfig()) for s in scans]) / n
        all_s = best(lambda: [detector(s, twist) for s in scans]) / n
    return {
        "sweeps": n,
        "read + deserialise, ms": 1e3 * floor_s,
        "read + decode, ms": 1e3 * decode_s,
        "candidates, ms": 1e3 * geometry_s,
        "front end, ms": 1e3 * all_s,
        "front end / floor": all_s / floor_s,
        "reading and front end / floor": (decode_s + all_s) / floor_s,
        "real-time factor": 0.1 / (decode_s + all_s),
    }


def main() -> None:
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("bag", nargs="?", type=Path)
    p.add_argument("--write", action="store_true")
    a = p.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        bag = a.bag or Path(folder) / "bench.bag"
        if a.bag is None:
            record(bag, 9, "grid", DriveConfig(longest_s=15.0), SensorConfig())
        got = measure(bag)
    before = json.loads(BASELINE.read_text()) if BASELINE.exists() else {}
    for k, v in got.items():
        print(f"{k:<34} {v:10.3f}" + (f"   baseline {before[k]:10.3f}" if k in before else ""))
    if a.write:
        BASELINE.write_text(json.dumps({k: round(v, 4) for k, v in got.items()}, indent=1) + "\n")
    missing = set(before) - set(got)
    if missing:
        sys.exit(f"missing: {sorted(missing)}")


if __name__ == "__main__":
    main()
