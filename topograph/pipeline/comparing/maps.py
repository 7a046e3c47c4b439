"""Table 5.1, A: the same detections and another estimator, and the maps of whole chains."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from topograph.config import Config
from topograph.errors import TopographError
from topograph.estimate.average import Rule
from topograph.evaluate import Metric, trunk_metrics, world_in_map
from topograph.evaluate.chapter5 import node_errors, sight
from topograph.evaluate.comparison import BEST, OURS, WRITTEN, Row
from topograph.exchange import Underlay, read_underlay
from topograph.mapping import Progress
from topograph.pipeline.comparing.work import Work, add_map
from topograph.pipeline.mapping import averaged, solve_run, thesis_map, topo_map
from topograph.pipeline.read import Heard
from topograph.topomap import TopoMap


def detections(w: Work) -> None:
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


def maps(w: Work, configs: dict[str, Config], progress: Progress) -> None:
    """The ladder of table A, and every map that somebody localizes in."""
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
            add_map(w, "A", f"{word}, {path}'s path", topo, truth, (e.stamps_ns, e.map_T_robot))
    flat_path = (flat.estimate.stamps_ns, flat.estimate.map_T_robot)
    add_map(w, "A", "graph without re-association", topo_map(flat, config, {}, clouds=False), truth, flat_path)
    our_path = (solved.estimate.stamps_ns, solved.estimate.map_T_robot)
    add_map(w, "A", "graph", out.maps[OURS], truth, our_path)
    progress("map", 0.5)
    other = w.heard["thesis", first]
    made: dict[str, Callable[[], tuple[TopoMap, Any]]] = {
        "graph on the thesis's trunks": lambda: graph_map(other, config),
        WRITTEN: lambda: own_thesis_map(other, configs[WRITTEN]),
        BEST: lambda: own_thesis_map(other, configs[BEST]),
        "thesis's map of our trunks": lambda: own_thesis_map(heard, configs[BEST]),
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
            add_map(w, "C map", name, out.maps[name], truth, path)
    add_map(w, "C map", OURS, out.maps[OURS], truth, our_path)
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


def per_run(w: Work, configs: dict[str, Config]) -> None:
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
                    topo = (graph_map if name == OURS else own_thesis_map)(heard, c)[0]
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


def graph_map(heard: Heard, config: Config) -> tuple[TopoMap, Any]:
    """Our map of a run, and its path."""
    s = solve_run(heard.session, config)
    return topo_map(s, config, {}), (s.estimate.stamps_ns, s.estimate.map_T_robot)


def own_thesis_map(heard: Heard, config: Config) -> tuple[TopoMap, Any]:
    """The thesis's map of a run, and its path."""
    _, e, topo = thesis_map(heard.session, config, {})
    return topo, (e.stamps_ns, e.map_T_robot)


def underlay(image: Path, topo: TopoMap, notes: list[str]) -> Underlay | None:
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
