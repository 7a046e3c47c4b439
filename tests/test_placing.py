"""A run without GNSS is laid onto a map by its trees, or refused."""

from pathlib import Path

import numpy as np
import pytest

from topograph.config import Config
from topograph.errors import InsufficientDataError
from topograph.evaluate import Truth
from topograph.evaluate.metrics import tree_errors
from topograph.pipeline import audited, extend, place, read_run, solve_run, topo_map
from topograph.session import Session
from topograph.simulate import DriveConfig, SensorConfig, record
from topograph.topomap import TopoMap

SEED = 64


def run_of(folder: Path, run: int, gnss: str, seed: int = SEED) -> Session:
    bag = folder / f"run{run}_{gnss}_{seed}.bag"
    if not bag.exists():
        record(bag, seed, "olive", DriveConfig(run=run, longest_s=50.0), SensorConfig(detections=True, gnss=gnss))
    return read_run([bag], Config())


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("placing")


@pytest.fixture(scope="module")
def first(folder: Path) -> TopoMap:
    return topo_map(solve_run(run_of(folder, 1, "rtk"), Config()), Config(), {})


def test_it_extends_the_map_to_centimetres(folder: Path, first: TopoMap) -> None:
    """Trees that only the second run saw are as right as the others, in the map's own frame; none is there twice."""
    session = run_of(folder, 2, "none")
    solved = solve_run(session, Config(), known=first, placed=place(first, session, Config()))
    both = extend(first, topo_map(solved, Config(), {}), solved, Config())
    truth = Truth.load(folder / f"run2_none_{SEED}.truth")
    assert len(both) > len(first)
    assert both.datum == first.datum
    assert audited(solved).word == "sound"
    ours, _, error = tree_errors(both, truth)
    assert len(ours) == len(both)
    off = np.linalg.norm(error[:, :2], axis=1)
    assert off.mean() < 0.03
    assert off.max() < 0.08
    new = both.cov[len(first) :, 0, 0]
    assert (np.sqrt(new) < 0.1).all()  # what only the second run saw is not as unsure as the place it was found at


def test_another_orchard_is_refused(folder: Path, first: TopoMap) -> None:
    session = run_of(folder, 2, "none", SEED + 1)
    with pytest.raises(InsufficientDataError, match="was not found"):
        place(first, session, Config())


def test_a_map_without_gnss_grows_too(folder: Path) -> None:
    """Neither run has GNSS: distances between trees are right, whatever the frame."""
    one, two = run_of(folder, 1, "none"), run_of(folder, 2, "none")
    local = topo_map(solve_run(one, Config()), Config(), {})
    assert local.datum is None
    solved = solve_run(two, Config(), known=local, placed=place(local, two, Config()))
    both = extend(local, topo_map(solved, Config(), {}), solved, Config())
    truth = Truth.load(folder / f"run2_none_{SEED}.truth")
    assert both.datum is None
    true = np.linalg.norm(truth.trees[:, None, :2] - truth.trees[None, :, :2], axis=2)
    found = np.linalg.norm(both.p[:, None, :2] - both.p[None, :, :2], axis=2)
    spread = np.sort(found, axis=1)[:, 1:5]  # four nearest neighbours tell trees apart
    cost = np.abs(spread[:, None] - np.sort(true, axis=1)[None, :, 1:5]).max(axis=2)
    twin = cost.argmin(axis=1)
    assert len(set(twin.tolist())) >= 0.8 * len(both)
    known = cost.min(axis=1) < 0.2
    assert np.abs(found[np.ix_(known, known)] - true[np.ix_(twin[known], twin[known])]).max() < 0.25
