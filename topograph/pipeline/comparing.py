"""Both methods on the same runs: three questions, each with its own inputs.

A: the same detections, another estimator. B: the same map and trunks, another localizer. C: whole chain against whole chain. Between them
stand all eight combinations of front end, map and localizer.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from topograph.config import Config, over
from topograph.errors import InsufficientDataError, TopographError
from topograph.estimate.average import Rule
from topograph.estimate.ekf import filtered_path
from topograph.evaluate import Metric, Truth, WorldInMap, map_metrics, path_metrics, trunk_metrics, world_in_map
from topograph.evaluate.chapter5 import (
    error_metrics,
    node_errors,
    node_metrics,
    sight,
    start_metrics,
    start_of,
)
from topograph.evaluate.comparison import BEST, OURS, WRITTEN, Comparison, Row, Track
from topograph.evaluate.localization import localization_errors, localization_metrics
from topograph.evaluate.outside import smfeval_metrics
from topograph.exchange import Underlay, check_picture, read_underlay
from topograph.geometry import interpolate
from topograph.localize import GraphMethod, Method, ThesisMethod
from topograph.mapping import Progress, prepare, silent
from topograph.pipeline.localizing import MethodOf, Replay, localize_heard
from topograph.pipeline.mapping import averaged, mapping_config, solve_run, thesis_map, topo_map
from topograph.pipeline.read import Heard, hear
from topograph.topomap import TopoMap


@dataclass(slots=True)
class _Work:
    """What is compared, and what it is made of: truths of the runs, what each front end made of them, truth to map, full chains."""

    out: Comparison
    truths: list[Truth | None]
    by_fixes: bool = False
    heard: dict[tuple[str, str], Heard] = field(default_factory=dict)
    worlds: dict[str, WorldInMap] = field(default_factory=dict)

    @property
    def one_front_end(self) -> bool:
        """The runs hold trunk detections, no clouds: there is nothing that the thesis's front end could see."""
        return all("points" not in self.heard["organised", r].session.chosen for r in self.out.runs)

    @property
    def first(self) -> str:
        return self.out.runs[0]


def compare_runs(
    runs: Sequence[Path],
    truths: Sequence[Truth | None],
    config: Config,
    *,
    starts: int = 16,
    ablations: bool = False,
    by_fixes: int = 0,
    image: Path | None = None,
    rivals: dict[str, MethodOf] | None = None,
    progress: Progress = silent,
) -> Comparison:
    """Map the first run and localize all of them, by both methods.

    Args:
        by_fixes: each run's own GNSS, filtered, is its truth (thesis 5.3): 1 all of it, N every N-th fix, which no map is then made with.
        image: a georeferenced picture that is drawn under the maps.
    """
    if image is not None:
        check_picture(image)
    out = Comparison(runs=_names(runs))
    w = _Work(out, list(truths), by_fixes == 1)
    configs = {OURS: config, WRITTEN: over(config, "thesis"), BEST: over(config, "thesis_best")}
    for n, path in enumerate(runs):
        for front_end in ("organised", "thesis"):
            progress("read", (2 * n + (front_end == "thesis")) / (2 * len(runs)))
            if front_end == "thesis" and "points" not in w.heard["organised", out.runs[n]].session.chosen:
                w.heard["thesis", out.runs[n]] = w.heard["organised", out.runs[n]]
                continue
            chosen = replace(config, trunks=replace(config.trunks, front_end=front_end))
            w.heard[front_end, out.runs[n]] = hear([path], chosen)
        out.notes += [f"{out.runs[n]}: {said}" for said in w.heard["organised", out.runs[n]].session.notes]
    progress("read", 1.0)
    if w.one_front_end:
        out.notes.append(
            "recorded trunk detections, no point clouds: both methods have the same front end, and ICP has no clouds"
        )
    if by_fixes:
        w.truths = [fixes_truth(with_fixes(w.heard["organised", r], by_fixes, True), config) for r in out.runs]
        for r, t in zip(out.runs, w.truths, strict=True):
            if t is None:
                out.notes.append(f"{r}: no truth, too few of its fixes are usable")
        if not any(t is not None for t in w.truths):
            raise InsufficientDataError(
                "--truth fixes: no run has enough usable fixes; give a smaller N, or another truth"
            )
        if by_fixes > 1:
            w.heard = {k: with_fixes(h, by_fixes, False) for k, h in w.heard.items()}
        out.notes.append(BY_FIXES if by_fixes == 1 else BY_WITHHELD.format(n=by_fixes))
    _detections(w)
    _maps(w, configs, progress)
    if image is not None:
        out.underlay = _underlay(image, out.maps[OURS], out.notes)
    _per_run(w, configs)
    _localizers(w, configs, rivals or {}, progress)
    _starts(w, configs, starts, progress)
    _conditions(w, configs)
    if ablations:
        _ablations(w, config, progress)
    return out


