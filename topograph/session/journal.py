"""What a run brought so far, on disk while it is driven: a process that dies takes half a second of it along at most."""

from __future__ import annotations

import io
import json
import struct
import time
import zipfile
import zlib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from topograph.bags import Fix, Heading, Imu, Odometry, Trunks
from topograph.errors import InputError
from topograph.geometry import Array

Message = Odometry | Imu | Fix | Heading
WAIT_S = 0.5
"""Messages that wait for a scan longer are written without one."""
MAGIC = b"topograph journal 1\n"
HEADER = struct.Struct("<QI")
"""Of a record: length and CRC-32 of its content."""
COLUMNS: dict[type[Message], tuple[str, ...]] = {
    Odometry: ("child_frame", "odom_T_child", "twist"),
    Imu: ("frame", "gyro", "accel"),
    Fix: ("frame", "lat_lon_h", "cov", "status"),
    Heading: ("frame", "yaw", "sigma"),
}
OF_TRUNKS = ("p", "axis", "diameter", "cov", "height", "score", "kinds", "measured", "stems", "free", "eye")


class Journal:
    """Append scans' trunks and messages to a file, each batch whole at once: what was appended stays when the process is killed.

    A file of records: length and CRC-32 of what follows, then one letter (`h` head as JSON, `b` batch as npz) and the content.

    Args:
        find: frame of a sensor -> its mounting (4, 4), or None where nobody knows.
        mount: kind and frame -> the mounting that the map takes, or None.
        about: further facts for whoever finds it.

    Attributes:
        broken: why nothing more is written, or "": a full disk ends the journal, not the drive.
    """

    def __init__(
        self,
        path: Path,
        *,
        start_ns: int,
        chosen: dict[str, str],
        find: Callable[[str], Array | None],
        mount: Callable[[str, str], Array | None],
        about: dict[str, str] | None = None,
    ) -> None:
        self.path, self._find, self._mount = path, find, mount
        self.broken = ""
        self._frames: set[tuple[str, str]] = set()
        self._known: dict[str, object] = {}
        self._waiting: list[Message] = []
        self._written = time.monotonic()
        self._file = path.open("xb", buffering=0)
        self._append(MAGIC)
        self._say({"start_ns": start_ns, "chosen": chosen, "about": about or {}})

    def hear(self, message: Message) -> None:
        """A message; it is written with the next scan, or half a second later."""
        self._waiting.append(message)
        kind = {Odometry: "child", Imu: "imu", Fix: "fix", Heading: "heading"}[type(message)]
        self._frames.add((kind, message.child_frame if isinstance(message, Odometry) else message.frame))
        if time.monotonic() - self._written >= WAIT_S:
            self.flush()

    def see(self, trunks: Trunks) -> None:
        """A scan's trunks in `base_link`."""
        self.flush(trunks)

    def flush(self, trunks: Trunks | None = None) -> None:
        """Write what waits."""
        mounts: dict[str, object] = {}
        for kind, frame in self._frames:
            mounts[f"find {frame}"] = _plain(self._find(frame))
            if kind != "child":
                mounts[f"mount {kind} {frame}"] = _plain(self._mount(kind, frame))
        self._say(mounts)  # transforms may come, or change, on the way
        if trunks is not None or self._waiting:
            self._record(b"b" + _packed(trunks, self._waiting))
            self._waiting = []
        self._written = time.monotonic()

    def close(self) -> None:
        """Nothing more comes; the file stays."""
        if not self._file.closed:
            self.flush()
            self._file.close()

    def _say(self, facts: dict[str, object]) -> None:
        new = {k: v for k, v in facts.items() if k not in self._known or self._known[k] != v}
        if new:
            self._record(b"h" + json.dumps(new).encode())
            self._known |= new

    def _record(self, content: bytes) -> None:
        self._append(HEADER.pack(len(content), zlib.crc32(content)) + content)

    def _append(self, data: bytes) -> None:
        if self.broken:
            return
        try:
            rest = memoryview(data)
            while len(rest):
                rest = rest[self._file.write(rest) :]
        except OSError as err:
            self.broken = f"the journal ends early ({err.strerror}): {self.path}"


class Journaled:
    """A journal that was left behind, read. A record that was torn or damaged is passed over.

    Attributes:
        start_ns, chosen, about: as they were given.
        damaged: records that could not be read; complete after `messages` has run through.

    Raises:
        InputError: not a journal.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.damaged = path, 0
        self._head: dict[str, Any] = {}
        try:
            with path.open("rb") as f:
                if f.read(len(MAGIC)) != MAGIC:
                    raise InputError(f"{path}: is no journal of this version of `topograph live`")
            for content in self._records():
                if content[:1] == b"h":
                    self._head |= json.loads(content[1:])
            self.start_ns = int(self._head["start_ns"])
            self.chosen = {str(k): str(v) for k, v in self._head["chosen"].items()}
            self.about = {str(k): str(v) for k, v in self._head["about"].items()}
        except OSError as err:
            raise InputError(f"{path}: {err.strerror}") from err
        except (ValueError, KeyError, TypeError, AttributeError) as err:
            raise InputError(f"{path}: the head of the journal is damaged ({err})") from err

    def find(self, frame: str) -> Array | None:
        """Mounting (4, 4) of the sensor with that frame."""
        return _matrix(self._head.get(f"find {frame}"))

    def mount(self, kind: str, frame: str) -> Array | None:
        """Mounting (4, 4) that the map takes for a kind of sensor with that frame."""
        return _matrix(self._head.get(f"mount {kind} {frame}"))

    def messages(self) -> Iterator[Trunks | Message]:
        """What came, in the order of its coming."""
        self.damaged = 0
        for content in self._records():
            if content[:1] != b"b":
                continue
            try:
                trunks, messages = _unpacked(content[1:])
            except (ValueError, KeyError, TypeError, IndexError, zipfile.BadZipFile, EOFError):
                self.damaged += 1
                continue
            yield from messages
            if trunks is not None:
                yield trunks

    def _records(self) -> Iterator[bytes]:
        """Contents whose sums are right; lengths lead from one record to the next."""
        with self.path.open("rb") as f:
            end = f.seek(0, 2)
            f.seek(len(MAGIC))
            while len(header := f.read(HEADER.size)) == HEADER.size:
                length, crc = HEADER.unpack(header)
                if length > end - f.tell():  # torn, or a length that is none
                    self.damaged += 1
                    return
                content = f.read(length)
                if zlib.crc32(content) == crc:
                    yield content
                else:
                    self.damaged += 1


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
            stamp_ns=int(read["stamp_ns"]), frame=str(read["frame"]), clouds=clouds, surface=bool(read["surface"]),
            **{name: read[name] for name in OF_TRUNKS},
        ),
        messages,
    )  # fmt: skip


def _plain(T: Array | None) -> list[list[float]] | None:
    return None if T is None else T.tolist()


def _matrix(rows: object) -> Array | None:
    return None if rows is None else np.array(rows, float).reshape(4, 4)
