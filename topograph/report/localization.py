"""Figures of a localized run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from topograph.evaluate.localization import LocalizationErrors
from topograph.localize import Report
from topograph.report.figures import BAD, PATH, POST, TREE, _png
from topograph.topomap import TopoMap

COLORS = {"searching": "#999999", "ambiguous": "#e0a030", "tracking": TREE, "degraded": "#762a83", "lost": BAD}


def localization_figure(topo: TopoMap, reports: Sequence[Report]) -> bytes:
    """The committed poses on the map, and state, places left and uncertainty over time."""
    figure = Figure(figsize=(11, 5.2))
    ax = figure.add_axes((0.06, 0.1, 0.5, 0.84))
    trees = topo.is_tree
    ax.scatter(topo.p[trees, 0], topo.p[trees, 1], s=18, color=TREE, alpha=0.6, label="mapped trees")
    if not trees.all():
        ax.scatter(topo.p[~trees, 0], topo.p[~trees, 1], s=14, marker="s", color=POST, alpha=0.6, label="mapped posts")
    fixes = [r.fix for r in reports if r.fix is not None]
    if fixes:
        xy = np.array([f.map_T_robot[:2, 3] for f in fixes])
        ax.plot(xy[:, 0], xy[:, 1], ".", ms=2, color=PATH, label="localized")
        ax.plot(*xy[0], "o", color=PATH, mfc="none", ms=10, label="first pose")
    unsure = [r for r in reports if r.fix is None and len(r.places)]
    if unsure:
        ax.scatter(
            unsure[-1].places[:, 0],
            unsure[-1].places[:, 1],
            marker="x",
            color=BAD,
            s=22,
            label="places still possible (last scan without a pose)",
        )
    ax.set_aspect("equal")
    ax.set_xlabel("x [m]")
    ax.set_ylabel("y [m]")
    ax.grid(alpha=0.2)
    ax.legend(loc="best", fontsize=7)
    t = (np.array([r.stamp_ns for r in reports]) - reports[0].stamp_ns) * 1e-9
    top = figure.add_axes((0.64, 0.7, 0.34, 0.24))
    for state, color in COLORS.items():
        mine = np.array([r.state == state for r in reports])
        if mine.any():
            top.plot(
                t[mine],
                np.maximum([r.hypotheses for r, m in zip(reports, mine, strict=True) if m], 0.5),
                ".",
                ms=3,
                color=color,
                label=state,
            )
    top.set_yscale("log")
    top.set_ylabel("places left")
    top.legend(fontsize=7)
    low = figure.add_axes((0.64, 0.4, 0.34, 0.22))
    low.plot(t, [100 * r.along for r in reports], color=PATH, lw=1, label="along the row")
    low.plot(t, [100 * r.across for r in reports], color=BAD, lw=1, label="across")
    low.set_ylabel("σ [cm]")
    low.legend(fontsize=7)
    seen = figure.add_axes((0.64, 0.1, 0.34, 0.22))
    seen.plot(t, [len(r.trees) for r in reports], color=TREE, lw=0.8)
    seen.set_ylabel("trees seen")
    seen.set_xlabel("t [s]")
    for a in (top, low, seen):
        a.grid(alpha=0.2)
    return _png(figure)


def localization_error_figure(errors: Mapping[str, LocalizationErrors]) -> bytes:
    """x, y and distance errors over time (the thesis's Figs. 5.10-5.15), one colour a method."""
    figure = Figure(figsize=(9, 6))
    axes = [figure.add_subplot(3, 1, k + 1) for k in range(3)]
    start = min((int(e.stamps_ns[0]) for e in errors.values() if len(e.stamps_ns)), default=0)
    for (name, e), color in zip(errors.items(), (TREE, BAD, PATH), strict=False):
        t = (e.stamps_ns - start) * 1e-9
        for ax, value in zip(axes, (e.xy[:, 0], e.xy[:, 1], np.hypot(*e.xy.T)), strict=True):
            ax.plot(t, value, ".", ms=2, color=color, label=name)
    for ax, label in zip(axes, ("error in x [m]", "error in y [m]", "distance [m]"), strict=True):
        ax.set_ylabel(label)
        ax.grid(alpha=0.3)
    axes[0].legend(fontsize=8)
    axes[2].set_xlabel("t [s]")
    figure.tight_layout()
    return _png(figure)


def cost_figure(rows: Sequence[Mapping[str, float | str]]) -> bytes:
    """Search and update time, and memory, against the number of trees; `rows` as tools/evaluate_localization.py makes them."""
    figure = Figure(figsize=(9, 3.6))
    for k, (key, label) in enumerate(
        (
            ("search_ms", "full search [ms]"),
            ("update_ms", "median update [ms]"),
            ("bytes_per_tree", "index [bytes a tree]"),
        )
    ):
        ax = figure.add_subplot(1, 3, k + 1)
        for scenario, color in zip(sorted({str(r["scenario"]) for r in rows}), (TREE, BAD, PATH), strict=False):
            mine = [r for r in rows if r["scenario"] == scenario]
            ax.plot(
                [float(r["trees"]) for r in mine],
                [float(r[key]) for r in mine],
                "o-",
                ms=3,
                color=color,
                label=scenario,
            )
        ax.set_xscale("log")
        ax.set_yscale("log")
        ax.set_xlabel("trees")
        ax.set_title(label, fontsize=9)
        ax.grid(alpha=0.3, which="both")
    figure.axes[0].legend(fontsize=8)
    figure.tight_layout()
    return _png(figure)