def _names(runs: Sequence[Path]) -> list[str]:
    """What the runs are called: their stems, numbered where two are alike."""
    stems = [p.stem for p in runs]
    return [f"{s} ({n + 1})" if stems.count(s) > 1 else s for n, s in enumerate(stems)]


BY_FIXES = (
    "truth: each run's own GNSS through the filter (thesis 5.3); it cannot be better than its fixes, maps used them too, and the mapping path "
    "of the thesis is that filter, so that paths are not compared"
)
BY_WITHHELD = "truth: every fix number {n} of each run's own GNSS, through the filter (thesis 5.3), withheld from all maps; wheels and IMU are in both"


def with_fixes(heard: Heard, n: int, withheld: bool) -> Heard:
    """The run with every `n`-th fix, or (not `withheld`) with all others."""
    s = heard.session.streams
    keep = (np.arange(len(s.fix_ns)) % n == 0) == withheld
    streams = replace(s, **{k: getattr(s, k)[keep] for k in ("fix_ns", "lat_lon_h", "fix_cov", "fix_status")})
    return replace(heard, session=replace(heard.session, streams=streams))


def _underlay(image: Path, topo: TopoMap, notes: list[str]) -> Underlay | None:
    """The part of the picture that the map covers, with a margin."""
    if topo.datum is None:
        notes.append(f"{image.name}: not drawn, the map is not georeferenced")
        return None
    seen = np.concatenate([topo.p[:, :2], topo.map_T_robot[:, :2, 3]])
    found = read_underlay(image, topo.datum, seen.min(axis=0) - 8.0, seen.max(axis=0) + 8.0)
    if not found.pixels[..., 3].any():
        notes.append(f"{image.name}: shows nothing of where the map is")
        return None
    return found


def fixes_truth(heard: Heard, config: Config) -> Truth | None:
    """The path of a run by its own GNSS, IMU and wheels through the filter, as the thesis had it; None without GNSS."""
    p = prepare(heard.session, mapping_config(config)).problem
    if p.datum is None:
        return None
    ns = np.unique(np.concatenate([[t.stamp_ns for t in heard.session.trunks], p.stamps_ns])).astype(np.int64)
    ns = ns[(ns >= p.stamps_ns[0]) & (ns <= p.stamps_ns[-1])]
    sigma = float(np.sqrt(np.median(p.fixes.cov[:, 0, 0])))
    return Truth.of_path(ns, filtered_path(p, ns), p.datum, sigma)


# -- detections ---------------------------------------------------------------------------------------------------


def _detections(w: _Work) -> None:
    """Table 5.1 per sweep, with the recall that it never had, and a scan to look at."""
    out = w.out
    for run, truth in zip(out.runs, w.truths, strict=True):
        if truth is None or not len(truth.returns):
            continue
        for name, front_end in ((OURS, "organised"), ("thesis", "thesis")):
            trunks = [t.select(t.score >= 0) for t in w.heard[front_end, run].session.trunks]
            metrics, _ = trunk_metrics(truth, np.array([t.stamp_ns for t in trunks]), [t.p for t in trunks])
            if run == w.first:
                mine = {} if out.sight is None else {k: p for k, (p, _) in out.sight.trunks.items()}
                middle = int(np.median(truth.scan_stamps_ns))
                out.sight = sight(truth, middle, {**mine, name: min(trunks, key=lambda t: abs(t.stamp_ns - middle)).p})
            out.rows.append(Row("5.1 a sweep", name, run, [Metric("trunks", sum(map(len, trunks))), *metrics]))


# -- A: the same detections, another estimator ----------------------------------------------------------------------


