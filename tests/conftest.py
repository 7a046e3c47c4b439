"""Shared paths and small simulated runs."""

from __future__ import annotations

from pathlib import Path

import pytest

from topograph.evaluate import Truth
from topograph.simulate import DriveConfig, OrchardConfig, SensorConfig, record

SHARED = Path(__file__).resolve().parents[2] / "shared" / "data"

SMALL = OrchardConfig(rows=3, columns=4, posts=3, people=1, walkers=1, hedges=0, vehicles=0)


@pytest.fixture(scope="session")
def shared() -> Path:
    """Folder of recorded data; tests that need it are skipped where it is absent."""
    if not SHARED.exists():
        pytest.skip("shared/data is not here")
    return SHARED


@pytest.fixture(scope="session")
def detections_run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Truth]:
    """A simulated run with trunk detections in place of clouds (mcap, zstd), and its truth."""
    path = tmp_path_factory.mktemp("runs") / "detections"
    truth = record(path, 3, "grid", DriveConfig(run=1), SensorConfig(detections=True, compression="zstd"))
    return path, truth


@pytest.fixture(scope="session")
def lidar_run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Truth]:
    """Half a minute of a simulated VLP-16 run in a small orchard (ROS 1), and its truth."""
    path = tmp_path_factory.mktemp("runs") / "lidar.bag"
    truth = record(path, 5, SMALL, DriveConfig(run=1, longest_s=30.0), SensorConfig(sweep_hz=5.0, columns=1200))
    return path, truth
