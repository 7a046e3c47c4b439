"""Recorded runs end to end, where `shared/data` is beside the project."""

from pathlib import Path

import numpy as np
import pytest

from topograph.config import Config
from topograph.pipeline import read_run, residual_metrics, solve_run, topo_map, why_no_trees


def test_husky_without_lidar(shared: Path) -> None:
    """No LiDAR, an IMU turned by 90° without TF, heights that settle by 30 m in the first minute."""
    run = read_run([shared / "husky_outdoor.bag"], Config())
    s = solve_run(run, Config(), check_fixes=2)
    assert "no trunks" in why_no_trees(s)
    assert any("IMU frame unknown" in n for n in run.notes)
    got = {m.name: m.value for m in residual_metrics(s)}
    assert got["held-out fixes RMS"] < 3.0  # the receiver states 0.8 to 1.7 m


@pytest.mark.slow
def test_victoria_park(shared: Path) -> None:
    """A car in a park: real trunks, not associated, with false ones among them; GPS with gaps and jumps."""
    run = read_run([shared / "victoria_park_first_half.bag"], Config())
    s = solve_run(run, Config(), check_fixes=2)
    got = {m.name: m.value for m in residual_metrics(s)}
    assert got["held-out fixes RMS"] < 3.0
    assert got["trunk residual median"] < 0.15
    topo = topo_map(s, Config(), {})
    d = np.linalg.norm(topo.p[:, None, :2] - topo.p[None, :, :2], axis=2) + 1e9 * np.eye(len(topo))
    assert (d.min(axis=1) < 1.0).mean() <= 0.02
    assert 80 < len(topo) < 250
