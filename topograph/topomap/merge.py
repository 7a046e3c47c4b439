"""A further run's map into an older one of the same frame."""

from __future__ import annotations

import json
from collections import defaultdict

import numpy as np
from numpy.typing import NDArray

from topograph.geometry import Array
from topograph.topomap.edges import TopomapConfig, among
from topograph.topomap.map import OTHER, TREE, TopoMap, Viewpoint
from topograph.topomap.rows import find_rows
from topograph.topomap.sessions import Seen


def merge(
    old: TopoMap,
    new: TopoMap,
    tree_of_old: NDArray[np.int64],
    config: TopomapConfig,
    passed: NDArray[np.int64] | None = None,
) -> TopoMap:
    """`tree_of_old` (T_old,) is the row in `new` that each old tree was seen as, or -1; `passed` (T_old,) scans of the new run that saw
    through the places of old trees.

    The new run was solved with the old trees as priors, so its values for them are the joint ones. Ids of old trees
    stay; sightings add up; of two viewpoints from the same side the fuller one is kept.
    """
    seen = tree_of_old >= 0
    fresh = np.setdiff1d(np.arange(len(new)), tree_of_old[seen])

    def both(name: str, taken: NDArray[np.bool_] = seen) -> Array:
        a, b = np.array(getattr(old, name)), getattr(new, name)
        a[taken] = b[tree_of_old[taken]]
        return np.concatenate([a, b[fresh]])

    no_worse = seen & ~_surer(old, new, tree_of_old)

    p = both("p")
    sightings = np.concatenate([old.sightings, new.sightings[fresh]])
    sightings[: len(old)][seen] += new.sightings[tree_of_old[seen]]
    ids = np.concatenate([old.ids, int(old.ids.max(initial=0)) + 1 + np.arange(len(fresh))])
    row_of_new = np.full(len(new), -1)
    row_of_new[tree_of_old[seen]] = np.flatnonzero(seen)
    row_of_new[fresh] = len(old) + np.arange(len(fresh))
    views = list(old.viewpoints)
    of_tree: dict[int, list[int]] = defaultdict(list)
    for i, v in enumerate(views):
        of_tree[v.tree].append(i)
    for v in new.viewpoints:
        moved = Viewpoint(int(row_of_new[v.tree]), v.direction, v.cloud, v.session + len(old.sessions))
        mine = of_tree[moved.tree]
        twin = [i for i in mine if float(views[i].direction @ v.direction) > config.viewpoint_cosine]
        if not twin:
            mine.append(len(views))
            views.append(moved)
        elif len(v.cloud) > len(views[twin[0]].cloud):
            views[twin[0]] = moved
    told = _told_better(old, new, tree_of_old)
    kind, chance, stems = (
        np.concatenate([np.where(told, getattr(new, k)[tree_of_old], getattr(old, k)), getattr(new, k)[fresh]])
        if len(new)
        else getattr(old, k)
        for k in ("kind", "kind_probability", "stems")
    )
    edges = among(p[:, :2], kind == TREE, config)
    stamps = np.concatenate([old.stamps_ns, new.stamps_ns])
    poses = np.concatenate([old.map_T_robot, new.map_T_robot])
    row = np.full(len(p), -1, np.int64)
    row[kind == TREE] = find_rows(p[kind == TREE, :2], poses[:, :2, 3])
    return TopoMap(
        datum=old.datum,
        ids=ids.astype(np.int64),
        p=p,
        cov=both("cov", no_worse),
        axis=both("axis"),
        lean_sigma=both("lean_sigma", no_worse),
        known_at=both("known_at", no_worse),
        diameter=both("diameter"),
        first_branch=both("first_branch"),
        sightings=sightings,
        score=both("score"),
        row=row,
        kind=kind,
        kind_probability=chance,
        stems=stems,
        edges=edges,
        lengths=np.linalg.norm(p[edges[:, 0]] - p[edges[:, 1]], axis=1),
        viewpoints=tuple(views),
        stamps_ns=stamps,
        map_T_robot=poses,
        datum_cov=old.datum_cov,
        meta=new.meta | {"inputs": _inputs(old, new)},
        sessions=(*old.sessions, *new.sessions),
        session=np.concatenate([_of_poses(old), _of_poses(new) + len(old.sessions)]),
        seen=_seen(old, new, row_of_new, np.flatnonzero(~seen), passed),
    )


def _of_poses(topo: TopoMap) -> NDArray[np.int64]:
    """Session (K,) of each pose; maps of older programs had none."""
    return topo.session if len(topo.session) == len(topo.stamps_ns) else np.zeros(len(topo.stamps_ns), np.int64)


def _inputs(old: TopoMap, new: TopoMap) -> str:
    """All files that either was made of, as JSON."""
    return json.dumps([i for t in (old, new) for i in json.loads(t.meta.get("inputs", "[]") or "[]")])


def _seen(
    old: TopoMap,
    new: TopoMap,
    row_of_new: NDArray[np.int64],
    unseen: NDArray[np.int64],
    passed: NDArray[np.int64] | None,
) -> Seen:
    """What both maps' sessions saw, and which old trees the new session looked for and did not see, rows `unseen`."""
    out = old.seen.and_(new.seen.moved(row_of_new, len(old.sessions)))
    if passed is None or not new.sessions:
        return out
    unseen = unseen[passed[unseen] > 0]
    none = np.zeros(len(unseen), np.int64)
    session = np.full(len(unseen), len(old.sessions))
    missed = Seen(tree=unseen, session=session, count=none, first_ns=none, last_ns=none, passed=passed[unseen])
    return out.and_(missed)


def _surer(old: TopoMap, new: TopoMap, tree_of_old: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Trees (T_old,) that the old map knows better than the new run: a tree seen again is at least as sure as it was, but what its shape adds to
    its place is added to each run's anew, though it is the same tree.
    """
    if not len(new):
        return np.zeros(len(old), bool)
    before, now = (np.trace(t.cov[:, :2, :2], axis1=1, axis2=2) for t in (old, new))
    return np.asarray(before < now[tree_of_old])


def _told_better(old: TopoMap, new: TopoMap, tree_of_old: NDArray[np.int64]) -> NDArray[np.bool_]:
    """(T_old,) trees of which the new run says better what they are: it tells kinds, not merely "something else", from as
    many sightings as the old map had, or the old map had been told nothing.
    """
    if not len(new):
        return np.zeros(len(old), bool)
    tells = (tree_of_old >= 0) & np.isfinite(new.kind_probability[tree_of_old]) & (new.kind[tree_of_old] != OTHER)
    return np.asarray(tells & (np.isnan(old.kind_probability) | (new.sightings[tree_of_old] >= old.sightings)))
