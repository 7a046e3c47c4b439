"""TopoMap <-> one OGC GeoPackage, which QGIS opens as it is. Written whole or not at all."""

from __future__ import annotations

import fcntl
import glob
import hashlib
import os
import socket
import sqlite3
import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from topograph.errors import MapError
from topograph.geometry import Array, Datum, from_quaternion, to_quaternion
from topograph.topomap import KINDS, Seen, SessionRecord, TopoMap, Viewpoint

SCHEMA_VERSION = 2
_WGS84 = (
    'GEOGCS["WGS 84",DATUM["WGS_1984",SPHEROID["WGS 84",6378137,298.257223563,AUTHORITY["EPSG","7030"]],'
    'AUTHORITY["EPSG","6326"]],PRIMEM["Greenwich",0,AUTHORITY["EPSG","8901"]],'
    'UNIT["degree",0.0174532925199433,AUTHORITY["EPSG","9122"]],AUTHORITY["EPSG","4326"]]'
)
_TABLES = """
CREATE TABLE gpkg_spatial_ref_sys (srs_name TEXT NOT NULL, srs_id INTEGER NOT NULL PRIMARY KEY,
  organization TEXT NOT NULL, organization_coordsys_id INTEGER NOT NULL, definition TEXT NOT NULL, description TEXT);
CREATE TABLE gpkg_contents (table_name TEXT NOT NULL PRIMARY KEY, data_type TEXT NOT NULL, identifier TEXT UNIQUE,
  description TEXT DEFAULT '', last_change DATETIME NOT NULL DEFAULT (strftime('%Y-%m-%dT%H:%M:%fZ','now')),
  min_x DOUBLE, min_y DOUBLE, max_x DOUBLE, max_y DOUBLE, srs_id INTEGER,
  CONSTRAINT fk_gc_r_srs_id FOREIGN KEY (srs_id) REFERENCES gpkg_spatial_ref_sys(srs_id));
CREATE TABLE gpkg_geometry_columns (table_name TEXT NOT NULL, column_name TEXT NOT NULL, geometry_type_name TEXT NOT NULL,
  srs_id INTEGER NOT NULL, z TINYINT NOT NULL, m TINYINT NOT NULL,
  CONSTRAINT pk_geom_cols PRIMARY KEY (table_name, column_name));
CREATE TABLE trees (id INTEGER PRIMARY KEY NOT NULL, geom BLOB, x REAL, y REAL, z REAL, cov_xx REAL, cov_xy REAL,
  cov_yy REAL, cov_zz REAL, axis_x REAL, axis_y REAL, axis_z REAL, diameter REAL, first_branch REAL,
  sightings INTEGER, score REAL, "row" INTEGER, kind TEXT NOT NULL, kind_probability REAL, stems INTEGER NOT NULL,
  state TEXT NOT NULL, block INTEGER NOT NULL, place TEXT NOT NULL);
CREATE TABLE edges (id INTEGER PRIMARY KEY NOT NULL, a INTEGER NOT NULL, b INTEGER NOT NULL, length REAL, geom BLOB);
CREATE TABLE path (id INTEGER PRIMARY KEY NOT NULL, stamp_ns INTEGER NOT NULL, x REAL, y REAL, z REAL,
  qx REAL, qy REAL, qz REAL, qw REAL, geom BLOB, session INTEGER NOT NULL);
CREATE TABLE viewpoints (id INTEGER PRIMARY KEY NOT NULL, tree INTEGER NOT NULL, vx REAL, vy REAL, vz REAL,
  points INTEGER, cloud BLOB, crc INTEGER, session INTEGER NOT NULL);
CREATE INDEX viewpoints_by_tree ON viewpoints (tree);
CREATE TABLE sessions (id INTEGER PRIMARY KEY NOT NULL, name TEXT NOT NULL, start_ns INTEGER NOT NULL, end_ns INTEGER NOT NULL,
  distance REAL, inputs TEXT NOT NULL, verdict TEXT NOT NULL);
CREATE TABLE sightings (id INTEGER PRIMARY KEY NOT NULL, tree INTEGER NOT NULL, session INTEGER NOT NULL, count INTEGER NOT NULL,
  first_ns INTEGER NOT NULL, last_ns INTEGER NOT NULL, passed INTEGER NOT NULL);
CREATE TABLE meta (key TEXT PRIMARY KEY NOT NULL, value TEXT);
"""