def _maps(w: _Work, configs: dict[str, Config], progress: Progress) -> None:
    out, first, truth, config = w.out, w.first, w.truths[0], configs[OURS]
    heard = w.heard["organised", first]
    progress("map", 0.0)
    solved = solve_run(heard.session, config)
    out.maps[OURS] = topo_map(solved, config, {})
    once = replace(config, trees=replace(config.trees, reassociate=False))
    flat = solve_run(heard.session, once)
    paths = {"filter": None, "graph": solved.estimate.map_T_robot}
    ladder: tuple[tuple[Rule, str], ...] = (
        ("halving", "eq. 4.14"),
        ("mean", "mean"),
        ("inverse", "inverse-variance mean"),
    )
    for rule, word in ladder:
        for path, poses in paths.items():
            c = replace(config, average=replace(config.average, rule=rule))
            e, topo = averaged(solved.problem, heard.session, c, {}, path=poses, clouds=False)
            _add_map(w, "A", f"{word}, {path}'s path", topo, truth, (e.stamps_ns, e.map_T_robot))
    for name, s in (("graph without re-association", flat), ("graph", solved)):
        topo = topo_map(s, config, {}, clouds=False)
        _add_map(w, "A", name, topo, truth, (s.estimate.stamps_ns, s.estimate.map_T_robot))
    progress("map", 0.5)
    other = w.heard["thesis", first]
    made: dict[str, Callable[[], tuple[TopoMap, Any]]] = {
        "graph on the thesis's trunks": lambda: _graph_map(other, config),
        WRITTEN: lambda: _thesis_map(other, configs[WRITTEN]),
        BEST: lambda: _thesis_map(other, configs[BEST]),
        "thesis's map of our trunks": lambda: _thesis_map(heard, configs[BEST]),
    }
    for name, make in made.items():
        if w.one_front_end and name == "graph on the thesis's trunks":
            continue
        try:
            out.maps[name], path = make()
        except TopographError as err:
            out.notes.append(f"{name}: no map ({err})")
            continue
        if name in (WRITTEN, BEST):
            _add_map(w, "C map", name, out.maps[name], truth, path)
    _add_map(w, "C map", OURS, out.maps[OURS], truth, (solved.estimate.stamps_ns, solved.estimate.map_T_robot))
    for name, topo in out.maps.items():
        if truth is None:
            continue
        try:
            w.worlds[name] = world_in_map(topo, truth)
        except TopographError as err:
            out.notes.append(f"{name}: {err}")
            continue
        if w.worlds[name].how != "WGS84":
            out.notes.append(f"{name}: errors are after the truth was laid onto the map by its {w.worlds[name].how}")
        if len(truth.trees):
            out.nodes[name] = node_errors(topo, truth)
            if not len(out.nodes[name].node):
                out.notes.append(f"{name}: no node within 2.5 m of a tree of the truth: is it of this orchard?")
    if truth is not None and len(truth.trees) and OURS in w.worlds:
        out.trees = w.worlds[OURS].points(truth.trees)[:, :2]
    progress("map", 1.0)


def _per_run(w: _Work, configs: dict[str, Config]) -> None:
    """Table 5.1 as the thesis counts: each run mapped by itself, each node right or wrong once (eq. 5.1); and its recall."""
    for run, truth in zip(w.out.runs, w.truths, strict=True):
        if truth is None or not len(truth.trees):
            continue
        for name, front_end in ((OURS, "organised"), (BEST, "thesis"), (WRITTEN, "thesis")):
            heard, c = w.heard[front_end, run], configs[name]
            try:
                if run == w.first:
                    topo = w.out.maps[name]
                else:
                    topo = (_graph_map if name == OURS else _thesis_map)(heard, c)[0]
            except (TopographError, KeyError) as err:
                w.out.notes.append(f"{run}, {name}: no map ({err})")
                continue
            e = node_errors(topo, truth)
            right = len(e.node)
            metrics = [
                Metric("right", right),
                Metric("wrong", e.nodes - right, "", "lower"),
                Metric("accuracy (eq. 5.1)", right / max(e.nodes, 1), "", "higher"),
                Metric("recall", float(e.seen[e.tree].sum() / max(e.seen.sum(), 1)), "", "higher"),
            ]
            w.out.rows.append(Row("5.1 a run", name, run, metrics))


def _graph_map(heard: Heard, config: Config) -> tuple[TopoMap, Any]:
    s = solve_run(heard.session, config)
    return topo_map(s, config, {}), (s.estimate.stamps_ns, s.estimate.map_T_robot)


def _thesis_map(heard: Heard, config: Config) -> tuple[TopoMap, Any]:
    _, e, topo = thesis_map(heard.session, config, {})
    return topo, (e.stamps_ns, e.map_T_robot)


