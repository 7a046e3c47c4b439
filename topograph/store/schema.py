"""The tables of a map file, and what its rows are made of."""

from __future__ import annotations

import struct

import numpy as np

from topograph.geometry import Array, Datum

SCHEMA_VERSION = 3
WGS84 = (
    'GEOGCS["WGS 84",DATUM["WGS_1984",SPHEROID["WGS 84",6378137,298.257223563,AUTHORITY["EPSG","7030"]],'
    'AUTHORITY["EPSG","6326"]],PRIMEM["Greenwich",0,AUTHORITY["EPSG","8901"]],'
    'UNIT["degree",0.0174532925199433,AUTHORITY["EPSG","9122"]],AUTHORITY["EPSG","4326"]]'
)
TABLES = """
CREATE TABLE gpkg_spatial_ref_sys (srs_name TEXT NOT NULL, srs_id INTEGER NOT NULL PRIMARY KEY,
  organization TEXT NOT NULL, organization_coordsys_id INTEGER NOT NULL, definition TEXT NOT NULL, description TEXT);
CREATE TABLE gpkg_contents (table_name TEXT NOT NULL PRIMARY KEY, data_type TEXT NOT NULL, identifier TEXT UNIQUE,
  description TEXT DEFAULT '', last_change DATETIME NOT NULL DEFAULT (strftime('%Y-%m-%dT%H:%M:%fZ','now')),
  min_x DOUBLE, min_y DOUBLE, max_x DOUBLE, max_y DOUBLE, srs_id INTEGER,
  CONSTRAINT fk_gc_r_srs_id FOREIGN KEY (srs_id) REFERENCES gpkg_spatial_ref_sys(srs_id));
CREATE TABLE gpkg_geometry_columns (table_name TEXT NOT NULL, column_name TEXT NOT NULL, geometry_type_name TEXT NOT NULL,
  srs_id INTEGER NOT NULL, z TINYINT NOT NULL, m TINYINT NOT NULL,
  CONSTRAINT pk_geom_cols PRIMARY KEY (table_name, column_name));
CREATE TABLE gpkg_extensions (table_name TEXT, column_name TEXT, extension_name TEXT NOT NULL, definition TEXT NOT NULL,
  scope TEXT NOT NULL, CONSTRAINT ge_tce UNIQUE (table_name, column_name, extension_name));
CREATE TABLE trees (id INTEGER PRIMARY KEY NOT NULL, geom POINT, x REAL, y REAL, z REAL, cov_xx REAL, cov_xy REAL,
  cov_yy REAL, cov_zz REAL, axis_x REAL, axis_y REAL, axis_z REAL, diameter REAL, first_branch REAL,
  sightings INTEGER, score REAL, "row" INTEGER, kind TEXT NOT NULL, kind_probability REAL, stems INTEGER NOT NULL,
  state TEXT NOT NULL, block INTEGER NOT NULL, place TEXT NOT NULL, lean_sigma REAL, known_at REAL);
CREATE TABLE edges (id INTEGER PRIMARY KEY NOT NULL, a INTEGER NOT NULL, b INTEGER NOT NULL, length REAL, geom LINESTRING);
CREATE TABLE path (id INTEGER PRIMARY KEY NOT NULL, stamp_ns INTEGER NOT NULL, x REAL, y REAL, z REAL,
  qx REAL, qy REAL, qz REAL, qw REAL, geom POINT, session INTEGER NOT NULL);
CREATE TABLE viewpoints (id INTEGER PRIMARY KEY NOT NULL, tree INTEGER NOT NULL, vx REAL, vy REAL, vz REAL,
  points INTEGER, cloud BLOB, crc INTEGER, session INTEGER NOT NULL);
CREATE INDEX viewpoints_by_tree ON viewpoints (tree);
CREATE TABLE sessions (id INTEGER PRIMARY KEY NOT NULL, name TEXT NOT NULL, start_ns INTEGER NOT NULL, end_ns INTEGER NOT NULL,
  distance REAL, inputs TEXT NOT NULL, verdict TEXT NOT NULL);
CREATE TABLE sightings (id INTEGER PRIMARY KEY NOT NULL, tree INTEGER NOT NULL, session INTEGER NOT NULL, count INTEGER NOT NULL,
  first_ns INTEGER NOT NULL, last_ns INTEGER NOT NULL, passed INTEGER NOT NULL);
CREATE TABLE meta (id INTEGER PRIMARY KEY NOT NULL, key TEXT UNIQUE NOT NULL, value TEXT);
CREATE TABLE path_lines (id INTEGER PRIMARY KEY NOT NULL, geom LINESTRING, session INTEGER NOT NULL, length REAL);
CREATE TABLE ellipses (id INTEGER PRIMARY KEY NOT NULL, geom POLYGON, tree INTEGER NOT NULL, major REAL, minor REAL);
CREATE TABLE layer_styles (id INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL, f_table_catalog TEXT, f_table_schema TEXT, f_table_name TEXT,
  f_geometry_column TEXT, styleName TEXT, styleQML TEXT, styleSLD TEXT, useAsDefault BOOLEAN, description TEXT, owner TEXT, ui TEXT,
  update_time DATETIME DEFAULT (strftime('%Y-%m-%dT%H:%M:%fZ','now')));
"""

