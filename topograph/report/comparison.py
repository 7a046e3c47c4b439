"""Tables and page of a comparison."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from topograph.evaluate import Metric
from topograph.evaluate.comparison import Comparison, Figure, wrong_starts
from topograph.evaluate.metrics import plain
from topograph.report.chapter5 import figures
from topograph.report.page import show
from topograph.report.templates import render
from topograph.whole import write_text

ABOUT = {
    "5.1 a sweep": (
        "Table 5.1, per sweep",
        "Trunks of each sweep against the trees that showed five returns or more, within 0.5 m. The thesis counted by hand and over a run "
        "(below), and gave no recall.",
    ),
    "5.1 a run": (
        "Table 5.1, per run",
        "Each node of the finished map counted once, as the thesis counts (eq. 5.1: right of all, within 2.5 m), with recall.",
    ),
    "A": (
        "A: the same detections, another estimator",
        "A ladder from the thesis's eq. 4.14 to the graph, on the path of its filter and on the graph's. All rungs have our trunks.",
    ),
    "B": (
        "B: the same map and trunks, another localizer",
        "Our map of the first run and our trunks, whoever localizes.",
    ),
    "C map": (
        "C: whole chain against whole chain, the map",
        "Each method with its own front end, its own path, its own map. At its best the thesis keeps eq. 4.14, which is its method; table A has the plain mean.",
    ),
    "C": ("C: whole chain against whole chain, localization", "Each method in the map that it made of the first run."),
    "2x2x2": (
        "Front end × map × localizer",
        "All eight combinations; the thesis's parts at their best. What the chain's parts are worth.",
    ),
    "convergence": (
        "Convergence",
        "Starts along the first run, each method in its own map; distances of those that came to a right pose (within 1 m).",
    ),
    "5.15": ("Convergence by trees in view", "Median number of trunks within 10 m on the way."),
    "conditions": (
        "Against the thesis's own figures",
        "Its olive orchard is not ours: what differs is switched on, one thing after the other. Its figures come near (with clouds at stops every 2 m: "
        "`simulate --design olive --stop-every 2 --scans-at-stops`) where it had what is given here; its front end finds more that is no tree in these "
        "orchards (grass, suckers, low branches) than the 15 % of its Table 5.1.",
    ),
    "ratios": (
        "Ours over the thesis's",
        "Ratio of the means; its interval is a paired bootstrap over runs, which are the units.",
    ),
    "ablations": ("Ablations", "One part left out in turn, on the first run's detections."),
}
"""Table -> title and what it says."""

COLUMNS = {
    "A": ("nodes", "precision (1 m)", "recall (1 m)", "tree error at 0.8 m, mean", "tree error at 0.8 m, max",
          "tree error at the foot, mean", "tree NEES (2 dof)", "path error mean (horizontal)", "path ATE RMSE (SE(3) aligned)"),
    "B": ("distance to the first pose", "share with a pose after the first", "times lost", "distance error mean", "|x| error mean",
          "|y| error mean", "distance error max", "heading error mean", "share of poses wrong", "smfeval: z of positions (0.92 is right)",
          "update median"),
}  # fmt: skip
"""What a table shows of its metrics; metrics.json has them all."""
COLUMNS["ablations"] = COLUMNS["A"]
COLUMNS["C map"] = (
    "nodes",
    "precision (0.5 m)",
    "precision (1 m)",
    "precision (2.5 m)",
    "recall (2.5 m)",
    *COLUMNS["A"][3:],
)
COLUMNS["C"] = COLUMNS["2x2x2"] = COLUMNS["B"]


@dataclass(frozen=True, slots=True)
class Cell:
    text: str
    interval: str = ""
    best: bool = False


@dataclass(frozen=True, slots=True)
class Line:
    name: str
    cells: list[Cell]


@dataclass(frozen=True, slots=True)
class Table:
    title: str
    about: str
    columns: list[str]
    rows: list[Line]


def tables(c: Comparison) -> list[Table]:
    """The tables of a comparison; the best figure of a column is marked, the interval over runs stands below."""
    found: dict[str, dict[str, dict[str, Figure]]] = {}
    for f in c.summary():
        found.setdefault(f.table, {}).setdefault(f.name, {})[f.metric] = f
    order = [t for t in ABOUT if t in found] + [t for t in found if t not in ABOUT]
    return [_table(t, found[t]) for t in order]


def _table(key: str, rows: Mapping[str, Mapping[str, Figure]]) -> Table:
    title, about = ABOUT.get(key) or (key, "")
    if not about and ": " in key:
        base, _, of = key.partition(": ")
        title = f"{ABOUT[base][0]}: {of}" if base in ABOUT else key
    there = list(dict.fromkeys(m for row in rows.values() for m in row))
    chosen = [m for m in COLUMNS.get(key.partition(": ")[0], there) if m in there]
    best: dict[str, float] = {}
    for m in chosen:
        known = [r[m] for r in rows.values() if m in r and np.isfinite(r[m].value)]
        if known and known[0].better and len(known) > 1:
            best[m] = (min if known[0].better == "lower" else max)(f.value for f in known)
    counted = {m for m in chosen if all(_is_count(r[m]) for r in rows.values() if m in r)}
    lines = [Line(name, [_cell(row.get(m), best.get(m), m in counted) for m in chosen]) for name, row in rows.items()]
    return Table(title, about, chosen, lines)


def _is_count(f: Figure) -> bool:
    return not f.unit and (not np.isfinite(f.value) or float(f.value).is_integer()) and not f.metric.startswith(SHARES)


SHARES = ("share", "precision", "recall", "accuracy", "trunk")
"""Figures between 0 and 1, also where all of a column are 1."""


def _cell(f: Figure | None, best: float | None, count: bool) -> Cell:
    if f is None:
        return Cell("–")
    if count:
        return Cell(f"{f.value:.0f}" if np.isfinite(f.value) else "–", "", best is not None and f.value == best)
    low, high = (show(Metric(f.metric, v, f.unit)) for v in (f.low, f.high))
    interval = f"{low} … {high}" if np.isfinite(f.low) and f.low != f.high else ""
    return Cell(show(Metric(f.metric, f.value, f.unit)), interval, best is not None and f.value == best)


def records(c: Comparison) -> list[dict[str, Any]]:
    """`metrics.json`: key, value, unit, direction, n, interval of every figure."""
    return [
        {
            "key": f"{f.table}/{f.name}/{f.metric}",
            "value": plain(f.value),
            "unit": f.unit,
            "direction": f.better,
            "n": f.n,
            "interval": [plain(f.low), plain(f.high)],
        }
        for f in c.summary()
    ]


def said_of(c: Comparison) -> list[str]:
    """What stands above the tables."""
    out = list(c.notes)
    for name, starts in c.starts.items():
        wrong, n, low, high = wrong_starts(starts)
        out.append(
            f"{name}: {wrong} of {n} starts ended at a wrong place (95 % interval of the share: {low:.3f} to {high:.3f})"
        )
    return out


def write_comparison(path: Path, c: Comparison, facts: Mapping[str, str]) -> dict[str, bytes]:
    """The page, self-contained; returns its pictures."""
    pictures = figures(c) if c.maps else {}
    shown: Sequence[dict[str, str]] = [
        {"caption": k, "data": base64.b64encode(png).decode()} for k, png in pictures.items()
    ]
    title = f"Both methods on {', '.join(c.runs)}"
    page = render("compare.html", title=title, facts=facts, said=said_of(c), tables=tables(c), figures=shown)
    write_text(path, page)
    return pictures
