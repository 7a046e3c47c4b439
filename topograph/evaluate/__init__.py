"""Truth, metrics, comparison. Draws nothing, and cannot tell which estimate is ours."""

from topograph.evaluate.frames import WorldInMap, world_in_map
from topograph.evaluate.metrics import Metric, fix_metrics, map_metrics, path_metrics, trunk_metrics, truth_metrics
from topograph.evaluate.references import read_truth
from topograph.evaluate.truth import Truth
from topograph.exchange import read_tum, write_tum

__all__ = [
    "Metric",
    "Truth",
    "WorldInMap",
    "fix_metrics",
    "map_metrics",
    "path_metrics",
    "read_truth",
    "read_tum",
    "trunk_metrics",
    "truth_metrics",
    "world_in_map",
    "write_tum",
]