def save(topo: TopoMap, path: Path) -> None:
    """Write the map; a killed write leaves the file that was there before, or none.

    Raises:
        MapError: the folder cannot be written.
    """
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        part.unlink(missing_ok=True)
        _sweep(path)
        connection = sqlite3.connect(part)
        try:
            connection.execute("PRAGMA journal_mode=DELETE")
            connection.execute("PRAGMA synchronous=FULL")
            connection.execute(f"PRAGMA application_id={0x47504B47}")
            connection.execute("PRAGMA user_version=10300")
            connection.executescript(_TABLES)
            with connection:
                _fill(connection, topo)
                digests = [(f"digest:{t}", _digest(connection, t)) for t in _DIGESTED]
                connection.executemany("INSERT INTO meta VALUES (?,?)", digests)
        finally:
            connection.close()
        os.replace(part, path)
    except (OSError, sqlite3.Error) as err:
        raise MapError(f"{path}: cannot be written ({err})") from err
    finally:
        part.unlink(missing_ok=True)


def _fill(c: sqlite3.Connection, t: TopoMap) -> None:
    srs = 4326 if t.datum is not None else -1
    c.executemany(
        "INSERT INTO gpkg_spatial_ref_sys VALUES (?,?,?,?,?,?)",
        [
            ("Undefined cartesian", -1, "NONE", -1, "undefined", "the map's own frame, metres"),
            ("Undefined geographic", 0, "NONE", 0, "undefined", None),
            ("WGS 84", 4326, "EPSG", 4326, _WGS84, "longitude, latitude, ellipsoidal height"),
        ],
    )
    world = t.p if t.datum is None else _lon_lat(t.datum, t.p)
    track = t.map_T_robot[:, :3, 3]
    world_track = track if t.datum is None else _lon_lat(t.datum, track)
    everything = np.concatenate([world, world_track]) if len(track) else world
    box = [*everything[:, :2].min(0), *everything[:, :2].max(0)] if len(everything) else [None] * 4
    for name, kind in (("trees", "POINT"), ("edges", "LINESTRING"), ("path", "POINT")):
        c.execute(
            "INSERT INTO gpkg_contents (table_name, data_type, identifier, min_x, min_y, max_x, max_y, srs_id) "
            "VALUES (?,?,?,?,?,?,?,?)",
            (name, "features", name, *(None if b is None else float(b) for b in box), srs),
        )
        c.execute("INSERT INTO gpkg_geometry_columns VALUES (?,?,?,?,?,?)", (name, "geom", kind, srs, 1, 0))
    for name in ("viewpoints", "sessions", "sightings", "meta"):
        c.execute(
            "INSERT INTO gpkg_contents (table_name, data_type, identifier) VALUES (?,?,?)",
            (name, "attributes", name),
        )
    state, block, place = t.state, t.block, t.place
    c.executemany(
        f"INSERT INTO trees VALUES ({','.join(23 * '?')})",
        [
            (
                int(t.ids[i]), _geometry(world[i : i + 1], srs), *_real(t.p[i]),
                *_real([t.cov[i, 0, 0], t.cov[i, 0, 1], t.cov[i, 1, 1], t.cov[i, 2, 2]]), *_real(t.axis[i]),
                *_real([t.diameter[i], t.first_branch[i]]), int(t.sightings[i]), *_real([t.score[i]]), int(t.row[i]),
                KINDS[int(t.kind[i])], *_real([t.kind_probability[i]]), int(t.stems[i]), state[i], int(block[i]), place[i],
            )
            for i in range(len(t))
        ],
    )  # fmt: skip
    c.executemany(
        "INSERT INTO edges VALUES (?,?,?,?,?)",
        [
            (k + 1, int(t.ids[a]), int(t.ids[b]), float(t.lengths[k]), _geometry(world[[a, b]], srs))
            for k, (a, b) in enumerate(t.edges.tolist())
        ],
    )
    q = to_quaternion(t.map_T_robot) if len(track) else np.zeros((0, 4))
    c.executemany(
        "INSERT INTO path VALUES (?,?,?,?,?,?,?,?,?,?,?)",
        [
            (
                k + 1,
                int(t.stamps_ns[k]),
                *_real(track[k]),
                *_real(q[k]),
                _geometry(world_track[k : k + 1], srs),
                1 + (int(t.session[k]) if len(t.session) else 0),
            )
            for k in range(len(track))
        ],
    )
    rows = []
    for k, v in enumerate(t.viewpoints):
        blob = np.clip(np.round(v.cloud * 1000.0), -32768, 32767).astype("<i2").tobytes()
        rows.append(
            (k + 1, int(t.ids[v.tree]), *_real(v.direction), len(v.cloud), blob, zlib.crc32(blob), v.session + 1)
        )
    c.executemany("INSERT INTO viewpoints VALUES (?,?,?,?,?,?,?,?,?)", rows)
    c.executemany(
        "INSERT INTO sessions VALUES (?,?,?,?,?,?,?)",
        [
            (k + 1, s.name, s.start_ns, s.end_ns, *_real([s.distance]), s.inputs, s.verdict)
            for k, s in enumerate(t.sessions)
        ],
    )
    seen = t.seen
    c.executemany(
        "INSERT INTO sightings VALUES (?,?,?,?,?,?,?)",
        [
            (
                k + 1,
                int(t.ids[seen.tree[k]]),
                int(seen.session[k]) + 1,
                *(int(v[k]) for v in (seen.count, seen.first_ns, seen.last_ns, seen.passed)),
            )
            for k in range(len(seen))
        ],
    )
    meta = {
        **t.meta,
        "schema_version": str(SCHEMA_VERSION),
        "datum": "" if t.datum is None else f"{t.datum.lat!r}, {t.datum.lon!r}, {t.datum.h!r}",
        "georeferenced": "no: not georeferenced" if t.datum is None else "yes",
        "datum_cov": " ".join(repr(float(v)) for v in t.datum_cov.ravel()),
    }
    c.executemany("INSERT INTO meta VALUES (?,?)", sorted(meta.items()))