def _add_map(w: _Work, table: str, name: str, topo: TopoMap, truth: Truth | None, path: Any) -> None:
    metrics = [Metric("nodes", len(topo.trees()))]
    if truth is not None and len(truth.trees):
        try:
            metrics = node_metrics(topo, truth)
            metrics += [m for m in map_metrics(topo, truth) if "NEES" in m.name]
        except TopographError as err:
            w.out.notes.append(f"{name}: {err}")
    if truth is not None and len(truth.stamps_ns) and not w.by_fixes:  # the thesis's path is that very filter's
        stamps, poses = path
        metrics += path_metrics(stamps, poses, topo.datum, truth.stamps_ns, truth.world_T_robot, truth.datum)
    w.out.rows.append(Row(table, name, w.first, metrics))


# -- B, C and the eight combinations --------------------------------------------------------------------------------


def by_graph(topo: TopoMap, config: Config) -> Method:
    return GraphMethod(topo, config.localize)


def by_thesis(topo: TopoMap, config: Config) -> Method:
    return ThesisMethod(topo, config.thesis)


def _localizers(w: _Work, configs: dict[str, Config], rivals: dict[str, MethodOf], progress: Progress) -> None:
    out, config = w.out, configs[OURS]
    measured = {m: replace(config, localize=replace(config.localize, measure=m)) for m in ("ranges", "bearings")}
    methods: list[tuple[str, MethodOf, Config]] = [
        (OURS, by_graph, config),
        ("graph, ranges only", by_graph, measured["ranges"]),
        ("graph, bearings only", by_graph, measured["bearings"]),
        (WRITTEN, by_thesis, configs[WRITTEN]),
        (BEST, by_thesis, configs[BEST]),
        *((name, method, config) for name, method in rivals.items()),
    ]
    maps = {
        "organised": {"graph": OURS, "thesis": "thesis's map of our trunks"},
        "thesis": {"graph": "graph on the thesis's trunks", "thesis": BEST},
    }
    jobs: list[tuple[str, str, str, str, MethodOf, Config]] = []
    for name, method, c in methods:
        jobs.append(("B", name, "organised", OURS, method, c))
    for front_end, by_map in maps.items():
        if front_end == "thesis" and w.one_front_end:
            continue
        for kind, map_name in by_map.items():
            for word, method, c in (("graph", by_graph, config), ("thesis", by_thesis, configs[BEST])):
                label = f"{'our' if front_end == 'organised' else 'thesis'} trunks, {kind} map, {word} localizer"
                jobs.append(("2x2x2", label, front_end, map_name, method, c))
    jobs.append(("C", OURS, "organised", OURS, by_graph, config))
    jobs.append(("C", BEST, "thesis", BEST, by_thesis, configs[BEST]))
    jobs.append(("C", WRITTEN, "thesis", WRITTEN, by_thesis, configs[WRITTEN]))
    done: dict[tuple[str, str, MethodOf, int, str], tuple[Replay, Track, list[Metric]]] = {}
    for n, (table, name, front_end, map_name, method, c) in enumerate(jobs):
        if map_name not in out.maps:
            continue
        for k, (run, truth) in enumerate(zip(out.runs, w.truths, strict=True)):
            progress("localize", (n * len(out.runs) + k) / (len(jobs) * len(out.runs)))
            key = (front_end, map_name, method, id(c), run)
            if key not in done:
                found = _localized(w, front_end, map_name, run, truth, method, c)
                if found is None:
                    continue
                done[key] = found
            if table == "C":
                out.tracks[name, run] = done[key][1]
            r, e = done[key][0], done[key][1].errors
            metrics = localization_metrics(r.reports, r.distance, r.update_ms, None)
            metrics += [] if e is None else error_metrics(e) + done[key][2]
            out.rows.append(Row(table, name, run, metrics))
    progress("localize", 1.0)


def _localized(
    w: _Work, front_end: str, map_name: str, run: str, truth: Truth | None, method: MethodOf, config: Config
) -> tuple[Replay, Track, list[Metric]] | None:
    out = w.out
    topo = out.maps[map_name]
    try:
        replay = localize_heard(topo, w.heard[front_end, run], config, method)
    except TopographError as err:
        out.notes.append(f"{run}, {map_name}: not localized ({err})")
        return None
    errors = true_xy = None
    outside: list[Metric] = []
    if truth is not None and len(truth.stamps_ns) and (world := _world_or_note(w, map_name, truth)) is not None:
        errors = localization_errors(replay.reports, truth, world)
        outside = smfeval_metrics(replay.reports, truth, world)
        stamps = np.array([r.stamp_ns for r in replay.reports], np.int64)
        true_xy = world.points(interpolate(truth.stamps_ns, truth.world_T_robot, stamps)[:, :3, 3])[:, :2]
    return replay, Track(replay.reports, replay.distance, errors, true_xy), outside


