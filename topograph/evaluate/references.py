"""The one door of `--truth`: a simulator's folder, a path (TUM), or trees (CSV, GeoJSON); several are laid together."""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from topograph.errors import InputError
from topograph.evaluate.truth import Truth
from topograph.exchange import read_tum
from topograph.geometry import Array, Datum


def read_truth(paths: Sequence[Path]) -> Truth | None:
    """The truth of several files: trees of one, path of another. None without any.

    Raises:
        InputError: a file is missing or not of a known layout; two of them have trees, or a path.
    """
    parts = [read_one(p) for p in paths]
    out: Truth | None = None
    for p, part in zip(paths, parts, strict=True):
        if out is None:
            out = part
            continue
        if (len(out.trees) and len(part.trees)) or (len(out.stamps_ns) and len(part.stamps_ns)):
            raise InputError(f"{p}: a second truth of the same kind; give one for the trees and one for the path")
        with_trees, with_path = (out, part) if len(out.trees) else (part, out)
        if with_path.datum is None and with_trees.datum is not None:
            raise InputError(f"{p}: a local path and georeferenced trees have no frame in common")
        out = replace(with_trees, stamps_ns=with_path.stamps_ns, world_T_robot=with_path.world_T_robot)
    return out


def read_one(path: Path) -> Truth:
    """One truth, by what the path is.

    Raises:
        InputError: missing, or of no known layout.
    """
    if path.is_dir():
        return Truth.load(path)
    if not path.is_file():
        raise InputError(f"{path}: no such truth; give a simulator's folder, a .tum path, or trees as .csv or .geojson")
    try:
        if path.suffix in (".tum", ".txt"):
            stamps, poses = read_tum(path)
            if len(stamps) < 2:
                raise InputError(f"{path}: a path of {len(stamps)} poses is no truth")
            order = np.argsort(stamps, kind="stable")
            return Truth.of_path(stamps[order], poses[order])
        if path.suffix in (".geojson", ".json"):
            return _of_rows(_features(json.loads(path.read_text(encoding="utf-8-sig"))), path)
        if path.suffix == ".csv":
            with path.open(newline="", encoding="utf-8-sig") as f:
                return _of_rows(list(csv.DictReader(f)), path)
    except (OSError, ValueError, KeyError, TypeError) as err:
        raise InputError(f"{path}: cannot be read as a truth ({err})") from err
    raise InputError(f"{path}: a truth is a folder, a .tum path, or trees as .csv or .geojson")


def _features(data: Mapping[str, Any]) -> list[dict[str, Any]]:
    rows = []
    for f in data["features"]:
        if f["geometry"]["type"] != "Point":
            continue
        lon, lat, *h = f["geometry"]["coordinates"]
        rows.append({**(f.get("properties") or {}), "lat": lat, "lon": lon, "h": h[0] if h else 0.0})
    return rows


NAMES = {"lat": ("lat", "latitude"), "lon": ("lon", "lng", "longitude"), "h": ("h", "height", "alt", "altitude", "ele")}


def _of_rows(rows: Sequence[Mapping[str, Any]], path: Path) -> Truth:
    """Trees of a table: `lat`, `lon` (h) or `x`, `y` (z); all else may be missing: axis_x, axis_y, axis_z, diameter, stems, sigma."""
    if not rows:
        raise InputError(f"{path}: no trees in it")
    found = {k: next((n for n in names if n in rows[0]), None) for k, names in NAMES.items()}

    def column(name: str | None, default: float) -> Array:
        values = [None if name is None else r.get(name) for r in rows]
        return np.array([default if v in (None, "") else float(v) for v in values])

    datum: Datum | None = None
    if found["lat"] and found["lon"]:
        geodetic = np.column_stack(
            [column(found["lat"], np.nan), column(found["lon"], np.nan), column(found["h"], 0.0)]
        )
        if not np.isfinite(geodetic).all():
            raise InputError(f"{path}: a tree has no latitude or longitude")
        datum = Datum(*geodetic.mean(axis=0).tolist())
        trees = datum.to_enu(geodetic)
    elif "x" in rows[0] and "y" in rows[0]:
        trees = np.column_stack([column("x", np.nan), column("y", np.nan), column("z", 0.0)])
        if not np.isfinite(trees).all():
            raise InputError(f"{path}: a tree has no x or y")
    else:
        raise InputError(
            f"{path}: trees need columns lat and lon, or x and y; there are {', '.join(map(str, rows[0]))}"
        )
    axes = np.column_stack([column("axis_x", 0.0), column("axis_y", 0.0), column("axis_z", 1.0)])
    sigma = column("sigma", np.nan)
    return Truth.of_trees(
        datum,
        trees,
        axes=axes / np.linalg.norm(axes, axis=1, keepdims=True),
        diameters=column("diameter", np.nan),
        stems=column("stems", 1).astype(np.int64),
        sigma=float(np.nanmedian(sigma)) if np.isfinite(sigma).any() else float("nan"),
    )
