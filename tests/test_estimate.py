"""The graph against truth, against the average in the limit, and against itself."""

from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from topograph.config import Config
from topograph.estimate import (
    AverageConfig,
    Estimate,
    EstimateConfig,
    Headings,
    Problem,
    average,
    graph,
    path_at,
    solver,
)
from topograph.estimate.assemble import no_fixes
from topograph.evaluate import Truth, map_metrics
from topograph.geometry import exp, inverse, planar, transform
from topograph.motion import Motion, MotionConfig
from topograph.pipeline import baseline, read_run, solve_run, topo_map
from topograph.trees import Detections, Sightings

NO_FIXES = no_fixes()
NO_HEADINGS = Headings(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros(0), np.zeros(0))


def problem(
    poses: np.ndarray, trees: np.ndarray, sigma: float, rng: np.random.Generator, reach: float = 30.0
) -> Problem:
    """Every pose sees every tree within reach, with isotropic noise."""
    n = len(poses)
    stamps = np.arange(n) * 10**9
    d = np.linalg.norm(poses[:, None, :3, 3] - trees[None], axis=2)
    k, j = np.nonzero(d < reach)
    p = transform(inverse(poses[k]), trees[j]) + sigma * rng.normal(size=(len(k), 3))
    cov = np.tile(sigma**2 * np.eye(3), (len(k), 1, 1))
    step = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1))])
    motion = Motion(stamps_ns=stamps, odom_T_robot=poses, distance=step, turned=np.zeros(n), gyro=False, wheels=True)
    nothing = np.zeros(len(k))
    detections = Detections(
        stamps_ns=stamps,
        scan=k,
        p=p,
        cov=cov.astype(np.float32),
        axis=np.tile([0.0, 0.0, 1.0], (len(k), 1)),
        height=nothing,
        diameter=nothing + 0.2,
        score=nothing,
        kinds=np.full((len(k), 3), np.nan),
        measured=np.zeros((len(k), 6)),
        stems=np.ones(len(k), np.int64),
        source=np.arange(len(k)),
        free=np.zeros((0, 360), np.uint32),
        eye=np.zeros((n, 3)),
    )
    sightings = Sightings(keyframe=k, tree=j, p=p, cov=cov, count=np.ones(len(k), np.int64), late=np.zeros((len(k), 3)))
    return Problem(
        stamps_ns=stamps,
        odom_T_robot=poses,
        step_sigma=motion.sigma(MotionConfig(), stamps),
        motion=motion,
        motion_config=MotionConfig(),
        inertial=None,
        fixes=NO_FIXES,
        headings=NO_HEADINGS,
        datum=None,
        detections=detections,
        sightings=sightings,
        n_trees=len(trees),
    )


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10_000), sigma=st.sampled_from([0.01, 0.05, 0.2]))
def test_limit_of_exact_poses_is_the_average(seed: int, sigma: float) -> None:
    """Exact poses, isotropic noise, no outliers: the graph's tree is the mean of its sightings."""
    rng = np.random.default_rng(seed)
    n = 40
    turns = rng.normal(0, 0.1, (n, 3))
    poses = planar(np.linspace(0, 20, n), rng.normal(0, 1, n), rng.uniform(-3, 3, n)) @ exp(
        np.concatenate([turns, np.zeros((n, 3))], axis=1)
    )
    trees = np.stack([np.linspace(2, 18, 5), np.full(5, 4.0), np.zeros(5)], axis=1)
    p = replace(problem(poses, trees, sigma, rng), start=poses, pose_sigma=1e-9)
    out = graph.solve(p, EstimateConfig(tukey=1e6, huber=1e6, learn_scale=False))
    seen = transform(poses[p.sightings.keyframe], p.sightings.p)
    mean = np.array([seen[p.sightings.tree == j].mean(0) for j in range(5)])
    np.testing.assert_allclose(out.trees, mean, atol=1e-6)
    count = np.bincount(p.sightings.tree)
    assert out.joint is not None
    np.testing.assert_allclose(np.diag(out.joint).reshape(-1, 3)[:, 0], sigma**2 / count, rtol=1e-3)


