"""The figures of the thesis's chapter 5, for all methods beside each other. Green is ours, red the thesis's, black the truth."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from scipy.stats import norm

from topograph.evaluate.chapter5 import Start
from topograph.evaluate.comparison import BEST, OURS, WRITTEN, Comparison, Track
from topograph.report.figures import BAD, PATH, TREE, _png

COLORS = {OURS: TREE, BEST: BAD, WRITTEN: "#e08214"}
MARKS = {OURS: "o", BEST: "s", WRITTEN: "^"}
"""Told apart without colours too."""
OTHER = "#762a83"


def figures(c: Comparison) -> dict[str, bytes]:
    """Caption -> PNG of each figure that the comparison has data for."""
    out: dict[str, bytes] = {}
    if c.sight is not None:
        out["Fig. 5.6: detections of one sweep, right and wrong"] = detections_figure(c)
    out["Fig. 5.7: the maps over each other"] = maps_figure(c)
    if any(len(e.node) for e in c.nodes.values()):
        out["Fig. 5.8: error of each node"] = nodes_figure(c)
        out["Fig. 5.9: histogram of the nodes' errors"] = histogram_figure(c)
    for n, run in enumerate(c.runs):
        tracks = {name: t for (name, r), t in c.tracks.items() if r == run}
        if not tracks:
            continue
        number = {0: "5.10", 1: "5.12", 2: "5.13"}.get(n, "5.13")
        out[f"Fig. {number}: localization of {run}"] = paths_figure(c, tracks)
        if any(t.errors is not None and len(t.errors.stamps_ns) for t in tracks.values()):
            out[f"Fig. 5.11: errors over time, {run}"] = errors_figure(tracks)
    if c.starts:
        out["Fig. 5.14: convergence distance"] = convergence_figure(c.starts)
        out["Fig. 5.15: convergence by trees in view"] = by_trees_figure(c.starts)
    return out


def detections_figure(c: Comparison) -> bytes:
    """One sweep from above, a panel a method: right trunks as dots, wrong ones as crosses, trees as circles (Fig. 5.6)."""
    assert c.sight is not None
    s = c.sight
    figure = Figure(figsize=(5.2 * len(s.trunks), 5.0))
    for k, (name, (p, right)) in enumerate(s.trunks.items()):
        ax = figure.add_subplot(1, len(s.trunks), k + 1)
        ax.plot(s.trees[:, 0], s.trees[:, 1], "o", ms=11, mfc="none", mec="#777777", label="tree")
        ax.plot(p[right, 0], p[right, 1], "o", ms=5, color=TREE, label=f"right ({int(right.sum())})")
        ax.plot(p[~right, 0], p[~right, 1], "x", ms=7, mew=1.8, color=BAD, label=f"wrong ({int((~right).sum())})")
        ax.plot(0, 0, "k^", ms=8)
        ax.set_xlim(-30, 30)
        ax.set_ylim(-30, 30)
        ax.set_aspect("equal")
        ax.set_title(name)
        ax.set_xlabel("x [m], forward")
        ax.legend(fontsize=8, loc="upper right")
        ax.grid(alpha=0.2)
    figure.tight_layout()
    return _png(figure)


def _shown(c: Comparison) -> list[str]:
    return [m for m in (OURS, BEST, WRITTEN) if m in c.maps]


def maps_figure(c: Comparison) -> bytes:
    """Both maps over each other, with the truth and the path."""
    figure = Figure(figsize=(9, 7))
    ax = figure.add_subplot()
    ours = c.maps[OURS]
    if c.underlay is not None:
        ax.imshow(c.underlay.pixels, extent=c.underlay.extent, zorder=0)
    ax.plot(*ours.map_T_robot[:, :2, 3].T, color=PATH, lw=0.8, alpha=0.7, label="path")
    if c.trees is not None:
        ax.plot(*c.trees.T, "k+", ms=11, mew=1.4, label="truth", zorder=5)
    shift = np.zeros(2)
    for name in _shown(c):
        topo = c.maps[name].trees()
        if name != OURS and topo.datum is not None and ours.datum is not None:
            shift = ours.datum.to_enu(topo.datum.to_geodetic(np.zeros((1, 3))))[0, :2]
        xy = topo.p[:, :2] + (0 if name == OURS else shift)
        face = COLORS[name] if name == OURS else "none"
        ax.plot(*xy.T, MARKS[name], ms=7, mec=COLORS[name], mfc=face, ls="", alpha=0.85, label=f"{name} ({len(topo)})")
    ax.set_aspect("equal")
    ax.set_xlabel("x [m]")
    ax.set_ylabel("y [m]")
    ax.grid(alpha=0.2)
    ax.legend(fontsize=8)
    return _png(figure)


def nodes_figure(c: Comparison) -> bytes:
    """A bar a tree and method, with min, mean and max (Fig. 5.8)."""
    names = [m for m in _shown(c) if m in c.nodes and len(c.nodes[m].node)]
    figure = Figure(figsize=(10, 4))
    ax = figure.add_subplot()
    wide = 0.8 / max(len(names), 1)
    for k, name in enumerate(names):
        e = c.nodes[name]
        d = np.hypot(*e.above.T)
        ax.bar(e.tree + (k - 0.5 * (len(names) - 1)) * wide, d, wide, color=COLORS[name],
               label=f"{name}: min {d.min():.3f}, mean {d.mean():.3f}, max {d.max():.3f} m")  # fmt: skip
        ax.axhline(float(d.mean()), color=COLORS[name], lw=1, ls="--")
    ax.set_xlabel("tree of the truth")
    ax.set_ylabel("error at 0.8 m [m]")
    ax.legend(fontsize=8)
    ax.grid(alpha=0.3, axis="y")
    return _png(figure)


def histogram_figure(c: Comparison) -> bytes:
    """Errors of the nodes, one panel (Fig. 5.9); nothing is clipped."""
    names = [m for m in _shown(c) if m in c.nodes and len(c.nodes[m].node)]
    figure = Figure(figsize=(8, 4))
    ax = figure.add_subplot()
    all_d = np.concatenate([np.hypot(*c.nodes[m].above.T) for m in names])
    bins = np.linspace(0, max(float(all_d.max()), 0.05) * 1.0001, 26).tolist()
    for name in names:
        d = np.hypot(*c.nodes[name].above.T)
        ax.hist(d, bins, color=COLORS[name], alpha=0.6, label=f"{name}, mean {d.mean():.3f} m")
    ax.set_xlabel("error at 0.8 m [m]")
    ax.set_ylabel("nodes")
    ax.legend(fontsize=8)
    return _png(figure)


def paths_figure(c: Comparison, tracks: dict[str, Track]) -> bytes:
    """Where each method had the robot, a panel each: from trees (green) or from odometry alone (blue), and the truth (Figs. 5.10-5.13)."""
    figure = Figure(figsize=(5.2 * len(tracks), 5.2))
    for k, (name, t) in enumerate(tracks.items()):
        ax = figure.add_subplot(1, len(tracks), k + 1)
        topo = c.maps.get(name, c.maps[OURS]).trees()
        ax.plot(topo.p[:, 0], topo.p[:, 1], ".", color="#aaaaaa", ms=5, label="nodes")
        if t.true_xy is not None:
            ax.plot(*t.true_xy.T, color="black", lw=1.2, label="truth")
        fixes = [(r.fix.map_T_robot[:2, 3], len(r.trees) > 0) for r in t.reports if r.fix is not None]
        if fixes:
            xy, seen = np.array([f for f, _ in fixes]), np.array([s for _, s in fixes])
            ax.plot(*xy[seen].T, ".", ms=3, color=TREE, label="from trees")
            ax.plot(*xy[~seen].T, ".", ms=3, color=PATH, label="from odometry alone")
        share = len(fixes) / max(len(t.reports), 1)
        ax.set_title(f"{name}\na pose for {100 * share:.0f} % of the scans", fontsize=10)
        ax.set_aspect("equal", adjustable="datalim")
        ax.grid(alpha=0.2)
        ax.set_xlabel("x [m]")
        ax.legend(fontsize=7)
    figure.tight_layout()
    return _png(figure)


def errors_figure(tracks: dict[str, Track]) -> bytes:
    """Errors in x, y and distance over time, with their means (Fig. 5.11)."""
    figure = Figure(figsize=(9, 6))
    axes = [figure.add_subplot(3, 1, k + 1) for k in range(3)]
    known = {n: t.errors for n, t in tracks.items() if t.errors is not None and len(t.errors.stamps_ns)}
    begin = min(int(e.stamps_ns[0]) for e in known.values())
    for name, e in known.items():
        seconds = (e.stamps_ns - begin) * 1e-9
        for ax, v in zip(axes, (e.xy[:, 0], e.xy[:, 1], np.hypot(*e.xy.T)), strict=True):
            ax.plot(seconds, v, MARKS.get(name, "."), ms=2, ls="", color=COLORS.get(name, OTHER),
                    label=f"{name}: mean {np.abs(v).mean():.3f} m")  # fmt: skip
    for ax, label in zip(axes, ("x [m]", "y [m]", "distance [m]"), strict=True):
        ax.set_ylabel(label)
        ax.grid(alpha=0.3)
        ax.legend(fontsize=7)
    axes[2].set_xlabel("t [s]")
    figure.tight_layout()
    return _png(figure)


def convergence_figure(starts: dict[str, list[Start]]) -> bytes:
    """Distance to the first pose, histogram and normal fit (Fig. 5.14); wrong ends and starts without an end are counted."""
    figure = Figure(figsize=(3.4 * len(starts), 3.6))
    right = {n: np.array([x.distance for x in s if np.isfinite(x.distance) and not x.wrong]) for n, s in starts.items()}
    top = max((float(d.max()) for d in right.values() if len(d)), default=1.0)
    for k, (name, found) in enumerate(starts.items()):
        ax = figure.add_subplot(1, len(starts), k + 1)
        d = right[name]
        if len(d):
            ax.hist(d, np.linspace(0, max(top, 0.1) * 1.001, 13).tolist(), color=COLORS.get(name, OTHER), alpha=0.7)
            x = np.linspace(0, max(top, 0.1), 200)
            if d.std() > 0:
                width = max(top, 0.1) / 12
                ax.plot(x, len(d) * width * norm.pdf(x, d.mean(), d.std()), "k", lw=1)
        wrong, never = sum(s.wrong for s in found), sum(not np.isfinite(s.distance) for s in found)
        mean = f"{d.mean():.1f} ± {d.std():.1f} m" if len(d) else "–"
        ax.set_title(f"{name}\n{mean}; {wrong} wrong, {never} without an end of {len(found)}", fontsize=8)
        ax.set_xlabel("distance driven [m]")
    figure.tight_layout()
    return _png(figure)


def by_trees_figure(starts: dict[str, list[Start]]) -> bytes:
    """Mean distance to a right pose by the trunks in view on the way (Fig. 5.15)."""
    figure = Figure(figsize=(8, 3.6))
    ax = figure.add_subplot()
    wide = 0.8 / max(len(starts), 1)
    for k, (name, found) in enumerate(starts.items()):
        groups = _by_trees(found)
        ax.bar([n + (k - 0.5 * (len(starts) - 1)) * wide for n in groups], [float(np.mean(v)) for v in groups.values()], wide,
               color=COLORS.get(name, OTHER), label=name)  # fmt: skip
    ax.set_xlabel("trunks within 10 m, median on the way")
    ax.set_ylabel("distance to a right pose [m]")
    ax.legend(fontsize=8)
    return _png(figure)


def _by_trees(found: Sequence[Start]) -> dict[int, list[float]]:
    out: dict[int, list[float]] = {}
    for s in found:
        if np.isfinite(s.distance) and not s.wrong:
            out.setdefault(s.trees, []).append(s.distance)
    return dict(sorted(out.items()))


__all__: list[Any] = ["figures"]
