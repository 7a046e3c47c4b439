"""The thesis's own figures, its method here, and what differs between the two."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from topograph.config import Config
from topograph.errors import TopographError
from topograph.evaluate import Metric, Truth
from topograph.evaluate.chapter5 import node_metrics
from topograph.evaluate.comparison import BEST, WRITTEN, Row
from topograph.pipeline.comparing.runs import without
from topograph.pipeline.comparing.work import Work
from topograph.pipeline.mapping import thesis_map
from topograph.pipeline.read import Heard

THESIS = {
    "tree error at 0.8 m, mean": 0.865,
    "tree error at 0.8 m, min": 0.095,
    "tree error at 0.8 m, max": 2.14,
    "distance error mean": 1.7,
    "convergence mean": 6.1,
    "convergence sd": 3.0,
    "convergence min": 1.0,
    "convergence max": 12.9,
}
"""What 5.4 reports: map; localization of run 1; convergence from 16 starts. m."""


BY_HAND = 0.6
"""Standard deviation per axis of a tree read off a satellite picture, m: its georeference, and a crown that is seen in place of a foot."""


def conditions(w: Work, configs: dict[str, Config]) -> None:
    """The thesis's figures, its method here, and what differs between the two switched on, one after the other."""
    truth, run = w.truths[0], w.first
    if truth is None or not len(truth.trees):
        return
    rows = w.out.rows
    rows.append(Row("conditions", "the thesis (5.4)", run, [Metric(k, v, "m") for k, v in THESIS.items()]))
    heard = w.heard["thesis", run]
    written = configs[WRITTEN]
    no_heading = replace(written, bags=replace(written.bags, topic_heading="none"))
    rng = np.random.default_rng(0)
    by_hand = replace(
        truth,
        trees=truth.trees
        + np.column_stack([rng.normal(0, BY_HAND, (len(truth.trees), 2)), np.zeros(len(truth.trees))]),
    )
    cases: tuple[tuple[str, Heard, Config, Truth], ...] = (
        ("its method as written", heard, written, truth),
        ("... without dual-antenna heading", without(heard, no_heading), no_heading, truth),
        ("... and trees taken from satellite pictures (0.6 m)", without(heard, no_heading), no_heading, by_hand),
        ("its method on our trunks", w.heard["organised", run], written, truth),
        ("... and trees taken from satellite pictures (0.6 m) ", w.heard["organised", run], written, by_hand),
    )
    for name, h, c, t in cases:
        try:
            topo = thesis_map(h.session, c, {})[2]
        except TopographError as err:
            w.out.notes.append(f"{name}: no map ({err})")
            continue
        found = [
            m
            for m in node_metrics(topo, t)
            if m.name in THESIS or m.name.startswith(("nodes", "precision (2.5", "recall (2.5"))
        ]
        rows.append(Row("conditions", name, run, found))
    for name, label in (
        (BEST, "its localizer at its best, its chain"),
        ("thesis's localizer in our map", "its localizer in our map, our trunks"),
    ):
        found = [m for r in rows if r.table == "convergence" and r.name == name for m in r.metrics if m.name in THESIS]
        found += [
            m
            for r in rows
            if r.table == ("C" if name == BEST else "B") and r.name == BEST and r.run == run
            for m in r.metrics
            if m.name in THESIS
        ]
        if found:
            rows.append(Row("conditions", label, run, found))
