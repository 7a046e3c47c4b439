"""A digest per table: what was not written is not read."""

from __future__ import annotations

import hashlib
import sqlite3
from pathlib import Path

from topograph.errors import MapError

DIGESTED = ("trees", "edges", "path", "viewpoints", "sessions", "sightings", "meta")


def digest(c: sqlite3.Connection, table: str) -> str:
    """SHA-256 over the rows of a table (not of an index, which may say otherwise); of `meta` without the digests themselves."""
    where = " WHERE key NOT LIKE 'digest:%' ORDER BY key" if table == "meta" else " ORDER BY id"
    columns = "key, value" if table == "meta" else "*"
    if table == "viewpoints":  # clouds have a CRC each
        columns = "id, tree, vx, vy, vz, points, crc" + (", session" if has(c, table, "session") else "")
    h = hashlib.sha256()
    for row in c.execute(f"SELECT {columns} FROM {table} NOT INDEXED{where}"):  # the names are those above
        h.update(repr(row).encode())
    return h.hexdigest()


def has(c: sqlite3.Connection, table: str, column: str) -> bool:
    """Whether a table has a column: maps of older programs lack some."""
    return any(r[1] == column for r in c.execute(f"PRAGMA table_info({table})"))


def check_digests(c: sqlite3.Connection, path: Path) -> None:
    """Maps of older programs, which knew no sessions, have none."""
    there = {
        k.removeprefix("digest:") for (k,) in c.execute("SELECT key FROM meta NOT INDEXED WHERE key LIKE 'digest:%'")
    }
    (version,) = c.execute("SELECT value FROM meta NOT INDEXED WHERE key='schema_version'").fetchone()
    with_digests = int(version) >= 2 and has(c, "sessions", "id")
    if missing := (set(DIGESTED) - there if with_digests else set()):
        raise MapError(
            f"{path}: the digest of table {min(missing)!r} is gone: the file was edited elsewhere; restore a copy, or take over what it says "
            f"with `topograph repair {path.name} NEW.gpkg`"
        )
    for key, value in c.execute("SELECT key, value FROM meta NOT INDEXED WHERE key LIKE 'digest:%'").fetchall():
        table = key.removeprefix("digest:")
        if table in DIGESTED and digest(c, table) != value:
            raise MapError(
                f"{path}: table {table!r} is not what was written: the file is damaged, or was edited elsewhere; restore a copy, or take over what "
                f"it says with `topograph repair {path.name} NEW.gpkg`"
            )
