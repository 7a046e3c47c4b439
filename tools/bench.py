"""Speed, as ratios side by side in one run: the floor, our front end, the thesis's on Open3D, KISS-ICP.

    python tools/bench.py [--write]

A short run is simulated, once as `.bag` and once as mcap with zstd. `--write` replaces the committed baseline
(tools/bench_baseline.json). A metric that the baseline has and this run lacks is a failure: `make bench` installs the
rivals. Times are CPU time of this process; compiled loops are warm. The floor is reading and deserialising the same clouds.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(name, "1")  # before numpy: all rivals on one thread

import numpy as np

from topograph.bags import Recording, Scan
from topograph.bags.config import BagsConfig
from topograph.config import Config
from topograph.pipeline import read_run
from topograph.simulate import DriveConfig, SensorConfig, record
from topograph.trunks import ThesisTrunksConfig, TrunksConfig
from topograph.trunks.detector import Detector
from topograph.trunks.thesis import ThesisDetector

BASELINE = Path(__file__).with_name("bench_baseline.json")
ONLY_POINTS = BagsConfig(topic_imu="none", topic_odometry="none", topic_fix="none", topic_heading="none")


def best(work: Callable[[], object], times: int = 5, clock: Callable[[], float] = time.process_time) -> float:
    """Least seconds of several tries: other jobs on the machine only ever add."""
    out = []
    for _ in range(times):
        began = clock()
        work()
        out.append(clock() - began)
    return min(out)


def all_of(items: Iterable[object]) -> None:
    """Go through all."""
    for _ in items:
        pass


def reading(bag: Path) -> dict[str, float]:
    """Seconds a sweep of the floor, of decoding, and of decoding with our front end."""
    with Recording([bag], ONLY_POINTS) as r:
        reader = r._readers[0]
        connections = [c for c in reader.connections if c.topic == r.chosen["points"]]
        n = sum(r.counts[t] for t in r.chosen.values())
        detector = Detector(r.frames.get("velodyne"), TrunksConfig())
        twist = np.array([0.9, 0, 0, 0, 0, 0.1])

        def floor() -> None:
            for c, _, raw in reader.messages(connections=connections):
                reader.deserialize(raw, c.msgtype)

        def scans() -> Iterator[Scan]:
            return (m for _, m in r.messages(["points"]) if isinstance(m, Scan))

        all_of(detector(m, twist) for m in scans())  # warm
        return {
            "floor": best(floor) / n,
            "decode": best(lambda: all_of(r.messages(["points"]))) / n,
            "all": best(lambda: all_of(detector(m, twist) for m in scans())) / n,
        }


def rivals(bag: Path) -> dict[str, float]:
    """Seconds a sweep of each front end on the same decoded sweeps, in turns."""
    with Recording([bag], ONLY_POINTS) as r:
        scans = [m for _, m in r.messages(["points"]) if isinstance(m, Scan)][::3]
        mount = r.frames.get(scans[0].frame)
    ours, thesis = Detector(mount, TrunksConfig()), ThesisDetector(mount, ThesisTrunksConfig())
    twist = np.array([0.9, 0, 0, 0, 0, 0.1])
    jobs = {
        "ours": lambda: all_of(ours(s, twist) for s in scans),
        "thesis": lambda: all_of(thesis(s, twist) for s in scans),
    }
    try:
        from kiss_icp.config import KISSConfig
        from kiss_icp.kiss_icp import KissICP

        def kiss() -> None:
            config = KISSConfig()
            config.mapping.voxel_size = 0.5
            config.registration.max_num_threads = 1
            odometry = KissICP(config)
            for s in scans:
                ok = np.isfinite(s.xyz).all(axis=1)
                offset = s.offset[ok] if s.offset is not None else np.zeros(int(ok.sum()))
                odometry.register_frame(
                    s.xyz[ok].astype(float), (offset - offset.min()) / max(float(np.ptp(offset)), 1e-6)
                )

        jobs["KISS-ICP"] = kiss
    except ImportError:
        pass
    return {k: best(job, 5 if k == "ours" else 2) / len(scans) for k, job in jobs.items()}


def measure(folder: Path) -> dict[str, float]:
    """All figures."""
    drive = DriveConfig(longest_s=20.0)
    record(folder / "run.bag", 9, "grid", drive, SensorConfig())
    record(folder / "run", 9, "grid", drive, SensorConfig(compression="zstd"))
    bag, mcap, ms = reading(folder / "run.bag"), reading(folder / "run"), 1e3
    got = rivals(folder / "run.bag")
    out = {
        "front end, ms a sweep": ms * got["ours"],
        "thesis on Open3D, ms a sweep": ms * got["thesis"],
        "thesis / ours": got["thesis"] / got["ours"],
        "floor .bag, ms": ms * bag["floor"],
        "read + decode .bag, ms": ms * bag["decode"],
        "read + front end .bag, ms": ms * bag["all"],
        "read + front end / floor, .bag": bag["all"] / bag["floor"],
        "floor mcap zstd, ms": ms * mcap["floor"],
        "read + front end mcap zstd, ms": ms * mcap["all"],
        "read + front end / floor, mcap zstd": mcap["all"] / mcap["floor"],
        "real-time factor, read + front end .bag": 0.1 / bag["all"],
    }
    if "KISS-ICP" in got:
        out["KISS-ICP, ms a sweep"] = ms * got["KISS-ICP"]
        out["KISS-ICP / ours"] = got["KISS-ICP"] / got["ours"]
    whole = best(lambda: read_run([folder / "run.bag"], Config()), 3)
    out["real-time factor, all streams"] = 20.0 / whole
    return out


def main() -> None:
    """Measure, print beside the baseline, fail when a metric is missing."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--write", action="store_true")
    a = p.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        got = measure(Path(folder))
    before = json.loads(BASELINE.read_text()) if BASELINE.exists() else {}
    for k, v in got.items():
        print(f"{k:<42} {v:10.3f}" + (f"   baseline {before[k]:10.3f}" if k in before else ""))
    missing = set(before) - set(got)
    if a.write and not missing:
        BASELINE.write_text(json.dumps({k: round(v, 4) for k, v in got.items()}, indent=1) + "\n")
    if missing:
        sys.exit(f"missing: {sorted(missing)}; install the rivals with pip install -e .[bench]")


if __name__ == "__main__":
    main()