def _real(values: Array | list[float]) -> list[float | None]:
    return [float(v) if np.isfinite(v) else None for v in values]


def _lon_lat(datum: Datum, p: Array) -> Array:
    return datum.to_geodetic(p)[:, [1, 0, 2]] if len(p) else np.zeros((0, 3))


def _geometry(points: Array, srs: int) -> bytes:
    """GeoPackage geometry: POINT Z of one point, LINESTRING Z of more."""
    head = b"GP\x00\x01" + struct.pack("<i", srs)
    if len(points) == 1:
        return head + struct.pack("<BI3d", 1, 1001, *points[0])
    return head + struct.pack("<BII", 1, 1002, len(points)) + np.ascontiguousarray(points, "<f8").tobytes()


@contextmanager
def _opened(path: Path) -> Iterator[sqlite3.Connection]:
    if not path.exists():
        raise MapError(f"{path}: no such map")
    try:
        c = sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro", uri=True)
    except sqlite3.Error as err:
        raise MapError(f"{path}: cannot be opened ({err})") from err
    try:
        c.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, LARGEST)
        c.execute("PRAGMA trusted_schema=OFF")
        c.execute("PRAGMA cell_size_check=ON")
        foreign = c.execute(  # the spatial indices that QGIS makes are harmless: nothing is written through them here
            "SELECT name FROM sqlite_master WHERE type IN ('view', 'trigger') AND name NOT LIKE 'rtree_%' AND name NOT LIKE 'trigger_%_feature_count_%'"
        ).fetchall()
        if foreign:
            raise MapError(f"{path}: holds a view or a trigger ({foreign[0][0]}), which no map does: it is not read")
        row = c.execute("SELECT value FROM meta WHERE key='schema_version'").fetchone()
        if row is None:
            raise MapError(f"{path}: a GeoPackage, but not a topograph map (no schema version)")
        if not int(row[0]) >= 1:
            raise MapError(f"{path}: schema {row[0]} is none: the file is damaged; restore a copy")
        if int(row[0]) > SCHEMA_VERSION:
            raise MapError(f"{path}: schema {row[0]} is newer than this program's {SCHEMA_VERSION}: update topograph")
        yield c
    except MapError:
        raise
    except Exception as err:  # whatever SQLite, numpy and pyproj make of damaged rows
        raise MapError(f"{path}: not a topograph map, or damaged ({err!r})") from err
    finally:
        c.close()


