"""Recordings -> scans, odometry, IMU, fixes, headings and recorded trunks, in time order.

The only room that knows ROS. `Recording` is the door; `BagWriter` is the way back, for the simulator.
"""

from topograph.bags.config import BagsConfig
from topograph.bags.messages import Fix, Heading, Imu, Odometry, Trunks
from topograph.bags.recording import DAMAGED, EMPTY, INFINITE, UNDECODED, Product, Recording
from topograph.bags.scan import Scan
from topograph.bags.scan import decode as decode_scan
from topograph.bags.survey import StreamSurvey, Survey, survey

__all__ = [
    "DAMAGED",
    "EMPTY",
    "INFINITE",
    "UNDECODED",
    "BagsConfig",
    "Fix",
    "Heading",
    "Imu",
    "Odometry",
    "Product",
    "Recording",
    "Scan",
    "StreamSurvey",
    "Survey",
    "Trunks",
    "decode_scan",
    "survey",
]
