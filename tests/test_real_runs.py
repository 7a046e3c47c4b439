"""Recorded runs end to end, where `shared/data` is beside the project."""

from pathlib import Path

import numpy as np
import pytest

from topograph.config import Config
from topograph.evaluate import read_tum
from topograph.geometry import align_se3, interpolate, transform
from topograph.mapping import Solved
from topograph.pipeline import localize_bags, read_run, residual_metrics, solve_run, topo_map, why_no_trees


def test_husky_without_lidar(shared: Path) -> None:
    """No LiDAR, an IMU turned by 90° without TF, heights that settle by 30 m in the first minute."""
    run = read_run([shared / "husky_outdoor.bag"], Config())
    s = solve_run(run, Config(), check_fixes=2)
    assert "no trunks" in why_no_trees(s)
    assert any("IMU frame unknown" in n for n in run.notes)
    got = {m.name: m.value for m in residual_metrics(s)}
    assert got["held-out fixes RMS"] < 3.0  # the receiver states 0.8 to 1.7 m


@pytest.fixture(scope="module")
def park(shared: Path) -> Solved:
    """Victoria Park, every second fix withheld."""
    return solve_run(read_run([shared / "victoria_park_first_half.bag"], Config()), Config(), check_fixes=2)


@pytest.mark.slow
def test_victoria_park(park: Solved) -> None:
    """A car in a park: real trunks, not associated, with false ones among them; GPS with gaps and jumps."""
    s = park
    got = {m.name: m.value for m in residual_metrics(s)}
    assert got["held-out fixes RMS"] < 3.0
    assert got["trunk residual median"] < 0.15
    topo = topo_map(s, Config(), {})
    d = np.linalg.norm(topo.p[:, None, :2] - topo.p[None, :, :2], axis=2) + 1e9 * np.eye(len(topo))
    assert (d.min(axis=1) < 1.0).mean() <= 0.02
    assert 80 < len(topo) < 250


@pytest.mark.slow
def test_victoria_park_without_a_fix_is_the_same_park(shared: Path, park: Solved) -> None:
    """2.1 km of a car's wheels, 70 m off by themselves: trees alone close the loops, and path and trees come out as with the fixes."""
    s = solve_run(read_run([shared / "victoria_park_first_half.bag"], Config()), Config(), check_fixes=1)
    assert s.problem.datum is None
    own, theirs = s.estimate.map_T_robot[:, :3, 3], park.estimate
    at = interpolate(theirs.stamps_ns, theirs.map_T_robot, s.estimate.stamps_ns)[:, :3, 3]
    off = np.hypot(*(transform(align_se3(own, at), own) - at)[:, :2].T)
    assert off.max() < 1.0
    assert abs(len(s.existence.ok) - len(park.existence.ok)) <= 6


@pytest.mark.slow
def test_forest_is_found_again(shared: Path) -> None:
    """Real trees in a forest: mapped in the first 240 s, the rest localized in that map; no pose is far from the reference."""
    bag = shared / "evo_forest"
    s = solve_run(read_run([bag], Config(), span_s=(0.0, 240.0)), Config())
    found = localize_bags(topo_map(s, Config(), {}), [bag], Config(), span_s=(240.0, 480.0))
    stamps, poses = read_tum(shared / "evo_forest.tum")
    e = s.estimate
    reference = interpolate(stamps, poses, e.stamps_ns)[:, :3, 3]
    frame = align_se3(e.map_T_robot[:, :3, 3], reference)
    at = np.array([f.stamp_ns for f in found.fixes])
    p = transform(frame, np.array([f.map_T_robot[:3, 3] for f in found.fixes]))
    error = np.hypot(*(p - interpolate(stamps, poses, at)[:, :3, 3])[:, :2].T)
    assert len(at) > 0.9 * len(found.reports)
    assert error.mean() < 0.1
    assert error.max() < 0.5
