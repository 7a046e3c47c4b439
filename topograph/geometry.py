"""SE(2)/SE(3) on arrays, frame algebra, ENU <-> WGS84.

Poses are homogeneous matrices `a_T_b` of shape (..., 4, 4): `a_p = a_T_b @ b_p`, neighbours cancel.
Tangent vectors are (rotation, translation), in radians and metres, in the body frame: the order of GTSAM.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]
Stamps = NDArray[np.int64]


def se3(rotation: ArrayLike, translation: ArrayLike) -> Array:
    """Poses (..., 4, 4) from rotation matrices (..., 3, 3) and translations (..., 3) in metres."""
    R = np.asarray(rotation, float)
    t = np.asarray(translation, float)
    out = np.zeros((*np.broadcast_shapes(R.shape[:-2], t.shape[:-1]), 4, 4))
    out[..., :3, :3] = R
    out[..., :3, 3] = t
    out[..., 3, 3] = 1.0
    return out


def from_quaternion(translation: ArrayLike, quaternion_xyzw: ArrayLike) -> Array:
    """Poses (..., 4, 4) from translations (..., 3) and quaternions (..., 4) in x, y, z, w order.

    Raises:
        ValueError: a quaternion has no length.
    """
    q = np.asarray(quaternion_xyzw, float)
    R = Rotation.from_quat(q.reshape(-1, 4)).as_matrix().reshape(*q.shape[:-1], 3, 3)
    return se3(R, translation)


def to_quaternion(pose: ArrayLike) -> Array:
    """Quaternions (..., 4), x, y, z, w, of poses (..., 4, 4); w is not negative."""
    T = np.asarray(pose, float)
    q = Rotation.from_matrix(T[..., :3, :3].reshape(-1, 3, 3)).as_quat(canonical=True)
    return np.asarray(q).reshape(*T.shape[:-2], 4)


def tangent_cov(poses: Array, cov: Array) -> Array:
    """Covariances (N, 6, 6) of x, y, z, then roll, pitch, yaw in each body's own frame (right perturbation, translation first), from those of
    roll, pitch, yaw, then x, y, z about the map's axes.
    """
    turn = np.zeros((len(poses), 6, 6))
    back = np.swapaxes(poses[:, :3, :3], 1, 2)
    turn[:, :3, 3:] = turn[:, 3:, :3] = back
    return np.asarray(turn @ cov @ np.swapaxes(turn, 1, 2))


def from_xyz_rpy(x: float, y: float, z: float, roll: float, pitch: float, yaw: float) -> Array:
    """One pose (4, 4) from metres and fixed-axis roll, pitch, yaw in radians (the URDF order)."""
    return se3(Rotation.from_euler("xyz", [roll, pitch, yaw]).as_matrix(), [x, y, z])


def yaw_of(pose: ArrayLike) -> Array:
    """Heading (...) in radians of poses (..., 4, 4): the direction of body x in the horizontal plane."""
    T = np.asarray(pose, float)
    return np.asarray(np.arctan2(T[..., 1, 0], T[..., 0, 0]))


def planar(x: ArrayLike, y: ArrayLike, yaw: ArrayLike) -> Array:
    """Poses (..., 4, 4) that move and turn in the horizontal plane only; metres and radians."""
    x, y, yaw = np.broadcast_arrays(np.asarray(x, float), np.asarray(y, float), np.asarray(yaw, float))
    out = np.zeros((*x.shape, 4, 4))
    c, s = np.cos(yaw), np.sin(yaw)
    out[..., 0, 0], out[..., 0, 1], out[..., 1, 0], out[..., 1, 1] = c, -s, s, c
    out[..., 2, 2] = out[..., 3, 3] = 1.0
    out[..., 0, 3], out[..., 1, 3] = x, y
    return out


def wrap(angle: ArrayLike) -> Array:
    """Angles in radians brought to (-pi, pi]."""
    a = np.asarray(angle, float)
    return np.asarray(np.pi - np.mod(np.pi - a, 2.0 * np.pi))


def inverse(pose: ArrayLike) -> Array:
    """`b_T_a` (..., 4, 4) of `a_T_b`."""
    T = np.asarray(pose, float)
    Rt = np.swapaxes(T[..., :3, :3], -1, -2)
    return se3(Rt, -(Rt @ T[..., :3, 3:])[..., 0])


def inverse_cov(cov: ArrayLike) -> Array:
    """Information (..., 3, 3) of positive definite covariances (..., 3, 3): the adjugate over the determinant, a third of LAPACK's time for many."""
    C = np.asarray(cov, float)
    (a, b, c), (d, e) = (C[..., 0, k] for k in range(3)), (C[..., 1, k] for k in (1, 2))
    f = C[..., 2, 2]
    out = np.empty(C.shape)
    out[..., 0, 0], out[..., 1, 1], out[..., 2, 2] = d * f - e * e, a * f - c * c, a * d - b * b
    out[..., 0, 1] = out[..., 1, 0] = c * e - b * f
    out[..., 0, 2] = out[..., 2, 0] = b * e - c * d
    out[..., 1, 2] = out[..., 2, 1] = b * c - a * e
    return np.asarray(out / (a * out[..., 0, 0] + b * out[..., 0, 1] + c * out[..., 0, 2])[..., None, None])


