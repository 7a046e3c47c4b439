"""The viewpoint clouds in the map's frame: PLY, PCD, LAZ."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from topograph.errors import UsageError
from topograph.topomap import TopoMap
from topograph.whole import whole

POINT = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("tree", "<u4")])


def points(topo: TopoMap) -> NDArray[np.void]:
    """All points with the id of their tree.

    Raises:
        UsageError: the map has no clouds.
    """
    parts = []
    for v in topo.viewpoints:
        part = np.zeros(len(v.cloud), POINT)
        for k, a in enumerate("xyz"):
            part[a] = v.cloud[:, k] + topo.p[v.tree, k]
        part["tree"] = topo.ids[v.tree]
        parts.append(part)
    if not parts:
        raise UsageError("the map holds no clouds: recorded detections and surveyed trees have none")
    return np.asarray(np.concatenate(parts))


def write_ply(topo: TopoMap, path: Path) -> None:
    """Binary PLY; property `tree` is the tree's id."""
    p = points(topo)
    head = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(p)}\nproperty float x\nproperty float y\nproperty float z\n"
        "property uint tree\nend_header\n"
    )
    with whole(path) as part:
        part.write_bytes(head.encode() + p.tobytes())


def write_pcd(topo: TopoMap, path: Path) -> None:
    """Binary PCD 0.7; field `label` is the tree's id."""
    p = points(topo)
    head = (
        "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z label\nSIZE 4 4 4 4\nTYPE F F F U\nCOUNT 1 1 1 1\n"
        f"WIDTH {len(p)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(p)}\nDATA binary\n"
    )
    with whole(path) as part:
        part.write_bytes(head.encode() + p.tobytes())


MILLIMETRE = 0.001


def write_laz(topo: TopoMap, path: Path) -> None:
    """LAS 1.4, compressed where the name ends in .laz; point_source_id is the tree's id (modulo 2^16), coordinates are the map's, in mm."""
    try:
        import laspy

        if path.suffix == ".laz":
            import lazrs  # noqa: F401  # laspy looks for it when it writes
    except ImportError as err:
        raise UsageError("LAZ needs laspy and lazrs: pip install 'topograph[exchange]'") from err
    p = points(topo)
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales = np.full(3, MILLIMETRE)
    header.offsets = np.array([np.floor(p[a].min()) for a in "xyz"])
    las = laspy.LasData(header)
    las.x, las.y, las.z = (p[a].astype(float) for a in "xyz")
    las.point_source_id = (p["tree"] % 65536).astype(np.uint16)
    with whole(path) as part:
        las.write(str(part))
