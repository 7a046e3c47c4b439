"""Localization: the algebra against numbers, invariances, right or unknown, and the whole chain from bags."""

import csv
import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st

from topograph import store
from topograph.bags import Imu, Odometry, Trunks
from topograph.cli import main
from topograph.errors import InsufficientDataError
from topograph.evaluate import Truth, read_tum
from topograph.geometry import Array, interpolate, planar
from topograph.localize import LocalizeConfig, Localizer, ThesisConfig, ThesisMethod
from topograph.localize.engine import Engine, on_top
from topograph.localize.filter import Filter
from topograph.localize.posterior import describe, weigh
from topograph.localize.submap import SECTORS, Move, Submap, Sweep, Visibility, open_to
from topograph.localize.thesis import multilaterate
from topograph.motion import Leg, Reckoner
from topograph.places.index import MapIndex, build_index
from topograph.places.search import Found, Landmarks, search
from topograph.simulate import DESIGNS, DriveConfig, SensorConfig, record
from topograph.simulate.starts import SCENARIOS, StartsConfig, drive, world
from topograph.topomap import TopoMap

seeds = st.integers(0, 10_000)


def sweep(p: Array, sigma: float = 0.05) -> Sweep:
    n = len(p)
    return Sweep(p, np.tile(sigma**2 * np.eye(2), (n, 1, 1)), np.full(n, np.nan), np.full(n, 0.01))


def still() -> Move:
    return Move(np.zeros(3), 1e-10 * np.eye(3), 0.0)


def told(c: StartsConfig) -> LocalizeConfig:
    return LocalizeConfig(
        view=c.view, map_sigma=c.map_sigma, trunk_sigma=0.0, seen=1 - c.miss, clutter=c.clutter, felled=0.03, new=0.03
    )


def index_of(xy: Array, config: LocalizeConfig) -> MapIndex:
    return build_index(xy, np.zeros(len(xy)), np.full(len(xy), np.nan), config.view, config.pair, config.map_sigma)


# -- the search ---------------------------------------------------------------------------------------------------


@given(seeds, st.floats(0.8, 2.5), st.floats(2.5, 6.0))
@settings(max_examples=40, deadline=None)
def test_a_search_finds_the_place_where_trees_are_dense(seed: int, tree: float, row: float) -> None:
    """Apples a metre apart: pairs of trees are listed up to six metres, and no longer pair of landmarks may be looked up among them."""
    rng = np.random.default_rng(seed)
    xy = np.stack(np.meshgrid(np.arange(30) * tree, np.arange(5) * row), axis=2).reshape(-1, 2)
    xy = xy + 0.03 * rng.normal(size=xy.shape)
    config = LocalizeConfig()
    index = index_of(xy, config)
    x, y, yaw = rng.uniform([3 * tree, 0, -3], [26 * tree, 4 * row, 3])
    near = xy[np.argsort(np.hypot(*(xy - [x, y]).T))[:40]] - [x, y]
    c, s = np.cos(yaw), np.sin(yaw)
    m = near @ np.array([[c, -s], [s, c]]) + 0.01 * rng.normal(size=near.shape)
    n = len(m)
    marks = Landmarks(
        m=m, cov=1e-4 * np.eye(2 * n), var=np.full(n, 1e-4), diameter=np.full(n, np.nan), diameter_var=np.full(n, np.nan),
        tree=np.full(n, np.log(0.9)), other=np.full(n, np.log(0.1 * index.density)), lasting=np.full(n, 0.9),
    )  # fmt: skip
    found = search(marks, index, config.places)
    off = np.hypot(*(found.pose[:, :2] - [x, y]).T) + np.abs((found.pose[:, 2] - yaw + np.pi) % (2 * np.pi) - np.pi)
    assert off.min() < 0.2


def test_on_top_of_each_other() -> None:
    """A frame in which the robot stands where it is, laid so that it does."""
    at = on_top(np.array([3.0, 4.0, 0.7]), np.array([1.0, -2.0, 0.2]))
    np.testing.assert_allclose(planar(*at) @ planar(1.0, -2.0, 0.2), planar(3.0, 4.0, 0.7), atol=1e-12)


