"""An orchard and drives through it -> real bags, and the truth beside them."""

from topograph.simulate.config import DESIGNS, DriveConfig, OrchardConfig, SensorConfig
from topograph.simulate.record import record

__all__ = ["DESIGNS", "DriveConfig", "OrchardConfig", "SensorConfig", "record"]