FARTHEST = 1e6
"""Of a tree from the datum, and of the datum's height, m."""
LARGEST = 64 * 1024**2
"""Bytes of a text, a blob or a row: the cloud of a viewpoint has thousands of points, not millions."""
_DIGESTED = ("trees", "edges", "path", "viewpoints", "sessions", "sightings", "meta")


def _digest(c: sqlite3.Connection, table: str) -> str:
    """SHA-256 over the rows of a table; of `meta` without the digests themselves."""
    where = " WHERE key NOT LIKE 'digest:%' ORDER BY key" if table == "meta" else " ORDER BY id"
    columns = "*"
    if table == "viewpoints":  # clouds have a CRC each
        columns = "id, tree, vx, vy, vz, points, crc" + (", session" if _has(c, table, "session") else "")
    h = hashlib.sha256()
    for row in c.execute(f"SELECT {columns} FROM {table}{where}"):  # the names are those above
        h.update(repr(row).encode())
    return h.hexdigest()


def _has(c: sqlite3.Connection, table: str, column: str) -> bool:
    """Whether a table has a column: maps of older programs lack some."""
    return any(r[1] == column for r in c.execute(f"PRAGMA table_info({table})"))


def _check_digests(c: sqlite3.Connection, path: Path) -> None:
    """Maps of older programs, which knew no sessions, have none."""
    there = {k.removeprefix("digest:") for (k,) in c.execute("SELECT key FROM meta WHERE key LIKE 'digest:%'")}
    (version,) = c.execute("SELECT value FROM meta WHERE key='schema_version'").fetchone()
    with_digests = int(version) >= 2 and _has(c, "sessions", "id")
    if missing := (set(_DIGESTED) - there if with_digests else set()):
        raise MapError(
            f"{path}: the digest of table {min(missing)!r} is gone: the file was edited elsewhere; restore a copy, or take over what it says "
            f"with `topograph repair {path.name} NEW.gpkg`"
        )
    for key, value in c.execute("SELECT key, value FROM meta WHERE key LIKE 'digest:%'").fetchall():
        table = key.removeprefix("digest:")
        if table in _DIGESTED and _digest(c, table) != value:
            raise MapError(
                f"{path}: table {table!r} is not what was written: the file is damaged, or was edited elsewhere; restore a copy, or take over what "
                f"it says with `topograph repair {path.name} NEW.gpkg`"
            )


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """The one writer of a map, from loading it to saving it. The lock dies with its process; who holds it stands in the lock file.

    Raises:
        MapError: somebody else writes it.
    """
    path = path.resolve()
    lock = path.with_name(f".{path.name}.lock")
    if not path.parent.is_dir():
        raise MapError(f"{path}: there is no folder {path.parent}")
    while True:
        try:
            handle = lock.open("a+")
        except OSError as err:
            raise MapError(f"{path}: cannot be written ({err.strerror})") from err
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            handle.seek(0)
            who = handle.read(200).strip() or "another process"
            handle.close()
            raise MapError(f"{path}: {who} is writing it; wait until it is done") from None
        if lock.exists() and os.fstat(handle.fileno()).st_ino == lock.stat().st_ino:
            break
        handle.close()  # its holder has just finished, and removed it
    try:
        handle.truncate(0)
        handle.write(f"process {os.getpid()} on {socket.gethostname()}")
        handle.flush()
        yield
    finally:
        lock.unlink(missing_ok=True)
        handle.close()


def _alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):
        return True
    return True


def _sweep(path: Path) -> None:
    """Remove what killed writers of this map left behind."""
    for part in path.parent.glob(f".{glob.escape(path.name)}.*.part*"):
        pid = part.name.removeprefix(f".{path.name}.").split(".")[0]
        if pid.isdigit() and int(pid) != os.getpid() and not _alive(int(pid)):
            part.unlink(missing_ok=True)


