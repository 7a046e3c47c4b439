"""A tree stands still and stops the beam: what moves, what rides along and what is seen through does not get in."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from topograph.config import Config
from topograph.evaluate import Truth
from topograph.evaluate.metrics import tree_errors
from topograph.pipeline import read_run, solve_run, topo_map
from topograph.simulate import DriveConfig, OrchardConfig, SensorConfig, record
from topograph.topomap import TopoMap

GROVE = OrchardConfig(rows=2, columns=4, posts=0, poles=0, people=0, walkers=0, hedges=0, vehicles=0, multi_stem=0.0)
SENSOR = SensorConfig(sweep_hz=5.0, columns=1200)


def mapped(path: Path, orchard: OrchardConfig, sensor: SensorConfig, seconds: float = 35.0) -> tuple[TopoMap, Truth]:
    truth = record(path, 41, orchard, DriveConfig(longest_s=seconds), sensor)
    config = Config()
    return topo_map(solve_run(read_run([path], config), config), config, {}), truth


def false_trees(topo: TopoMap, truth: Truth) -> int:
    return int(topo.is_tree.sum()) - len(tree_errors(topo, truth)[0])


@pytest.mark.parametrize(
    ("orchard", "sensor", "most"),
    [
        (replace(GROVE, companions=2), SENSOR, 0),
        (replace(GROVE, walkers=4), SENSOR, 1),  # one of them paces within half a metre of one place
        (GROVE, replace(SENSOR, mast=True), 0),
        (GROVE, replace(SENSOR, twice=True), 0),
    ],
    ids=["companions", "walkers", "mast", "twice"],
)
def test_no_tree_that_is_none(tmp_path: Path, orchard: OrchardConfig, sensor: SensorConfig, most: int) -> None:
    topo, truth = mapped(tmp_path / "run.bag", orchard, sensor)
    assert false_trees(topo, truth) <= most
    assert len(tree_errors(topo, truth)[0]) >= 5


def test_a_lidar_run_from_bag_to_map(tmp_path: Path) -> None:
    """Positions, diameters, clouds and viewpoints of a map made of sweeps."""
    topo, truth = mapped(tmp_path / "run.bag", GROVE, SENSOR)
    i, j, error = tree_errors(topo, truth)
    trees = topo.trees()
    assert np.linalg.norm(error[:, :2], axis=1).mean() < 0.03
    assert np.abs(trees.diameter[i] - truth.diameters[j]).mean() < 0.03
    assert {v.tree for v in trees.viewpoints} >= set(i.tolist())
    for v in trees.viewpoints:
        # The cloud is the side that was looked at: it lies before the axis, on the viewpoint's side (eq. 4.13).
        across = v.cloud - np.outer(v.cloud @ trees.axis[v.tree], trees.axis[v.tree])
        assert np.mean(across @ v.direction > 0) > 0.7
