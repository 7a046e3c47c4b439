"""Lie axioms, round trips, and agreement with pyproj and gtsam."""

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from topograph import geometry as g

tangents = arrays(float, 6, elements=st.floats(-1.7, 1.7))
points = arrays(float, 3, elements=st.floats(-50, 50))


@given(tangents)
def test_log_inverts_exp(xi: np.ndarray) -> None:
    np.testing.assert_allclose(g.log(g.exp(xi)), xi, atol=1e-8)


@given(tangents)
def test_exp_is_gtsams(xi: np.ndarray) -> None:
    np.testing.assert_allclose(g.exp(xi), gtsam.Pose3.Expmap(xi).matrix(), atol=1e-9)


@given(tangents, tangents, points)
def test_group(a: np.ndarray, b: np.ndarray, p: np.ndarray) -> None:
    A, B = g.exp(a), g.exp(b)
    np.testing.assert_allclose(g.inverse(A) @ A, np.eye(4), atol=1e-10)
    np.testing.assert_allclose(g.transform(A @ B, p), g.transform(A, g.transform(B, p)), atol=1e-8)


@given(tangents)
def test_quaternion_round_trip(xi: np.ndarray) -> None:
    T = g.exp(xi)
    np.testing.assert_allclose(g.from_quaternion(T[:3, 3], g.to_quaternion(T)), T, atol=1e-9)


@given(tangents, tangents, st.floats(0, 1))
def test_interpolation_is_constant_twist(a: np.ndarray, step: np.ndarray, u: float) -> None:
    poses = np.stack([g.exp(a), g.exp(a) @ g.exp(0.5 * step)])
    at = int(1e9 * u)
    out = g.interpolate(np.array([0, 1_000_000_000]), poses, at)[0]
    np.testing.assert_allclose(out, g.exp(a) @ g.exp(0.5 * step * at / 1e9), atol=1e-8)


@given(st.floats(-85, 85), st.floats(-179, 179), arrays(float, (4, 3), elements=st.floats(-3000, 3000)))
def test_enu_round_trip(lat: float, lon: float, p: np.ndarray) -> None:
    datum = g.Datum(lat, lon, 100.0)
    np.testing.assert_allclose(datum.to_enu(datum.to_geodetic(p)), p, atol=1e-4)


def test_enu_axes() -> None:
    datum = g.Datum(*np.array([40.0, -8.0, 0.0]))  # numpy's numbers print differently, and PROJ reads prints
    e, n, u = datum.to_enu([40.0, -8.0 + 1e-4, 10.0])
    assert e == pytest.approx(8.54, abs=0.02)
    assert n == pytest.approx(0, abs=1e-3)
    assert u == pytest.approx(10, abs=1e-3)


@given(arrays(float, (6, 2), elements=st.floats(-20, 20)), st.floats(-3, 3), st.floats(-9, 9), st.floats(-9, 9))
def test_rigid_fit_recovers_motion(source: np.ndarray, yaw: float, x: float, y: float) -> None:
    if np.linalg.matrix_rank(source - source.mean(0), tol=1.0) < 1:
        return
    c, s = np.cos(yaw), np.sin(yaw)
    target = source @ np.array([[c, s], [-s, c]]) + [x, y]
    fx, fy, fyaw = g.fit_rigid_2d(source, target)
    c, s = np.cos(fyaw), np.sin(fyaw)
    np.testing.assert_allclose(source @ np.array([[c, s], [-s, c]]) + [fx, fy], target, atol=1e-6)


def test_align_se3_recovers_motion() -> None:
    rng = np.random.default_rng(0)
    p = rng.normal(size=(20, 3))
    T = g.exp(np.array([0.3, -0.2, 2.0, 4.0, 5.0, 6.0]))
    np.testing.assert_allclose(g.align_se3(p, g.transform(T, p)), T, atol=1e-9)


def test_align_se3_never_mirrors() -> None:
    """Points that a mirror would fit better are still turned only."""
    rng = np.random.default_rng(1)
    p = rng.normal(size=(20, 3)) * [5.0, 3.0, 0.1]
    R = g.align_se3(p, p * [1.0, 1.0, -1.0])[:3, :3]
    assert np.linalg.det(R) == pytest.approx(1.0)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-9)


@given(arrays(float, (3, 3), elements=st.floats(-1, 1)))
def test_information_inverts_covariance(root: np.ndarray) -> None:
    cov = root @ root.T + 1e-4 * np.eye(3)
    np.testing.assert_allclose(g.inverse_cov(np.stack([cov, cov]))[1] @ cov, np.eye(3), atol=1e-6)


@given(st.floats(0.2, 1.5), st.floats(0.0, 2.0), st.floats(0.005, 0.1), st.floats(0.005, 0.05))
def test_a_trunk_is_known_best_where_it_was_seen(seen: float, height: float, lean: float, sigma: float) -> None:
    """Against samples: a place seen at one height, an axis with an error of its own, the foot along it and from there up again."""
    rng = np.random.default_rng(2)
    place, slope = sigma * rng.normal(size=(4000, 2)), lean * rng.normal(size=(4000, 2))
    foot = place - seen * slope
    foot_cov = np.diag([*np.cov(foot.T)[[0, 1], [0, 1]], 0.01])[None]
    up = np.array([[0.0, 0.0, 1.0]])
    p, cov = g.above_ground(np.zeros((1, 3)), foot_cov, up, np.array([lean]), np.array([seen]), height)
    np.testing.assert_allclose(p, [[0.0, 0.0, height]])
    true = np.var(foot + height * slope, axis=0)
    np.testing.assert_allclose(cov[0, [0, 1], [0, 1]], true, rtol=0.1, atol=0.1 * foot_cov[0, 0, 0])
