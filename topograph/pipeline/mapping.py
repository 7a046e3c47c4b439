"""Straight lines from a run to a map."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from topograph import audit
from topograph.config import Config
from topograph.estimate import Estimate, Problem, average, path_at
from topograph.evaluate import Metric, fix_metrics
from topograph.geometry import Array, transform
from topograph.mapping import (
    KnownMap,
    MappingConfig,
    Placed,
    Prepared,
    Progress,
    Solved,
    map_T_scans,
    prepare,
    silent,
    solve_session,
)
from topograph.session import Session
from topograph.topomap import SessionRecord, TopoMap, build, merge
from topograph.topomap.map import TREE
from topograph.trees import Existence, overdue, seen_through, shapes


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
    solved = solve_session(
        run, mapping_config(config), check_fixes=check_fixes, known=old, placed=placed, progress=progress
    )
    if placed is None:
        said = audit.refused_fixes(solved.problem, solved.estimate)
        run.notes.extend(n for n in said if n not in run.notes)
    return solved


def mapping_config(config: Config) -> MappingConfig:
    """The blocks of a configuration that the loop is told."""
    return MappingConfig(config.motion, config.trees, config.estimate)


def known_map(topo: TopoMap) -> KnownMap:
    """What the loop needs of a map."""
    return KnownMap(topo.p, topo.cov, topo.axis, topo.lean_sigma, topo.known_at, topo.stems, topo.datum)


def why_no_trees(solved: Solved) -> str:
    """One line on why a map has no trees; "" when it has some. Posts are none."""
    trees, posts = int((solved.existence.kind == TREE).sum()), int((solved.existence.kind != TREE).sum())
    if trees:
        return ""
    if posts:
        return f"no trees: of {solved.run.scans} scans, what was seen often enough are {posts} posts (is the LiDAR mounted as TF says?)"
    if solved.run.scans == 0 and {"points", "trunks"} & set(solved.run.chosen):
        return "no trunks: no scan could be used in the part of the recording that was read (see what was skipped, and --from, --to)"
    if solved.run.scans == 0:
        return "no trunks: the recording has no point cloud and no trunk detections (name one with --topic-points or --topic-trunks)"
    return f"no trunks: none of {solved.run.scans} scans showed a tree often enough to be mapped"


def topo_map(solved: Solved, config: Config, meta: dict[str, str], *, clouds: bool = True) -> TopoMap:
    """The map of a solved run, with its viewpoint clouds or without."""
    return build(
        solved.estimate,
        solved.detections,
        solved.run.trunks.in_order() if clouds else None,
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
    return _record_of(solved.run, solved.estimate, float(solved.motion.distance[-1]), meta)


def _record_of(run: Session, e: Estimate, distance: float, meta: dict[str, str]) -> SessionRecord:
    return SessionRecord(
        name=run.id,
        start_ns=int(e.stamps_ns[0]),
        end_ns=int(e.stamps_ns[-1]),
        distance=distance,
        inputs=meta.get("inputs", "[]"),
        verdict=meta.get("verdict", ""),
    )


def averaged(
    problem: Problem,
    run: Session,
    config: Config,
    meta: dict[str, str],
    *,
    path: Array | None = None,
    clouds: bool = True,
) -> tuple[Estimate, TopoMap]:
    """The thesis's map (Algorithm 3) of a problem's detections, with poses of the filter, or a `path` (K, 4, 4) at the keyframes."""
    e = average.solve(problem, config.average, path)
    d = problem.detections
    poses = path_at(e.stamps_ns, e.map_T_robot, problem.motion, d.stamps_ns)
    n = len(e.trees)
    all_trees = Existence(
        ok=np.ones(n, bool),
        kind=np.zeros(n, np.int64),
        probability=np.full(n, np.nan),
        score=np.zeros(n),
        hits=np.bincount(e.tree[e.tree >= 0], minlength=n),
        passed=np.zeros(n, np.int64),
    )
    topo = build(
        e,
        d,
        run.trunks.in_order() if clouds else None,
        poses,
        all_trees,
        shapes(d, e.tree, poses, n),
        problem.datum,
        config.topomap,
        {**meta, "method": "thesis"},
        _record_of(run, e, float(problem.motion.distance[-1]), meta),
    )
    return e, topo


def baseline(solved: Solved, config: Config) -> tuple[Estimate, TopoMap]:
    """The thesis's map of the same detections as the graph had, without clouds."""
    return averaged(solved.problem, solved.run, config, {}, clouds=False)


def thesis_map(
    run: Session, config: Config, meta: dict[str, str], *, check_fixes: int = 0
) -> tuple[Prepared, Estimate, TopoMap]:
    """The thesis's map of a run: all that its front end found, filtered poses, Algorithm 3, viewpoint clouds. No graph is solved."""
    p = prepare(run, mapping_config(config), check_fixes=check_fixes, screened=False)
    return (p, *averaged(p.problem, run, config, meta))


def residual_metrics(solved: Solved) -> list[Metric]:
    """What can be said without truth: loops, doubles are in the map's metrics; here residuals and held-out fixes."""
    e, s = solved.estimate, solved.problem.sightings
    out = [
        Metric("keyframes", len(e.stamps_ns)),
        Metric("distance driven", float(solved.motion.distance[-1]), "m"),
        Metric("loops closed", solved.loops.closed),
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
    T, d, trees = map_T_scans(solved), solved.detections, solved.estimate.trees
    absent = known.tree < 0
    lacking = overdue(d, solved.estimate.tree, T, np.concatenate([trees, known.p[absent]]))
    passed = seen_through(d, T, known.p)
    passed[absent] = np.maximum(passed[absent], lacking[len(trees) :])
    lacking[np.setdiff1d(np.arange(len(trees)), known.tree)] = 0  # what is new cannot be gone
    seen = replace(new.seen, passed=np.maximum(new.seen.passed, lacking[new.seen.tree]))
    return merge(old, replace(new, seen=seen), known.tree, config.topomap, passed)
