"""Pictures of maps, residuals, scans and comparisons, as PNG bytes."""

from __future__ import annotations

import io
from collections.abc import Mapping
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Ellipse

from topograph.bags import Scan, Trunks
from topograph.geometry import Array, Stamps, transform
from topograph.topomap import TopoMap

matplotlib.use("Agg")

TREE, EDGE, PATH, TRUE, BAD = "#1b7837", "#b8c4bb", "#2166ac", "#d6604d", "#b2182b"
POST = "#7b5c3e"


def _png(figure: Figure) -> bytes:
    out = io.BytesIO()
    figure.savefig(out, format="png", dpi=110, bbox_inches="tight")
    return out.getvalue()


def _axes(width: float = 9.0, height: float = 7.5) -> tuple[Figure, Any]:
    figure = Figure(figsize=(width, height))
    return figure, figure.add_subplot()


def map_figure(topo: TopoMap, true_trees: Array | None = None, title: str = "") -> bytes:
    """The map from above: edges, path, trees with their diameters and ten-fold 95 % ellipses, what else stands there, and
    the truth if given.
    """
    figure, ax = _axes()
    others = ~topo.is_tree
    if others.any():
        ax.plot(*topo.p[others, :2].T, "s", color=POST, ms=4, zorder=3, label="post, pole")
    topo = topo.trees()
    for a, b in topo.edges:
        ax.plot(*topo.p[[a, b], :2].T, color=EDGE, lw=0.8, zorder=1)
    if len(topo.stamps_ns):
        ax.plot(*topo.map_T_robot[:, :2, 3].T, color=PATH, lw=1.0, zorder=2, label="path")
    if true_trees is not None:
        ax.plot(*true_trees[:, :2].T, "+", color=TRUE, ms=9, mew=1.2, zorder=4, label="truth")
    radii, angle = topo.ellipses()
    for i in range(len(topo)):
        d = topo.diameter[i] if np.isfinite(topo.diameter[i]) else 0.2
        ax.add_patch(Circle(tuple(topo.p[i, :2]), max(0.5 * d, 0.1), color=TREE, zorder=3))
        if np.isfinite(topo.cov[i]).all():
            size = 2 * 10 * radii[i]
            ax.add_patch(
                Ellipse(
                    tuple(topo.p[i, :2]),
                    size[0],
                    size[1],
                    angle=np.degrees(angle[i]),
                    fill=False,
                    color=TREE,
                    lw=0.6,
                    alpha=0.7,
                )
            )
    if len(topo) <= 80:
        for i in range(len(topo)):
            ax.annotate(
                str(topo.ids[i]),
                topo.p[i, :2],
                xytext=(4, 4),
                textcoords="offset points",
                fontsize=7,
                color="#444444",
            )
    ax.plot([], [], "o", color=TREE, label="tree (95 % ellipse ×10)")
    ax.set_aspect("equal")
    frame = "east, north of the datum" if topo.datum is not None else "local frame, not georeferenced"
    ax.set_xlabel(f"x [m] ({frame})")
    ax.set_ylabel("y [m]")
    ax.set_title(title or f"{len(topo)} trees, {len(topo.edges)} edges")
    ax.grid(alpha=0.2)
    ax.legend(loc="best", fontsize=8)
    return _png(figure)


