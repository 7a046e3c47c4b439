"""Tables, figures, HTML, exports. Computes no number that is not already a metric."""

from topograph.report.figures import (
    map_figure,
    residual_figure,
    residual_time_figure,
    scan_figure,
    tree_error_figure,
)
from topograph.report.localization import localization_error_figure, localization_figure
from topograph.report.page import Page
from topograph.report.record import write_json

__all__ = [
    "Page",
    "localization_error_figure",
    "localization_figure",
    "map_figure",
    "residual_figure",
    "residual_time_figure",
    "scan_figure",
    "tree_error_figure",
    "write_json",
]
