"""Straight lines: bags to a map, a map and bags to poses."""

from topograph.mapping import Placed, Solved, map_T_scans
from topograph.pipeline.auditing import audited
from topograph.pipeline.inspecting import Inspection, Role, inspect_bags
from topograph.pipeline.localizing import Replay, localize_bags
from topograph.pipeline.mapping import (
    averaged,
    baseline,
    extend,
    residual_metrics,
    solve_run,
    thesis_map,
    topo_map,
    why_no_trees,
)
from topograph.pipeline.placing import has_no_common_gnss, place, refuse_twice
from topograph.pipeline.read import read_run, scan_near
from topograph.pipeline.replaying import JOURNAL, Played, live_metrics, play

__all__ = [
    "JOURNAL",
    "Inspection",
    "Placed",
    "Played",
    "Replay",
    "Role",
    "Solved",
    "audited",
    "averaged",
    "baseline",
    "extend",
    "has_no_common_gnss",
    "inspect_bags",
    "live_metrics",
    "localize_bags",
    "map_T_scans",
    "place",
    "play",
    "read_run",
    "refuse_twice",
    "residual_metrics",
    "scan_near",
    "solve_run",
    "thesis_map",
    "topo_map",
    "why_no_trees",
]
