"""Each factor against numerical Jacobians, its native twin, and a hand-computed residual."""

import gtsam
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

import factors
from factors import Kernel
from topograph.geometry import exp, inverse, transform

tangents = arrays(float, 6, elements=st.floats(-1.2, 1.2))
points = arrays(float, 3, elements=st.floats(-20, 20))
X, L = 1, 2
NONE = Kernel("none")


def values(T: np.ndarray, p: np.ndarray | None = None) -> gtsam.Values:
    v = gtsam.Values()
    v.insert(X, factors.to_pose3(T))
    if p is not None:
        v.insert(L, p)
    return v


@given(arrays(float, (5, 3), elements=st.floats(-1, 1)))
def test_bearing_basis_is_gtsams(d: np.ndarray) -> None:
    d = d + np.array([1.5, 0.3, -0.2])
    unit = d / np.linalg.norm(d, axis=1, keepdims=True)
    ours = factors.bearing_basis(unit)
    for u, b in zip(unit, ours, strict=True):
        np.testing.assert_allclose(b, gtsam.Unit3(u).basis(), atol=1e-9)


@given(
    st.floats(-3.1, 3.1),
    st.floats(-0.3, 0.3),
    st.tuples(st.floats(-0.05, 0.05), st.floats(-0.05, 0.05), st.floats(-0.1, 0.1)),
)
@example(2.4e-16, 0.03125, (0.0, 0.03125, 0.0))  # as high as it is aside, but for the last bit
@example(2.4e-16, 0.03125, (0.0, 0.03125, 1e-17))
@example(np.pi / 2, 0.0, (0.0, 0.03, 0.0))
def test_a_trunk_abeam_has_its_height_weighed_as_its_height(
    bearing: float, height: float, off: tuple[float, float, float]
) -> None:
    """Whatever axis GTSAM's basis is built across: the error is that of the straight residual, where height is known ten times worse."""
    seen = np.array([4.0 * np.cos(bearing), 4.0 * np.sin(bearing), height])
    expected = seen + off
    cov = np.diag([0.03, 0.03, 0.3]) ** 2
    f = factors.trunks([1], [2], seen[None], cov[None], Kernel("none"), expected=expected[None])[0]
    v = gtsam.Values()
    v.insert(1, gtsam.Pose3())
    v.insert(2, expected)
    straight = 0.5 * np.array(off) @ np.linalg.solve(cov, off)
    assert f.error(v) == pytest.approx(straight, rel=0.2, abs=0.2)


@given(tangents, points, points)
def test_trunk_residual_jacobians(xi: np.ndarray, tree: np.ndarray, z: np.ndarray) -> None:
    T = exp(xi)
    e, by_pose, by_tree = factors.trunk_residual(T, tree, z)
    np.testing.assert_allclose(e, transform(inverse(T), tree) - z, atol=1e-9)
    h = 1e-6
    for k in range(6):
        d = np.zeros(6)
        d[k] = h
        numeric = (factors.trunk_residual(T @ exp(d), tree, z)[0] - factors.trunk_residual(T @ exp(-d), tree, z)[0]) / (
            2 * h
        )
        np.testing.assert_allclose(by_pose[:, k], numeric, atol=1e-5)
    for k in range(3):
        d = np.zeros(3)
        d[k] = h
        numeric = (factors.trunk_residual(T, tree + d, z)[0] - factors.trunk_residual(T, tree - d, z)[0]) / (2 * h)
        np.testing.assert_allclose(by_tree[:, k], numeric, atol=1e-5)


@given(tangents, points, arrays(float, 3, elements=st.floats(-0.03, 0.03)), st.floats(0.02, 0.3))
def test_native_trunk_agrees_with_cartesian_twin(
    xi: np.ndarray, body: np.ndarray, error: np.ndarray, sigma: float
) -> None:
    """Whitened norms of the native (bearing, range) and of the Cartesian residual agree to first order in error/range."""
    size = np.sort(np.abs(body))
    if np.linalg.norm(body) < 2.0 or size[1] - size[0] < 0.2:  # where two axes are least, Unit3's basis jumps
        return
    T = exp(xi)
    cov = sigma**2 * np.diag([1.0, 2.0, 3.0])
    tree = transform(T, body)
    z = body + error
    native = factors.trunk(X, L, z, cov, NONE).error(values(T, tree))
    twin = 0.5 * error @ np.linalg.inv(cov) @ error
    assert native == pytest.approx(twin, rel=float(6 * np.linalg.norm(error) / np.linalg.norm(body) + 1e-6), abs=1e-9)


@given(tangents, points, arrays(float, 3, elements=st.floats(-1, 1)))
def test_fix_is_the_antenna(xi: np.ndarray, z: np.ndarray, lever: np.ndarray) -> None:
    T = exp(xi)
    f = factors.fix(X, z, lever, np.diag([0.01, 0.01, 0.04]), NONE)
    np.testing.assert_allclose(f.unwhitenedError(values(T)), transform(T, lever) - z, atol=1e-9)


