"""What every table of trees says of a tree, in one place."""

from __future__ import annotations

from typing import Any

import numpy as np

from topograph.topomap import KINDS, TopoMap


def columns(topo: TopoMap) -> dict[str, list[Any]]:
    """Name -> value of each landmark; None where it is not known. `lat`, `lon` (degrees) and `h` (m) only of a georeferenced map."""
    out: dict[str, list[Any]] = {
        "id": topo.ids.tolist(),
        **{a: _known(topo.p[:, k]) for k, a in enumerate("xyz")},
    }
    if topo.datum is not None:
        g = topo.geodetic()
        out |= {a: _known(g[:, k]) for k, a in enumerate(("lat", "lon", "h"))}
    sigma = np.sqrt(topo.cov[:, [0, 1], [0, 1]])
    return out | {
        "diameter": _known(topo.diameter),
        "sigma_x": _known(sigma[:, 0]),
        "sigma_y": _known(sigma[:, 1]),
        "axis_x": _known(topo.axis[:, 0]),
        "axis_y": _known(topo.axis[:, 1]),
        "axis_z": _known(topo.axis[:, 2]),
        "sightings": topo.sightings.tolist(),
        "row": topo.row.tolist(),
        "kind": [KINDS[int(k)] for k in topo.kind],
        "kind_probability": _known(topo.kind_probability),
        "stems": topo.stems.tolist(),
        "state": list(topo.state),
        "block": [int(b) for b in topo.block],
        "place": list(topo.place),
    }


def _known(values: Any) -> list[float | None]:
    return [float(v) if np.isfinite(v) else None for v in values]
