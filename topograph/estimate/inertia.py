"""The IMU's part of the graph: preintegrated factors between keyframes, and priors of the biases."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np

import factors
from topograph.estimate.problem import Problem
from topograph.geometry import Array

_LONGEST_GAP_S = 0.15


@dataclass(frozen=True, slots=True)
class Inertia:
    """Preintegrated measurements per interval (None where samples are missing), noise, bias at rest."""

    preintegrated: list[Any]
    seconds: Array
    noise: factors.ImuNoise
    gyro_bias: Array

    def factors(self, X: int, V: int, B: int) -> Iterator[Any]:
        """The factors of poses X+k, velocities V+k and biases B+k."""
        for k, pim in enumerate(self.preintegrated):
            if pim is not None:
                yield factors.preintegrated((X + k, V + k, B + k), (X + k + 1, V + k + 1, B + k + 1), pim)
            else:
                yield factors.bias_walk(B + k, B + k + 1, float(self.seconds[k]), self.noise)
        bias = gtsam.imuBias.ConstantBias(np.zeros(3), self.gyro_bias)
        yield gtsam.PriorFactorConstantBias(B, bias, factors.sigmas([0.15, 0.15, 0.15, 3e-3, 3e-3, 3e-3]))
        loose = factors.sigmas([3.0, 3.0, 3.0])
        for k in range(len(self.preintegrated) + 1):
            before = k > 0 and self.preintegrated[k - 1] is not None
            if not before:
                yield gtsam.PriorFactorVector(V + k, np.zeros(3), loose)


def inertia(problem: Problem) -> Inertia | None:
    """Preintegrate the run's samples; None without an IMU."""
    imu = problem.inertial
    if imu is None:
        return None
    # Twice the measured white noise: vibration is not white, and its aliases are not seen in the samples.
    noise = factors.ImuNoise(gyro=2.0 * imu.gyro_density, accel=2.0 * imu.accel_density)
    mount = np.eye(4)
    mount[:3, 3] = imu.robot_T_imu[:3, 3]  # the samples are in the base's axes already
    parameters = factors.preintegration(noise, mount)
    stamps = imu.stamps_ns
    out: list[Any] = []
    for a, b in zip(problem.stamps_ns[:-1].tolist(), problem.stamps_ns[1:].tolist(), strict=True):
        i, j = np.searchsorted(stamps, [a, b])
        edges = np.concatenate([[a], stamps[i:j], [b]])
        edges = edges[np.concatenate([[True], np.diff(edges) > 0])]
        dt = np.diff(edges) * 1e-9
        if a < stamps[0] or b > stamps[-1] or len(dt) == 0 or dt.max() > _LONGEST_GAP_S:
            out.append(None)
            continue
        low, high = max(i - 1, 0), min(j + 1, len(stamps))
        t, middle = (stamps[low:high] - a) * 1e-9, (0.5 * (edges[:-1] + edges[1:]) - a) * 1e-9
        gyro = np.stack([np.interp(middle, t, imu.gyro[low:high, k]) for k in range(3)], axis=1)
        accel = np.stack([np.interp(middle, t, imu.accel[low:high, k]) for k in range(3)], axis=1)
        out.append(factors.preintegrate(parameters, dt, gyro, accel, imu.gyro_bias))
    return Inertia(out, np.diff(problem.stamps_ns) * 1e-9, noise, imu.gyro_bias)
