"""Faults while localizing live: does it go on, and is "tracking" true?  python tools/live_faults.py [NAME...] [--seed 2201]

The messages of a simulated run are handed to a `Localizer` as a robot's node would, in the order of their arrival, with one fault each: those of
tools/faults.py that a live robot can meet, and such as the door for bags would stop. Wrong is "tracking" with the robot more than 0.5 m or 5°
from where it is said to be, or "degraded" with more than three stated deviations (at least 0.5 m) or 15°; an exception is a defect.
"""

from __future__ import annotations

import argparse
import tempfile
import traceback
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from faults import FAULTS, Bag, Event, Fault, S, base, each

from topograph import store
from topograph.bags import Imu, Odometry, Trunks
from topograph.config import Config
from topograph.geometry import interpolate, inverse, yaw_of
from topograph.localize import Localizer
from topograph.pipeline import read_run, solve_run, topo_map
from topograph.topomap import TopoMap
from topograph.trunks import TrunksConfig, from_recorded

KINDS = (
    "clock trunks",
    "clock odometry",
    "clock imu",
    "imu",
    "wheel",
    "slip",
    "odometry",
    "trunk",
    "stall",
    "late",
    "shuffle",
    "dark",
    "stands",
    "all clocks",
)
"""Words in the names of the faults of tools/faults.py that a live robot can meet."""
LIVE: dict[str, Fault] = {}
NAN3 = np.full(3, np.nan)


def some(kind: str, change, share: float) -> Fault:
    """Change a random share of a kind's messages."""

    def run(bag: Bag, rng: np.random.Generator) -> None:
        hit = {id(e) for e in bag.of(kind) if rng.random() < share}
        out = []
        for e in bag.events:
            if id(e) in hit:
                new = change(e.it)
                if new is None:
                    continue
                e = Event(e.kind, e.log_ns, new, e.topic)
            out.append(e)
        bag.events = out

    return run