def transform(pose: ArrayLike, points: ArrayLike) -> Array:
    """Points (..., 3) moved by poses (..., 4, 4), broadcast against each other."""
    T = np.asarray(pose, float)
    p = np.asarray(points, float)
    return np.asarray((T[..., :3, :3] @ p[..., None])[..., 0] + T[..., :3, 3])


LEAST_SHARE = 0.02
"""Of the variances of a foot, what is open anywhere along its axis: covariances that were rounded, or merged, stay some."""


def above_ground(
    foot: Array, cov: Array, axis: Array, lean_sigma: Array, known_at: Array, height: float
) -> tuple[Array, Array]:
    """Points (T, 3) `height` m above ground on the axes (T, 3) of trunks, and their covariances (T, 3, 3), from those of their feet.

    A foot was brought down from the height `known_at` (T,) at which its trunk was seen, along an axis known to `lean_sigma` (T,) rad; nearer to
    there the lean's error weighs less. NaN: nobody says, and the foot's covariance stays.
    """
    p = foot + axis * (height / np.maximum(axis[:, 2:], 0.3))
    change = np.nan_to_num(((height - known_at) ** 2 - known_at**2) * lean_sigma**2)
    out = cov.copy()
    flat = cov[:, [0, 1], [0, 1]]
    out[:, [0, 1], [0, 1]] = np.maximum(flat + change[:, None], LEAST_SHARE * flat)
    return p, out


def skew(v: ArrayLike) -> Array:
    """Cross-product matrices (..., 3, 3) of vectors (..., 3)."""
    w = np.asarray(v, float)
    out = np.zeros((*w.shape, 3))
    out[..., 0, 1], out[..., 0, 2] = -w[..., 2], w[..., 1]
    out[..., 1, 0], out[..., 1, 2] = w[..., 2], -w[..., 0]
    out[..., 2, 0], out[..., 2, 1] = -w[..., 1], w[..., 0]
    return out


def _left_jacobian(phi: Array) -> Array:
    theta2 = np.sum(phi * phi, axis=-1)[..., None, None]
    theta = np.sqrt(theta2)
    small = theta < 1e-4
    safe = np.where(small, 1.0, theta)
    a = np.where(small, 0.5 - theta2 / 24.0, (1.0 - np.cos(safe)) / safe**2)
    b = np.where(small, 1.0 / 6.0 - theta2 / 120.0, (safe - np.sin(safe)) / safe**3)
    S = skew(phi)
    return np.asarray(np.eye(3) + a * S + b * (S @ S))


def exp(tangent: ArrayLike) -> Array:
    """Poses (..., 4, 4) of tangent vectors (..., 6): rotation (rad), translation (m)."""
    xi = np.asarray(tangent, float)
    phi = xi[..., :3]
    R = Rotation.from_rotvec(phi.reshape(-1, 3)).as_matrix().reshape(*phi.shape[:-1], 3, 3)
    return se3(R, (_left_jacobian(phi) @ xi[..., 3:, None])[..., 0])


def log(pose: ArrayLike) -> Array:
    """Tangent vectors (..., 6) of poses (..., 4, 4); the inverse of `exp` for angles below pi."""
    T = np.asarray(pose, float)
    phi = Rotation.from_matrix(T[..., :3, :3].reshape(-1, 3, 3)).as_rotvec().reshape(*T.shape[:-2], 3)
    rho = np.linalg.solve(_left_jacobian(phi), T[..., :3, 3:])[..., 0]
    return np.concatenate([phi, rho], axis=-1)