def load(path: Path | str, *, clouds: bool = True, check: bool = True) -> TopoMap:
    """Read a map; without `clouds` in a fraction of the time, without `check` whatever its digests say.

    Raises:
        MapError: missing, damaged, or of a newer schema.
    """
    path = Path(path)
    with _opened(path) as c:
        if check:
            _check_digests(c, path)
        meta = dict(c.execute("SELECT key, value FROM meta"))
        newer = ", kind, kind_probability, stems" if int(meta["schema_version"]) >= 2 else ", 'tree', NULL, 1"
        rows = c.execute(
            "SELECT id, x, y, z, cov_xx, cov_xy, cov_yy, cov_zz, axis_x, axis_y, axis_z, diameter, first_branch, "
            'sightings, score, "row"' + newer + " FROM trees ORDER BY id"
        ).fetchall()
        v = np.array([[np.nan if x is None else x for x in r[:16]] for r in rows], float).reshape(-1, 16)
        kind = np.array([KINDS.index(r[16]) if r[16] in KINDS or check else 0 for r in rows], np.int64)
        chance = np.array([np.nan if r[17] is None else r[17] for r in rows], float)
        ids = v[:, 0].astype(np.int64)
        cov = np.zeros((len(v), 3, 3))
        cov[:, 0, 0], cov[:, 0, 1], cov[:, 1, 0] = v[:, 4], v[:, 5], v[:, 5]
        cov[:, 1, 1], cov[:, 2, 2] = v[:, 6], v[:, 7]
        place = {int(i): k for k, i in enumerate(ids)}
        edges = np.array(
            [
                (place[a], place[b])
                for a, b in c.execute("SELECT a, b FROM edges ORDER BY id")
                if check or {a, b} <= place.keys()
            ],
            np.int64,
        )
        path_rows = np.array(
            c.execute("SELECT x, y, z, qx, qy, qz, qw FROM path ORDER BY id").fetchall(), float
        ).reshape(-1, 7)
        stamps = np.array([r[0] for r in c.execute("SELECT stamp_ns FROM path ORDER BY id")], np.int64)
        told = _has(c, "viewpoints", "session")
        views: tuple[Viewpoint, ...] = ()
        if clouds:
            views = tuple(
                _viewpoint(path, place, r)
                for r in c.execute(_VIEWS.format("session" if told else "1"))
                if check or r[0] in place
            )
        sightings = v[:, 13].astype(np.int64)
        sessions, session, seen = _sessions(c, place, stamps, sightings, check)
        datum = Datum(*(float(x) for x in meta["datum"].split(","))) if meta.get("datum") else None
        edges = edges.reshape(-1, 2)
        p = v[:, 1:4]
        if not (np.isfinite(p).all() and np.isfinite(path_rows).all()):
            raise MapError(f"{path}: a position is not finite: the file is damaged; restore a copy")
        if np.abs(p).max(initial=0.0) > FARTHEST or not np.isfinite(v[:, 8:11]).all():
            raise MapError(
                f"{path}: a tree stands nowhere on Earth, or has no axis: the file is damaged; restore a copy"
            )
        if datum is not None and not (abs(datum.lat) <= 90 and abs(datum.lon) <= 360 and abs(datum.h) < FARTHEST):
            raise MapError(
                f"{path}: the datum {meta['datum']} is no place on Earth: the file is damaged; restore a copy"
            )
        return TopoMap(
            datum=datum,
            ids=ids,
            p=p,
            cov=cov,
            axis=v[:, 8:11],
            diameter=v[:, 11],
            first_branch=v[:, 12],
            sightings=sightings,
            score=v[:, 14],
            row=v[:, 15].astype(np.int64),
            kind=kind,
            kind_probability=chance,
            stems=np.array([r[18] for r in rows], np.int64),
            edges=edges,
            lengths=np.linalg.norm(p[edges[:, 0]] - p[edges[:, 1]], axis=1),
            viewpoints=views,
            stamps_ns=stamps,
            map_T_robot=from_quaternion(path_rows[:, :3], path_rows[:, 3:]) if len(stamps) else np.zeros((0, 4, 4)),
            datum_cov=np.array([float(x) for x in meta.get("datum_cov", "0 " * 9).split()]).reshape(3, 3),
            meta={k: x for k, x in meta.items() if k not in _OWN and not k.startswith("digest:")},
            sessions=sessions,
            session=session,
            seen=seen,
        )