def test_outliers_do_not_move_trees() -> None:
    rng = np.random.default_rng(5)
    n = 60
    poses = planar(np.linspace(0, 30, n), 0, 0.05 * np.sin(np.arange(n)))
    trees = np.stack([np.linspace(2, 28, 8), 3.0 * (-1.0) ** np.arange(8), np.zeros(8)], axis=1)
    p = replace(problem(poses, trees, 0.03, rng, reach=12.0), start=poses)
    bad = rng.random(len(p.sightings)) < 0.1
    z = p.sightings.p.copy()
    z[bad, :2] += rng.uniform(2, 6, (int(bad.sum()), 2))
    out = graph.solve(replace(p, sightings=replace(p.sightings, p=z)), EstimateConfig())
    assert np.linalg.norm((out.trees - trees)[:, :2], axis=1).max() < 0.05
    assert out.weights[bad].max() < 0.1
    assert np.median(out.weights[~bad]) > 0.8


def test_path_between_keyframes_passes_through_them() -> None:
    rng = np.random.default_rng(1)
    stamps = np.arange(5) * 10**9
    odom = np.stack([exp(np.array([0, 0, 0.1 * k, k, 0.1 * k, 0])) for k in range(5)])
    truth = np.stack([T @ exp(rng.normal(0, 0.05, 6)) for T in odom])
    motion = Motion(
        stamps_ns=stamps, odom_T_robot=odom, distance=np.arange(5.0), turned=np.zeros(5), gyro=False, wheels=True
    )
    np.testing.assert_allclose(path_at(stamps, truth, motion, stamps), truth, atol=1e-9)
    middle = path_at(stamps, truth, motion, np.array([1_500_000_000]))[0]
    assert np.linalg.norm(middle[:3, 3] - truth[1:3, :3, 3].mean(0)) < 0.1


def test_average_is_algorithm_3() -> None:
    """Nearest node within d_max, and the mean of old and new: worked out by hand for two sightings of one tree."""
    poses = planar(np.array([0.0, 0.1]), 0.0, 0.0)
    p = problem(poses, np.array([[5.0, 0.0, 0.0]]), 1e-9, np.random.default_rng(0))
    z = p.detections.p.copy()
    z[1] += [0.4, 0.2, 0.0]
    out = average.solve(replace(p, detections=replace(p.detections, p=z)), AverageConfig(least=1))
    assert len(out.trees) == 1
    np.testing.assert_allclose(out.trees[0], [5.2, 0.1, 0.0], atol=1e-6)


@pytest.mark.parametrize(
    ("rule", "expected"), [("halving", 5.225), ("mean", 5.2), ("inverse", (0.25 * 5.0 + 4.0 * 5.3) / 4.25)]
)
def test_rungs_of_the_ladder(rule, expected: float) -> None:
    """Three sightings at 5.0, 5.3 and 5.3 m, weighed by eq. 4.14, alike, and by their inverse variance (1/4, 1, 3): by hand."""
    poses = planar(np.zeros(3), 0.0, 0.0)
    p = problem(poses, np.array([[5.0, 0.0, 0.0]]), 1e-9, np.random.default_rng(0))
    z = p.detections.p.copy()
    z[:, 0] = 5.0, 5.3, 5.3
    cov = np.tile(np.eye(3) * 1e-4, (3, 1, 1))
    cov[0] *= 4.0
    cov[2] /= 3.0
    d = replace(p.detections, p=z, cov=cov.astype(np.float32))
    out = average.solve(replace(p, detections=d), AverageConfig(least=1, rule=rule))
    np.testing.assert_allclose(out.trees[0, 0], expected, atol=1e-6)


def test_nearest_node_or_the_first_of_the_list() -> None:
    """Two nodes 1 m apart, and a cluster nearer to the second: 4.3.3 means that one, Algorithm 3 as written takes the first within d_max."""
    poses = planar(np.zeros(3), 0.0, 0.0)
    p = problem(poses, np.array([[5.0, 0.0, 0.0]]), 1e-9, np.random.default_rng(0))
    z = p.detections.p.copy()
    z[:, 0] = 5.0, 6.6, 6.1
    p = replace(p, detections=replace(p.detections, p=z))
    near = average.solve(p, AverageConfig(least=1)).trees[:, 0]
    first = average.solve(p, AverageConfig(least=1, nearest=False)).trees[:, 0]
    np.testing.assert_allclose(near, [5.0, 6.35], atol=1e-6)
    np.testing.assert_allclose(first, [5.55, 6.6], atol=1e-6)
    assert len(average.solve(p, AverageConfig(least=2)).trees) == 1


