"""What the loop is told."""

from __future__ import annotations

from dataclasses import dataclass, field

from topograph.estimate import EstimateConfig
from topograph.motion import MotionConfig
from topograph.trees import TreesConfig


@dataclass(frozen=True, slots=True)
class MappingConfig:
    """The blocks of the rooms that it goes through."""

    motion: MotionConfig = field(default_factory=MotionConfig)
    trees: TreesConfig = field(default_factory=TreesConfig)
    estimate: EstimateConfig = field(default_factory=EstimateConfig)