# -- the filter ---------------------------------------------------------------------------------------------------


@given(seeds)
@settings(max_examples=30, deadline=None)
def test_the_filter_is_the_kalman_filter_of_its_model(seed: int) -> None:
    """Prediction, new landmark and update against the textbook's equations with numerical Jacobians."""
    rng = np.random.default_rng(seed)
    f = Filter(2)
    x, P = np.zeros(3), np.zeros((3, 3))

    def jacobian(g, at):
        d = 1e-6
        return np.stack([(g(at + d * e) - g(at - d * e)) / (2 * d) for e in np.eye(len(at))], axis=1)

    def moved(s: Array, m: Array) -> Array:
        c, sn = np.cos(s[2]), np.sin(s[2])
        return np.concatenate([[s[0] + c * m[0] - sn * m[1], s[1] + sn * m[0] + c * m[1], s[2] + m[2]], s[3:]])

    def seen(s: Array, k: int) -> Array:
        c, sn = np.cos(s[2]), np.sin(s[2])
        d = s[3 + 2 * k : 5 + 2 * k] - s[:2]
        return np.array([c * d[0] + sn * d[1], -sn * d[0] + c * d[1]])

    def grown(s: Array, z: Array) -> Array:
        c, sn = np.cos(s[2]), np.sin(s[2])
        return np.concatenate([s, [s[0] + c * z[0] - sn * z[1], s[1] + sn * z[0] + c * z[1]]])

    for _ in range(3):
        m, A = rng.normal(0, 0.5, 3), rng.normal(0, 0.1, (3, 3))
        Q = A @ A.T
        n = len(x)
        F = jacobian(lambda s, m=m: moved(s, m), x)
        G = jacobian(lambda q, x=x: moved(x, q), m)[:3, :2]
        noise = np.zeros((n, n))
        c, sn = np.cos(x[2]), np.sin(x[2])
        B = np.array([[c, -sn, 0], [sn, c, 0], [0, 0, 1]])
        noise[:3, :3] = B @ Q @ B.T
        np.testing.assert_allclose(G[:2], B[:2, :2], atol=1e-6)
        x, P = moved(x, m), F @ P @ F.T + noise
        f.predict(m, Q, 0.5)
        z, R = rng.normal(0, 5, 2), 0.01 * np.diag(rng.uniform(0.5, 2, 2))
        H = jacobian(lambda s, z=z: grown(s, z), x)
        Hz = jacobian(lambda q, x=x: grown(x, q), z)
        x, P = grown(x, z), H @ P @ H.T + Hz @ R @ Hz.T
        f.add(z, R)
        k = int(rng.integers(f.n))
        z = seen(x, k) + rng.normal(0, 0.1, 2)
        H = jacobian(lambda s, k=k: seen(s, k), x)
        S = H @ P @ H.T + R
        m2, logdet = f.innovations(z[None], R[None])
        v = z - seen(x, k)
        assert m2[0, k] == pytest.approx(v @ np.linalg.solve(S, v), rel=1e-4)
        assert logdet[0, k] == pytest.approx(np.log(np.linalg.det(S)), abs=1e-4)
        K = P @ H.T @ np.linalg.inv(S)
        x, P = x + K @ v, P - K @ S @ K.T
        f.update(k, z, R)
        np.testing.assert_allclose(f.mean, x, atol=1e-5)
        np.testing.assert_allclose(f.cov, P, atol=1e-5)


def test_landmarks_that_go_are_marginalised() -> None:
    rng = np.random.default_rng(0)
    f = Filter(2)
    for p in rng.uniform(-5, 5, (5, 2)):
        f.add(p, 0.01 * np.eye(2))
    f.predict(np.array([1.0, 0.0, 0.2]), 0.01 * np.eye(3), 1.0)
    before, cov = f.mean.copy(), f.cov.copy()
    keep = np.array([True, False, True, False, True])
    f.keep(keep)
    rows = np.array([0, 1, 2, 3, 4, 7, 8, 11, 12])
    np.testing.assert_array_equal(f.mean, before[rows])
    np.testing.assert_array_equal(f.cov, cov[np.ix_(rows, rows)])


