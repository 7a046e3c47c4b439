"""Truth, metrics, comparison. Draws nothing, and cannot tell which estimate is ours."""

from topograph.evaluate.metrics import Metric, fix_metrics, map_metrics, path_metrics, trunk_metrics, truth_metrics
from topograph.evaluate.truth import Truth, read_tum, write_tum

__all__ = [
    "Metric",
    "Truth",
    "fix_metrics",
    "map_metrics",
    "path_metrics",
    "read_tum",
    "trunk_metrics",
    "truth_metrics",
    "write_tum",
]
