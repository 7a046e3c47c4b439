"""The thesis's front end (4.3.1-4.3.2, Algorithms 1 and 2) on Open3D, to compare with.

Where the thesis is silent: a z interval is in the LiDAR's frame, as there; intensity is filtered only when a bound is
given, for it depends on the sensor; the plane is found among points below the sensor and a normal within `plane_angle`
of it counts as ground; conditional clustering joins neighbours within `cluster_distance` whose normals differ by less
than `cluster_angle`. A cluster's centroid lies on the visible surface and stays there: `Trunks.surface`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from topograph.bags import Scan, Trunks
from topograph.geometry import Array, transform
from topograph.ranges import Count, Positive, Real
from topograph.trunks.open3d_door import open3d

SURFACE_SIGMA = 0.12
"""Standard deviation of a centroid on the surface against the axis, m: about a radius."""


@dataclass(frozen=True, slots=True)
class ThesisTrunksConfig:
    """Parameters of Algorithms 1 and 2; lengths in m, angles in degrees. Found by random search on
    training orchards (tools/tune_thesis.py: the best of 140 sets by F1).

    Attributes:
        z_min, z_max: height interval in the LiDAR's frame; `intensity_min`, `intensity_max` likewise.
        normal_neighbours: of the normal's PCA.
        plane_distance, plane_angle: of a ground point from the RANSAC plane and of its normal from the plane's.
        radius, radius_neighbours: r and N_n of the radius filter.
        mean_neighbours, deviations: k and alpha of the statistical filter.
        cluster_distance, cluster_angle: conditions of the clustering.
        cluster_min, cluster_max: points of a cluster.
        farthest: clusters beyond are left out.
    """

    z_min: Real = -0.36
    z_max: Real = 0.69
    intensity_min: float = float("-inf")
    intensity_max: float = float("inf")
    normal_neighbours: Count = 11
    plane_distance: Positive = 0.15
    plane_angle: Positive = 38.0
    radius: Positive = 0.33
    radius_neighbours: Count = 3
    mean_neighbours: Count = 20
    deviations: Positive = 1.66
    cluster_distance: Positive = 0.48
    cluster_angle: Positive = 52.0
    cluster_min: Count = 8
    cluster_max: Count = 979
    farthest: Positive = 30.0


class ThesisDetector:
    """Scan -> trunks in `base_link`, without deskew: the thesis stood still. The same interface as `Detector`."""

    def __init__(self, base_T_lidar: Array, config: ThesisTrunksConfig) -> None:
        open3d()  # where it is missing, that is said before a recording is read
        self.base_T_lidar = base_T_lidar
        self.config = config

    def __call__(self, scan: Scan, twist: Array, up: Array | None = None) -> Trunks:
        points, normals = self.filtered(scan)
        clusters = self.clusters(points, normals)
        c = self.config
        centroids = np.array([points[i].mean(0) for i in clusters]).reshape(-1, 3)
        near = np.hypot(centroids[:, 0], centroids[:, 1]) < c.farthest
        clusters = [i for i, ok in zip(clusters, near, strict=True) if ok]
        p = transform(self.base_T_lidar, centroids[near]).reshape(-1, 3)
        n = len(p)
        clouds = tuple(transform(self.base_T_lidar, points[i]).astype(np.float32) for i in clusters)
        cov = np.tile(np.diag([SURFACE_SIGMA**2, SURFACE_SIGMA**2, 0.3**2]), (n, 1, 1))
        up = np.tile([0.0, 0.0, 1.0], (n, 1))
        nothing = np.full(n, np.nan)
        return Trunks(
            stamp_ns=scan.stamp_ns,
            frame="base_link",
            p=p,
            axis=up,
            diameter=nothing,
            cov=cov,
            height=nothing,
            score=np.full(n, 2.0),
            clouds=clouds,
            surface=True,
        )

    def filtered(self, scan: Scan) -> tuple[Array, Array]:
        """Algorithm 1: points (M, 3) in the LiDAR's frame that may be trunks, and their normals (M, 3)."""
        c, o3d = self.config, open3d()
        none = np.zeros((0, 3))
        z = scan.xyz[:, 2]
        keep = np.isfinite(scan.xyz).all(axis=1) & (z > c.z_min) & (z < c.z_max)
        keep &= (scan.xyz != 0).any(axis=1)
        if scan.intensity is not None:
            keep &= (scan.intensity >= c.intensity_min) & (scan.intensity <= c.intensity_max)
        if keep.sum() < c.normal_neighbours:
            return none, none
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(scan.xyz[keep].astype(float)))
        cloud.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(c.normal_neighbours))
        cloud = self._without_ground(cloud)
        if len(cloud.points) > c.mean_neighbours:
            cloud, _ = cloud.remove_radius_outlier(c.radius_neighbours, c.radius)
        if len(cloud.points) <= c.mean_neighbours:
            return none, none
        cloud, _ = cloud.remove_statistical_outlier(c.mean_neighbours, c.deviations)
        return np.asarray(cloud.points), np.asarray(cloud.normals)

    def _without_ground(self, cloud: Any) -> Any:
        """RANSAC on points below the sensor; a point on the plane is ground when its normal agrees."""
        c, o3d = self.config, open3d()
        below = np.flatnonzero(np.asarray(cloud.points)[:, 2] < 0.0)
        if len(below) < 50:
            return cloud
        o3d.utility.random.seed(0)
        plane, _ = cloud.select_by_index(below.tolist()).segment_plane(c.plane_distance, 3, 200)
        normal = np.asarray(plane[:3]) / np.linalg.norm(plane[:3])
        if abs(normal[2]) < np.cos(np.radians(30.0)):
            return cloud  # not a ground plane: a hedge, a wall
        p, n = np.asarray(cloud.points), np.asarray(cloud.normals)
        on = np.abs(p @ normal + plane[3] / np.linalg.norm(plane[:3])) < c.plane_distance
        ground = on & (np.abs(n @ normal) > np.cos(np.radians(c.plane_angle)))
        return cloud.select_by_index(np.flatnonzero(~ground).tolist())

    def clusters(self, points: Array, normals: Array) -> list[NDArray[np.int64]]:
        """Algorithm 2: conditional Euclidean clustering."""
        c = self.config
        if len(points) < c.cluster_min:
            return []
        pairs = cKDTree(points).query_pairs(c.cluster_distance, output_type="ndarray").reshape(-1, 2)
        alike = np.abs(np.sum(normals[pairs[:, 0]] * normals[pairs[:, 1]], axis=1)) > np.cos(
            np.radians(c.cluster_angle)
        )
        pairs = pairs[alike]
        graph = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(points), len(points)))
        _, label = connected_components(graph, directed=False)
        order = np.argsort(label, kind="stable")
        groups = np.split(order, np.flatnonzero(np.diff(label[order])) + 1)
        return [g for g in groups if c.cluster_min <= len(g) <= c.cluster_max]