def tree_error_figure(error: Array, title: str = "Errors of the trees") -> bytes:
    """Histogram of tree errors (M,), m (the thesis's Fig. 5.9)."""
    figure, ax = _axes(6.5, 3.6)
    ax.hist(100 * error, bins=min(30, max(8, len(error) // 2)), color=TREE, alpha=0.85)
    ax.axvline(100 * float(np.mean(error)), color=BAD, lw=1.2, label=f"mean {100 * np.mean(error):.1f} cm")
    ax.set_xlabel("horizontal error [cm]")
    ax.set_ylabel("trees")
    ax.set_title(title)
    ax.legend()
    return _png(figure)


def residual_figure(residuals: Mapping[str, Array]) -> bytes:
    """Normalised residuals by factor type, against the Gaussian that they should follow."""
    shown = {k: v[np.isfinite(v)] for k, v in residuals.items() if np.isfinite(v).any()}
    figure = Figure(figsize=(2.6 * max(len(shown), 1), 2.7))
    x = np.linspace(-5, 5, 201)
    for k, (name, r) in enumerate(shown.items()):
        ax = figure.add_subplot(1, len(shown), k + 1)
        ax.hist(np.clip(r, -5, 5), bins=41, range=(-5, 5), density=True, color=PATH, alpha=0.75)
        ax.plot(x, np.exp(-0.5 * x**2) / np.sqrt(2 * np.pi), color=BAD, lw=1)
        ax.set_title(f"{name} (n={len(r)})", fontsize=9)
        ax.set_yticks([])
        ax.set_xlabel("σ", fontsize=8)
    figure.tight_layout()
    return _png(figure)


WINDOWS = 120
"""Parts of a run whose residuals are summed up."""


def residual_time_figure(residuals: Mapping[str, Array], stamps_ns: Mapping[str, Stamps], start_ns: int) -> bytes:
    """Size of the normalised residuals (R,) by factor type over the time since `start_ns`: middle and 95th percentile of each part of the run."""
    shown = {
        k: (v, stamps_ns[k])
        for k, v in residuals.items()
        if np.isfinite(v).any() and len(stamps_ns.get(k, ())) == len(v)
    }
    figure = Figure(figsize=(9, 1.5 * max(len(shown), 1) + 0.6))
    first = None
    for k, (name, (r, ns)) in enumerate(shown.items()):
        first = ax = figure.add_subplot(len(shown), 1, k + 1, sharex=first)
        finite = np.isfinite(r)
        t, size = (ns[finite] - start_ns) * 1e-9, np.abs(r[finite])
        ends = np.linspace(t.min(), max(t.max(), t.min() + 1e-3), WINDOWS + 1)
        part = np.clip(np.searchsorted(ends, t, side="right") - 1, 0, WINDOWS - 1)
        order = np.argsort(part, kind="stable")
        which, begins = np.unique(part[order], return_index=True)
        groups = np.split(size[order], begins[1:])
        middle = 0.5 * (ends[:-1] + ends[1:])
        high, low = np.full(WINDOWS, np.nan), np.full(WINDOWS, np.nan)  # a gap stays one
        high[which], low[which] = [np.percentile(g, 95) for g in groups], [np.median(g) for g in groups]
        ax.plot(middle, high, ".-", ms=2, color=BAD, lw=1, label="95th percentile")
        ax.plot(middle, low, ".-", ms=2, color=PATH, lw=1, label="middle")
        for level, color in ((1.96, BAD), (0.674, PATH)):
            ax.axhline(level, color=color, lw=0.7, ls="--", alpha=0.7)
        ax.set_ylabel(f"{name} [σ]", fontsize=8)
        ax.set_ylim(bottom=0)
        ax.grid(alpha=0.2)
    if shown:
        figure.axes[0].legend(fontsize=7, loc="upper right")
        figure.axes[-1].set_xlabel("t [s], since the recording began")
    figure.tight_layout()
    return _png(figure)


def scan_figure(scan: Scan, base_T_lidar: Array, trunks: Trunks, true: Array | None = None) -> bytes:
    """One sweep from above with its trunks (circles of their diameter, 95 % ellipses), and true trees (N, 2) if given."""
    figure, ax = _axes(10, 9)
    finite = np.isfinite(scan.xyz).all(axis=1)
    p = transform(base_T_lidar, scan.xyz[finite])
    near = np.hypot(p[:, 0], p[:, 1]) < 35
    dots = ax.scatter(p[near, 0], p[near, 1], s=0.8, c=np.clip(p[near, 2], -1, 3), cmap="viridis", linewidths=0)
    figure.colorbar(dots, ax=ax, shrink=0.7, label="z in base_link [m]")
    for i in range(len(trunks)):
        ax.add_patch(
            Circle(
                tuple(trunks.p[i, :2]),
                max(0.5 * float(trunks.diameter[i]), 0.1),
                color=BAD,
                fill=False,
                lw=1.2,
            )
        )
        ax.add_patch(Circle(tuple(trunks.p[i, :2]), 0.6, color=BAD, fill=False, lw=0.6))
        ax.annotate(f"{trunks.score[i]:.1f}", trunks.p[i, :2], xytext=(6, 6), textcoords="offset points", fontsize=7)
    if true is not None:
        ax.plot(*true[:, :2].T, "+", color="black", ms=8, label="trees (truth)")
        ax.legend(loc="upper right")
    ax.plot(0, 0, "k^", ms=8)
    limit = max(12.0, float(np.hypot(trunks.p[:, 0], trunks.p[:, 1]).max(initial=0.0)) + 3.0)
    ax.set_xlim(-limit, limit)
    ax.set_ylim(-limit, limit)
    ax.set_aspect("equal")
    ax.set_xlabel("x [m], base_link, forward")
    ax.set_ylabel("y [m], left")
    ax.set_title(f"{len(trunks)} trunks (numbers: log-odds)")
    return _png(figure)
