"""Straight lines from a run to a map."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from topograph.config import Config
from topograph.estimate import Estimate, average, path_at
from topograph.evaluate import Metric, fix_metrics
from topograph.geometry import transform
from topograph.mapping import KnownMap, MappingConfig, Placed, Progress, Solved, map_T_scans, silent, solve_session
from topograph.session import Session
from topograph.topomap import SessionRecord, TopoMap, build, merge
from topograph.trees import Existence, in_order, seen_through, shapes


def solve_run(
    run: Session,
    config: Config,
    *,
    check_fixes: int = 0,
    known: TopoMap | None = None,
    placed: Placed | None = None,
    progress: Progress = silent,
) -> Solved:
    """`mapping.solve_session` with the settings of a whole run, and a map as it is stored."""
    old = None if known is None else known_map(known)
    return solve_session(
        run, mapping_config(config), check_fixes=check_fixes, known=old, placed=placed, progress=progress
    )


def mapping_config(config: Config) -> MappingConfig:
    """The blocks of a configuration that the loop is told."""
    return MappingConfig(config.motion, config.trees, config.estimate)


def known_map(topo: TopoMap) -> KnownMap:
    """What the loop needs of a map."""
    return KnownMap(topo.p, topo.cov, topo.axis, topo.datum)


def why_no_trees(solved: Solved) -> str:
    """One line on why a map has no trees; "" when it has some."""
    if solved.problem.n_trees:
        return ""
    if solved.run.scans == 0:
        return "no trunks: the recording has no point cloud and no trunk detections (name one with --topic-points or --topic-trunks)"
    return f"no trunks: none of {solved.run.scans} scans showed a tree often enough to be mapped"


def topo_map(solved: Solved, config: Config, meta: dict[str, str], *, clouds: bool = True) -> TopoMap:
    """The map of a solved run, with its viewpoint clouds or without."""
    return build(
        solved.estimate,
        solved.detections,
        in_order(solved.run.trunks) if clouds else [],
        map_T_scans(solved),
        solved.existence,
        solved.shapes,
        solved.problem.datum,
        config.topomap,
        meta,
        _record(solved, meta),
    )


def _record(solved: Solved, meta: dict[str, str]) -> SessionRecord:
    """The run as a session of a map."""
    stamps = solved.estimate.stamps_ns
    return SessionRecord(
        name=solved.run.id,
        start_ns=int(stamps[0]),
        end_ns=int(stamps[-1]),
        distance=float(solved.motion.distance[-1]),
        inputs=meta.get("inputs", "[]"),
        verdict=meta.get("verdict", ""),
    )


def baseline(solved: Solved, config: Config) -> tuple[Estimate, TopoMap]:
    """The thesis's map of the same detections: Algorithm 3 with filtered poses, nodes with few sightings left out.

    The thesis kept every node; without a bound each false detection would be a tree. The same bound as ours is used.
    """
    e = average.solve(solved.problem, config.estimate)
    hits = np.bincount(e.tree[e.tree >= 0], minlength=len(e.trees))
    keep = hits >= config.trees.min_sightings
    name = np.where(keep, np.cumsum(keep) - 1, -1)
    tree = np.where(e.tree >= 0, name[np.maximum(e.tree, 0)], -1)
    e = replace(e, trees=e.trees[keep], tree_cov=e.tree_cov[keep], tree=tree)
    poses = path_at(e.stamps_ns, e.map_T_robot, solved.motion, solved.detections.stamps_ns)
    n = int(keep.sum())
    all_trees = Existence(
        ok=np.ones(n, bool),
        kind=np.zeros(n, np.int64),
        probability=np.full(n, np.nan),
        score=np.zeros(n),
        hits=hits[keep],
        passed=np.zeros(n, np.int64),
    )
    topo = build(
        e,
        solved.detections,
        [],
        poses,
        all_trees,
        shapes(solved.detections, tree, poses, n),
        solved.problem.datum,
        config.topomap,
        {"method": "thesis"},
    )
    return e, topo


def residual_metrics(solved: Solved) -> list[Metric]:
    """What can be said without truth: loops, doubles are in the map's metrics; here residuals and held-out fixes."""
    e, s = solved.estimate, solved.problem.sightings
    out = [
        Metric("keyframes", len(e.stamps_ns)),
        Metric("distance driven", float(solved.motion.distance[-1]), "m"),
        Metric("loops closed", solved.loops),
    ]
    if len(s):
        seen = transform(e.map_T_robot[s.keyframe], s.p) - e.trees[s.tree]
        r = np.linalg.norm(seen[:, :2], axis=1)
        out.append(Metric("trunk residual median", float(np.median(r)), "m", "lower"))
        out.append(Metric("trunk sightings", int(s.count.sum())))
    if len(solved.held_out) and solved.problem.datum is not None:
        streams, i = solved.run.streams, solved.held_out
        inside = (streams.fix_ns[i] >= e.stamps_ns[0]) & (streams.fix_ns[i] <= e.stamps_ns[-1])
        i = i[inside]
        poses = path_at(e.stamps_ns, e.map_T_robot, solved.motion, streams.fix_ns[i])
        mount = solved.run.mounts.get("fix")
        antenna = transform(poses, np.zeros(3) if mount is None else mount[:3, 3])
        fix = solved.problem.datum.to_enu(streams.lat_lon_h[i])
        out += fix_metrics(antenna, fix, np.sqrt(streams.fix_cov[i, 0, 0]))
    return out


def extend(old: TopoMap, new: TopoMap, solved: Solved, config: Config) -> TopoMap:
    """The old map with a further run in it: trees seen again are updated, the others kept, new ones added."""
    known = solved.problem.known
    assert known is not None
    passed = seen_through(solved.detections, map_T_scans(solved), known.p)
    return merge(old, new, known.tree, config.topomap, passed)
