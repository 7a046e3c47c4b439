"""What a run brought so far, on disk while it is driven: a process that dies takes half a second of it along."""

from __future__ import annotations

import io
import json
import sqlite3
import time
import zipfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from urllib.parse import quote

import numpy as np

from topograph.bags import Fix, Heading, Imu, Odometry, Trunks
from topograph.errors import InputError
from topograph.geometry import Array

Message = Odometry | Imu | Fix | Heading
COMMIT_S = 0.5
"""What is younger is lost with the process."""
FORMAT = 1
COLUMNS: dict[type[Message], tuple[str, ...]] = {
    Odometry: ("child_frame", "odom_T_child", "twist"),
    Imu: ("frame", "gyro", "accel"),
    Fix: ("frame", "lat_lon_h", "cov", "status"),
    Heading: ("frame", "yaw", "sigma"),
}
OF_TRUNKS = ("p", "axis", "diameter", "cov", "height", "score", "kinds", "measured", "stems", "free", "eye")


class Journal:
    """Append scans' trunks and messages to an SQLite file; killed at any time, it is whole up to the last commit.

    Args:
        find: frame of a sensor -> its mounting (4, 4), or None where nobody knows.
        mount: kind and frame -> the mounting that the map takes, or None.
    """

    def __init__(
        self,
        path: Path,
        *,
        start_ns: int,
        chosen: dict[str, str],
        find: Callable[[str], Array | None],
        mount: Callable[[str, str], Array | None],
    ) -> None:
        self.path, self._find, self._mount = path, find, mount
        self._frames: set[tuple[str, str]] = set()
        self._known: dict[str, str] = {}
        self._db = sqlite3.connect(path, isolation_level=None)
        self._db.execute("PRAGMA journal_mode = WAL")
        self._db.execute(
            "PRAGMA synchronous = NORMAL"
        )  # a dead process loses nothing that was committed; a dead machine may
        self._db.execute("CREATE TABLE head (key TEXT PRIMARY KEY, value TEXT NOT NULL)")
        self._db.execute("CREATE TABLE batch (n INTEGER PRIMARY KEY, data BLOB NOT NULL)")
        self._db.execute("BEGIN")
        self._say("format", FORMAT)
        self._say("start_ns", start_ns)
        self._say("chosen", chosen)
        self._committed = -np.inf

    def add(self, trunks: Trunks | None, messages: Iterable[Message]) -> None:
        """The messages since the last scan, then the scan's trunks in `base_link`."""
        messages = list(messages)
        for m in messages:
            kind = {Odometry: "child", Imu: "imu", Fix: "fix", Heading: "heading"}[type(m)]
            self._frames.add((kind, m.child_frame if isinstance(m, Odometry) else m.frame))
        self._db.execute("INSERT INTO batch (data) VALUES (?)", (_packed(trunks, messages),))
        if (now := time.monotonic()) - self._committed >= COMMIT_S:
            self._commit()
            self._committed = now

    def close(self, *, keep: bool) -> None:
        """The run has ended: its journal goes, or stays as one file."""
        self._commit()
        self._db.execute("COMMIT")
        self._db.execute("PRAGMA journal_mode = DELETE")
        self._db.close()
        if not keep:
            self.path.unlink(missing_ok=True)

    def _commit(self) -> None:
        for kind, frame in self._frames:
            self._say(f"find {frame}", _plain(self._find(frame)))
            if kind != "child":
                self._say(f"mount {kind} {frame}", _plain(self._mount(kind, frame)))
        self._db.execute("COMMIT")
        self._db.execute("BEGIN")

    def _say(self, key: str, value: object) -> None:
        text = json.dumps(value)
        if self._known.get(key) != text:  # transforms may come, or change, on the way
            self._db.execute("INSERT OR REPLACE INTO head VALUES (?, ?)", (key, text))
            self._known[key] = text