def _sessions(
    c: sqlite3.Connection, place: dict[int, int], stamps: NDArray[np.int64], sightings: NDArray[np.int64], check: bool
) -> tuple[tuple[SessionRecord, ...], NDArray[np.int64], Seen]:
    """The sessions of a map, the one of each of its poses, and what they saw; a map that was written before they were kept has one."""
    if not _has(c, "sessions", "name"):
        n, k = len(sightings), len(stamps)
        zero = np.zeros(n, np.int64)
        if not n and not k:
            return (), zero, Seen.none()
        first, last = (int(stamps[0]), int(stamps[-1])) if k else (0, 0)
        record = SessionRecord(name="before sessions were kept", start_ns=first, end_ns=last)
        seen = Seen(
            tree=np.arange(n), session=zero, count=sightings, first_ns=zero + first, last_ns=zero + last, passed=zero
        )
        return (record,), np.zeros(k, np.int64), seen
    records = tuple(
        SessionRecord(
            name=r[0], start_ns=r[1], end_ns=r[2], distance=np.nan if r[3] is None else r[3], inputs=r[4], verdict=r[5]
        )
        for r in c.execute("SELECT name, start_ns, end_ns, distance, inputs, verdict FROM sessions ORDER BY id")
    )
    session = np.array([r[0] for r in c.execute("SELECT session FROM path ORDER BY id")], np.int64) - 1
    rows = np.array(
        [
            (place[r[0]], *r[1:])
            for r in c.execute("SELECT tree, session, count, first_ns, last_ns, passed FROM sightings ORDER BY id")
            if check or (r[0] in place and 0 < r[1] <= len(records))  # somebody may have taken trees out
        ],
        np.int64,
    ).reshape(-1, 6)
    seen = Seen(
        tree=rows[:, 0],
        session=rows[:, 1] - 1,
        count=rows[:, 2],
        first_ns=rows[:, 3],
        last_ns=rows[:, 4],
        passed=rows[:, 5],
    )
    return records, session, seen


_OWN = ("schema_version", "datum", "georeferenced", "datum_cov")
_VIEWS = "SELECT tree, vx, vy, vz, points, cloud, crc, {} FROM viewpoints"


def clouds_near(path: Path, xy: Array, radius: float) -> list[tuple[int, Array, NDArray[np.float32]]]:
    """(tree id, direction (3,), cloud (M, 3) about the node) of the nodes within `radius` m of `xy`; reads no others."""
    with _opened(path) as c:
        x, y = float(xy[0]), float(xy[1])
        found = c.execute(
            "SELECT v.tree, vx, vy, vz, points, cloud, crc, 1 FROM viewpoints v JOIN trees t ON t.id = v.tree "
            "WHERE t.x BETWEEN ? AND ? AND t.y BETWEEN ? AND ? AND (t.x-?)*(t.x-?)+(t.y-?)*(t.y-?) <= ?",
            (x - radius, x + radius, y - radius, y + radius, x, x, y, y, radius**2),
        ).fetchall()
        views = [(r[0], _viewpoint(path, {r[0]: 0}, r)) for r in found]
    return [(tree, v.direction, v.cloud) for tree, v in views]


def _viewpoint(
    path: Path, place: dict[int, int], r: tuple[int, float, float, float, int, bytes, int, int]
) -> Viewpoint:
    tree, vx, vy, vz, points, blob, crc, session = r
    if zlib.crc32(blob) != crc or len(blob) != 6 * points:
        raise MapError(f"{path}: the cloud of tree {tree} is damaged; map the bags again or restore a copy")
    return Viewpoint(
        place[tree],
        np.array([vx, vy, vz]),
        (np.frombuffer(blob, "<i2").reshape(-1, 3) * 0.001).astype(np.float32),
        session - 1,
    )
