"""Trunks that a bag brings along, turned into the base's frame and given a covariance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from topograph.bags import Trunks
from topograph.geometry import Array, transform
from topograph.trunks.config import TrunksConfig

LOWEST, HIGHEST = 0.05, 3.0
"""Heights above `base_link` that are taken for heights above ground, m; a detection at 0 does not say how high it is."""


def from_recorded(trunks: Trunks, base_T_sensor: Array, config: TrunksConfig) -> Trunks:
    """Trunks in `base_link`.

    Recorded detections state no covariance: a first guess grows with range, and the estimator rescales it by its
    residuals. Along the axis a detection is loose: where on the trunk it lies is not measured. The centroid of a
    visible surface (the thesis's clusters) is moved onto the axis: away from the sensor by π/4 of the radius.
    """
    p, axis = trunks.p, trunks.axis
    diameter = trunks.diameter
    if trunks.surface and len(trunks):
        diameter = np.array([_width(c, q) for c, q in zip(trunks.clouds, p, strict=True)])
        away = p[:, :2] / np.maximum(np.linalg.norm(p[:, :2], axis=1, keepdims=True), 1e-6)
        p = p.copy()
        p[:, :2] += away * (np.pi / 4) * 0.5 * np.nan_to_num(diameter, nan=0.2)[:, None]
    distance = np.linalg.norm(p, axis=1)
    p, axis = transform(base_T_sensor, p), axis @ base_T_sensor[:3, :3].T
    sigma = config.recorded_sigma + config.recorded_growth * distance
    cov = sigma[:, None, None] ** 2 * np.eye(3)
    cov = cov + config.recorded_along**2 * axis[:, :, None] * axis[:, None, :]
    # The frame stands on the ground (REP-105), and the ground under a tree is about as steep as under the robot.
    above = np.where((p[:, 2] > LOWEST) & (p[:, 2] < HIGHEST), p[:, 2], np.nan)
    height = np.where(np.isfinite(trunks.height), trunks.height, above)
    near = (distance > config.nearest) & (distance < config.recorded_reach)
    out = replace(trunks, frame="base_link", p=p, axis=axis, cov=cov, diameter=diameter, height=height, surface=False)
    return out if near.all() else out.select(near)


def _width(cloud: np.typing.NDArray[np.float32], centre: Array) -> float:
    """Widest extent across the line of sight, m."""
    if len(cloud) < 3:
        return float("nan")
    side = np.array([-centre[1], centre[0]]) / max(float(np.hypot(*centre[:2])), 1e-6)
    across = (cloud[:, :2] - centre[:2]) @ side
    return float(np.percentile(across, 97) - np.percentile(across, 3))
