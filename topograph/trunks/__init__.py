"""Scan -> trunks: a pure function of one scan and the motion during it. No poses, no map."""

from topograph.trunks.config import LEAST_CLOUD, TrunksConfig
from topograph.trunks.nothing import none_at
from topograph.trunks.recorded import from_recorded
from topograph.trunks.smear import smeared
from topograph.trunks.thesis import ThesisTrunksConfig

__all__ = ["LEAST_CLOUD", "ThesisTrunksConfig", "TrunksConfig", "from_recorded", "none_at", "smeared"]
