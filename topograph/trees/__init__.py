"""Trunks + a predicted path -> which trunks are one tree: tracking, loop closing, births and deaths."""

from topograph.trees.detections import Detections
from topograph.trees.drift import ASTRAY, SPAN, Way, astray, deviation, drift
from topograph.trees.existence import Existence, exists, overdue, seen_through
from topograph.trees.foot import grounds
from topograph.trees.keyframes import choose_keyframes
from topograph.trees.loops import Closed, LoopCloser, Loops, TrackTable, moved_pose, tabulate
from topograph.trees.refine import refine
from topograph.trees.screen import screen
from topograph.trees.shape import Shapes, feet, relevelled, shapes
from topograph.trees.sightings import AtKeyframes, Sightings, gather
from topograph.trees.slip import SlipWatch
from topograph.trees.tracks import Tracker, TreesConfig, follow
from topograph.trees.wheels import with_trunks_way

__all__ = [
    "ASTRAY",
    "SPAN",
    "AtKeyframes",
    "Closed",
    "Detections",
    "Existence",
    "LoopCloser",
    "Loops",
    "Shapes",
    "Sightings",
    "SlipWatch",
    "TrackTable",
    "Tracker",
    "TreesConfig",
    "Way",
    "astray",
    "choose_keyframes",
    "deviation",
    "drift",
    "exists",
    "feet",
    "follow",
    "gather",
    "grounds",
    "moved_pose",
    "overdue",
    "refine",
    "relevelled",
    "screen",
    "seen_through",
    "shapes",
    "tabulate",
    "with_trunks_way",
]