def _own() -> None:
    for share in (0.02, 0.3):
        LIVE[f"NaN in {share:.0%} of odometry"] = some(
            "odometry", lambda m: replace(m, odom_T_child=np.full(7, np.nan)), share
        )
        LIVE[f"infinite {share:.0%} of odometry"] = some(
            "odometry", lambda m: replace(m, odom_T_child=np.full(7, np.inf)), share
        )
        LIVE[f"zero quaternion in {share:.0%} of odometry"] = some(
            "odometry", lambda m: replace(m, odom_T_child=np.concatenate([m.odom_T_child[:3], np.zeros(4)])), share
        )
        LIVE[f"quaternion not of length one in {share:.0%} of odometry"] = some(
            "odometry", lambda m: replace(m, odom_T_child=m.odom_T_child * np.array([1, 1, 1, 3, 3, 3, 3.0])), share
        )
        LIVE[f"NaN in {share:.0%} of the gyro"] = some("imu", lambda m: replace(m, gyro=NAN3), share)
        LIVE[f"NaN in {share:.0%} of the accelerometer"] = some("imu", lambda m: replace(m, accel=NAN3), share)
        LIVE[f"{share:.0%} of trunks' points NaN"] = some("trunks", lambda m: replace(m, p=m.p * np.nan), share)
        LIVE[f"{share:.0%} of trunks' covariances NaN"] = some(
            "trunks", lambda m: replace(m, cov=m.cov * np.nan), share
        )
        LIVE[f"{share:.0%} of trunks' covariances negative"] = some(
            "trunks", lambda m: replace(m, cov=-np.tile(np.eye(3), (len(m.p), 1, 1))), share
        )
        LIVE[f"{share:.0%} of scans without trunks"] = some("trunks", lambda m: m.select(np.zeros(len(m), bool)), share)
        LIVE[f"{share:.0%} of axes zero"] = some("trunks", lambda m: replace(m, axis=m.axis * 0.0), share)
        LIVE[f"{share:.0%} of diameters infinite"] = some(
            "trunks", lambda m: replace(m, diameter=m.diameter + np.inf), share
        )
    for kind in ("odometry", "imu", "trunks"):
        for begin, end in ((0.0, 20.0), (20.0, 23.0), (20.0, 35.0), (30.0, 1e9), (0.0, 1e9)):
            if kind != "trunks" or end < 1e9:
                LIVE[f"no {kind} from {begin:g} to {end:g} s"] = each(
                    kind, lambda m, t: None, lambda t, a=begin, b=end: a <= t < b
                )

    def swapped(bag: Bag, rng: np.random.Generator) -> None:
        scans = bag.of("trunks")
        for k in range(50, len(scans) - 1, 7):
            scans[k].it, scans[k + 1].it = scans[k + 1].it, scans[k].it

    def old(bag: Bag, rng: np.random.Generator) -> None:
        scans = bag.of("trunks")
        scans[200].it = scans[20].it

    def twice(bag: Bag, rng: np.random.Generator) -> None:
        bag.events = sorted(
            [*bag.events, *(Event(e.kind, e.log_ns, e.it) for e in bag.of("trunks")[::3])], key=lambda e: e.log_ns
        )

    def later(kind: str, by: float) -> Fault:
        def run(bag: Bag, rng: np.random.Generator) -> None:
            for e in bag.of(kind):
                e.log_ns += int(by * S)

        return run

    def reset(bag: Bag, rng: np.random.Generator) -> None:
        out, origin = [], None
        for e in bag.events:
            if e.kind == "odometry" and bag.at(e) > 25.0:
                origin = e.it.odom_T_child[:3] if origin is None else origin
                e = Event(
                    e.kind,
                    e.log_ns,
                    replace(e.it, odom_T_child=np.concatenate([e.it.odom_T_child[:3] - origin, e.it.odom_T_child[3:]])),
                )
            out.append(e)
        bag.events = out

    def carried(bag: Bag, rng: np.random.Generator) -> None:
        """Picked up and put down a few rows on, twenty seconds later, wheels at rest: time closes up."""
        cut = [e for e in bag.events if not 20.0 <= bag.at(e) < 32.0]
        still = [e for e in bag.events if e.kind == "odometry" and bag.at(e) < 20.0][-1].it
        first = next(e for e in cut if e.kind == "odometry" and bag.at(e) >= 32.0).it
        move = _matrix(still.odom_T_child) @ inverse(_matrix(first.odom_T_child))
        for e in cut:
            if e.kind == "odometry" and bag.at(e) >= 32.0:
                e.it = replace(e.it, odom_T_child=_seven(move @ _matrix(e.it.odom_T_child)))
        bag.events = cut

    def frozen(begin: float, end: float, noise: float) -> Fault:
        """The scan at `begin` again and again under fresh stamps."""

        def run(bag: Bag, rng: np.random.Generator) -> None:
            kept = None
            for e in bag.of("trunks"):
                if begin <= bag.at(e) < end:
                    kept = kept or e.it
                    e.it = replace(kept, stamp_ns=e.it.stamp_ns, p=kept.p + noise * rng.normal(0, 1, kept.p.shape))

        return run

    for seconds in (1.5, 3.0, 1e9):
        for noise in (0.0, 0.01):
            LIVE[f"trunks frozen for {seconds:g} s, noise {noise:g} m"] = frozen(25.0, 25.0 + seconds, noise)
    LIVE["scans swapped"] = swapped
    LIVE["an old scan again"] = old
    LIVE["scans twice"] = twice
    LIVE["odometry arrives 0.3 s late"] = later("odometry", 0.3)
    LIVE["odometry arrives 2 s late"] = later("odometry", 2.0)
    LIVE["imu arrives 1 s late"] = later("imu", 1.0)
    LIVE["odometry is reset"] = reset
    LIVE["carried"] = carried


def _matrix(seven: np.ndarray) -> np.ndarray:
    from topograph.geometry import from_quaternion

    return from_quaternion(seven[:3], seven[3:])


def _seven(T: np.ndarray) -> np.ndarray:
    from topograph.geometry import to_quaternion

    p, q = T[:3, 3], to_quaternion(T)[-4:] if np.ndim(to_quaternion(T)) == 1 else to_quaternion(T)[1]
    return np.concatenate([p, q])


_own()
for _name, _fault in FAULTS.items():
    if _name == "clean" or (
        any(w in _name for w in KINDS) and "mount" not in _name and "frame" not in _name and "imu_link" not in _name
    ):
        LIVE.setdefault(_name, _fault)


@dataclass(frozen=True)
class Outcome:
    """Scans, those with a pose, those of them that are wrong, the worst error (m), states, and what was raised."""

    name: str
    scans: int
    posed: int
    wrong: int
    worst: float
    states: dict[str, int]
    raised: str


