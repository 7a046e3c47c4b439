"""Numerics for compiled kernels are numpy's."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from topograph.compiled import determinant3, quantile, solve3

finite = st.floats(-1e3, 1e3)


@settings(deadline=None)  # the first call may compile
@given(arrays(float, st.integers(1, 40), elements=finite), st.floats(0.0, 1.0))
def test_quantile(values, share):
    kept = values.copy()
    np.testing.assert_allclose(quantile(values, share), np.quantile(values, share), rtol=1e-9, atol=1e-9)
    np.testing.assert_array_equal(values, kept)


@settings(deadline=None)
@given(arrays(float, (3, 3), elements=st.floats(-3, 3)), arrays(float, 3, elements=finite))
def test_solution_and_determinant(root, b):
    A = root @ root.T + 0.1 * np.eye(3)
    np.testing.assert_allclose(A @ solve3(A, b), b, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(determinant3(A), np.linalg.det(A), rtol=1e-6)
