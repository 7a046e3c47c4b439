"""The package's own words, and the examples as a user runs them."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import topograph
from topograph.evaluate import Truth, map_metrics

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"


def test_importing_costs_nothing_and_names_are_there() -> None:
    code = "import sys, topograph; assert 'numpy' not in sys.modules; [getattr(topograph, n) for n in topograph.__all__]; assert 'numpy' in sys.modules"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0
    with pytest.raises(AttributeError):
        _ = topograph.nobody
    assert (Path(topograph.__file__).parent / "py.typed").exists()


def test_map_save_load_localize(tmp_path: Path, detections_run: tuple[Path, Truth]) -> None:
    path, truth = detections_run
    orchard = topograph.map_bags(path)
    assert orchard.meta["verdict"] == "sound"
    assert len(repr(orchard)) < 200
    got = {m.name: m.value for m in map_metrics(orchard, truth)}
    assert got["tree precision"] == got["tree recall"] == 1.0
    topograph.save_map(orchard, str(tmp_path / "m.gpkg"))
    again = topograph.load_map(str(tmp_path / "m.gpkg"))
    np.testing.assert_array_equal(again.p, orchard.p)
    replay = topograph.localize_bags(again, path)
    assert len(replay.fixes) > 0.9 * len(replay.reports)


def test_the_example_of_a_detector_of_ones_own(tmp_path: Path, detections_run: tuple[Path, Truth]) -> None:
    sys.path.insert(0, str(EXAMPLES))
    from own_detector import Node

    from topograph.bags import Imu, Odometry, Recording, Trunks

    path, truth = detections_run
    topograph.save_map(topograph.map_bags(path), tmp_path / "m.gpkg")
    topo = topograph.load_map(tmp_path / "m.gpkg")
    off = []
    with Recording([path]) as r:
        node = Node(str(tmp_path / "m.gpkg"), r.frames.find("imu_link")[:3, :3])
        for _, m in r.messages():
            if isinstance(m, Odometry):
                node.odometry(m.stamp_ns, m.odom_T_child, m.twist)
            elif isinstance(m, Imu):
                node.imu(m.stamp_ns, m.gyro, m.accel)
            elif isinstance(m, Trunks):
                pose = node.scan(m.stamp_ns, m.p, m.diameter)
                if pose is not None:
                    k = int(np.argmin(np.abs(truth.stamps_ns - m.stamp_ns)))
                    true = topo.datum.to_enu(truth.datum.to_geodetic(truth.world_T_robot[k, :3, 3][None]))[0]
                    off.append(np.linalg.norm((pose[:3, 3] - true)[:2]))
    assert len(off) > 300
    assert np.median(off) < 0.1
