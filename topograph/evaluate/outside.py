"""What an outside tool says of stated covariances: smfeval (PyPI), where it is installed."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from topograph.evaluate.frames import WorldInMap
from topograph.evaluate.localization import covered
from topograph.evaluate.metrics import Metric
from topograph.evaluate.truth import Truth
from topograph.geometry import from_xyz_rpy, interpolate, tangent_cov, to_quaternion
from topograph.localize import Report


def smfeval_metrics(reports: Sequence[Report], truth: Truth, world: WorldInMap) -> list[Metric]:
    """Coverage of the stated 90 % ellipsoids and mean z of the positions (x, y, z) of committed poses, as smfeval scores them; empty
    where it is not installed, or the method states no covariance.
    """
    try:
        from smfeval.scoring import calibrate
        from smfeval.steps import GaussianStep
    except ImportError:
        return []
    fixes = [r.fix for r in reports if r.fix is not None and covered(truth, r.fix.stamp_ns)]
    fixes = [f for f in fixes if np.isfinite(f.cov).all()]
    if len(fixes) < 2:
        return []
    stamps = np.array([f.stamp_ns for f in fixes], np.int64)
    true = interpolate(truth.stamps_ns, truth.world_T_robot, stamps)
    poses = np.array([f.map_T_robot for f in fixes])
    p, q = poses[:, :3, 3], to_quaternion(poses)
    cov = tangent_cov(poses, np.array([f.cov for f in fixes]))
    steps = [
        GaussianStep(timestamp=1e-9 * s, translation=t, quat_xyzw=r, covariance=c)
        for s, t, r, c in zip(stamps.tolist(), p, q, cov, strict=True)
    ]
    turned = from_xyz_rpy(0.0, 0.0, 0.0, 0.0, 0.0, world.turn) @ true
    found = calibrate(steps, world.points(true[:, :3, 3]), to_quaternion(turned))
    return [
        Metric("smfeval: in the stated 90 % ellipsoid (0.9 is right)", found.coverage, ""),
        Metric("smfeval: z of positions (0.92 is right)", found.z_translation_mean, ""),
    ]
