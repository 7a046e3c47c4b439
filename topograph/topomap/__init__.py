"""Estimate + scans -> TopoMap: nodes with viewpoint clouds, edges, rows. No solver, no files."""

from topograph.topomap.build import build
from topograph.topomap.clouds import Query, Target
from topograph.topomap.edges import TopomapConfig, neighbours
from topograph.topomap.map import CHI2_95, KINDS, TopoMap, Viewpoint
from topograph.topomap.merge import merge
from topograph.topomap.rows import find_rows
from topograph.topomap.sessions import Seen, SessionRecord

__all__ = [
    "CHI2_95",
    "KINDS",
    "Query",
    "Seen",
    "SessionRecord",
    "Target",
    "TopoMap",
    "TopomapConfig",
    "Viewpoint",
    "build",
    "find_rows",
    "merge",
    "neighbours",
]
