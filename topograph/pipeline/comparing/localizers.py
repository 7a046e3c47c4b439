"""B, C and all eight combinations: who localizes, in which map, with which trunks; and convergence from many starts."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from topograph.config import Config
from topograph.errors import TopographError
from topograph.evaluate import Metric, Truth
from topograph.evaluate.chapter5 import error_metrics, start_metrics, start_of
from topograph.evaluate.comparison import BEST, OURS, WRITTEN, Row, Track
from topograph.evaluate.localization import localization_errors, localization_metrics
from topograph.evaluate.outside import smfeval_metrics
from topograph.geometry import interpolate
from topograph.localize import GraphMethod, Method, ThesisMethod
from topograph.mapping import Progress
from topograph.pipeline.comparing.work import Work, world_or_note
from topograph.pipeline.localizing import MethodOf, Replay, localize_heard
from topograph.topomap import TopoMap


def by_graph(topo: TopoMap, config: Config) -> Method:
    """Ours."""
    return GraphMethod(topo, config.localize)


def by_thesis(topo: TopoMap, config: Config) -> Method:
    """The thesis's."""
    return ThesisMethod(topo, config.thesis)


def localizers(w: Work, configs: dict[str, Config], rivals: dict[str, MethodOf], progress: Progress) -> None:
    """Tables B, 2x2x2 and C."""
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
    done: dict[tuple[str, str, MethodOf, int, str], Localized] = {}
    for n, (table, name, front_end, map_name, method, c) in enumerate(jobs):
        if map_name not in out.maps:
            continue
        for k, (run, truth) in enumerate(zip(out.runs, w.truths, strict=True)):
            progress("localize", (n * len(out.runs) + k) / (len(jobs) * len(out.runs)))
            key = (front_end, map_name, method, id(c), run)
            if key not in done:
                found = localized(w, front_end, map_name, run, truth, method, c)
                if found is None:
                    continue
                done[key] = found
            if table == "C":
                out.tracks[name, run] = done[key].track
            r, e = done[key].replay, done[key].track.errors
            metrics = localization_metrics(r.reports, r.distance, r.update_ms, None)
            metrics += [] if e is None else error_metrics(e) + done[key].outside
            out.rows.append(Row(table, name, run, metrics))
    progress("localize", 1.0)


@dataclass(frozen=True, slots=True)
class Localized:
    """One run localized: what was reported, its errors, and what others' yardsticks say of them."""

    replay: Replay
    track: Track
    outside: list[Metric]


def localized(
    w: Work, front_end: str, map_name: str, run: str, truth: Truth | None, method: MethodOf, config: Config
) -> Localized | None:
    """One run in one map by one method; None, with a note, where that cannot be."""
    out = w.out
    topo = out.maps[map_name]
    try:
        replay = localize_heard(topo, w.heard[front_end, run], config, method)
    except TopographError as err:
        out.notes.append(f"{run}, {map_name}: not localized ({err})")
        return None
    errors = true_xy = None
    outside: list[Metric] = []
    if truth is not None and len(truth.stamps_ns) and (world := world_or_note(w, map_name, truth)) is not None:
        errors = localization_errors(replay.reports, truth, world)
        outside = smfeval_metrics(replay.reports, truth, world)
        stamps = np.array([r.stamp_ns for r in replay.reports], np.int64)
        true_xy = world.points(interpolate(truth.stamps_ns, truth.world_T_robot, stamps)[:, :3, 3])[:, :2]
    return Localized(replay, Track(replay.reports, replay.distance, errors, true_xy), outside)


PATIENCE = 120.0
"""Metres after which a start counts as one without an end: ten times what the thesis's worst start took."""


def starts_along(w: Work, configs: dict[str, Config], n: int, progress: Progress) -> None:
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
        world = world_or_note(w, map_name, truth)
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
