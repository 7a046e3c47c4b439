"""Localization by the thousand starts, on simulated trunk detections.

    python tools/evaluate_localization.py starts | thesis | risk | mismatch | nowhere | kidnap | track | cost  [--seed N] [--quick]

Seeds below 1,000,000 were looked at while building; the default seeds begin there and are for reporting only.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from topograph.bags import Trunks
from topograph.localize import ThesisConfig, ThesisMethod
from topograph.localize.belief import Belief
from topograph.localize.config import LocalizeConfig
from topograph.localize.engine import Engine
from topograph.localize.submap import Move, Sweep
from topograph.motion import Leg
from topograph.places.index import MapIndex, build_index
from topograph.simulate.starts import SCENARIOS, StartsConfig, Step, World, drive, world
from topograph.topomap import TopoMap

WRONG_M, WRONG_RAD = 0.5, 0.1


def told(c: StartsConfig, **changes: Any) -> LocalizeConfig:
    """What the localizer is told of a scenario: its noise, as a user would from the sensors' figures."""
    return replace(
        LocalizeConfig(
            view=c.view, map_sigma=c.map_sigma, trunk_sigma=0.0, seen=1 - c.miss, clutter=c.clutter, felled=0.03, new=0.03,
            diameter_sigma=0.01,
        ),
        **changes,
    )  # fmt: skip


def index_of(w: World, c: StartsConfig, config: LocalizeConfig) -> MapIndex:
    """The map's index; diameters only where the scenario measures them."""
    diameters = w.mapped_diameters if np.isfinite(c.diameter_sigma) else np.full(len(w.mapped), np.nan)
    return build_index(w.mapped, np.zeros(len(w.mapped)), diameters, c.view, config.pair, config.map_sigma)


def feed(engine: Engine, s: Step, c: StartsConfig) -> Belief:
    """One simulated scan; odometry's noise is told as it is, with the scale error as noise."""
    d = max(s.distance, 1e-9)
    cov = np.diag([((c.scale + c.white / 2) * d) ** 2 + 1e-6, (c.white * d) ** 2 + 1e-6, c.wander**2 * d + 1e-8])
    R = np.tile(c.sigma**2 * np.eye(2), (len(s.p), 1, 1))
    return engine.step(
        Move(s.motion, cov, s.distance), Sweep(s.p, R, s.diameter, np.full(len(s.p), c.diameter_sigma**2))
    )


def off(b: Belief, s: Step) -> tuple[float, float]:
    """Error of a committed pose, m and rad."""
    assert b.pose is not None
    turn = (b.pose[2] - s.pose[2] + np.pi) % (2 * np.pi) - np.pi
    return float(np.hypot(*(b.pose[:2] - s.pose[:2]))), float(abs(turn))


@dataclass(frozen=True)
class Start:
    """One start: metres until committed (inf: never), right or wrong, error, ms of each update, trees seen at first."""

    metres: float
    wrong: bool
    error: float
    ms: list[float]
    trees: int


def start(
    seed: int,
    c: StartsConfig,
    config: LocalizeConfig,
    length: float,
    told_as: StartsConfig | None = None,
    oracle: bool = False,
) -> Start:
    """Drive from a random place until committed. `oracle`: true associations and perfect odometry, same evidence."""
    rng = np.random.default_rng([seed, 5])
    w = world(c, rng)
    engine = Engine(index_of(w, told_as or c, config), config)
    metres, ms, trees = 0.0, [], -1
    for s in drive(w, replace(c, scale=0.0, white=0.0, wander=0.0) if oracle else c, rng, length):
        metres += s.distance
        trees = int((s.source >= 0).sum()) if trees < 0 else trees
        if oracle:
            s = _without_false(s)
        began = time.perf_counter()
        b = feed(engine, s, told_as or c)
        ms.append(1e3 * (time.perf_counter() - began))
        if b.committed:
            e, turn = off(b, s)
            return Start(metres, e > WRONG_M or turn > WRONG_RAD, e, ms, trees)
    return Start(np.inf, False, np.nan, ms, trees)


def _without_false(s: Step) -> Step:
    true = s.source >= 0
    return replace(s, p=s.p[true], diameter=s.diameter[true], source=s.source[true])


