"""Inertial samples between two keyframes, preintegrated with biases (Forster et al. 2017, as in GTSAM)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from factors.noise import sigmas
from factors.pose import to_pose3


@dataclass(frozen=True, slots=True)
class ImuNoise:
    """Densities of white noise (rad/s/√Hz, m/s²/√Hz), random walks of the biases (per √s), gravity (m/s²)."""

    gyro: float = 1e-3
    accel: float = 2e-2
    gyro_walk: float = 1e-4
    accel_walk: float = 1e-3
    gravity: float = 9.80665


def preintegration(noise: ImuNoise, robot_T_imu: NDArray[np.float64]) -> Any:
    """Parameters for `preintegrate`: once for all intervals of a run, each of which refers to them."""
    p = gtsam.PreintegrationCombinedParams.MakeSharedU(noise.gravity)
    p.setGyroscopeCovariance(np.eye(3) * noise.gyro**2)
    p.setAccelerometerCovariance(np.eye(3) * noise.accel**2)
    p.setIntegrationCovariance(np.eye(3) * 1e-8)
    p.setBiasOmegaCovariance(np.eye(3) * noise.gyro_walk**2)
    p.setBiasAccCovariance(np.eye(3) * noise.accel_walk**2)
    p.setBodyPSensor(to_pose3(robot_T_imu))
    return p


def preintegrate(
    parameters: Any,
    seconds: NDArray[np.float64],
    gyro: NDArray[np.float64],
    accel: NDArray[np.float64],
    gyro_bias: NDArray[np.float64],
) -> Any:
    """Preintegrated samples: each of (N, 3) rates holds for its interval of `seconds` (N,), all positive."""
    if not ((seconds > 0).all() and np.isfinite(gyro).all() and np.isfinite(accel).all()):
        raise ValueError("inertial samples must be finite and their intervals positive")
    pim = gtsam.PreintegratedCombinedMeasurements(parameters, gtsam.imuBias.ConstantBias(np.zeros(3), gyro_bias))
    for a, w, dt in zip(accel, gyro, seconds.tolist(), strict=True):
        pim.integrateMeasurement(a, w, dt)
    return pim


def preintegrated(keys_a: tuple[int, int, int], keys_b: tuple[int, int, int], pim: Any) -> Any:
    """Factor between (pose, velocity, bias) of two keyframes."""
    (xa, va, ba), (xb, vb, bb) = keys_a, keys_b
    return gtsam.CombinedImuFactor(xa, va, xb, vb, ba, bb, pim)


def bias_walk(key_a: int, key_b: int, seconds: float, noise: ImuNoise) -> Any:
    """Keeps two biases together where samples are missing between their keyframes."""
    root = np.sqrt(max(seconds, 1e-3))
    s = np.concatenate([np.full(3, noise.accel_walk), np.full(3, noise.gyro_walk)]) * root
    return gtsam.BetweenFactorConstantBias(key_a, key_b, gtsam.imuBias.ConstantBias(), sigmas(s))
