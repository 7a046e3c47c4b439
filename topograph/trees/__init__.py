"""Trunks + a predicted path -> which trunks are one tree: tracking, loop closing, births and deaths."""

from topograph.trees.detections import Detections
from topograph.trees.existence import exists
from topograph.trees.keyframes import choose_keyframes
from topograph.trees.loops import LoopCloser, TrackTable, moved_pose, tabulate
from topograph.trees.refine import refine
from topograph.trees.sightings import Sightings, gather
from topograph.trees.tracks import TreesConfig, follow

__all__ = [
    "Detections",
    "LoopCloser",
    "Sightings",
    "TrackTable",
    "TreesConfig",
    "choose_keyframes",
    "exists",
    "follow",
    "gather",
    "moved_pose",
    "refine",
    "tabulate",
]