# -- search and evidence ------------------------------------------------------------------------------------------


def hunted(trees: Array, seen: Array, config: LocalizeConfig):
    index = index_of(trees, config)
    submap = Submap(config, Visibility(config))
    for _ in range(3):
        submap.step(still(), sweep(seen))
    marks, _ = describe(submap, index, config)
    return weigh(search(marks, index, config.places), marks, submap, index, config)


@given(seeds, st.floats(-3.0, 3.0), st.floats(-500, 500), st.floats(-500, 500))
@settings(max_examples=25, deadline=None)
def test_the_place_is_found_and_follows_the_map(seed: int, yaw: float, x: float, y: float) -> None:
    """What is seen from a place in scattered trees leads back to it; a map that is moved moves the place and nothing else."""
    rng = np.random.default_rng(seed)
    trees = rng.uniform(0, 60, (60, 2))
    config = LocalizeConfig(view=15.0)
    place = rng.uniform(20, 40, 2)
    near = trees[np.hypot(*(trees - place).T) < 13.0] - place
    if len(near) < 7:
        return
    p = hunted(trees, near, config)
    np.testing.assert_allclose(p.pose[0, :2], place, atol=0.02)
    assert abs(p.pose[0, 2]) < 0.005
    assert p.p.sum() + p.unknown + p.rest == pytest.approx(1.0)
    c, s = np.cos(yaw), np.sin(yaw)
    R = np.array([[c, -s], [s, c]])
    q = hunted(trees @ R.T + [x, y], near, config)
    np.testing.assert_allclose(q.pose[0, :2], R @ p.pose[0, :2] + [x, y], atol=0.02)
    turn = (q.pose[0, 2] - p.pose[0, 2] - yaw + np.pi) % (2 * np.pi) - np.pi
    assert abs(turn) < 0.005


def feed(engine: Engine, s, c: StartsConfig):
    d = max(s.distance, 1e-9)
    cov = np.diag([(0.03 * d) ** 2 + 1e-6, (c.white * d) ** 2 + 1e-6, c.wander**2 * d + 1e-8])
    return engine.step(Move(s.motion, cov, s.distance), sweep(s.p, c.sigma))


def metres_to_commit(c: StartsConfig, starts: int, first: int, longest: float, off: float) -> list[float]:
    """How far each of so many starts drove until its commit, at most `longest` m; the pose must be right to `off` m. World and drive of a
    start are drawn from its number and `first`, `first + 1`."""
    config = told(c)
    metres = []
    for seed in range(starts):
        w = world(c, np.random.default_rng([seed, first]))
        engine = Engine(index_of(w.mapped, config), config)
        driven = 0.0
        for s in drive(w, c, np.random.default_rng([seed, first + 1]), longest):
            driven += s.distance
            b = feed(engine, s, c)
            if b.pose is not None:
                assert np.hypot(*(b.pose[:2] - s.pose[:2])) < off
                break
        metres.append(driven)
    return metres


@pytest.mark.parametrize("name", ["A", "D", "T"])
def test_commits_are_right(name: str) -> None:
    """Thirty starts each: found, and where the robot is."""
    metres = metres_to_commit(SCENARIOS[name], 30, 1, 25.0, 0.5)
    assert np.mean(metres) < (4.0 if name == "T" else 0.3)


def test_trees_that_were_replaced_aside_do_not_hide_the_place() -> None:
    """One tree in six was felled and another planted 0.3 to 0.5 m beside its stump: each of them was taken for the old one, and all told another
    orchard of this design."""
    c = replace(SCENARIOS["A"], replanted=0.17, view=12.0, miss=0.1)
    assert np.mean(metres_to_commit(c, 10, 23, 15.0, 0.3)) < 2.0