def interpolate(stamps_ns: Stamps, poses: Array, query_ns: ArrayLike) -> Array:
    """Poses (M, 4, 4) at `query_ns` on the screw between the neighbours of `poses` (N, 4, 4).

    Outside the range the nearest end holds. `stamps_ns` (N,) must rise strictly.
    """
    q = np.atleast_1d(np.asarray(query_ns, np.int64))
    if len(stamps_ns) == 1:
        return np.repeat(poses, len(q), axis=0)
    i = np.clip(np.searchsorted(stamps_ns, q, side="right") - 1, 0, len(stamps_ns) - 2)
    span = (stamps_ns[i + 1] - stamps_ns[i]).astype(float)
    u = np.clip((q - stamps_ns[i]) / span, 0.0, 1.0)
    a_T_b = inverse(poses[i]) @ poses[i + 1]
    return np.asarray(poses[i] @ exp(u[:, None] * log(a_T_b)))


def fit_rigid_2d(source: Array, target: Array, weight: Array | None = None) -> tuple[float, float, float]:
    """(x, y, yaw) of the rigid motion that takes `source` (N, 2) onto `target` (N, 2), least squares.

    Horn's closed form in the plane; `weight` (N,) defaults to ones.

    >>> corner = np.array([[0.0, 0.0], [4.0, 0.0], [0.0, 3.0]])
    >>> turned = corner @ np.array([[0.0, 1.0], [-1.0, 0.0]]) + [1.0, 2.0]      # by 90° to the left, then moved
    >>> tuple(round(v, 3) for v in fit_rigid_2d(corner, turned))
    (1.0, 2.0, 1.571)
    """
    w = np.ones(len(source)) if weight is None else weight
    w = w / w.sum()
    cs, ct = w @ source, w @ target
    a, b = source - cs, target - ct
    yaw = float(np.arctan2(w @ (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]), w @ np.sum(a * b, axis=1)))
    c, s = np.cos(yaw), np.sin(yaw)
    return (
        float(ct[0] - c * cs[0] + s * cs[1]),
        float(ct[1] - s * cs[0] - c * cs[1]),
        yaw,
    )


def align_se3(source: Array, target: Array) -> Array:
    """Pose (4, 4) that takes points `source` (N, 3) onto `target` (N, 3), least squares (Umeyama 1991, no scale)."""
    cs, ct = source.mean(0), target.mean(0)
    U, _, Vt = np.linalg.svd((target - ct).T @ (source - cs))
    D = np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    R = U @ D @ Vt
    return se3(R, ct - R @ cs)


@dataclass(frozen=True, slots=True)
class Datum:
    """Origin of the `map` frame on the ellipsoid: latitude and longitude in degrees, height in metres (WGS84).

    >>> datum = Datum(44.9, 8.2, 180.0)
    >>> datum.to_enu([44.9001, 8.2, 180.0]).round(2).tolist()      # a ten thousandth of a degree to the north
    [0.0, 11.11, -0.0]
    >>> datum.to_geodetic([0.0, 11.11, 0.0]).round(4).tolist()
    [44.9001, 8.2, 180.0]
    """

    lat: float
    lon: float
    h: float

    def to_enu(self, lat_lon_h: ArrayLike) -> Array:
        """East, north, up (..., 3) in metres of geodetic positions (..., 3) in degrees, degrees, metres."""
        g = np.asarray(lat_lon_h, float)
        e, n, u = _topocentric(self).transform(g[..., 1], g[..., 0], g[..., 2])
        return np.stack([np.asarray(e), np.asarray(n), np.asarray(u)], axis=-1)

    def to_geodetic(self, enu: ArrayLike) -> Array:
        """Latitude, longitude, height (..., 3) in degrees, degrees, metres of ENU positions (..., 3)."""
        p = np.asarray(enu, float)
        lon, lat, h = _topocentric(self).transform(p[..., 0], p[..., 1], p[..., 2], direction="INVERSE")
        return np.stack([np.asarray(lat), np.asarray(lon), np.asarray(h)], axis=-1)


@functools.lru_cache(maxsize=64)
def _topocentric(datum: Datum) -> Any:
    from pyproj import Transformer

    return Transformer.from_pipeline(
        "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad "
        "+step +proj=cart +ellps=WGS84 "
        f"+step +proj=topocentric +ellps=WGS84 "
        f"+lat_0={float(datum.lat)!r} +lon_0={float(datum.lon)!r} +h_0={float(datum.h)!r}"
    )
