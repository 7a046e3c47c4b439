"""A map that one can walk through, in a browser, offline: one file, or served with clouds on demand.

The page's script is made of tools/viewer (deck.gl) and shipped as an asset.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from topograph.exchange import read_localization
from topograph.geometry import Array
from topograph.localize import row_direction
from topograph.report.templates import render
from topograph.topomap import TopoMap
from topograph.whole import write_text

MOST_CLOUD_BYTES = 3_000_000
"""Of all clouds in a self-contained page; they are thinned alike until they fit."""
STATES = ("searching", "ambiguous", "tracking", "degraded", "lost")


def write_viewer(
    path: Path,
    topo: TopoMap,
    title: str,
    *,
    facts: str = "",
    notes: Sequence[str] = (),
    localization: dict[str, Any] | None = None,
) -> None:
    """Write one self-contained page."""
    write_text(path, page(topo, title, facts=facts, notes=notes, localization=localization))


def page(
    topo: TopoMap,
    title: str,
    *,
    facts: str = "",
    notes: Sequence[str] = (),
    localization: dict[str, Any] | None = None,
    served: bool = False,
) -> str:
    """The page; `served`: without clouds, which it then asks its server for."""
    data = map_data(topo, clouds=not served) | {"served": served}
    if localization is not None:
        data["localization"] = localization
    script = files("topograph.report").joinpath("assets/viewer.js").read_text()
    text = json.dumps(data, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    frame = "x east, y north" if topo.datum is not None else "local frame, not georeferenced"
    return render(
        "viewer.html", title=title, facts=facts or summary(topo), notes=notes, data=text, served=served, frame=frame,
        script=script.replace("</script", "<\\/script"),
    )  # fmt: skip


def summary(topo: TopoMap) -> str:
    """Counts in one line."""
    trees, others = int(topo.is_tree.sum()), int((~topo.is_tree).sum())
    missing = sum(s == "missing" for s in topo.state)
    parts = [f"{trees} trees", f"{others} other landmarks" if others else "", f"{missing} missing" if missing else ""]
    n = len(topo.sessions)
    parts += [f"{len(topo.edges)} edges", f"{n} session{'s' if n != 1 else ''}", topo.meta.get("verdict", "")]
    return " · ".join(p for p in parts if p)


def map_data(topo: TopoMap, *, clouds: bool) -> dict[str, Any]:
    """What the script draws: arrays as base64 of little-endian numbers."""
    n = len(topo)
    radii, angle = (np.nan_to_num(v) for v in topo.ellipses())
    seen = np.zeros((len(topo.sessions), n), np.int64)
    if len(topo.seen):
        np.add.at(seen, (topo.seen.session, topo.seen.tree), topo.seen.count)
    bits = (seen[:30] > 0).astype(np.int64).T @ (1 << np.arange(min(len(seen), 30))) if len(seen) else np.zeros(n)
    g = topo.geodetic()
    session = topo.session if len(topo.session) else np.zeros(len(topo.stamps_ns), np.int64)
    track = topo.map_T_robot[:, :2, 3]
    return {
        "trees": {
            **{k: _f4(topo.p[:, i]) for i, k in enumerate("xyz")},
            **{f"a{k}": _f4(topo.axis[:, i]) for i, k in enumerate("xyz")},
            "id": topo.ids.tolist(), "d": _f4(np.nan_to_num(topo.diameter)), "a": _f4(radii[:, 0]), "b": _f4(radii[:, 1]), "turn": _f4(angle),
            "kind": _packed(topo.kind.astype("u1"), "u1"), "missing": _packed(np.array([s == "missing" for s in topo.state], "u1"), "u1"),
            "stems": topo.stems.tolist(), "sightings": topo.sightings.tolist(), "place": list(topo.place),
            "chance": _f4(np.nan_to_num(topo.kind_probability, nan=-1.0)), "sessions": _packed(bits.astype("<i4"), "i4"),
        },
        "lat": None if topo.datum is None else [f"{v:.7f}" for v in g[:, 0]],
        "lon": None if topo.datum is None else [f"{v:.7f}" for v in g[:, 1]],
        "edges": _packed(topo.edges.astype("<i4").ravel(), "i4"),
        "paths": [{"session": int(k) + 1, "points": _f4(track[session == k].ravel())} for k in np.unique(session)],
        "sessions": [{"name": s.name} for s in topo.sessions],
        "seen": [_packed(row.astype("<i4"), "i4") for row in seen],
        "views": _views(topo, clouds),
    }  # fmt: skip


def _views(topo: TopoMap, clouds: bool) -> dict[str, list[dict[str, Any]]]:
    """Row of a tree -> its viewpoints, with clouds in mm about the node."""
    total = sum(6 * len(v.cloud) for v in topo.viewpoints)
    every = max(1, -(-total // MOST_CLOUD_BYTES))
    out: dict[str, list[dict[str, Any]]] = {}
    for v in topo.viewpoints:
        view: dict[str, Any] = {"dx": round(float(v.direction[0]), 3), "dy": round(float(v.direction[1]), 3)}
        if clouds and len(v.cloud):
            view["cloud"] = _packed(millimetres(v.cloud[::every]), "i2")
        out.setdefault(str(v.tree), []).append(view)
    return out


def millimetres(cloud: NDArray[np.float32]) -> NDArray[np.int16]:
    """A cloud (N, 3) about its node as the map file has it, flat."""
    return np.clip(np.round(cloud * 1000.0), -32768, 32767).astype("<i2").ravel()


def _packed(values: NDArray[Any], kind: str) -> dict[str, str]:
    return {"b64": base64.b64encode(np.ascontiguousarray(values).tobytes()).decode(), "type": kind}


def _f4(values: Any) -> dict[str, str]:
    return _packed(np.asarray(values, "<f4"), "f4")


def localization_data(
    folder: Path, topo: TopoMap, truth_xy: Array | None = None, errors: Array | None = None
) -> dict[str, Any]:
    """A localization as the page replays it, of the folder that `localize` wrote; `truth_xy` (S, 2) and `errors` (S,) of its scans, m.

    Raises:
        InputError: the folder holds none.
    """
    found = read_localization(folder)
    number = {int(t): k for k, t in enumerate(topo.ids)}
    seen = [[number[t] for t in trees.tolist() if t in number] for trees in found.trees]
    start = int(found.stamps_ns[0])
    x, y = found.map_T_robot[:, 0, 3], found.map_T_robot[:, 1, 3]
    yaw = np.arctan2(found.map_T_robot[:, 1, 0], found.map_T_robot[:, 0, 0])
    hyps = found.places
    flat = np.concatenate(hyps)
    return {
        "time": [round(1e-9 * (s - start), 3) for s in found.stamps_ns.tolist()],
        "states": list(STATES),
        "state": _packed(np.array([STATES.index(w) for w in found.state], "u1"), "u1"),
        "x": _f4(x), "y": _f4(y), "yaw": _f4(yaw),
        "sigmaA": _f4(np.nan_to_num(found.along)), "sigmaB": _f4(np.nan_to_num(found.across)),
        "rowAngle": float(np.arctan2(*row_direction(topo)[::-1])),
        "count": found.count.tolist(),
        "seenStart": np.concatenate([[0], np.cumsum([len(s) for s in seen])]).tolist(),
        "seen": [t for s in seen for t in s],
        "hypStart": np.concatenate([[0], np.cumsum([len(h) for h in hyps])]).tolist(),
        "hypX": _f4(flat[:, 0]), "hypY": _f4(flat[:, 1]), "hypW": _f4(flat[:, 3]),
        "truth": None if truth_xy is None else _f4(truth_xy.ravel()),
        "error": None if errors is None else _f4(errors),
    }  # fmt: skip