FEATURES = {"trees": "POINT", "edges": "LINESTRING", "path": "POINT", "path_lines": "LINESTRING", "ellipses": "POLYGON"}
"""Layers and what they are made of."""
ATTRIBUTES = ("viewpoints", "sessions", "sightings", "meta", "layer_styles")
_KEEP = 'NOT NULL AND NOT ST_IsEmpty(NEW."{c}")'
_ROW = 'INSERT OR REPLACE INTO "rtree_{t}_{c}" VALUES (NEW."{i}", ST_MinX(NEW."{c}"), ST_MaxX(NEW."{c}"), ST_MinY(NEW."{c}"), ST_MaxY(NEW."{c}"));'
RTREE_TRIGGERS = (
    'CREATE TRIGGER "rtree_{t}_{c}_insert" AFTER INSERT ON "{t}" WHEN (new."{c}" NOT NULL AND NOT ST_IsEmpty(NEW."{c}")) BEGIN ' + _ROW + " END",
    'CREATE TRIGGER "rtree_{t}_{c}_update1" AFTER UPDATE OF "{c}" ON "{t}" WHEN OLD."{i}" = NEW."{i}" AND (NEW."{c}" ' + _KEEP + ") BEGIN " + _ROW + " END",
    'CREATE TRIGGER "rtree_{t}_{c}_update2" AFTER UPDATE OF "{c}" ON "{t}" WHEN OLD."{i}" = NEW."{i}" AND (NEW."{c}" ISNULL OR ST_IsEmpty(NEW."{c}")) '
    'BEGIN DELETE FROM "rtree_{t}_{c}" WHERE id = OLD."{i}"; END',
    'CREATE TRIGGER "rtree_{t}_{c}_update3" AFTER UPDATE ON "{t}" WHEN OLD."{i}" != NEW."{i}" AND (NEW."{c}" ' + _KEEP
    + ') BEGIN DELETE FROM "rtree_{t}_{c}" WHERE id = OLD."{i}"; ' + _ROW + " END",
    'CREATE TRIGGER "rtree_{t}_{c}_update4" AFTER UPDATE ON "{t}" WHEN OLD."{i}" != NEW."{i}" AND (NEW."{c}" ISNULL OR ST_IsEmpty(NEW."{c}")) '
    'BEGIN DELETE FROM "rtree_{t}_{c}" WHERE id IN (OLD."{i}", NEW."{i}"); END',
    'CREATE TRIGGER "rtree_{t}_{c}_delete" AFTER DELETE ON "{t}" WHEN old."{c}" NOT NULL BEGIN DELETE FROM "rtree_{t}_{c}" WHERE id = OLD."{i}"; END',
)  # fmt: skip
"""Of the OGC GeoPackage extension "RTree Spatial Indexes", annex F.3."""
FARTHEST = 1e6
"""Of a tree from the datum, and of the datum's height, m."""
LARGEST = 64 * 1024**2
"""Bytes of a text, a blob or a row: the cloud of a viewpoint has thousands of points, not millions."""


def real(values: Array | list[float]) -> list[float | None]:
    return [float(v) if np.isfinite(v) else None for v in values]


def lon_lat(datum: Datum, p: Array) -> Array:
    return datum.to_geodetic(p)[:, [1, 0, 2]] if len(p) else np.zeros((0, 3))


def geometry(points: Array, srs: int) -> bytes:
    """GeoPackage geometry: POINT Z of one point, LINESTRING Z of more."""
    head = b"GP\x00\x01" + struct.pack("<i", srs)
    if len(points) == 1:
        return head + struct.pack("<BI3d", 1, 1001, *points[0])
    return head + struct.pack("<BII", 1, 1002, len(points)) + np.ascontiguousarray(points, "<f8").tobytes()


def polygon(ring: Array, srs: int) -> bytes:
    """GeoPackage geometry: POLYGON Z of one closed ring (N, 3)."""
    head = b"GP\x00\x01" + struct.pack("<i", srs)
    return head + struct.pack("<BIII", 1, 1003, 1, len(ring)) + np.ascontiguousarray(ring, "<f8").tobytes()