def test_a_perfect_lattice_stays_ambiguous() -> None:
    """Four corners look alike: no commit, and at least the four places are named."""
    c = replace(SCENARIOS["A"], jitter=0.0, gaps=0.0, felled=0.0, new=0.0)
    config = told(c)
    for seed in range(6):
        w = world(c, np.random.default_rng([seed, 3]))
        engine = Engine(index_of(w.mapped, config), config)
        for s in drive(w, c, np.random.default_rng([seed, 4]), 15.0):
            b = feed(engine, s, c)
            assert b.pose is None
        assert b.state == "ambiguous"
        assert b.hypotheses >= 2


def test_another_orchard_is_unknown() -> None:
    c = SCENARIOS["A"]
    config = told(c)
    for seed in range(6):
        w, v = (world(c, np.random.default_rng([seed, k])) for k in (5, 6))
        engine = Engine(index_of(w.mapped, config), config)
        for s in drive(v, c, np.random.default_rng([seed, 7]), 15.0):
            assert feed(engine, s, c).pose is None


def test_what_a_search_left_out_overrules_no_track() -> None:
    """Of two places the one that is held fits better, and the search has found the other alone; and the other way round."""
    c = SCENARIOS["A"]
    config = told(c)
    w = world(c, np.random.default_rng(12))
    engine = Engine(index_of(w.mapped, config), config)
    for s in drive(w, c, np.random.default_rng(13), 6.0):
        feed(engine, s, c)
    assert engine.track is not None
    h = engine.hunt
    own = on_top(engine.track.mean[:3], h.submap.filter.mean[:3])
    aside = own + [c.spacing, 0.0, 0.0]
    marks, rows = describe(h.submap, engine.index, config)
    beside = engine.track.moved(c.spacing, 0.0, 0.0, np.zeros(3))
    for found, held, overruled in [(aside, engine.track, False), (own, beside, True)]:
        h.found = Found(found[None], np.zeros(1), 0.0, 1)
        h.posterior, h.rows = weigh(h.found, marks, h.submap, engine.index, config), rows
        assert engine._fits_worse(held) == overruled


@pytest.mark.parametrize("lattice", [False, True])
def test_a_kidnapped_robot_notices(lattice: bool) -> None:
    c = SCENARIOS["A"]
    config = told(c)
    for seed in range(5):
        w = world(c, np.random.default_rng([seed, 8]))
        engine = Engine(index_of(w.mapped, config), config)
        jump = np.array([c.spacing, -c.row_spacing, 0.0]) if lattice else None
        driven, right, wrong = 0.0, 0, 0.0
        for s in drive(w, c, np.random.default_rng([seed, 9]), 22.0, jump_at=10.0, jump=jump):
            driven += s.distance
            b = feed(engine, s, c)
            if driven > 10.0 and b.pose is not None and np.hypot(*(b.pose[:2] - s.pose[:2])) > 0.5:
                wrong += s.distance
            if driven > 16.0:
                assert b.pose is None or np.hypot(*(b.pose[:2] - s.pose[:2])) < 0.5
                right += b.pose is not None
        assert engine.losses >= 1
        assert right > 5
        assert wrong < 0.6  # by the alarms, before the second opinion is asked


# -- dead reckoning -----------------------------------------------------------------------------------------------


BEGIN = 10**18


def odometry_at(t: float, x: float, y: float, yaw: float) -> Odometry:
    q = [0, 0, np.sin(yaw / 2), np.cos(yaw / 2)]
    return Odometry(BEGIN + round(1e9 * t), "base_link", np.array([x, y, 0, *q]), np.zeros(6))


def imu_at(t: float, rate: float, sideways: float = 0.0, bias: float = 0.0) -> Imu:
    return Imu(BEGIN + round(1e9 * t), "imu", np.array([0, 0, rate + bias]), np.array([0.0, sideways, 9.80665]))


def after(pose: Array, leg: Leg) -> Array:
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return pose + [c * leg.step[0] - s * leg.step[1], s * leg.step[0] + c * leg.step[1], leg.step[2]]


