"""A live robot's bad messages: nothing is raised, and "tracking" is not said half a metre off. The whole suite: tools/live_faults.py."""

from __future__ import annotations

import pytest
from live_faults import LIVE, Outcome, suite

NAMES = [
    "clean", "NaN in 30% of odometry", "zero quaternion in 30% of odometry", "30% of trunks' covariances negative", "30% of axes zero",
    "no odometry from 20 to 35 s", "no odometry from 30 to 1e+09 s", "no imu from 0 to 1e+09 s", "no trunks from 20 to 35 s",
    "scans swapped", "an old scan again", "odometry arrives 2 s late", "carried", "zero stamps trunks", "one trunks stamp an hour ahead",
    "imu one rate of 1e+300", "imu without gravity", "imu gyro dies half way", "imu gyro scaled by 1.1", "wheels x 0.0 for 6 s", "wheels x 3.0 for 6 s",
    "odometry frozen", "odometry backwards", "trunks mirrored", "trunks frozen for 3 s, noise 0.01 m", "trunks frozen for 1e+09 s, noise 0 m",
    "all clocks jump -5 s half way",
]  # fmt: skip


@pytest.fixture(scope="module")
def outcomes(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Outcome]:
    return {o.name: o for o in suite(NAMES, 2202, tmp_path_factory.mktemp("live"))}


@pytest.mark.parametrize("name", NAMES)
def test_live(outcomes: dict[str, Outcome], name: str) -> None:
    o = outcomes[name]
    assert not o.raised
    assert o.wrong == 0, o


@pytest.mark.parametrize(
    "name",
    ["clean", "odometry frozen", "wheels x 0.0 for 6 s", "no odometry from 20 to 35 s", "imu gyro scaled by 1.1"],
)
def test_what_the_trunks_mend_is_not_lost(outcomes: dict[str, Outcome], name: str) -> None:
    """Wheels that are blocked, missing or frozen, and a gyro that is off by a tenth, do not end a track in an orchard."""
    o = outcomes[name]
    assert o.posed > 0.97 * o.scans, o


def test_a_mirrored_world_is_another_world(outcomes: dict[str, Outcome]) -> None:
    assert outcomes["trunks mirrored"].posed == 0
    assert set(NAMES) <= set(LIVE)
