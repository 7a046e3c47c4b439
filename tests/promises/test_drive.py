"""A robot drives through recorded trees: what it maps are the stems, and a later run finds itself among them without GNSS."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import woods
from evaluate_recorded import at_chest, held_out, stems_at_chest
from recordings import DATA, GATE

from topograph import localize_bags, map_bags
from topograph.config import Config
from topograph.evaluate import Truth, world_in_map
from topograph.evaluate.localization import localization_errors
from topograph.evaluate.metrics import match
from topograph.simulate import DESIGNS, DriveConfig, SensorConfig, record
from topograph.simulate.drive import Drive
from topograph.simulate.lidar import sweep
from topograph.simulate.orchard import plant
from topograph.simulate.sensors import columns
from topograph.trunks import TrunksConfig

recorded = pytest.mark.skipif(not (DATA / "real_stems").exists(), reason="needs the recordings of ../shared/data")


@recorded
def test_a_recorded_stand_is_mapped_and_found_again(tmp_path: Path) -> None:
    """The score has not seen the plot; seed 3201."""
    wood = woods.plot("pine_plot")
    bags = [tmp_path / "run1.bag", tmp_path / "run2.bag"]
    for run, (bag, gnss, seconds) in enumerate(zip(bags, ("rtk", "none"), (40.0, 15.0), strict=True), 1):
        wood.record(bag, 3201, DriveConfig(run=run, speed=0.6, laps=2, longest_s=seconds), SensorConfig(gnss=gnss, sweep_hz=5.0))  # fmt: skip
    config = replace(Config(), trunks=TrunksConfig(score=str(held_out("pine_plot"))))
    topo = map_bags(bags[0], config=config)
    truth = Truth.load(bags[0].with_suffix(".truth"))
    trees = topo.trees()
    at, cov = at_chest(trees, truth)
    stems = stems_at_chest(truth)
    i, j = match(at, stems, GATE)
    assert len(j) >= len(stems) - 1
    assert len(at) - len(i) <= 1
    off = at[i] - stems[j]
    assert np.linalg.norm(off, axis=1).mean() < 0.03
    assert np.einsum("ni,nij,nj->n", off, np.linalg.inv(cov[i]), off).mean() < 4.0
    replay = localize_bags(topo, bags[1], config=config)
    assert len(replay.fixes) > 0.9 * len(replay.reports)
    path = Truth.load(bags[1].with_suffix(".truth"))
    error = np.linalg.norm(localization_errors(replay.reports, path, world_in_map(topo, path)).xy, axis=1)
    assert len(error) == len(replay.fixes)
    assert error.mean() < 0.05
    assert error.max() < 0.15


@recorded
def test_sweeps_of_clouds_are_cast_as_the_simulators_are(tmp_path: Path) -> None:
    """Pose at each column, sign of the azimuth, rings and times: points of a sweep of the simulator's, taken for a cloud, come back as they were."""
    sensor = SensorConfig(sweep_hz=5.0, range_sigma=0.0, dropout=0.0, divergence=0.0)
    record(tmp_path / "r.bag", 5, "grid", DriveConfig(longest_s=8.0), replace(sensor, sweep_hz=1.0))
    way = Truth.load(tmp_path / "r.truth")
    wood = woods.plot("pine_plot")
    drive = Drive(way.stamps_ns, way.world_T_robot, np.zeros(len(way.stamps_ns)))
    poses = columns(drive, sensor, int(way.stamps_ns[110]))
    scene = plant(DESIGNS["grid"], 5)
    s = sweep(scene, sensor, poses, 0.0, 1)
    column = np.floor(s.time / (sensor.sweep_s / sensor.columns) + 1e-3).astype(int)
    T = poses[np.minimum(column, sensor.columns - 1)]
    cloud = (T[:, :3, :3] @ s.xyz[:, :, None].astype(float))[..., 0] + T[:, :3, 3]
    high = cloud[:, 2] - scene.ground.at(cloud[:, :2])
    again = replace(wood, points=cloud, of=np.zeros(len(cloud), np.int32), above=high, ground=False).look(scene, sensor, poses, 0.0, 1)  # fmt: skip
    first, second = ({(int(r), round(float(t) * 1e6)): p for r, t, p in zip(k.ring, k.time, k.xyz, strict=True)} for k in (s, again))  # fmt: skip
    common = first.keys() & second.keys()
    assert len(common) > 0.99 * len(first)
    np.testing.assert_allclose([second[k] for k in common], [first[k] for k in common], atol=0.02)