@given(st.floats(0.2, 2.0), st.floats(-0.5, 0.5), st.booleans(), st.sampled_from([1, 7, 13, 100, 400]))
@settings(max_examples=30, deadline=None)
def test_reckoning_of_an_arc(speed: float, rate: float, imu: bool, cut: int) -> None:
    """A constant twist ends where the closed form says, whichever sensor gives the turn, and however it is cut."""
    reckoner = Reckoner(robot_R_imu=np.eye(3))
    pose = np.zeros(3)
    for k in range(-10, 401):
        t = 0.01 * k
        if k % 5 == 0:
            yaw = rate * t
            x, y = (np.sin(yaw) / rate, (1 - np.cos(yaw)) / rate) if abs(rate) > 1e-6 else (t, 0.0)
            reckoner.add(odometry_at(t, speed * x, speed * y, yaw))
        if imu:
            reckoner.add(imu_at(t, rate, speed * rate))
        if k >= 0 and (k % cut == 0 or k == 400):
            leg = reckoner.advance(BEGIN + round(1e9 * t))
            pose = after(pose, leg)
            assert leg.gyro == (imu and k > 0)
            assert leg.blind == 0.0
    yaw = 4.0 * rate
    end = np.array([np.sin(yaw) / rate, (1 - np.cos(yaw)) / rate]) if abs(rate) > 1e-6 else np.array([4.0, 0.0])
    np.testing.assert_allclose(pose[:2], speed * end, atol=0.005 * speed if imu else 0.002)
    assert pose[2] == pytest.approx(yaw, abs=0.002)


@given(st.floats(-0.02, 0.02), st.floats(0.05, 1.5), st.sampled_from([0.1, 0.5, 1.0, 2.0, 8.0]))
@settings(max_examples=30, deadline=None)
def test_a_turn_after_a_stop_is_no_bias(bias: float, turn: float, every: float) -> None:
    """Stand 2 s, turn, stand 2 s: the turn is the gyro's, its bias is learnt at the stops, whatever the scans' cadence."""
    reckoner = Reckoner(robot_R_imu=np.eye(3))
    yaw, total = 0.0, 0.0
    for k in range(801):
        t = 0.01 * k
        rate = turn / 4.0 if 2.0 <= t < 6.0 else 0.0
        yaw += 0.01 * rate
        reckoner.add(imu_at(t, rate, bias=bias))
        if k % 2 == 0:
            reckoner.add(odometry_at(t, 0.0, 0.0, 0.9 * yaw))  # the wheels slip
        if k % round(100 * every) == 0:
            total += reckoner.advance(BEGIN + round(1e9 * t)).step[2]
    assert reckoner.bias[2] == pytest.approx(bias, abs=1e-3)
    late = abs(bias) * min(every, 2.5)  # what was turned before the bias was known
    assert total == pytest.approx(turn, abs=0.005 + late)


def test_wheels_that_fall_silent_are_missed_and_not_made_up_for() -> None:
    """Odometry that pauses leaves its time uncovered, and what it reports of it afterwards does not count twice."""
    reckoner = Reckoner(robot_R_imu=np.eye(3))
    legs = []
    for k in range(101):
        t = 0.1 * k
        for j in range(5):
            at = t - 0.08 + 0.02 * j
            if not 3.0 < at < 6.0:
                reckoner.add(odometry_at(at, at, 0.0, 0.0))
            reckoner.add(imu_at(at, 0.0))
        legs.append(reckoner.advance(BEGIN + round(1e9 * t)))
    blind = np.array([leg.blind for leg in legs])
    assert sum(blind) == pytest.approx(3.0, abs=0.2)
    assert not blind[:30].any()
    assert not blind[63:].any()
    assert sum(leg.distance for leg in legs) + sum(blind) == pytest.approx(10.0, abs=0.05)