class Journaled:
    """A journal that was left behind, read.

    Attributes:
        start_ns, chosen: as they were given.

    Raises:
        InputError: not a journal, or of a newer program.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            with path.open("rb") as f:
                if f.read(15) != b"SQLite format 3":
                    raise InputError(f"{path}: is no journal of `topograph live`")
            self._db = sqlite3.connect(f"file:{quote(str(path.resolve()))}?mode=ro", uri=True)
            self._head = {k: json.loads(v) for k, v in self._db.execute("SELECT key, value FROM head")}
            self.start_ns, self.chosen = (
                int(self._head["start_ns"]),
                {str(k): str(v) for k, v in self._head["chosen"].items()},
            )
            newer = int(self._head["format"]) > FORMAT
        except OSError as err:
            raise InputError(f"{path}: {err.strerror}") from err
        except (sqlite3.Error, ValueError, KeyError, TypeError, AttributeError) as err:
            raise InputError(
                f"{path}: is no journal of `topograph live`, or nothing of it was written ({err})"
            ) from err
        if newer:
            raise InputError(f"{path}: written by a newer topograph; update this one")

    def find(self, frame: str) -> Array | None:
        """Mounting (4, 4) of the sensor with that frame."""
        return _matrix(self._head.get(f"find {frame}"))

    def mount(self, kind: str, frame: str) -> Array | None:
        """Mounting (4, 4) that the map takes for a kind of sensor with that frame."""
        return _matrix(self._head.get(f"mount {kind} {frame}"))

    def __iter__(self) -> Iterator[tuple[Trunks | None, list[Message]]]:
        """Scan by scan: the trunks, and the messages before them.

        Raises:
            InputError: a part of it is damaged.
        """
        try:
            for (data,) in self._db.execute("SELECT data FROM batch ORDER BY n"):
                yield _unpacked(data)
        except (sqlite3.Error, ValueError, KeyError, TypeError, IndexError, zipfile.BadZipFile, EOFError) as err:
            raise InputError(f"{self.path}: the journal is damaged ({err})") from err

    def close(self) -> None:
        """Give the file back."""
        self._db.close()


def _packed(trunks: Trunks | None, messages: Sequence[Message]) -> bytes:
    """One batch as an npz: a column per attribute and kind of message."""
    out: dict[str, np.ndarray] = {}
    for kind, names in COLUMNS.items():
        mine = [(i, m) for i, m in enumerate(messages) if type(m) is kind]
        if not mine:
            continue
        out[f"{kind.__name__} place"] = np.array([i for i, _ in mine])
        out[f"{kind.__name__} stamp_ns"] = np.array([m.stamp_ns for _, m in mine], np.int64)
        for name in names:
            out[f"{kind.__name__} {name}"] = np.array([getattr(m, name) for _, m in mine])
    if trunks is not None:
        out["stamp_ns"], out["frame"], out["surface"] = (
            np.array(trunks.stamp_ns),
            np.array(trunks.frame),
            np.array(trunks.surface),
        )
        out |= {name: getattr(trunks, name) for name in OF_TRUNKS}
        out["clouds"] = np.concatenate([*trunks.clouds, np.zeros((0, 3), np.float32)])
        out["sizes"] = np.array([len(c) for c in trunks.clouds], np.int64)
    packed = io.BytesIO()
    np.savez(packed, allow_pickle=False, **out)
    return packed.getvalue()


def _unpacked(data: bytes) -> tuple[Trunks | None, list[Message]]:
    with np.load(io.BytesIO(data), allow_pickle=False) as z:
        read = {k: z[k] for k in z.files}
    placed: list[tuple[int, Message]] = []
    for kind, names in COLUMNS.items():
        if f"{kind.__name__} place" not in read:
            continue
        columns = [read[f"{kind.__name__} {name}"] for name in ("stamp_ns", *names)]
        for i, *values in zip(read[f"{kind.__name__} place"], *columns, strict=True):
            # Numbers and words come back as they were, rows as arrays.
            placed.append((int(i), kind(*(v.item() if v.ndim == 0 else v for v in values))))
    messages = [m for _, m in sorted(placed, key=lambda p: p[0])]
    if "stamp_ns" not in read:
        return None, messages
    clouds = tuple(np.split(read["clouds"], np.cumsum(read["sizes"])[:-1])) if len(read["sizes"]) else ()
    return (
        Trunks(
            int(read["stamp_ns"]), str(read["frame"]), clouds=clouds, surface=bool(read["surface"]),
            **{name: read[name] for name in OF_TRUNKS},
        ),
        messages,
    )  # fmt: skip


def _plain(T: Array | None) -> list[list[float]] | None:
    return None if T is None else T.tolist()


def _matrix(rows: object) -> Array | None:
    return None if rows is None else np.array(rows, float).reshape(4, 4)
