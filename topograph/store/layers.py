"""What a map file holds for people besides its own tables: the path as lines, ellipses, spatial indices, styles. Derived, and never read back."""

from __future__ import annotations

import sqlite3
import struct

import numpy as np
from numpy.typing import NDArray

from topograph.geometry import Array
from topograph.store.schema import FEATURES, RTREE_TRIGGERS, geometry, lon_lat, polygon
from topograph.store.styles import STYLES
from topograph.topomap import TopoMap

CORNERS = 24
"""Of the polygon that stands for an ellipse."""


def add_layers(c: sqlite3.Connection, t: TopoMap, srs: int) -> None:
    """Lines of the path, ellipses of the trees, then indices over all feature tables and QGIS's styles."""
    _path_lines(c, t, srs)
    _ellipses(c, t, srs)
    for table in FEATURES:
        _index(c, table)
    _styles(c)


def _path_lines(c: sqlite3.Connection, t: TopoMap, srs: int) -> None:
    """One line a session."""
    track = t.map_T_robot[:, :3, 3]
    world = track if t.datum is None else lon_lat(t.datum, track)
    session = t.session if len(t.session) else np.zeros(len(track), np.int64)
    rows = []
    for k in np.unique(session):
        mine = np.flatnonzero(session == k)
        if len(mine) > 1:
            length = float(np.linalg.norm(np.diff(track[mine, :3], axis=0), axis=1).sum())
            rows.append((int(k) + 1, geometry(world[mine], srs), int(k) + 1, length))
    c.executemany("INSERT INTO path_lines VALUES (?,?,?,?)", rows)


def _ellipses(c: sqlite3.Connection, t: TopoMap, srs: int) -> None:
    """95 % of each tree's position, true to scale."""
    radii, angle = t.ellipses()
    rows: list[tuple[int, bytes, int, float, float]] = []
    for i in np.flatnonzero(np.isfinite(angle)).tolist():
        ring = np.tile(t.p[i], (CORNERS + 1, 1))
        cos, sin = np.cos(angle[i]), np.sin(angle[i])
        ring[:, :2] += _circle() * radii[i] @ np.array([[cos, sin], [-sin, cos]])
        world = ring if t.datum is None else lon_lat(t.datum, ring)
        rows.append((len(rows) + 1, polygon(world, srs), int(t.ids[i]), float(radii[i, 0]), float(radii[i, 1])))
    c.executemany("INSERT INTO ellipses VALUES (?,?,?,?,?)", rows)


def _circle() -> Array:
    a = np.linspace(0.0, 2 * np.pi, CORNERS + 1)
    ring = np.column_stack([np.cos(a), np.sin(a)])
    ring[-1] = ring[0]  # closed to the last bit
    return ring


def _index(c: sqlite3.Connection, table: str) -> None:
    """The R-tree of GeoPackage's extension gpkg_rtree_index, filled here, with the triggers that it asks for."""
    name = f"rtree_{table}_geom"
    c.execute(f"CREATE VIRTUAL TABLE {name} USING rtree(id, minx, maxx, miny, maxy)")
    rows = [(i, *_box(blob)) for i, blob in c.execute(f"SELECT id, geom FROM {table} WHERE geom NOT NULL")]
    c.executemany(f"INSERT INTO {name} VALUES (?,?,?,?,?)", rows)
    c.execute(
        "INSERT INTO gpkg_extensions VALUES (?,?,?,?,?)",
        (table, "geom", "gpkg_rtree_index", "http://www.geopackage.org/spec120/#extension_rtree", "write-only"),
    )
    for statement in RTREE_TRIGGERS:
        c.execute(statement.format(t=table, c="geom", i="id"))
    if rows:
        boxes = np.array(rows)[:, 1:]
        low, high = boxes[:, [0, 2]].min(axis=0), boxes[:, [1, 3]].max(axis=0)
        c.execute(
            "UPDATE gpkg_contents SET min_x=?, min_y=?, max_x=?, max_y=? WHERE table_name=?",
            (*map(float, (low[0], low[1], high[0], high[1])), table),
        )


def _box(blob: bytes) -> tuple[float, float, float, float]:
    """minx, maxx, miny, maxy of a geometry that `schema` wrote."""
    (kind,) = struct.unpack_from("<I", blob, 9)
    at = {1001: 13, 1002: 17, 1003: 21}[kind]
    p: NDArray[np.float64] = np.frombuffer(blob, "<f8", offset=at).reshape(-1, 3)
    return float(p[:, 0].min()), float(p[:, 0].max()), float(p[:, 1].min()), float(p[:, 1].max())


def _styles(c: sqlite3.Connection) -> None:
    """QGIS takes the default style of a layer from the file itself."""
    c.executemany(
        "INSERT INTO layer_styles (f_table_catalog, f_table_schema, f_table_name, f_geometry_column, styleName, styleQML, styleSLD, useAsDefault, description, owner) "
        "VALUES ('', '', ?, 'geom', 'topograph', ?, '', 1, 'written by topograph', '')",
        [(table, STYLES[table]) for table in FEATURES],
    )