@given(st.floats(0.3, 1.5), st.floats(-0.6, 0.6), st.floats(-0.1, 0.1))
@settings(max_examples=20, deadline=None)
def test_attitude_of_a_robot_that_starts_in_a_turn(speed: float, rate: float, pitch: float) -> None:
    """What the wheels explain of specific force is not taken for a tilt, and the tilt's deviation says how new it is."""
    reckoner = Reckoner(robot_R_imu=np.eye(3))
    down = 9.80665 * np.array([-np.sin(pitch), 0.0, np.cos(pitch)])
    for k in range(61):
        t = 0.01 * k
        if k % 2 == 0:
            yaw = rate * t
            x, y = (np.sin(yaw) / rate, (1 - np.cos(yaw)) / rate) if abs(rate) > 1e-6 else (t, 0.0)
            reckoner.add(odometry_at(t, speed * x, speed * y, yaw))
        force = down + [0.0, speed * rate, 0.0]
        reckoner.add(Imu(BEGIN + round(1e9 * t), "imu", rate * down / 9.80665, force))
        if k in (20, 60):
            leg = reckoner.advance(BEGIN + round(1e9 * t))
            assert leg.roll == pytest.approx(0.0, abs=0.012)
            assert leg.pitch == pytest.approx(pitch, abs=0.012)
            assert leg.tilt_sigma > 0.02


@pytest.mark.parametrize("every", [1, 10, 100])
def test_how_often_it_is_asked_makes_the_tilt_no_surer(every: int) -> None:
    """After a minute gravity's own deviation is left, whether a scan came every hundredth of a second or each second."""
    reckoner = Reckoner(robot_R_imu=np.eye(3))
    for k in range(6001):
        t = 0.01 * k
        if k % 2 == 0:
            reckoner.add(odometry_at(t, t, 0.0, 0.0))
        reckoner.add(imu_at(t, 0.0))
        if k % every == 0 and k > 0:
            leg = reckoner.advance(BEGIN + round(1e9 * t))
    assert 0.01 <= leg.tilt_sigma < 0.012


# -- the thesis's method ------------------------------------------------------------------------------------------


@given(seeds)
@settings(max_examples=40, deadline=None)
def test_multilateration_of_exact_ranges(seed: int) -> None:
    rng = np.random.default_rng(seed)
    beacons = rng.uniform(-10, 10, (4, 2))
    place, yaw = rng.uniform(-5, 5, 2), rng.uniform(-3, 3)
    c, s = np.cos(yaw), np.sin(yaw)
    found = multilaterate((beacons - place) @ np.array([[c, -s], [s, c]]), beacons)
    np.testing.assert_allclose(found[:2], place, atol=1e-3)
    assert abs((found[2] - yaw + np.pi) % (2 * np.pi) - np.pi) < 1e-3


def trunks_at(p: Array, stamp: int) -> Trunks:
    n = len(p)
    return Trunks(
        stamp_ns=stamp,
        frame="base_link",
        p=np.column_stack([p, np.full(n, 0.8)]),
        axis=np.tile([0.0, 0.0, 1.0], (n, 1)),
        diameter=np.full(n, np.nan),
        cov=np.tile(1e-3 * np.eye(3), (n, 1, 1)),
        height=np.full(n, 0.8),
        score=np.ones(n),
    )


def test_the_thesis_finds_scattered_trees_and_explodes_in_rows() -> None:
    rng = np.random.default_rng(1)
    trees = rng.uniform(0, 30, (20, 2))
    place = np.array([15.0, 14.0])
    seen = trees - place
    leg = Leg(step=np.zeros(3), distance=0.0, turned=0.0, seconds=0.1)
    method = ThesisMethod(TopoMap.of_points(trees), ThesisConfig(view=9.0))
    for k in range(12):
        report = method.step(trunks_at(seen[np.hypot(*seen.T) < 9.0], k + 1), leg)
    assert report.fix is not None
    np.testing.assert_allclose(report.fix.map_T_robot[:2, 3], place, atol=0.05)
    rows = np.stack(np.meshgrid(np.arange(30) * 4.0, np.arange(30) * 4.0), axis=-1).reshape(-1, 2)
    method = ThesisMethod(TopoMap.of_points(rows), ThesisConfig(view=9.0))
    seen = rows - [58.3, 57.9]
    method.step(trunks_at(seen[np.hypot(*seen.T) < 9.0], 1), leg)
    assert method.exploded == 1


# -- the door and the whole chain ---------------------------------------------------------------------------------


