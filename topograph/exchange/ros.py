"""The map for RViz and Foxglove: the thesis's topics (5.2) as a ROS 1 bag or an MCAP file of ROS 2 messages."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import numpy as np

from topograph.bags.writer import BagWriter
from topograph.exchange.clouds import POINT, points
from topograph.exchange.localized import Localized
from topograph.geometry import Array, planar
from topograph.topomap import KINDS, TopoMap

FRAME = "map"
COLORS = {"tree": (0.11, 0.47, 0.22, 1.0), "missing": (0.70, 0.09, 0.17, 1.0), "post": (0.48, 0.36, 0.24, 1.0)}
SHOWN = 1.5
"""Height of a trunk as it is drawn, m."""


def write_ros(topo: TopoMap, path: Path, localized: Localized | None = None) -> None:
    """`/topological_map` (MarkerArray: trunks, edges, addresses), `/path` (Path), `/clusters` (PointCloud2 of all viewpoints); of a localization,
    scan by scan, `/robot_poses` (PoseArray: the pose, or the places that are left) and `/tf` from `map` to `base_link` (thesis 5.2).
    """
    folder = path.with_name(f".{path.stem}.{os.getpid()}.part{path.suffix if path.suffix == '.bag' else ''}")
    _remove(folder)
    stamp = int(topo.stamps_ns[-1]) if len(topo.stamps_ns) else 1
    if localized is not None:
        stamp = int(localized.stamps_ns[0])  # the map is there when the replay begins
    try:
        with BagWriter(folder) as bag:
            bag.markers("/topological_map", stamp, FRAME, _trunks(topo), _edges(topo), _names(topo))
            if len(topo.stamps_ns):
                bag.trajectory("/path", stamp, FRAME, topo.stamps_ns, topo.map_T_robot)
            if topo.viewpoints:
                cloud = points(topo)
                view = np.zeros(len(cloud), POINT)
                view[:] = cloud
                bag.points("/clusters", stamp, stamp, FRAME, view)
            if localized is not None:
                _replay(bag, localized)
        # One file is what Foxglove opens.
        (folder if path.suffix == ".bag" else folder / f"{folder.name}.mcap").replace(path)
    finally:
        _remove(folder)


def _remove(folder: Path) -> None:
    if folder.is_dir():
        shutil.rmtree(folder)
    folder.unlink(missing_ok=True)


def _replay(bag: BagWriter, run: Localized) -> None:
    for stamp, ok, T, places in zip(
        run.stamps_ns.tolist(), run.placed.tolist(), run.map_T_robot, run.places, strict=True
    ):
        bag.pose_array(
            "/robot_poses", stamp, FRAME, T[None] if ok else planar(places[:, 0], places[:, 1], places[:, 2])
        )
        if ok:
            bag.tf_static(stamp, {(FRAME, "base_link"): T}, "/tf")


def _trunks(topo: TopoMap) -> list[tuple[Array, Array, float, tuple[float, ...]]]:
    """Middle (3,), axis (3,), diameter and colour of each landmark."""
    out: list[tuple[Array, Array, float, tuple[float, ...]]] = []
    for i, state in enumerate(topo.state):
        kind = KINDS[int(topo.kind[i])]
        color = COLORS["missing" if kind == "tree" and state == "missing" else "tree" if kind == "tree" else "post"]
        d = float(topo.diameter[i]) if np.isfinite(topo.diameter[i]) else 0.2
        out.append((topo.p[i] + 0.5 * SHOWN * topo.axis[i], topo.axis[i], d, color))
    return out


def _edges(topo: TopoMap) -> Array:
    """(2E, 3) ends of the edges."""
    return topo.p[topo.edges].reshape(-1, 3) if len(topo.edges) else np.zeros((0, 3))


def _names(topo: TopoMap) -> list[tuple[Array, str]]:
    return [
        (topo.p[i] + np.array([0.0, 0.0, SHOWN + 0.4]), place or str(topo.ids[i])) for i, place in enumerate(topo.place)
    ]
