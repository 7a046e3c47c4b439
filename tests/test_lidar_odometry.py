"""The motion that the point clouds tell, where there are no wheels."""

import numpy as np
import pytest

from topograph.bags import Scan
from topograph.geometry import exp, from_quaternion, from_xyz_rpy, inverse, log, transform
from topograph.motion import LidarOdometry

MOUNT = from_xyz_rpy(0.3, -0.1, 0.9, 0.0, 0.1, 0.6)
TWIST = np.array([0.0, 0.0, 0.25, 0.9, 0.0, 0.0])
"""rad/s, m/s of the base."""
PERIOD = 0.1


def swept(k: int, world: np.ndarray, timed: bool) -> Scan:
    """The sweep that ends at `PERIOD` (k + 1), stamped at its beginning, point by point from where the robot was; or all at once, at the end."""
    n = len(world)
    t = np.linspace(0.0, PERIOD, n) if timed else np.full(n, PERIOD)
    world_T_lidar = np.array([exp(TWIST * (PERIOD * k + s)) for s in t]) @ MOUNT
    return Scan(
        stamp_ns=10**18 + int(k * PERIOD * 1e9) + (0 if timed else int(PERIOD * 1e9)), frame="lidar",
        xyz=transform(inverse(world_T_lidar), world).astype(np.float32), ring=None,
        offset=t.astype(np.float32) if timed else None, intensity=None,
    )  # fmt: skip


@pytest.mark.parametrize("timed", [True, False])
def test_motion_is_that_of_the_base_at_the_end_of_the_sweep(timed: bool) -> None:
    """A bend among posts and on the ground, with a LiDAR that is mounted aside, tilted and turned."""
    rng = np.random.default_rng(3)
    posts = np.repeat(rng.uniform(-25, 25, (40, 2)), 60, axis=0) + rng.normal(0, 0.05, (2400, 2))
    ground = rng.uniform(-25, 25, (3000, 2))
    world = np.concatenate(
        [np.column_stack([posts, rng.uniform(0, 3, 2400)]), np.column_stack([ground, 0 * ground[:, 0]])]
    )
    odometry = LidarOdometry(lambda frame: MOUNT, "base_link")
    made = []
    for k in range(25):
        seen = world + rng.normal(0, 0.01, world.shape)
        made.append(odometry.step(swept(k, seen[rng.permutation(len(seen))] if timed else seen, timed)))
    assert all(m is not None for m in made)
    stamps = np.array([m.stamp_ns for m in made])
    np.testing.assert_allclose((stamps - 10**18) * 1e-9, PERIOD * np.arange(1, 26), atol=1e-4)
    q = np.array([m.odom_T_child for m in made])
    poses = from_quaternion(q[:, :3], q[:, 3:])
    true = np.array([exp(TWIST * PERIOD * (k + 1)) for k in range(25)])
    off = log(inverse(inverse(true[5]) @ true[-1]) @ inverse(poses[5]) @ poses[-1])
    assert np.abs(off[3:]).max() < 0.05  # of 1.8 m
    assert np.abs(off[:3]).max() < 0.01
    np.testing.assert_allclose(made[-1].twist[[0, 5]], TWIST[[3, 2]], atol=0.1)


def test_a_sweep_of_hardly_a_return_says_nothing() -> None:
    odometry = LidarOdometry(lambda frame: MOUNT, "base_link")
    xyz = np.full((500, 3), np.nan, np.float32)
    xyz[:50] = 1.0
    scan = Scan(stamp_ns=1, frame="lidar", xyz=xyz, ring=None, offset=None, intensity=None)
    assert odometry.step(scan) is None