def test_a_map_of_one_tree_is_refused() -> None:
    with pytest.raises(InsufficientDataError, match="1 trees"):
        Localizer(TopoMap.of_points(np.zeros((1, 2))))


def test_live_door_gives_poses_and_reports() -> None:
    """Fed message by message: no pose while nothing is seen, then the right one, then every scan."""
    rng = np.random.default_rng(3)
    trees = rng.uniform(0, 40, (30, 2))
    localizer = Localizer(TopoMap.of_points(trees))
    assert localizer.update(trunks_at(np.zeros((0, 2)), 10**18)) is None
    place = np.array([15.0, 20.0])
    for k in range(8):
        stamp = 10**18 + (k + 1) * 500_000_000
        x = place + [0.4 * k, 0.0]
        seen = trees - x
        near = seen[np.hypot(*seen.T) < 15.0]
        pose = np.array([0.4 * k, 0, 0, 0, 0, 0, 1.0])
        fix = localizer.update(
            trunks_at(near + rng.normal(0, 0.02, near.shape), stamp),
            [Odometry(stamp, "base_link", pose, np.zeros(6))],
        )
    assert fix is not None
    assert localizer.report is not None
    assert localizer.report.state == "tracking"
    np.testing.assert_allclose(fix.map_T_robot[:2, 3], x, atol=0.06)
    assert np.linalg.eigvalsh(fix.cov).min() > 0


@pytest.mark.parametrize("first", [0.5, 1.1])
def test_leaning_trees_are_compared_at_the_height_that_all_scans_say(first: float) -> None:
    """Recorded detections at 0.8 m on trees that lean, whose height some scans misjudge: the ground under the robot went on otherwise."""
    rng = np.random.default_rng(5)
    foot = rng.uniform(0, 40, (40, 2))
    axis = np.tile(np.array([0.25, 0.0, 1.0]) / np.hypot(0.25, 1.0), (40, 1))
    localizer = Localizer(replace(TopoMap.of_points(foot), axis=axis))
    fix = None
    for k in range(16):
        x, stamp = np.array([12.0 + 0.4 * k, 20.0]), 10**18 + k * 500_000_000
        rows = np.flatnonzero(np.hypot(*(foot - x).T) < 12.0)
        seen = foot[rows] + [0.25 * 0.8, 0.0] - x + rng.normal(0, 0.01, (len(rows), 2))
        height = first if k == 0 else 0.8 + 0.5 * (k % 5 > 2)  # and two in five that follow
        trunks = replace(trunks_at(seen, stamp), axis=axis[rows], height=np.full(len(rows), height))
        heard = [imu_at(0.5 * k + t, 0.0) for t in (-0.4, -0.3, -0.2, -0.1, 0.0)]
        fix = localizer.update(trunks, [*heard, odometry_at(0.5 * k, 0.4 * k, 0.0, 0.0)])
    assert fix is not None
    np.testing.assert_allclose(fix.map_T_robot[:2, 3], x, atol=0.03)


