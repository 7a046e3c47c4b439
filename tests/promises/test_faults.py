"""Right or said: injected faults never make a wrong map without a word. The whole list is in tools/faults.py."""

from collections import Counter
from pathlib import Path

import pytest
from faults import FAULTS, suite

CHOSEN = [
    "clean", "clock trunks +0.5 s", "clock imu +0.5 s", "clock odometry +5 s", "clock fix -0.5 s", "uptime clock fix",
    "zero stamps trunks", "one trunks stamp a year ahead", "first odometry stamp an hour ahead", "all clocks jump -5 s half way",
    "each message twice", "arrival shuffled by 0.9 s", "odometry stops half way", "imu frame empty", "fix frame unknown",
    "imu_link upside down", "gnss x + 1 m", "gnss_baseline yaw 90", "trunks' mount yaw 180", "trunks' mount yaw 5",
    "trunks' mount y + 0.3 m", "trunks' mount pitch 10", "fix altitude NaN", "fix lat and lon swapped", "fix 40 % outliers of 5 m",
    "fix jumps 0.5 m half way", "fix jumps 0.5 m until half way", "fix jumps 10.0 m half way", "fix frozen", "two fixes", "imu gyro dead", "imu gyro z flipped",
    "imu one rate of 1000", "wheels x 0.0 for 3 s", "wheels x 3.0 for 3 s", "wheels x 1.3", "odometry pose zero, twist good",
    "trunks mirrored", "a person beside the robot",
]  # fmt: skip
"""Of each kind the ones that once made a wrong map, a traceback or a silent loss."""
RIGHT = {
    "clean", "clock imu +0.5 s", "clock odometry +5 s", "uptime clock fix", "one trunks stamp a year ahead", "each message twice",
    "first odometry stamp an hour ahead", "arrival shuffled by 0.9 s", "imu_link upside down", "gnss_baseline yaw 90",
    "fix altitude NaN", "fix 40 % outliers of 5 m", "imu gyro dead", "imu one rate of 1000", "wheels x 0.0 for 3 s",
    "wheels x 3.0 for 3 s", "wheels x 1.3", "odometry pose zero, twist good", "a person beside the robot",
}  # fmt: skip
"""The ones that have to come out right, and be called so."""


@pytest.mark.slow
def test_no_fault_makes_a_wrong_map_without_a_word(tmp_path: Path) -> None:
    assert set(CHOSEN) <= set(FAULTS)
    out = suite(CHOSEN, 73, tmp_path)
    kinds = Counter(o.kind for o in out)
    bad = [(o.name, o.kind, o.says) for o in out if o.kind in ("WRONG", "TRACEBACK", "LOST MESSAGES")]
    assert not bad
    not_right = [(o.name, o.kind, o.says) for o in out if o.name in RIGHT and o.kind != "right"]
    assert not not_right
    assert max(o.path for o in out if o.name.startswith("wheels")) < 0.2
    assert kinds["wrong, said"] >= 5  # the audit speaks, and the rig can tell a wrong map
