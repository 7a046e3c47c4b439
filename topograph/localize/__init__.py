"""TopoMap + trunks + odometry -> where the robot is, over time: search, commit, track, lose. No files, no clock."""

from topograph.localize.config import LocalizeConfig
from topograph.localize.localizer import GraphMethod, Localizer, row_direction
from topograph.localize.method import Fix, Method, Report
from topograph.localize.smooth import smooth
from topograph.localize.submap import Move, Sweep
from topograph.localize.thesis import ThesisConfig, ThesisMethod

__all__ = [
    "Fix",
    "GraphMethod",
    "LocalizeConfig",
    "Localizer",
    "Method",
    "Move",
    "Report",
    "Sweep",
    "ThesisConfig",
    "ThesisMethod",
    "row_direction",
    "smooth",
]
