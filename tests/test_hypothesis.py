"""The graph of one place: against the batch solution, its own promises, and what each measurement is worth."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import factors
from factors import Kernel
from topograph.localize.config import LocalizeConfig
from topograph.localize.hypothesis import LAG, OLDEST, Hypothesis
from topograph.localize.submap import Move, Sweep

NONE = Kernel("none")
MAP_SIGMA, STEP, TURN, SIGMA = 0.03, 0.01, 0.004, 0.05


@given(
    st.tuples(st.floats(-5, 5), st.floats(-5, 5), st.floats(-3, 3)),
    st.tuples(st.floats(2, 15), st.floats(-10, 10)),
    st.tuples(st.floats(-0.2, 0.2), st.floats(-0.2, 0.2)),
    st.sampled_from(factors.MEASURES),
)
def test_a_sighting_in_the_plane(
    pose: tuple[float, float, float], seen: tuple[float, float], off: tuple[float, float], measure: str
) -> None:
    """Its error by hand, and its Jacobians against numerical ones."""
    T = gtsam.Pose2(*pose)
    place = T.transformFrom(np.add(seen, off))
    f = factors.sighting_2d(1, 2, seen, np.diag([0.04, 0.01]), NONE, measure)
    v = gtsam.Values()
    v.insert(1, T)
    v.insert(2, place)
    true = np.add(seen, off)
    by = np.arctan2(true[1], true[0]) - np.arctan2(seen[1], seen[0]), np.hypot(*true) - np.hypot(*seen)
    line = np.array(seen) / np.hypot(*seen)
    side = np.array([-line[1], line[0]])
    sigma = np.sqrt(side @ np.diag([0.04, 0.01]) @ side) / np.hypot(*seen), np.sqrt(line @ np.diag([0.04, 0.01]) @ line)
    chosen = {"both": [0, 1], "bearings": [0], "ranges": [1]}[measure]
    assert f.error(v) == pytest.approx(0.5 * sum((by[k] / sigma[k]) ** 2 for k in chosen), rel=1e-6, abs=1e-9)
    A, _ = f.linearize(v).jacobian()
    for k in range(5):
        d = np.zeros(5)
        d[k] = 1e-6
        ends = []
        for sign in (1.0, -1.0):
            w = gtsam.Values()
            w.insert(1, T.retract(sign * d[:3]))
            w.insert(2, place + sign * d[3:])
            ends.append(f.linearize(w).jacobian()[1])
        np.testing.assert_allclose(A[:, k], -(ends[0] - ends[1]) / 2e-6, atol=1e-4)


class World:
    """A drive in a circle among trees, with errors of the sizes that are stated."""

    def __init__(self, seed: int, bias: float = 0.0, map_sigma: float = MAP_SIGMA) -> None:
        self.rng = np.random.default_rng(seed)
        self.true = self.rng.uniform(-18, 18, (60, 2))
        self.mapped = self.true + self.rng.normal(0, map_sigma, (60, 2))
        self.pose = np.array([6.0, 0.0, np.pi / 2])
        self.bias = bias
        self.cov = np.diag([STEP**2, STEP**2, TURN**2])

    def begin(self, config: LocalizeConfig) -> Hypothesis:
        cov = np.diag([0.05, 0.05, 0.02]) ** 2
        start = self.pose + self.rng.multivariate_normal(np.zeros(3), cov)
        return Hypothesis(start, cov, self.mapped, np.full(60, MAP_SIGMA**2), config)

    def step(self) -> tuple[Move, Sweep, np.ndarray]:
        move = np.array([0.2, 0.0, 0.2 / 6.0])
        c, s = np.cos(self.pose[2]), np.sin(self.pose[2])
        self.pose = self.pose + [c * move[0], s * move[0], move[2]]
        c, s = np.cos(self.pose[2]), np.sin(self.pose[2])
        body = (self.true - self.pose[:2]) @ np.array([[c, -s], [s, c]])
        near = np.flatnonzero((np.hypot(*body.T) < 9.0) & (np.hypot(*body.T) > 0.5) & (self.rng.random(60) < 0.7))
        z = body[near] + self.rng.normal(0, SIGMA, (len(near), 2)) + [self.bias, 0.0]
        told = move + self.rng.multivariate_normal(np.zeros(3), self.cov)
        n = len(near)
        sweep = Sweep(z, np.tile(SIGMA**2 * np.eye(2), (n, 1, 1)), np.full(n, np.nan), np.full(n, 0.01))
        return Move(told, self.cov, 0.2), sweep, np.column_stack([np.arange(n), near])


def off(h: Hypothesis, w: World) -> np.ndarray:
    e = h.pose - w.pose
    e[2] = (e[2] + np.pi) % (2 * np.pi) - np.pi
    return e


def nees(measure: str, seeds: range) -> tuple[float, float]:
    """Mean NEES of the pose (3 is right) and mean distance, m, after the oldest poses have been marginalised several times."""
    config = LocalizeConfig(measure=measure, trunk_sigma=0.0)  # type: ignore[arg-type]  # one of its words
    out, far = [], []
    for seed in seeds:
        w = World(seed)
        h = w.begin(config)
        for k in range(70):
            h.step(*w.step())
            if k > 40 and k % 5 == 0:
                e = off(h, w)
                out.append(e @ np.linalg.solve(h.cov, e))
                far.append(np.hypot(*e[:2]))
    return float(np.mean(out)), float(np.mean(far))


def test_what_is_stated_is_true_and_what_each_measurement_is_worth() -> None:
    both, bearings, ranges = (nees(m, range(24)) for m in ("both", "bearings", "ranges"))
    for value, _ in (both, bearings, ranges):
        assert 2.2 < value < 4.2
    assert both[1] < bearings[1]
    assert both[1] < ranges[1]
    assert both[1] < 0.03


@pytest.mark.parametrize(("map_sigma", "low", "high"), [(0.005, 0.2, 0.5), (0.03, 0.7, 1.4), (0.06, 1.8, 4.5)])
def test_how_well_the_map_is_known_is_learnt(map_sigma: float, low: float, high: float) -> None:
    """Trees that lie better than is taken for granted, as well, and worse: the covariance follows, with caution."""
    config = LocalizeConfig(trunk_sigma=0.0)
    scales = []
    for seed in range(12):
        w = World(seed, map_sigma=map_sigma)
        h = w.begin(config)
        assert h.scale == 1.0
        assert w.begin(LocalizeConfig(map_sigma=0.2)).scale == 1.0
        assert w.begin(LocalizeConfig(map_sigma=0.005)).scale == 1.0
        for _ in range(70):
            h.step(*w.step())
        scales.append(h.scale)
    assert low < np.median(scales) < high


def test_the_lag_costs_nothing() -> None:
    """Marginalising old poses changes little against the batch graph of all of them."""
    config = LocalizeConfig(trunk_sigma=0.0)
    w, again = World(5), World(5)
    h, whole = w.begin(config), again.begin(config)
    whole._marginalise = lambda: None  # type: ignore[method-assign]  # the batch solution
    for _ in range(4 * (LAG + OLDEST)):
        h.step(*w.step())
        whole.step(*again.step())
        assert len(h._poses) <= LAG + OLDEST + 1
    assert len(whole._poses) == 4 * (LAG + OLDEST) + 1
    np.testing.assert_allclose(h.pose, whole.pose, atol=2e-3)
    np.testing.assert_allclose(np.sqrt(np.diag(h.cov)), np.sqrt(np.diag(whole.cov)), rtol=0.1)


def test_a_wrong_sighting_does_not_pull() -> None:
    """Huber: one trunk in eight taken for the wrong tree."""
    w = World(7)
    h = w.begin(LocalizeConfig(trunk_sigma=0.0))
    for _ in range(40):
        move, sweep, pairs = w.step()
        sweep.p[:: max(len(pairs), 8)] += [0.6, -0.5]
        h.step(move, sweep, pairs)
    assert np.hypot(*off(h, w)[:2]) < 0.08


def test_without_trees_it_is_dead_reckoning() -> None:
    w = World(9)
    h = w.begin(LocalizeConfig())
    before = h.cov[0, 0]
    for _ in range(60):
        move, sweep, _ = w.step()
        h.step(move, sweep, np.zeros((0, 2), np.int64))
    assert h.cov[0, 0] > before + 20 * STEP**2
    e = off(h, w)
    assert e @ np.linalg.solve(h.cov, e) < 16.0
