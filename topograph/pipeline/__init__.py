"""Straight lines: bags to a map, a map and bags to poses. `mapping` holds the one loop (associate <-> solve)."""

from topograph.pipeline.auditing import audited
from topograph.pipeline.inspecting import Inspection, Role, inspect_bags
from topograph.pipeline.localizing import Replay, localize_bags
from topograph.pipeline.mapping import (
    Solved,
    baseline,
    extend,
    map_T_scans,
    residual_metrics,
    solve_run,
    topo_map,
    why_no_trees,
)
from topograph.pipeline.read import read_run, scan_near

__all__ = [
    "Inspection",
    "Replay",
    "Role",
    "Solved",
    "audited",
    "baseline",
    "extend",
    "inspect_bags",
    "localize_bags",
    "map_T_scans",
    "read_run",
    "residual_metrics",
    "scan_near",
    "solve_run",
    "topo_map",
    "why_no_trees",
]
