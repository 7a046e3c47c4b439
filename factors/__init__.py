"""Measurement -> GTSAM factor. numpy and gtsam only; keys are arguments; nothing of topograph.

Every function takes plain numbers and arrays, checks them (GTSAM does not), and returns a native factor.
Poses are 4x4 matrices `map_T_robot`; tangent vectors and their covariances are (rotation, translation), body frame.
"""

from factors.gnss import fix, fix_linear, fixes
from factors.ground import level
from factors.heading import heading, headings
from factors.imu import ImuNoise, bias_walk, preintegrate, preintegrated, preintegration
from factors.noise import Kernel, gaussian, robust, sigmas
from factors.odometry import odometries, odometry, odometry_2d
from factors.pose import from_pose3, to_pose3, to_pose3s
from factors.ranging import MEASURES, range_2d, sighting_2d
from factors.trunk import bearing_basis, trunk, trunk_2d, trunk_linear, trunk_residual, trunks

__all__ = [
    "MEASURES",
    "ImuNoise",
    "Kernel",
    "bearing_basis",
    "bias_walk",
    "fix",
    "fix_linear",
    "fixes",
    "from_pose3",
    "gaussian",
    "heading",
    "headings",
    "level",
    "odometries",
    "odometry",
    "odometry_2d",
    "preintegrate",
    "preintegrated",
    "preintegration",
    "range_2d",
    "robust",
    "sighting_2d",
    "sigmas",
    "to_pose3",
    "to_pose3s",
    "trunk",
    "trunk_2d",
    "trunk_linear",
    "trunk_residual",
    "trunks",
]
