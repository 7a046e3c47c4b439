"""A map in other programs' formats."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from topograph.errors import UsageError
from topograph.evaluate import write_tum
from topograph.report.figures import cloud_points
from topograph.report.record import write_text
from topograph.topomap import KINDS, TopoMap


def write(topo: TopoMap, path: Path) -> None:
    """Write by the suffix: .geojson and .csv (trees), .tum (path), .ply (clouds).

    Raises:
        UsageError: another suffix, or GeoJSON of a map that is not georeferenced.
    """
    if path.suffix == ".geojson":
        write_text(path, json.dumps(_geojson(topo)) + "\n")
    elif path.suffix == ".csv":
        write_text(path, _csv(topo))
    elif path.suffix == ".tum":
        write_tum(path, topo.stamps_ns, topo.map_T_robot)
    elif path.suffix == ".ply":
        points = cloud_points(topo, range(len(topo)))
        head = f"ply\nformat ascii 1.0\nelement vertex {len(points)}\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
        write_text(path, head + "".join(f"{x:.3f} {y:.3f} {z:.3f}\n" for x, y, z in points))
    else:
        raise UsageError(f"{path}: end the name in .geojson, .csv, .tum or .ply")


def _geojson(topo: TopoMap) -> dict[str, Any]:
    if topo.datum is None:
        raise UsageError("the map is not georeferenced: GeoJSON needs longitude and latitude; export .csv instead")
    g, state, block, place = topo.geodetic(), topo.state, topo.block, topo.place
    trees = [
        {
            "type": "Feature",
            "geometry": {"type": "Point", "coordinates": [float(g[i, 1]), float(g[i, 0]), float(g[i, 2])]},
            "properties": {
                "id": int(topo.ids[i]),
                "diameter": float(topo.diameter[i]) if np.isfinite(topo.diameter[i]) else None,
                "sightings": int(topo.sightings[i]),
                "row": int(topo.row[i]),
                "kind": KINDS[int(topo.kind[i])],
                "stems": int(topo.stems[i]),
                "state": state[i],
                "block": int(block[i]),
                "place": place[i],
            },
        }
        for i in range(len(topo))
    ]
    return {"type": "FeatureCollection", "features": trees}


def _csv(topo: TopoMap) -> str:
    g, state, block, place = topo.geodetic(), topo.state, topo.block, topo.place
    lines = ["id,x,y,z,lat,lon,h,diameter,sigma_x,sigma_y,sightings,row,kind,kind_probability,stems,state,block,place"]
    for i in range(len(topo)):
        sx, sy = np.sqrt(topo.cov[i, [0, 1], [0, 1]])
        lines.append(
            f"{topo.ids[i]},{topo.p[i, 0]:.4f},{topo.p[i, 1]:.4f},{topo.p[i, 2]:.4f},{g[i, 0]:.9f},{g[i, 1]:.9f},{g[i, 2]:.4f},"
            f"{topo.diameter[i]:.4f},{sx:.4f},{sy:.4f},{topo.sightings[i]},{topo.row[i]},{KINDS[int(topo.kind[i])]},{topo.kind_probability[i]:.3f},{topo.stems[i]},{state[i]},{block[i]},{place[i]}"
        )
    return "\n".join(lines) + "\n"