def many(job: Callable[[int], object], seeds: range) -> list:
    """A job per seed, on both cores."""
    job(seeds[0])  # compiled before the workers begin
    with ProcessPoolExecutor(2) as pool:
        return list(pool.map(job, seeds, chunksize=max(1, len(seeds) // 64)))


def line(name: str, runs: list[Start], length: float) -> str:
    """Mean distance (undecided count as the whole length), spread, wrong commits and their 95 % bound, cost."""
    d = np.array([min(r.metres, length) for r in runs])
    done = [r for r in runs if np.isfinite(r.metres)]
    wrong = sum(r.wrong for r in runs)
    error = np.array([r.error for r in done if not r.wrong])
    ms = np.concatenate([r.ms for r in runs])
    bound = 3.0 / len(runs) if wrong == 0 else (wrong + 2 * np.sqrt(wrong) + 2) / len(runs)
    return (
        f"{name:<34} n={len(runs):<6} mean {d.mean():6.2f} m  p95 {np.percentile(d, 95):5.1f}  undecided {len(runs) - len(done):<4} "
        f"wrong {wrong} (95 % bound {bound:.1e})  error {100 * error.mean():.1f} cm  update median {np.median(ms):.1f} max {ms.max():.0f} ms"
    )


def starts(seed: int, quick: float) -> None:
    """Distance to commit at risk 1e-4."""
    t = SCENARIOS["T"]
    trees = replace(t, diameter_sd=0.05, diameter_sigma=0.04)
    table = [
        ("thesis-like (T), no diameters", t, 2500, 25.0), ("thesis-like (T), diameters", trees, 2500, 25.0),
        *((f"grid 15 cm jitter (A), {n} trees", replace(SCENARIOS["A"], trees=n), k, 20.0) for n, k in ((100, 500), (1000, 300), (10000, 60), (100000, 10))),
        *((f"olives (D), {n} trees", replace(SCENARIOS["D"], trees=n), k, 20.0) for n, k in ((100, 500), (1000, 300), (10000, 60), (100000, 10))),
        *((f"grid 5 cm jitter (B), {n} trees", replace(SCENARIOS["B"], trees=n), k, 20.0) for n, k in ((100, 1000), (1000, 300), (10000, 80), (100000, 16))),
        ("8 m view, 30 % missed, 20 % false", replace(SCENARIOS["H"], trees=1000), 300, 30.0),
        ("the same with diameters", replace(SCENARIOS["H"], trees=1000, diameter_sd=0.04, diameter_sigma=0.03), 300, 30.0),
    ]  # fmt: skip
    for name, c, n, length in table:
        runs = many(partial(start, c=c, config=told(c), length=length), range(seed, seed + max(4, int(n * quick))))
        print(line(name, runs, length), flush=True)
        if c is t:
            for k in (2, 3, 4, 5):
                some = [min(r.metres, length) for r in runs if (r.trees == k if k < 5 else r.trees >= k)]
                if some:
                    print(
                        f"    {k}{'+' if k == 5 else ' '} trees seen at the start: {np.mean(some):.2f} m ({len(some)})"
                    )
            best = many(partial(start, c=c, config=told(c, clutter=1e-3), length=length, told_as=replace(c, clutter=1e-3, scale=1e-4, white=1e-4, wander=1e-5), oracle=True), range(seed, seed + max(4, int(n * quick))))  # fmt: skip
            print(line("    oracle", best, length), flush=True)


def thesis_start(seed: int, c: StartsConfig, length: float) -> Start:
    """The thesis's method on the same starts as `start`; it has no view of risk: one pose left is its commit."""
    rng = np.random.default_rng([seed, 5])
    w = world(c, rng)
    topo = TopoMap.of_points(w.mapped)
    method = ThesisMethod(topo, ThesisConfig(view=c.view, icp=0.0))
    metres, ms, trees = 0.0, [], -1
    for k, s in enumerate(drive(w, c, rng, length)):
        metres += s.distance
        trees = int((s.source >= 0).sum()) if trees < 0 else trees
        m = len(s.p)
        trunks = Trunks(
            stamp_ns=k + 1, frame="base_link", p=np.column_stack([s.p, np.full(m, 0.8)]), axis=np.tile([0.0, 0.0, 1.0], (m, 1)),
            diameter=np.full(m, np.nan), cov=np.tile(0.01 * np.eye(3), (m, 1, 1)), height=np.full(m, 0.8), score=np.ones(m),
        )  # fmt: skip
        began = time.perf_counter()
        report = method.step(trunks, Leg(step=s.motion, distance=s.distance, turned=abs(s.motion[2]), seconds=0.5))
        ms.append(1e3 * (time.perf_counter() - began))
        if report.fix is not None:
            e = float(np.hypot(*(report.fix.map_T_robot[:2, 3] - s.pose[:2])))
            return Start(metres, e > 1.0, e, ms, trees)
    return Start(np.inf, False, np.nan, ms, trees)


def thesis(seed: int, quick: float) -> None:
    """The thesis's method (without its ICP step: there are no clouds) on thesis-like orchards."""
    runs = many(partial(thesis_start, c=SCENARIOS["T"], length=25.0), range(seed, seed + max(4, int(400 * quick))))
    print(line("thesis-like (T), the thesis's method", runs, 25.0), flush=True)
    for k in (2, 3, 4, 5):
        some = [min(r.metres, 25.0) for r in runs if (r.trees == k if k < 5 else r.trees >= k)]
        if some:
            print(f"    {k}{'+' if k == 5 else ' '} trees seen at the start: {np.mean(some):.2f} m ({len(some)})")


def risk(seed: int, quick: float) -> None:
    """Wrong commits at several risks, over the scenarios that are hard."""
    scenarios = {"B": 100, "F": 100, "T": 24, "E": 100, "Fo": 1000}
    for r, n in ((1e-2, 500), (1e-3, 500), (1e-4, 2100)):
        runs = []
        for name, trees in scenarios.items():
            c = SCENARIOS[name] if name == "T" else replace(SCENARIOS[name], trees=trees)
            some = many(
                partial(start, c=c, config=told(c, risk=r), length=20.0), range(seed, seed + max(4, int(n * quick)))
            )
            print(
                f"  {name}: {sum(s.wrong for s in some)} wrong of {sum(np.isfinite(s.metres) for s in some)}",
                flush=True,
            )
            runs += some
        print(line(f"risk {r:g}", runs, 20.0), flush=True)


def mismatch(seed: int, quick: float) -> None:
    """The world is worse than the localizer was told."""
    for name, trees in (("B", 100), ("F", 100), ("T", 24)):
        c = SCENARIOS[name] if name == "T" else replace(SCENARIOS[name], trees=trees)
        for what, worse in (
            ("map error twice", replace(c, map_sigma=2 * c.map_sigma)), ("detection noise twice", replace(c, sigma=2 * c.sigma)),
            ("10 % felled, 8 % new", replace(c, felled=0.10, new=0.08)),
            ("odometry three times", replace(c, scale=3 * c.scale, white=3 * c.white, wander=3 * c.wander)),
        ):  # fmt: skip
            runs = many(
                partial(start, c=worse, config=told(c), length=20.0, told_as=c),
                range(seed, seed + max(4, int(500 * quick))),
            )
            print(line(f"{name}: {what}", runs, 20.0), flush=True)


def elsewhere(seed: int, c: StartsConfig, lattice: bool, length: float) -> tuple[str, int, float]:
    """A drive that must not commit: another orchard of the same design, or a perfect lattice."""
    config = told(c)
    w = world(c, np.random.default_rng([seed, 5]))
    v = w if lattice else world(c, np.random.default_rng([seed, 77]))
    engine = Engine(index_of(w, c, config), config)
    b = None
    for s in drive(v, c, np.random.default_rng([seed, 6]), length):
        b = feed(engine, s, c)
        if b.committed:
            return "committed", 1, 0.0
    assert b is not None
    apart = float(np.hypot(*(b.places[1:, :2] - b.places[0, :2]).T).max()) if len(b.places) > 1 else 0.0
    return b.state, b.hypotheses, apart


def nowhere(seed: int, quick: float) -> None:
    """Perfect lattices and other orchards of the same design."""
    for name, trees in (("A", 100), ("F", 100), ("G", 100)):
        c = replace(SCENARIOS[name], trees=trees, jitter=0.0, gaps=0.0, felled=0.0, new=0.0)
        out = many(partial(elsewhere, c=c, lattice=True, length=30.0), range(seed, seed + max(4, int(100 * quick))))
        _say(f"perfect lattice ({name})", out)
    for name, trees in (("T", 24), ("B", 100), ("A", 100), ("D", 100), ("F", 100), ("B", 1000)):
        c = SCENARIOS[name] if name == "T" else replace(SCENARIOS[name], trees=trees)
        out = many(partial(elsewhere, c=c, lattice=False, length=30.0), range(seed, seed + max(4, int(100 * quick))))
        _say(f"another orchard ({name}, {trees} trees)", out)


def _say(name: str, out: list[tuple[str, int, float]]) -> None:
    states = {s: sum(o[0] == s for o in out) for s in sorted({o[0] for o in out})}
    places = np.median([o[1] for o in out])
    print(
        f"{name:<34} n={len(out)}  {states}  places left, median {places:.0f}, up to {max(o[2] for o in out):.0f} m apart",
        flush=True,
    )


def kidnapped(seed: int, c: StartsConfig, lattice: bool, config: LocalizeConfig) -> tuple[float, float, bool]:
    """Metres from being carried away until noticed and until found again; whether a wrong pose was given afterwards.

    Noticed: the old pose is given up or replaced.
    """
    rng = np.random.default_rng([seed, 8])
    w = world(c, rng)
    engine = Engine(index_of(w, c, config), config)
    jump = None
    if lattice:
        jump = np.array([*(rng.choice([-1, 1], 2) * rng.integers(1, 3, 2) * [c.spacing, c.row_spacing]), 0.0])
    metres, carried, noticed, found, wrong = 0.0, np.nan, np.inf, np.inf, False
    expected = None
    for s in drive(w, c, rng, 60.0, jump_at=20.0, jump=jump):
        metres += s.distance
        if expected is not None and np.isnan(carried) and np.hypot(*(s.pose[:2] - expected)) > 2.0 * c.step + 0.5:
            carried = metres
        expected = s.pose[:2]
        b = feed(engine, s, c)
        if np.isnan(carried):
            continue
        if not b.committed:
            noticed = min(noticed, metres - carried)
        else:
            e, _ = off(b, s)
            if e < WRONG_M:
                noticed, found = min(noticed, metres - carried), min(found, metres - carried)
                if np.isfinite(found):
                    break
            elif np.isfinite(noticed):
                wrong = True
    return noticed, found, wrong


def kidnap(seed: int, quick: float) -> None:
    """Carried to a random place, and by an exact lattice vector."""
    for name in ("A", "B", "D", "F"):
        c = replace(SCENARIOS[name], trees=1000)
        fresh = many(partial(start, c=c, config=told(c), length=30.0), range(seed, seed + max(4, int(60 * quick))))
        for lattice in (False, True):
            if lattice and c.layout != "grid":
                continue
            out = many(
                partial(kidnapped, c=c, lattice=lattice, config=told(c)), range(seed, seed + max(4, int(60 * quick)))
            )
            noticed, found = np.array([o[0] for o in out]), np.array([o[1] for o in out])
            print(
                f"{name} {'by a lattice vector' if lattice else 'to a random place':<22} n={len(out)}  noticed after {np.mean(np.minimum(noticed, 40)):.2f} m "
                f"(p95 {np.percentile(np.minimum(noticed, 40), 95):.1f}, never {np.isinf(noticed).sum()})  found after {np.mean(np.minimum(found, 40)):.2f} m "
                f"(never {np.isinf(found).sum()}; a fresh start {np.mean([min(r.metres, 30) for r in fresh]):.2f})  wrong {sum(o[2] for o in out)}",
                flush=True,
            )  # fmt: skip


def tracked(
    seed: int, c: StartsConfig, length: float
) -> tuple[float, int, list[float], list[float], list[float], float]:
    """A long drive: metres, losses, errors (m), headings (deg), NEES, share of scans with a pose after the first."""
    rng = np.random.default_rng([seed, 9])
    w = world(c, rng)
    config = told(c)
    engine = Engine(index_of(w, c, config), config)
    metres, errors, turns, nees, posed, after = 0.0, [], [], [], 0, 0
    for s in drive(w, c, rng, length):
        metres += s.distance
        b = feed(engine, s, c)
        after += bool(posed)
        if b.pose is not None:
            posed += 1
            e, turn = off(b, s)
            errors.append(e)
            turns.append(np.degrees(turn))
            d = b.pose[:2] - s.pose[:2]
            nees.append(float(d @ np.linalg.solve(b.cov[:2, :2], d)))
    return metres, engine.losses, errors, turns, nees, posed / max(after + 1, 1)


def track(seed: int, quick: float) -> None:
    """Tracking: errors, false alarms, consistency."""
    changes: list[tuple[str, dict[str, Any]]] = [(k, {}) for k in "ABDFE"]
    for name, changed in [*changes, ("A", {"felled": 0.1, "new": 0.08})]:
        c = replace(SCENARIOS[name], trees=1000, **changed)
        out = many(partial(tracked, c=c, length=500.0), range(seed, seed + max(2, int(8 * quick))))
        e, h = np.concatenate([o[2] for o in out]), np.concatenate([o[3] for o in out])
        n = np.concatenate([o[4] for o in out])
        print(
            f"{name} {'felled 10 %, new 8 %' if changed else '':<22} {sum(o[0] for o in out) / 1000:.1f} km  lost {sum(o[1] for o in out)}  error mean {100 * e.mean():.1f} cm "
            f"p99 {100 * np.percentile(e, 99):.1f}  heading {h.mean():.2f}° p99 {np.percentile(h, 99):.2f}  NEES {n.mean():.2f} (2)  "
            f"pose {100 * np.mean([o[5] for o in out]):.1f} %",
            flush=True,
        )  # fmt: skip


def latency(seed: int, quick: float) -> None:
    """CPU time of this thread for each update while tracking, against the size of the map."""
    for n in (1000, 10_000, 100_000):
        for name in ("A", "B", "D"):
            c = replace(SCENARIOS[name], trees=n)
            config = told(c)
            rng = np.random.default_rng([seed, 11])
            w = world(c, rng)
            engine = Engine(index_of(w, c, config), config)
            ms: list[float] = []
            searching: list[float] = []
            lost = 0
            for s in drive(w, c, rng, max(20.0, 150.0 * quick)):
                began = time.thread_time()
                tracked_before = engine.track is not None
                feed(engine, s, c)
                (ms if tracked_before else searching).append(1e3 * (time.thread_time() - began))
                lost = engine.losses
            q = np.array(ms) if ms else np.full(1, np.nan)
            print(
                f"{name} {n:>7} trees  tracking n={len(ms):<4} median {np.median(q):6.1f}  p99 {np.percentile(q, 99):6.1f}  max {q.max():6.1f} ms;  "
                f"searching n={len(searching):<4} max {max(searching, default=np.nan):6.1f} ms;  lost {lost}",
                flush=True,
            )


def cost(seed: int, quick: float, picture: Path) -> None:
    """Search time, update time and memory against the size of the map, on one core, drawn to `picture`."""
    from topograph.localize.posterior import describe, weigh
    from topograph.places.search import search

    rows = []
    for n in (100, 300, 1000, 3000, 10000, 30000, 100000):
        for name in ("A", "B", "D"):
            c = replace(SCENARIOS[name], trees=n)
            config = told(c)
            rng = np.random.default_rng([seed, 5])
            w = world(c, rng)
            began = time.perf_counter()
            index = index_of(w, c, config)
            build = time.perf_counter() - began
            engine = Engine(index, replace(config, information=1e9))
            for s in drive(w, c, rng, 3.0):
                feed(engine, s, c)
            times = []
            for _ in range(3):
                began = time.perf_counter()
                marks, _ = describe(engine.hunt.submap, index, config)
                weigh(search(marks, index, config.places), marks, engine.hunt.submap, index, config)
                times.append(1e3 * (time.perf_counter() - began))
            run = [start(seed + k, c, config, 6.0) for k in range(3 if n < 50000 else 1)]
            update = float(np.median(np.concatenate([r.ms for r in run])))
            rows.append({"scenario": name, "trees": n, "search_ms": min(times), "update_ms": update, "build_s": build, "bytes_per_tree": index.bytes / len(index)})  # fmt: skip
            print(
                "  ".join(f"{k} {v:.4g}" if isinstance(v, float) else f"{k} {v}" for k, v in rows[-1].items()),
                flush=True,
            )
    picture.with_suffix(".json").write_text(json.dumps(rows, indent=1) + "\n")
    from topograph.report.localization import cost_figure

    picture.write_bytes(cost_figure(rows))


def main() -> None:
    """Run one of the experiments."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "what", choices=["starts", "thesis", "risk", "mismatch", "nowhere", "kidnap", "track", "latency", "cost"]
    )
    parser.add_argument("--seed", type=int, default=1_000_000)
    parser.add_argument("--quick", type=float, default=1.0, help="Share of the runs.")
    parser.add_argument("--picture", type=Path, default=Path("cost.png"))
    a = parser.parse_args()
    if a.what == "cost":
        cost(a.seed, a.quick, a.picture)
    else:
        globals()[a.what](a.seed, a.quick)


if __name__ == "__main__":
    main()