@given(st.floats(-3.1, 3.1), st.floats(-0.02, 0.02), st.floats(-0.2, 0.2))
def test_heading_sees_azimuth_only(yaw: float, error: float, pitch: float) -> None:
    """Azimuth errors weigh as sigma says, whatever the slope; the slope itself costs next to nothing."""
    c, s = np.cos(yaw), np.sin(yaw)
    cp, sp = np.cos(pitch), np.sin(pitch)
    T = np.eye(4)
    T[:3, :3] = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    f = factors.heading(X, yaw + error, [1.0, 0.0, 0.0], 0.01, NONE)
    expected = 0.5 * (error * cp / 0.01) ** 2
    assert f.error(values(T)) == pytest.approx(expected, rel=0.05, abs=0.15)


def test_heading_of_a_sideways_baseline() -> None:
    T = np.eye(4)
    f = factors.heading(X, -np.pi / 2, [0.0, -1.0, 0.0], 0.01, NONE)
    assert f.error(values(T)) == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize(
    "make",
    [
        lambda: factors.sigmas([0.1, np.nan]),
        lambda: factors.sigmas([0.1, 0.0]),
        lambda: factors.gaussian(np.diag([1.0, -1.0])),
        lambda: factors.gaussian(np.full((2, 2), np.nan)),
        lambda: factors.to_pose3(2 * np.eye(4)),
        lambda: factors.fix(X, [np.nan, 0, 0], [0, 0, 0], np.eye(3), NONE),
        lambda: factors.trunk(X, L, [0.0, 0.0, 0.0], np.eye(3), NONE),
        lambda: factors.range_2d(X, L, -1.0, 0.1, NONE),
        lambda: factors.heading(X, np.nan, [1, 0, 0], 0.1, NONE),
    ],
)
def test_nonsense_is_refused(make) -> None:
    with pytest.raises(ValueError):
        make()


@pytest.mark.parametrize("name", ["huber", "cauchy", "tukey", "dcs"])
@given(d=st.floats(0, 20))
def test_kernel_weights_are_gtsams(name: str, d: float) -> None:
    kernel = Kernel(name, 3.0)
    assert float(kernel.weight(d)) == pytest.approx(kernel.estimator().weight(d), abs=1e-9)


def test_bias_walks_are_those_of_their_sensor() -> None:
    noise = factors.ImuNoise(gyro_walk=1e-4, accel_walk=1e-2)
    f = factors.bias_walk(1, 2, 4.0, noise)
    for accel, gyro, expected in ((2e-2, 0.0, 0.5), (0.0, 2e-4, 0.5), (2e-4, 0.0, 0.5e-4)):
        v = gtsam.Values()
        v.insert(1, gtsam.imuBias.ConstantBias())
        v.insert(2, gtsam.imuBias.ConstantBias(np.array([accel, 0, 0]), np.array([gyro, 0, 0])))
        assert f.error(v) == pytest.approx(expected, rel=1e-6)


def test_preintegration_is_as_sure_as_its_samples() -> None:
    """White noise of density s makes an angle of deviation s √t, and a speed of deviation s √t; gravity is taken off."""
    noise = factors.ImuNoise(gyro=2e-3, accel=3e-2)
    n, dt = 400, 0.005
    accel = np.tile([0.0, 0.0, 9.80665], (n, 1))
    pim = factors.preintegrate(
        factors.preintegration(noise, np.eye(4)), np.full(n, dt), np.zeros((n, 3)), accel, np.zeros(3)
    )
    sigma = np.sqrt(np.diag(pim.preintMeasCov()))
    np.testing.assert_allclose(sigma[:3], 2e-3 * np.sqrt(n * dt), rtol=0.02)
    assert sigma[8] == pytest.approx(3e-2 * np.sqrt(n * dt), rel=0.1)
    still = pim.predict(gtsam.NavState(gtsam.Pose3(), np.zeros(3)), gtsam.imuBias.ConstantBias())
    np.testing.assert_allclose(still.pose().translation(), np.zeros(3), atol=1e-6)


@given(tangents, points, arrays(float, 3, elements=st.floats(-0.5, 0.5)))
def test_fix_linear_is_the_native_fix(xi: np.ndarray, lever: np.ndarray, error: np.ndarray) -> None:
    """Its horizontal and vertical parts, linearised, are those of the native factors of the same noise."""
    T = exp(xi)
    z = transform(T, lever) + error
    cov = np.array([[0.04, 0.01, 0.0], [0.01, 0.09, 0.0], [0.0, 0.0, 0.16]])
    g = gtsam.GaussianFactorGraph()
    column = np.zeros((1, 3, 1))
    column[0, 0, 0] = 1.0
    factors.fix_linear(g, [X], T[None], lever[None], z[None], cov[None], NONE, (7, column))
    native = factors.fix(X, z, lever, cov, NONE).linearize(values(T))
    zero = gtsam.VectorValues()
    zero.insert(X, np.zeros(6))
    zero.insert(7, np.zeros(1))
    assert g.error(zero) == pytest.approx(native.error(zero), rel=1e-6, abs=1e-9)
    step = gtsam.VectorValues()
    step.insert(X, np.array([0.01, -0.02, 0.03, 0.1, -0.2, 0.05]))
    step.insert(7, np.zeros(1))
    assert g.error(step) == pytest.approx(native.error(step), rel=1e-6, abs=1e-9)
