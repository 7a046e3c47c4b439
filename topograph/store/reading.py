"""One file -> TopoMap."""

from __future__ import annotations

import sqlite3
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from topograph.errors import MapError
from topograph.geometry import Array, Datum, from_quaternion
from topograph.store.digest import check_digests, has
from topograph.store.schema import FARTHEST, LARGEST, SCHEMA_VERSION
from topograph.topomap import KINDS, Seen, SessionRecord, TopoMap, Viewpoint


@contextmanager
def opened(path: Path) -> Iterator[sqlite3.Connection]:
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
        row = c.execute("SELECT value FROM meta NOT INDEXED WHERE key='schema_version'").fetchone()
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


def load(path: Path | str, *, clouds: bool = True, check: bool = True) -> TopoMap:
    """Read a map; without `clouds` in a fraction of the time, without `check` whatever its digests say.

    Raises:
        MapError: missing, damaged, or of a newer schema.
    """
    path = Path(path)
    with opened(path) as c:
        if check:
            check_digests(c, path)
        meta = dict(c.execute("SELECT key, value FROM meta NOT INDEXED"))
        version = int(meta["schema_version"])
        newer = ", kind, kind_probability, stems" if version >= 2 else ", 'tree', NULL, 1"
        newer += ", lean_sigma, known_at" if version >= 3 else ", NULL, NULL"
        rows = c.execute(
            "SELECT id, x, y, z, cov_xx, cov_xy, cov_yy, cov_zz, axis_x, axis_y, axis_z, diameter, first_branch, "
            'sightings, score, "row"' + newer + " FROM trees ORDER BY id"
        ).fetchall()
        v = np.array([[np.nan if x is None else x for x in r[:16]] for r in rows], float).reshape(-1, 16)
        kind = np.array([KINDS.index(r[16]) if r[16] in KINDS or check else 0 for r in rows], np.int64)
        chance, lean_sigma, known_at = (
            np.array([np.nan if r[k] is None else r[k] for r in rows], float) for k in (17, 19, 20)
        )
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
        told = has(c, "viewpoints", "session")
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
            lean_sigma=lean_sigma,
            known_at=known_at,
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
    if not has(c, "sessions", "name"):
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
    with opened(path) as c:
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