def _world_or_note(w: _Work, map_name: str, truth: Truth) -> WorldInMap | None:
    try:
        return _world(w, map_name, truth)
    except TopographError as err:
        w.out.notes.append(f"{map_name}: {err}")
        return None


def _world(w: _Work, map_name: str, truth: Truth) -> WorldInMap:
    """Georeferenced truths find into a georeferenced map by themselves; else the frame is that of the run that was mapped."""
    if truth.datum is None or w.out.maps[map_name].datum is None:
        if map_name in w.worlds:
            return w.worlds[map_name]
        if truth is not w.truths[0] and not len(truth.trees):
            raise InsufficientDataError(
                "the map is local and the run that it was made of has no truth: nothing leads from the truth into it"
            )
    return world_in_map(w.out.maps[map_name], truth)


PATIENCE = 120.0
"""Metres after which a start counts as one without an end: ten times what the thesis's worst start took."""


# -- convergence ------------------------------------------------------------------------------------------------------


def _starts(w: _Work, configs: dict[str, Config], n: int, progress: Progress) -> None:
    """`n` starts along the first run (Figs. 5.14, 5.15), each method in its own chain's map."""
    out, run, truth = w.out, w.first, w.truths[0]
    if truth is None or not len(truth.stamps_ns) or n < 1:
        return
    chains: list[tuple[str, str, str, MethodOf, Config]] = [
        (OURS, "organised", OURS, by_graph, configs[OURS]),
        ("thesis's localizer in our map", "organised", OURS, by_thesis, configs[BEST]),
        (BEST, "thesis", BEST, by_thesis, configs[BEST]),
        (WRITTEN, "thesis", WRITTEN, by_thesis, configs[WRITTEN]),
    ]
    for c, (name, front_end, map_name, method, config) in enumerate(chains):
        if map_name not in out.maps:
            continue
        heard = w.heard[front_end, run]
        scans = len(heard.session.trunks)
        world = _world_or_note(w, map_name, truth)
        if world is None:
            continue
        found = []
        for k, scan in enumerate(np.linspace(0, 0.8 * scans, n).astype(int).tolist()):
            progress("starts", (c * n + k) / (len(chains) * n))
            r = localize_heard(
                out.maps[map_name], heard, config, method, first=scan, until_committed=True, most=PATIENCE
            )
            found.append(start_of(scan, r.reports, r.distance, r.trunks_seen, truth, world))
        out.starts[name] = found
        out.rows.append(Row("convergence", name, run, start_metrics(found)))
        for trees in sorted({s.trees for s in found}):
            mine = [s.distance for s in found if s.trees == trees and np.isfinite(s.distance) and not s.wrong]
            if mine:
                out.rows.append(
                    Row(
                        "5.15",
                        f"{name}, {trees} trees",
                        run,
                        [Metric("convergence mean", float(np.mean(mine)), "m", "lower"), Metric("starts", len(mine))],
                    )
                )
    progress("starts", 1.0)


# -- the thesis's own conditions ----------------------------------------------------------------------------------------

THESIS = {
    "tree error at 0.8 m, mean": 0.865,
    "tree error at 0.8 m, min": 0.095,
    "tree error at 0.8 m, max": 2.14,
    "distance error mean": 1.7,
    "convergence mean": 6.1,
    "convergence sd": 3.0,
    "convergence min": 1.0,
    "convergence max": 12.9,
}
"""What 5.4 reports: map; localization of run 1; convergence from 16 starts. m."""
BY_HAND = 0.6
"""Standard deviation per axis of a tree read off a satellite picture, m: its georeference, and a crown that is seen in place of a foot."""


