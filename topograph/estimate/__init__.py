"""Sightings + streams -> Estimate: path, trees, covariances.

`graph.solve` (GTSAM) and `average.solve` (the thesis) take the same Problem and give the same Estimate; they do not
know of each other.
"""

from topograph.estimate.average import AverageConfig
from topograph.estimate.path import path_at
from topograph.estimate.problem import Estimate, EstimateConfig, Fixes, Headings, KnownTrees, Link, Problem

__all__ = [
    "AverageConfig",
    "Estimate",
    "EstimateConfig",
    "Fixes",
    "Headings",
    "KnownTrees",
    "Link",
    "Problem",
    "path_at",
]
