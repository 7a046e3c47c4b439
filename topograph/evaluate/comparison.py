"""A comparison, as tables and figures need it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from topograph.evaluate.chapter5 import NodeErrors, Sight, Start
from topograph.evaluate.localization import LocalizationErrors
from topograph.evaluate.metrics import Metric
from topograph.evaluate.statistics import bootstrap, wilson
from topograph.exchange import Underlay
from topograph.geometry import Array
from topograph.localize import Report
from topograph.topomap import TopoMap

OURS, WRITTEN, BEST = "graph", "thesis as written", "thesis at its best"
"""What is compared: the factor graph, Algorithms 1-6 to the letter, and with every kindness that is known but eq. 4.14, which is the method (table A
has the plain mean on the same detections)."""


@dataclass(frozen=True, slots=True)
class Row:
    """A line of a table: which table, what of which run, and its figures."""

    table: str
    name: str
    run: str
    metrics: list[Metric]


@dataclass(frozen=True, slots=True)
class Track:
    """A run localized by one method.

    Attributes:
        reports, distance: one per scan; metres driven.
        errors: of the committed scans, or None without a truth.
        true_xy: (S, 2) where the robot was, in the map's frame, m, or None.
    """

    reports: Sequence[Report]
    distance: Sequence[float]
    errors: LocalizationErrors | None
    true_xy: Array | None


@dataclass(slots=True, kw_only=True)
class Comparison:
    """All that the tables and figures are drawn from.

    Attributes:
        runs: names of the runs; the first one is mapped.
        rows: of all tables.
        maps: name of a method -> its map; `nodes` its errors; `trees` (T, 2) the truth in ours, or None.
        tracks: (method, run) -> how the whole chain localized it.
        starts: method -> starts in the first run.
        sight: a scan of the first run, or None.
        underlay: a picture of the place, in our map's frame, or None.
        notes: what had to be left out, and why.
    """

    runs: list[str] = field(default_factory=list)
    rows: list[Row] = field(default_factory=list)
    maps: dict[str, TopoMap] = field(default_factory=dict)
    nodes: dict[str, NodeErrors] = field(default_factory=dict)
    trees: Array | None = None
    tracks: dict[tuple[str, str], Track] = field(default_factory=dict)
    starts: dict[str, list[Start]] = field(default_factory=dict)
    sight: Sight | None = None
    underlay: Underlay | None = None
    notes: list[str] = field(default_factory=list)

    def summary(self) -> list[Figure]:
        """Each figure of each table over the runs, with its interval: what `metrics.json` holds."""
        found: dict[tuple[str, str, str], list[Metric]] = {}
        for r in self.rows:
            for m in r.metrics:
                found.setdefault((r.table, r.name, m.name), []).append(m)
        return [_figure(key, ms) for key, ms in found.items()]


@dataclass(frozen=True, slots=True, kw_only=True)
class Figure:
    """One figure over the runs: `n` of them, and the 95 % interval (low, high), NaN where one run says nothing of it."""

    table: str
    name: str
    metric: str
    value: float
    unit: str
    better: str
    n: int
    low: float
    high: float


def _figure(key: tuple[str, str, str], metrics: Sequence[Metric]) -> Figure:
    values = np.array([m.value for m in metrics], float)
    known = values[np.isfinite(values)]
    value = float(known.mean()) if len(known) else float("nan")
    low, high = bootstrap(known.tolist())
    return Figure(
        table=key[0], name=key[1], metric=key[2], value=value, unit=metrics[0].unit, better=metrics[0].better, n=len(known), low=low, high=high,
    )  # fmt: skip


def wrong_starts(starts: Sequence[Start]) -> tuple[int, int, float, float]:
    """Starts that ended wrong, of how many that ended, and the Wilson interval of their share."""
    ended = [s for s in starts if np.isfinite(s.distance)]
    wrong = sum(s.wrong for s in ended)
    return wrong, len(ended), *wilson(wrong, len(ended))