def _conditions(w: _Work, configs: dict[str, Config]) -> None:
    """The thesis's figures, its method here, and what differs between the two switched on, one after the other."""
    truth, run = w.truths[0], w.first
    if truth is None or not len(truth.trees):
        return
    rows = w.out.rows
    rows.append(Row("conditions", "the thesis (5.4)", run, [Metric(k, v, "m") for k, v in THESIS.items()]))
    heard = w.heard["thesis", run]
    written = configs[WRITTEN]
    no_heading = replace(written, bags=replace(written.bags, topic_heading="none"))
    rng = np.random.default_rng(0)
    by_hand = replace(
        truth,
        trees=truth.trees
        + np.column_stack([rng.normal(0, BY_HAND, (len(truth.trees), 2)), np.zeros(len(truth.trees))]),
    )
    cases: tuple[tuple[str, Heard, Config, Truth], ...] = (
        ("its method as written", heard, written, truth),
        ("... without dual-antenna heading", without(heard, no_heading), no_heading, truth),
        ("... and trees taken from satellite pictures (0.6 m)", without(heard, no_heading), no_heading, by_hand),
        ("its method on our trunks", w.heard["organised", run], written, truth),
        ("... and trees taken from satellite pictures (0.6 m) ", w.heard["organised", run], written, by_hand),
    )
    for name, h, c, t in cases:
        try:
            topo = thesis_map(h.session, c, {})[2]
        except TopographError as err:
            w.out.notes.append(f"{name}: no map ({err})")
            continue
        found = [
            m
            for m in node_metrics(topo, t)
            if m.name in THESIS or m.name.startswith(("nodes", "precision (2.5", "recall (2.5"))
        ]
        rows.append(Row("conditions", name, run, found))
    for name, label in (
        (BEST, "its localizer at its best, its chain"),
        ("thesis's localizer in our map", "its localizer in our map, our trunks"),
    ):
        found = [m for r in rows if r.table == "convergence" and r.name == name for m in r.metrics if m.name in THESIS]
        found += [
            m
            for r in rows
            if r.table == ("C" if name == BEST else "B") and r.name == BEST and r.run == run
            for m in r.metrics
            if m.name in THESIS
        ]
        if found:
            rows.append(Row("conditions", label, run, found))


# -- ablations --------------------------------------------------------------------------------------------------------


def ablated(config: Config) -> dict[str, Config]:
    """What is left out -> the configuration without it."""
    b, e, t = config.bags, config.estimate, config.trees
    return {
        "nothing": config,
        "IMU factors (gyro in dead reckoning stays)": replace(config, estimate=replace(e, use_imu=False)),
        "IMU": replace(config, bags=replace(b, topic_imu="none")),
        "dual-antenna heading": replace(config, bags=replace(b, topic_heading="none")),
        "GNSS": replace(config, bags=replace(b, topic_fix="none", topic_heading="none")),
        "wheels": replace(config, bags=replace(b, topic_odometry="none")),
        "robust losses": replace(config, estimate=replace(e, huber=1e6, tukey=1e6)),
        "learned noise scales": replace(config, estimate=replace(e, learn_scale=False)),
        "re-association": replace(config, trees=replace(t, reassociate=False)),
        "existence by free space": replace(config, trees=replace(t, passed=1e6)),
        "score (all candidates alike)": replace(config, trees=replace(t, usual_score=0.0, min_share=0.0)),
    }


def _ablations(w: _Work, config: Config, progress: Progress) -> None:
    """Each part left out in turn, on the first run's detections."""
    out, first, truth = w.out, w.first, w.truths[0]
    heard = w.heard["organised", first]
    cases = ablated(config)
    for k, (name, c) in enumerate(cases.items()):
        progress("ablations", k / len(cases))
        session = without(heard, c).session
        try:
            s = solve_run(session, c)
        except TopographError as err:
            out.rows.append(Row("ablations", f"without {name}", first, []))
            out.notes.append(f"without {name}: {err}")
            continue
        topo = topo_map(s, c, {}, clouds=False)
        _add_map(w, "ablations", f"without {name}", topo, truth, (s.estimate.stamps_ns, s.estimate.map_T_robot))
    progress("ablations", 1.0)


def without(heard: Heard, config: Config) -> Heard:
    """The run as if the streams that the configuration turns off had not been recorded; its trunks are those that were detected."""
    s = heard.session
    streams, chosen = s.streams, dict(s.chosen)
    for kind in ("imu", "heading", "fix", "odometry"):
        if getattr(config.bags, f"topic_{kind}") == "none":
            streams = streams.without(kind)
            chosen.pop(kind, None)
    mounts = {k: v for k, v in s.mounts.items() if k in chosen}
    return replace(
        heard, session=replace(s, streams=streams, chosen=chosen, mounts=mounts, notes=[], skipped=s.skipped.copy())
    )