def attempt(name: str, bag: Bag, topo: TopoMap, delay: int) -> Outcome:
    """Feed and judge."""
    local = Localizer(topo, robot_R_imu=bag.mounts["imu_link"][:3, :3])
    buffer: list[Odometry | Imu] = []
    scans = posed = wrong = 0
    worst = 0.0
    states: Counter[str] = Counter()
    try:
        for e in sorted(bag.events, key=lambda e: e.log_ns):
            if isinstance(e.it, Odometry | Imu):
                buffer.append(e.it)
            elif isinstance(e.it, Trunks):
                fix = local.update(e.it, buffer)
                buffer = []
                scans += 1
                assert local.report is not None
                states[local.report.state] += 1
                if fix is None:
                    continue
                posed += 1
                # Where the robot was when the scan was taken, whatever its stamp says.
                taken = e.log_ns - delay if "clock" in name or "stamp" in name else fix.stamp_ns
                true = interpolate(bag.truth.stamps_ns, bag.truth.world_T_robot, [taken])[0]
                off = float(np.linalg.norm(fix.map_T_robot[:2, 3] - true[:2, 3]))
                turn = float(np.degrees(abs((yaw_of(fix.map_T_robot) - yaw_of(true) + np.pi) % (2 * np.pi) - np.pi)))
                worst = max(worst, off)
                sure = local.report.state == "tracking"
                stated = float(np.sqrt(max(fix.cov[3, 3], fix.cov[4, 4])))
                wrong += not (off < max(0.5, 0.0 if sure else 3 * stated) and turn < (5.0 if sure else 15.0))
    except Exception as err:  # noqa: BLE001  # what the suite is there to find
        where = traceback.extract_tb(err.__traceback__)[-1]
        return Outcome(
            name,
            scans,
            posed,
            wrong,
            worst,
            dict(states),
            f"{type(err).__name__}: {err} ({Path(where.filename).name}:{where.lineno})",
        )
    return Outcome(name, scans, posed, wrong, worst, dict(states), "")


def clean(seed: int, folder: Path) -> None:
    """The clean run, and its map in the truth's frame."""
    bag, path = base(seed, folder), folder / f"map_{seed}.gpkg"
    if path.exists():
        return
    config = Config()
    topo = topo_map(solve_run(read_run([folder / f"base_{seed}"], config), config), config, {})
    assert topo.datum is not None
    by = topo.datum.to_enu(bag.truth.datum.to_geodetic(np.zeros(3)))
    store.save(replace(topo, p=topo.p - by, datum=bag.truth.datum), path)


def one(job: tuple[str, int, Path]) -> Outcome:
    name, seed, folder = job
    bag = base(seed, folder)
    for e in bag.of("trunks"):
        e.it = from_recorded(e.it, bag.mounts.get(e.it.frame, np.eye(4)), TrunksConfig())
    delay = int(np.median([e.log_ns - e.it.stamp_ns for e in bag.of("trunks")]))
    LIVE[name](bag, np.random.default_rng([seed, sum(map(ord, name))]))
    return attempt(name, bag, store.load(folder / f"map_{seed}.gpkg"), delay)


def suite(names: list[str], seed: int, folder: Path, jobs: int = 2) -> list[Outcome]:
    """All of `names`, in order."""
    clean(seed, folder)
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
        return list(pool.map(one, [(n, seed, folder) for n in names], chunksize=4))


def main() -> None:
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("names", nargs="*", help="faults whose names contain one of these; all by default")
    p.add_argument("--seed", type=int, default=2201)
    p.add_argument("--work", type=Path, help="keep the clean run here")
    a = p.parse_args()
    names = [n for n in LIVE if not a.names or any(w in n for w in a.names)]
    with tempfile.TemporaryDirectory() as folder:
        work = a.work or Path(folder)
        work.mkdir(parents=True, exist_ok=True)
        out = suite(names, a.seed, work)
    for o in out:
        word = "RAISED" if o.raised else "WRONG" if o.wrong else "ok"
        print(
            f"{word:<7} {o.name:<52} {o.scans:>4} scans {o.posed:>4} posed {o.wrong:>4} wrong worst {o.worst:6.2f} m {o.states} {o.raised}"
        )
    bad = Counter("raised" if o.raised else "wrong" if o.wrong else "ok" for o in out)
    print(
        f"\n{dict(bad)}; {len(out)} faults, seed {a.seed}; scans with a wrong pose: {sum(o.wrong for o in out)} of {sum(o.posed for o in out)}"
    )


if __name__ == "__main__":
    main()