@pytest.fixture(scope="module")
def mapped(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An orchard mapped from run 1, and run 3 (zigzag) of it without GNSS."""
    folder = tmp_path_factory.mktemp("localize")
    orchard = replace(DESIGNS["grid"], lean=0.02)
    sensor = SensorConfig(detections=True, compression="zstd")
    record(folder / "run1", 4, orchard, DriveConfig(run=1), sensor)
    record(folder / "run3", 4, orchard, DriveConfig(run=3), replace(sensor, gnss="none"))
    out = CliRunner().invoke(
        main, ["map", str(folder / "run1"), "-o", str(folder / "m.gpkg"), "--results", str(folder / "map"), "-q"]
    )
    assert out.exit_code == 0, out.output
    return folder


@pytest.mark.parametrize("method", ["graph", "thesis"])
def test_localize_command(mapped: Path, tmp_path: Path, method: str) -> None:
    words = [
        "localize",
        str(mapped / "m.gpkg"),
        str(mapped / "run3"),
        "--results",
        str(tmp_path),
        "--method",
        method,
        "-q",
    ]
    out = CliRunner().invoke(main, [*words, "--truth", str(mapped / "run3.truth")])
    assert out.exit_code == 0, out.output
    with (tmp_path / "localization.csv").open() as f:
        rows = list(csv.DictReader(f))
    assert list(rows[0])[:12] == [
        "stamp",
        "state",
        "x",
        "y",
        "z",
        "qx",
        "qy",
        "qz",
        "qw",
        "hypotheses",
        "risk",
        "trees",
    ]
    stamps, poses = read_tum(tmp_path / "localization.tum")
    assert len(stamps) == sum(r["x"] != "" for r in rows)
    assert {r["state"] for r in rows} <= {"searching", "ambiguous", "tracking", "degraded", "lost"}
    assert (tmp_path / "report.html").stat().st_size > 10_000
    if method == "graph":
        truth, topo = Truth.load(mapped / "run3.truth"), store.load(mapped / "m.gpkg")
        assert topo.datum is not None
        true = interpolate(truth.stamps_ns, truth.world_T_robot, stamps)
        at = topo.datum.to_enu(truth.datum.to_geodetic(true[:, :3, 3]))
        for p in (poses, read_tum(tmp_path / "smoothed.tum")[1]):
            error = np.hypot(*(p[:, :2, 3] - at[:, :2]).T)
            assert error.mean() < 0.05
            assert np.percentile(error, 99) < 0.15
        assert len(stamps) > 0.9 * len(rows)


def test_nothing_to_localize_with(mapped: Path) -> None:
    runner = CliRunner()
    out = runner.invoke(main, ["localize", str(mapped / "m.gpkg"), str(mapped / "run3"), "--topic-odometry", "none"])
    assert out.exit_code == 4
    assert "--topic-odometry" in out.output
    out = runner.invoke(main, ["localize", str(mapped / "none.gpkg"), str(mapped / "run3")])
    assert out.exit_code == 5


def test_a_record_of_passage_says_how_far_the_view_is_open() -> None:
    free = np.zeros(2 * SECTORS, np.uint32)
    free[:] = (1 << 12) - 1  # seen through to 12 m: what stands in the thirteenth may be seen
    free[100:110] = (1 << 3) - 1  # a car at 3 m
    far = open_to(free)
    assert far[10] == 13.0
    assert (far[51:54] == 4.0).all()  # but for its edges: the sensor stands beside the base
    assert np.isinf(open_to(np.zeros(0, np.uint32))).all()


def test_trees_behind_a_parked_car_are_not_missing() -> None:
    """Nine tenths of the view are blocked from 2 m on for 10 m of the way, and some trunks of the rest are missed as ever."""
    c = replace(SCENARIOS["A"], trees=300, miss=0.1, clutter=0.02)
    config = told(c)
    doubt = {True: 0.0, False: 0.0}
    for seed, told_of_it in itertools.product(range(4), doubt):
        w = world(c, np.random.default_rng([seed, 31]))
        engine = Engine(index_of(w.mapped, config), config)
        driven = 0.0
        for s in drive(w, c, np.random.default_rng([seed, 32]), 25.0):
            driven += s.distance
            blocked = 10.0 < driven < 20.0
            away = np.arctan2(s.p[:, 1], s.p[:, 0])
            keep = ~(blocked & (away > -2.4) & (np.hypot(*s.p.T) > 2.0))
            bearing = (np.arange(SECTORS) + 0.5) * (2 * np.pi / SECTORS) - np.pi
            view = np.where(blocked & told_of_it & (bearing > -2.4), 3.0, np.inf)
            n = int(keep.sum())
            cov = np.diag([(0.02 * s.distance) ** 2 + 1e-4] * 2 + [0.007**2 * max(s.distance, 0.01)])
            engine.step(
                Move(s.motion, cov, s.distance),
                Sweep(
                    s.p[keep], np.tile(c.sigma**2 * np.eye(2), (n, 1, 1)), np.full(n, np.nan), np.full(n, 0.01), view
                ),
            )
            if blocked:
                doubt[told_of_it] += engine.sums[0]
        assert engine.losses == 0 or not told_of_it
    assert doubt[True] < 0.5 * doubt[False]
