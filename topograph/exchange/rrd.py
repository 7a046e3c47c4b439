"""The map for the Rerun viewer: trunks as cylinders, ellipses, edges, path over time, clouds."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from topograph.errors import UsageError
from topograph.topomap import KINDS, TopoMap
from topograph.whole import whole

COLORS = {"tree": (27, 120, 55), "post": (123, 92, 62), "missing": (178, 24, 43)}
TRUNK_M = 1.5
"""Height that a trunk is drawn with; what was measured is its axis, and its diameter at 0.8 m."""
UNKNOWN_DIAMETER_M = 0.2


def write_rrd(topo: TopoMap, path: Path) -> None:
    """A Rerun recording. Entities: `map/trees`, `map/ellipses`, `map/edges`, `map/path`, `map/robot` (over `stamp`), `map/clouds`.

    Raises:
        UsageError: rerun is not installed.
    """
    try:
        import rerun as rr
    except ImportError as err:
        raise UsageError("a Rerun recording needs rerun: pip install 'topograph[rerun]'") from err
    with whole(path) as part, rr.RecordingStream("topograph", recording_id=path.stem) as recording:
        recording.save(part)
        recording.log("map", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        _trees(recording, rr, topo)
        _path(recording, rr, topo)
        clouds = [v.cloud + topo.p[v.tree] for v in topo.viewpoints if len(v.cloud)]
        if clouds:
            recording.log("map/clouds", rr.Points3D(np.concatenate(clouds), radii=0.01), static=True)


def _trees(recording: Any, rr: Any, topo: TopoMap) -> None:
    """Cylinders along the axes, from the foot on; flat ellipses at the feet; edges from foot to foot."""
    if not len(topo):
        return
    labels = [f"{KINDS[k]} {i}" for k, i in zip(topo.kind.tolist(), topo.ids.tolist(), strict=True)]
    kinds = ["missing" if s == "missing" else KINDS[k] for k, s in zip(topo.kind.tolist(), topo.state, strict=True)]
    colors = [COLORS.get(k, (128, 128, 128)) for k in kinds]
    up = np.tile([0.0, 0.0, 1.0], (len(topo), 1))
    across = np.cross(up, topo.axis)
    lean = np.arccos(np.clip(topo.axis[:, 2], -1.0, 1.0))
    turn = Rotation.from_rotvec(
        across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-12) * lean[:, None]
    )
    radius = 0.5 * np.nan_to_num(topo.diameter, nan=UNKNOWN_DIAMETER_M)
    centre = topo.p + 0.5 * TRUNK_M * topo.axis
    trunks = rr.Cylinders3D(
        lengths=np.full(len(topo), TRUNK_M), radii=radius, centers=centre, quaternions=turn.as_quat(), colors=colors, labels=labels,
        show_labels=len(topo) <= 200,
    )  # fmt: skip
    recording.log("map/trees", trunks, static=True)
    radii, angle = topo.ellipses()
    known = np.isfinite(radii).all(axis=1)
    if known.any():
        flat = np.column_stack([radii[known], np.full(int(known.sum()), 1e-3)])
        turned = Rotation.from_euler("z", angle[known, None]).as_quat()
        ellipses = rr.Ellipsoids3D(half_sizes=flat, centers=topo.p[known], quaternions=turned, colors=(27, 120, 55))
        recording.log("map/ellipses", ellipses, static=True)
    if len(topo.edges):
        recording.log("map/edges", rr.LineStrips3D(topo.p[topo.edges], colors=(150, 165, 155)), static=True)


def _path(recording: Any, rr: Any, topo: TopoMap) -> None:
    """A line per session, and the robot's pose over the recording's time."""
    if not len(topo.stamps_ns):
        return
    session = topo.session if len(topo.session) else np.zeros(len(topo.stamps_ns), np.int64)
    at = topo.map_T_robot[:, :3, 3]
    lines = [at[session == s] for s in np.unique(session)]
    recording.log("map/path", rr.LineStrips3D(lines, colors=(33, 102, 172)), static=True)
    for stamp, T in zip(topo.stamps_ns.tolist(), topo.map_T_robot, strict=True):
        recording.set_time("stamp", timestamp=np.datetime64(stamp, "ns"))
        recording.log("map/robot", rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]))
