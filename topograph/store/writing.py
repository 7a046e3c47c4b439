"""TopoMap -> one file."""

from __future__ import annotations

import sqlite3
import zlib
from contextlib import closing
from pathlib import Path

import numpy as np

from topograph.errors import MapError
from topograph.geometry import to_quaternion
from topograph.store.digest import DIGESTED, digest
from topograph.store.layers import add_layers
from topograph.store.lock import sweep
from topograph.store.schema import ATTRIBUTES, FEATURES, SCHEMA_VERSION, TABLES, WGS84, geometry, lon_lat, real
from topograph.topomap import KINDS, TopoMap
from topograph.whole import whole


def save(topo: TopoMap, path: Path) -> None:
    """Write the map; a killed write leaves the file that was there before, or none.

    Raises:
        MapError: the folder cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        sweep(path)
        with whole(path) as part, closing(sqlite3.connect(part)) as connection:
            connection.execute("PRAGMA journal_mode=DELETE")
            connection.execute("PRAGMA synchronous=FULL")
            connection.execute(f"PRAGMA application_id={0x47504B47}")
            connection.execute("PRAGMA user_version=10300")
            connection.executescript(TABLES)
            with connection:
                fill(connection, topo)
                add_layers(connection, topo, _srs(topo))
                digests = [(f"digest:{t}", digest(connection, t)) for t in DIGESTED]
                connection.executemany("INSERT INTO meta (key, value) VALUES (?,?)", digests)
    except (OSError, sqlite3.Error) as err:
        raise MapError(f"{path}: cannot be written ({err})") from err


def _srs(t: TopoMap) -> int:
    return 4326 if t.datum is not None else -1


def fill(c: sqlite3.Connection, t: TopoMap) -> None:
    srs = _srs(t)
    c.executemany(
        "INSERT INTO gpkg_spatial_ref_sys VALUES (?,?,?,?,?,?)",
        [
            ("Undefined cartesian", -1, "NONE", -1, "undefined", "the map's own frame, metres"),
            ("Undefined geographic", 0, "NONE", 0, "undefined", None),
            ("WGS 84", 4326, "EPSG", 4326, WGS84, "longitude, latitude, ellipsoidal height"),
        ],
    )
    world = t.p if t.datum is None else lon_lat(t.datum, t.p)
    track = t.map_T_robot[:, :3, 3]
    world_track = track if t.datum is None else lon_lat(t.datum, track)
    everything = np.concatenate([world, world_track]) if len(track) else world
    box = [*everything[:, :2].min(0), *everything[:, :2].max(0)] if len(everything) else [None] * 4
    for name, kind in FEATURES.items():
        c.execute(
            "INSERT INTO gpkg_contents (table_name, data_type, identifier, min_x, min_y, max_x, max_y, srs_id) "
            "VALUES (?,?,?,?,?,?,?,?)",
            (name, "features", name, *(None if b is None else float(b) for b in box), srs),
        )
        c.execute("INSERT INTO gpkg_geometry_columns VALUES (?,?,?,?,?,?)", (name, "geom", kind, srs, 1, 0))
    for name in ATTRIBUTES:
        c.execute(
            "INSERT INTO gpkg_contents (table_name, data_type, identifier) VALUES (?,?,?)",
            (name, "attributes", name),
        )
    state, block, place = t.state, t.block, t.place
    c.executemany(
        f"INSERT INTO trees VALUES ({','.join(25 * '?')})",
        [
            (
                int(t.ids[i]), geometry(world[i : i + 1], srs), *real(t.p[i]),
                *real([t.cov[i, 0, 0], t.cov[i, 0, 1], t.cov[i, 1, 1], t.cov[i, 2, 2]]), *real(t.axis[i]),
                *real([t.diameter[i], t.first_branch[i]]), int(t.sightings[i]), *real([t.score[i]]), int(t.row[i]),
                KINDS[int(t.kind[i])], *real([t.kind_probability[i]]), int(t.stems[i]), state[i], int(block[i]), place[i],
                *real([t.lean_sigma[i], t.known_at[i]]),
            )
            for i in range(len(t))
        ],
    )  # fmt: skip
    c.executemany(
        "INSERT INTO edges VALUES (?,?,?,?,?)",
        [
            (k + 1, int(t.ids[a]), int(t.ids[b]), float(t.lengths[k]), geometry(world[[a, b]], srs))
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
                *real(track[k]),
                *real(q[k]),
                geometry(world_track[k : k + 1], srs),
                1 + (int(t.session[k]) if len(t.session) else 0),
            )
            for k in range(len(track))
        ],
    )
    rows = []
    for k, v in enumerate(t.viewpoints):
        blob = np.clip(np.round(v.cloud * 1000.0), -32768, 32767).astype("<i2").tobytes()
        rows.append(
            (k + 1, int(t.ids[v.tree]), *real(v.direction), len(v.cloud), blob, zlib.crc32(blob), v.session + 1)
        )
    c.executemany("INSERT INTO viewpoints VALUES (?,?,?,?,?,?,?,?,?)", rows)
    c.executemany(
        "INSERT INTO sessions VALUES (?,?,?,?,?,?,?)",
        [
            (k + 1, s.name, s.start_ns, s.end_ns, *real([s.distance]), s.inputs, s.verdict)
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
    c.executemany("INSERT INTO meta (key, value) VALUES (?,?)", sorted(meta.items()))
