"""Noise models, checked: GTSAM accepts NaN and negative variances silently."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np
from numpy.typing import ArrayLike, NDArray

_ESTIMATORS: dict[str, Any] = {
    "huber": gtsam.noiseModel.mEstimator.Huber,
    "cauchy": gtsam.noiseModel.mEstimator.Cauchy,
    "tukey": gtsam.noiseModel.mEstimator.Tukey,
    "dcs": gtsam.noiseModel.mEstimator.DCS,
}


@dataclass(frozen=True, slots=True)
class Kernel:
    """A robust loss: "none", "huber", "cauchy", "tukey" or "dcs", and its constant in standard deviations."""

    name: str = "none"
    width: float = 1.345

    def weight(self, distance: ArrayLike) -> NDArray[np.float64]:
        """Weight (...) of residuals whose whitened norm is `distance` (...), as GTSAM's estimators define it."""
        d: NDArray[np.float64] = np.asarray(distance, float)
        k = self.width
        if self.name == "none":
            return np.ones_like(d)
        if self.name == "huber":
            return np.asarray(np.minimum(1.0, k / np.maximum(d, 1e-12)))
        if self.name == "cauchy":
            return np.asarray(k * k / (k * k + d * d))
        if self.name == "tukey":
            return np.where(d <= k, (1 - (d / k) ** 2) ** 2, 0.0)
        if self.name == "dcs":
            return np.where(d * d > k, (2 * k / (k + d * d)) ** 2, 1.0)
        raise ValueError(f"unknown kernel {self.name!r}")

    def estimator(self) -> Any:
        """GTSAM's m-estimator, or None for "none"."""
        return None if self.name == "none" else _ESTIMATORS[self.name].Create(self.width)


def sigmas(values: ArrayLike) -> Any:
    """Diagonal noise of standard deviations (d,).

    Raises:
        ValueError: one is not finite or not positive.
    """
    s = np.asarray(values, float)
    if not (np.isfinite(s).all() and (s > 0).all()):
        raise ValueError(f"standard deviations must be finite and positive, not {s}")
    return gtsam.noiseModel.Diagonal.Sigmas(s)


def gaussian(cov: ArrayLike) -> Any:
    """Gaussian noise of a covariance (d, d).

    Raises:
        ValueError: it is not finite, symmetric and positive definite.
    """
    return gaussians(np.asarray(cov, float)[None], Kernel("none"))[0]


def gaussians(cov: NDArray[np.float64], kernel: Kernel) -> list[Any]:
    """Gaussian noises of covariances (N, d, d) under a robust loss, checked in bulk.

    Raises:
        ValueError: as `gaussian`.
    """
    scale = np.maximum(1.0, np.abs(cov).max(axis=(1, 2), initial=0.0))[:, None, None]
    if not np.isfinite(cov).all() or (np.abs(cov - np.swapaxes(cov, 1, 2)) > 1e-9 * scale + 1e-5 * np.abs(cov)).any():
        raise ValueError("a covariance must be finite and symmetric")
    if len(cov) and np.linalg.eigvalsh(cov)[:, 0].min() <= 0:
        raise ValueError("a covariance must be positive definite")
    create, estimator = gtsam.noiseModel.Gaussian.Covariance, kernel.estimator()
    if estimator is None:
        return [create(c) for c in cov]
    robustly = gtsam.noiseModel.Robust.Create
    return [robustly(estimator, create(c)) for c in cov]


def robust(model: Any, kernel: Kernel) -> Any:
    """`model` under a robust loss."""
    estimator = kernel.estimator()
    return model if estimator is None else gtsam.noiseModel.Robust.Create(estimator, model)