@pytest.fixture(scope="module")
def solved(detections_run: tuple[Path, Truth]):
    run = read_run([detections_run[0]], Config())
    return solve_run(run, Config()), detections_run[1]


def by_name(metrics) -> dict[str, float]:
    return {m.name: m.value for m in metrics}


def test_simulated_run_maps_to_centimetres(solved) -> None:
    s, truth = solved
    got = by_name(map_metrics(topo_map(s, Config(), {}), truth))
    assert got["tree precision"] == 1.0
    assert got["tree recall"] == 1.0
    assert got["tree error mean"] < 0.05
    assert got["tree error max"] < 0.20


def test_graph_beats_average_fourfold_on_the_same_detections(solved) -> None:
    s, truth = solved
    ours = by_name(map_metrics(topo_map(s, Config(), {}), truth))
    theirs = by_name(map_metrics(baseline(s, Config())[1], truth))
    assert theirs["tree error mean"] > 2.0 * ours["tree error mean"]
    assert ours["tree precision"] >= theirs["tree precision"]


def test_held_out_fixes_do_not_reach_the_estimator(detections_run: tuple[Path, Truth]) -> None:
    run = read_run([detections_run[0]], Config())
    s = solve_run(run, Config(), check_fixes=2)
    assert len(s.held_out) == len(run.streams.fix_ns) // 2
    assert s.problem.datum is not None
    used = np.setdiff1d(np.arange(len(run.streams.fix_ns)), s.held_out)
    enu = s.problem.datum.to_enu(run.streams.lat_lon_h)
    # A keyframe's fix is the mean of used ones only: move the withheld ones away and nothing changes.
    moved = run.streams.lat_lon_h.copy()
    moved[s.held_out] += 0.01
    again = solve_run(replace(run, streams=replace(run.streams, lat_lon_h=moved)), Config(), check_fixes=2)
    np.testing.assert_array_equal(again.problem.fixes.map_p_antenna, s.problem.fixes.map_p_antenna)
    assert len(used) + len(s.held_out) == len(enu)


def test_without_gnss_the_map_is_local_and_right(detections_run: tuple[Path, Truth]) -> None:
    run = read_run([detections_run[0]], Config())
    s = solve_run(run, Config(), check_fixes=1)
    topo = topo_map(s, Config(), {})
    assert topo.datum is None
    assert any("not georeferenced" in n for n in run.notes)
    got = by_name(map_metrics(topo, detections_run[1]))
    assert got["tree recall"] == 1.0
    assert got["tree error mean"] < 0.25


def test_estimates_repeat_bit_for_bit(detections_run: tuple[Path, Truth]) -> None:
    a, b = (solve_run(read_run([detections_run[0]], Config()), Config()).estimate for _ in range(2))
    assert isinstance(a, Estimate)
    np.testing.assert_array_equal(a.trees, b.trees)


def test_a_large_graph_with_a_variable_that_nothing_joins_is_solved() -> None:
    """GTSAM hands METIS an adjacency without such a variable, and METIS reads beyond its end: a crash of the whole program."""
    n = solver.LARGE + 100
    nonlinear, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    unit = gtsam.noiseModel.Unit.Create(3)
    for k in range(n + 1):
        values.insert(k, gtsam.Pose2())
    for k in range(n - 1):
        nonlinear.add(gtsam.BetweenFactorPose2(k, k + 1, gtsam.Pose2(1.0, 0.0, 0.0), unit))
    nonlinear.add(gtsam.PriorFactorPose2(0, gtsam.Pose2(), unit))
    nonlinear.add(gtsam.PriorFactorPose2(n, gtsam.Pose2(5.0, 6.0, 0.0), unit))
    solved = solver.optimised(nonlinear, values, 5)
    assert solved.atPose2(n - 1).x() == pytest.approx(n - 1)
    assert solved.atPose2(n).y() == pytest.approx(6.0)
    linear = nonlinear.linearize(solved)
    assert solver.ordering_of(linear, n + 1).size() == n + 1
