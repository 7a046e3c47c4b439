"""One run: one or several bags, read as a single stream of products."""

from __future__ import annotations

import heapq
import logging
import shutil
import sqlite3
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing
from itertools import islice
from pathlib import Path
from tempfile import TemporaryDirectory
from types import TracebackType
from typing import Any, Self, cast

import numpy as np
import zstandard
from numpy.typing import NDArray
from rosbags.highlevel import AnyReader
from rosbags.interfaces import Connection

from topograph.bags import decode, packets, topics
from topograph.bags.clocks import Clocks, Message
from topograph.bags.config import BagsConfig
from topograph.bags.definitions import typestore
from topograph.bags.files import PACKED, recordings_in, refuse_twice, resolve, side_files
from topograph.bags.frames import Frames
from topograph.bags.messages import Fix, Heading, Imu, Odometry, Trunks
from topograph.bags.salvage import Salvaged, SalvagedFolder, why_unreadable
from topograph.bags.scan import Scan
from topograph.bags.scan import decode as decode_scan
from topograph.errors import InputError
from topograph.geometry import from_quaternion

log = logging.getLogger(__name__)

UNDECODED = "cannot be decoded"
INFINITE = "not finite"
EMPTY = "no point in it"
ZSTD = b"\x28\xb5\x2f\xfd"
"""What a compressed message of ROS 2 begins with; one that is not begins with a zero."""
DAMAGED = "announced by the recording's index, not in the file (damaged)"

Reader = AnyReader | Salvaged | SalvagedFolder
Product = Scan | Odometry | Imu | Fix | Heading | Trunks


class Recording:
    """A run's bags, opened. Use as a context manager.

    Attributes:
        chosen: stream kind -> topic.
        counts: topic -> number of messages.
        frames: sensor frames.
        skipped: reason -> count, filled while reading.
        duration_s: from the first to the last message, by recording time.
        start_ns, log_ns: recording time of the first message, and of the one that was given last.
        clocks: what the last reading found of the streams' clocks.
        undecoded: stream kind -> why the first message that could not be decoded could not.
        given: stream kind -> messages that the file held, usable or not, in the last reading.
        untimed: scans without a time per point, counted by who takes them.
        notes: what had to be salvaged, a sentence per file.
        count_within: times of recording (from, until before), ns, of the messages that are counted; None: all.
    """

    def __init__(self, paths: Sequence[Path], config: BagsConfig | None = None) -> None:
        self.paths = [q for p in paths for q in resolve(Path(p))]
        refuse_twice(self.paths)
        self.config = config or BagsConfig()
        self.skipped: Counter[str] = Counter()
        self.frames = Frames(self.config.base_frame, self.config.extrinsics)
        self.chosen: dict[str, str] = {}
        self.types: dict[str, str] = {}
        self.counts: Counter[str] = Counter()
        self.duration_s = 0.0
        self.start_ns = self.log_ns = 0
        self.clocks = Clocks(self.skipped)
        self.undecoded: dict[str, str] = {}
        self.given: Counter[str] = Counter()
        self.untimed = 0
        self.notes: list[str] = []
        self.count_within: tuple[int, int] | None = None
        self._counting = True
        self._readers: list[Reader] = []
        self._stack = ExitStack()
        self._velodyne: packets.Velodyne | None = None
        self._livox: int | None = None

    @property
    def moved_by_lidar(self) -> bool:
        """Whether the motion is to come from the point clouds."""
        return self.config.topic_odometry == topics.FROM_LIDAR and "points" in self.chosen

    def to_name(self, kind: str) -> list[str]:
        """Topics that could be the stream, but only when they are named."""
        named = topics.KINDS[kind].named
        return sorted(t for t, typ in self.types.items() if typ in named and self.counts[t])

    def __enter__(self) -> Self:
        try:
            self._open_all()
            self._index()
        except BaseException:
            self._stack.close()
            raise
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None, tb: TracebackType | None) -> None:
        self._stack.close()

    def _open_all(self) -> None:
        """Open the files; folders that do not open as such are replaced by the files in them, files by what can be salvaged."""
        waiting, self.paths = self.paths, []
        for path in waiting:
            try:
                self._take(path, self._open(path))
                continue
            except Exception as err:  # whatever the readers' libraries raise on damage
                why, cause = f"{path}: {why_unreadable(path, err)}", err
                if self.config.strict:
                    raise InputError(f"{why}; without --strict what is whole in it is read") from err
            if path.is_file():
                self._take(path, self._salvage(path, cause))
                continue
            files, refused = recordings_in(path), []
            for p in files:  # the last part of a run that ended with the power may be empty
                try:
                    self._take(p, self._whole_or_salvaged(p))
                except InputError as err:
                    refused.append(str(err))
            if len(refused) == len(files):
                raise InputError("; ".join([why, *refused]))
            self.notes.append(f"{path.name}: metadata.yaml does not fit ({cause}); its files are read one by one")
            self.notes += [f"left out: {r}" for r in refused]

    def _take(self, path: Path, reader: Reader) -> None:
        self._stack.callback(reader.close)
        self._readers.append(reader)
        self.paths.append(path)

    def _open(self, path: Path) -> AnyReader:
        """The file by its index; raises whatever the readers' libraries do on damage."""
        if path.suffix == ".active":
            raise ValueError("it was never closed")
        if path.suffix in PACKED:
            path = self._inflated(path)
        beside = [q for q in side_files(path) if q.stat().st_size]
        if beside:
            if self.config.strict:
                raise ValueError(f"{beside[0].name} holds messages that were never written into it")
            path = self._joined(path, beside)
        elif path.suffix == ".db3" and set("%?#") & set(str(path)):  # rosbags hands the name on as an address
            link = self._folder() / "recording.db3"
            link.symlink_to(path.resolve())
            path = link
        reader = AnyReader([path], default_typestore=typestore(ros1=False))
        reader.open()
        if not all(isinstance(c.topic, str) and isinstance(c.msgtype, str) for c in reader.connections):
            reader.close()
            raise ValueError("a topic without a name")
        return reader

    def _folder(self) -> Path:
        return Path(self._stack.enter_context(TemporaryDirectory(prefix="topograph-")))

    def _inflated(self, path: Path) -> Path:
        """A file of `ros2 bag record --compression-mode file`, as it was before, in a folder of its own for as long as it is read."""
        inflated = self._folder() / path.stem
        with path.open("rb") as packed, inflated.open("wb") as out:
            try:
                zstandard.ZstdDecompressor().copy_stream(packed, out)
            except OSError as err:
                raise InputError(
                    f"{path}: cannot be decompressed into {inflated.parent.parent} ({err.strerror}); make room there, or name a folder in TMPDIR"
                ) from err
            except zstandard.ZstdError as err:
                if self.config.strict:
                    raise
                # What is whole is read; what is missing is told by the file in it.
                log.info("%s: damaged (%r)", path, err)
        return inflated

    def _joined(self, path: Path, beside: Sequence[Path]) -> Path:
        """A copy of an SQLite file with what its journal holds: SQLite would write it into the recording itself."""
        copy = self._folder() / "recording.db3"
        shutil.copyfile(path, copy)
        for q in beside:
            shutil.copyfile(q, copy.with_name(copy.name + q.name.removeprefix(path.name)))
        with closing(sqlite3.connect(copy)) as db:
            db.execute("PRAGMA wal_checkpoint(TRUNCATE)")
            db.execute("PRAGMA journal_mode=DELETE")
        self.notes.append(f"{path.name}: was not closed; what {beside[0].name} holds was joined with it in a copy")
        return copy

    def _whole_or_salvaged(self, path: Path) -> Reader:
        try:
            return self._open(path)
        except Exception as err:  # noqa: BLE001  # whatever the readers' libraries raise on damage; told below
            return self._salvage(path, err)

    def _salvaged(self, path: Path) -> Salvaged:
        if path.suffix not in PACKED:
            return Salvaged(path)
        inflated = self._inflated(path)
        if not inflated.stat().st_size:
            raise InputError(f"{path}: nothing of it can be decompressed; restore a copy of it")
        return Salvaged(inflated)

    def _salvage(self, path: Path, err: Exception) -> Salvaged:
        """What is whole in the file."""
        saved = self._salvaged(path)
        lost = f"not read: {saved.lost}" if saved.lost else "nothing else was found in it"
        self.notes.append(
            f"{path.name}: truncated, damaged or of an unusual kind ({str(err) or type(err).__name__}): {saved.message_count} messages "
            f"({(saved.end_time - saved.start_time) * 1e-9:.0f} s) were read in sequence; {lost}"
        )
        return saved

    def _index(self) -> None:
        starts, ends = [], []
        for reader in self._readers:
            for c in reader.connections:
                self.types[c.topic] = c.msgtype
                self.counts[c.topic] += c.msgcount
            if reader.message_count:
                starts.append(reader.start_time)
                ends.append(reader.end_time)
        if not starts:
            raise InputError(
                f"{', '.join(map(str, self.paths))}: no messages; record again or check `topograph inspect`"
            )
        self.start_ns = min(starts)
        self.duration_s = (max(ends) - self.start_ns) * 1e-9
        self.chosen = topics.choose({t: k for t, k in self.types.items() if self.counts[t]}, self.config)
        self._read_tf()

    def _read_tf(self) -> None:
        for name, most in (("tf", 500), ("tf_static", 10_000)):  # static last: it wins
            topics_tf = {t for t, typ in self.types.items() if t.endswith(name) and typ == "tf2_msgs/msg/TFMessage"}
            for i in range(len(self._readers) if topics_tf else 0):
                for _, _, c, raw in islice(self._raw(i, topics_tf, None), most):
                    try:
                        self._add_tf(name, self._readers[i].deserialize(raw, c.msgtype))
                    except Exception as err:  # noqa: BLE001  # one message; it is counted
                        self.skipped[f"{name}: {UNDECODED}"] += 1
                        log.debug("%s: %s", c.topic, err)

    def _add_tf(self, name: str, message: Any) -> None:
        for t in message.transforms:
            x, q = t.transform.translation, t.transform.rotation
            if name == "tf" and t.header.frame_id.lstrip("/") in ("odom", "map", "world"):
                continue  # moving frames are not mounts
            row = np.array([x.x, x.y, x.z, q.x, q.y, q.z, q.w])
            if not np.isfinite(row).all() or np.linalg.norm(row[3:]) < 1e-6:
                self.skipped[f"{name}: {t.child_frame_id} is no pose (not finite, or a zero quaternion)"] += 1
                continue
            self.frames.add(t.header.frame_id, t.child_frame_id, from_quaternion(row[:3], row[3:]))

    def messages(
        self, kinds: Sequence[str] = tuple(topics.KINDS), window_ns: tuple[int, int] | None = None
    ) -> Iterator[tuple[str, Product]]:
        """(kind, product) of the chosen streams in order of recording time; what cannot be used is counted.

        `window_ns` (from, to) bounds the time of recording.
        """
        wanted = {self.chosen[k]: k for k in kinds if k in self.chosen}
        clocks = Clocks(self.skipped)
        for m in clocks.pass_on(self._decoded(wanted, window_ns)):
            self.log_ns = m.log_ns
            self.clocks = clocks
            yield m.kind, cast(Product, m.product)
        self.clocks = clocks

    def survey(self, every: int) -> Iterator[tuple[str, int, Product | None, tuple[str, ...]]]:
        """(kind, time of recording in ns, product with its stamp as it is, fields of a cloud) of all chosen streams.

        Of the clouds only each `every`-th is decoded; the others, and what cannot be decoded, are None.
        """
        wanted = {topic: kind for kind, topic in self.chosen.items()}
        seen: Counter[str] = Counter()
        for i, log_ns, connection, raw in self._merged(set(wanted), None):
            kind = wanted[connection.topic]
            seen[kind] += 1
            if kind == "points" and seen[kind] % every:
                yield kind, log_ns, None, ()
                continue
            product = self._product(kind, self._readers[i], connection, raw)
            fields: tuple[str, ...] = ()
            if isinstance(product, Scan) and seen[kind] == every:
                fields = self._fields(self._readers[i], connection, raw)
            yield kind, log_ns, product, fields
        self.given = Counter({k: seen[k] for k in wanted.values()})
        for topic, kind in wanted.items():
            self.count_missing(topic, kind)

    def _decoded(self, wanted: dict[str, str], window_ns: tuple[int, int] | None) -> Iterator[Message]:
        """Products in order of recording, stamps as they are; what the index announces and the file does not give is counted."""
        self.given = Counter()
        for i, log_ns, connection, raw in self._merged(set(wanted), window_ns):
            within = self.count_within
            self._counting = within is None or within[0] <= log_ns < within[1]
            self.given[wanted[connection.topic]] += self._counting
            product = self._product(wanted[connection.topic], self._readers[i], connection, raw)
            if product is not None:
                yield Message(wanted[connection.topic], log_ns, product)
        if window_ns is None:
            for topic, kind in wanted.items():
                self.count_missing(topic, kind)

    def count_missing(self, topic: str, kind: str) -> None:
        """Count what the index announces and the file did not give."""
        if self.config.strict and self.counts[topic] != self.given[kind]:
            raise InputError(
                f"{topic}: {self.counts[topic]} messages are announced and {self.given[kind]} are there; without --strict those are read"
            )
        if self.counts[topic] < self.given[kind]:
            self.notes.append(f"{topic}: {self.counts[topic]} messages are announced and {self.given[kind]} are there")
        if self.counts[topic] > self.given[kind]:
            self.skipped[f"{kind}: {DAMAGED}"] += self.counts[topic] - self.given[kind]
        self.counts[topic] = max(self.counts[topic], self.given[kind])  # reading in sequence may find more

    def _merged(self, names: set[str], window_ns: tuple[int, int] | None) -> Iterator[tuple[int, int, Connection, Any]]:
        """(file, time of recording, connection, bytes) of the topics in order of recording."""
        parts = (self._raw(i, names, window_ns) for i in range(len(self._readers)))
        return heapq.merge(*parts, key=lambda m: m[1])

    def _raw(
        self, i: int, names: set[str], window_ns: tuple[int, int] | None
    ) -> Iterator[tuple[int, int, Connection, Any]]:
        start, stop = window_ns or (None, None)
        at_last: Counter[str] = Counter()
        last = start
        for attempt in ("by its index", "in sequence"):
            reader = self._readers[i]
            found = [c for c in reader.connections if c.topic in names]
            if not found:
                return
            given, at_last = at_last, Counter()
            try:
                for connection, log_ns, raw in reader.messages(connections=found, start=last, stop=stop):
                    if not isinstance(log_ns, int):  # a row of SQLite may hold anything
                        raise TypeError(f"time of recording {log_ns!r}")
                    if reader.is2 and bytes(raw[:4]) == ZSTD:  # which only metadata.yaml would have told
                        raw = zstandard.ZstdDecompressor().decompress(raw)
                    if log_ns == last and given[connection.topic]:
                        given[connection.topic] -= 1
                        at_last[connection.topic] += 1
                        continue
                    if log_ns != last:
                        at_last.clear()
                    last = log_ns
                    at_last[connection.topic] += 1
                    yield i, log_ns, connection, raw
            except Exception as err:  # whatever the readers' libraries raise on damage; what is missing is counted
                if self.config.strict:
                    raise InputError(
                        f"{self.paths[i]}: damaged ({err}); without --strict what is whole in it is read"
                    ) from err
                log.info("%s: damaged (%r)", self.paths[i], err)
                if attempt == "in sequence" or not isinstance(reader, AnyReader):
                    self.skipped[f"rest of {self.paths[i].name}: damaged"] += window_ns is not None
                    return
                path = self.paths[i]
                saved = SalvagedFolder(recordings_in(path)) if path.is_dir() else self._salvaged(path)
                self._stack.callback(saved.close)
                self._readers[i] = saved
                at = ((last or self.start_ns) - self.start_ns) * 1e-9
                self.notes.append(
                    f"{self.paths[i].name}: damaged at {at:.0f} s ({err}); read on in sequence, not read: {saved.lost or 'nothing'}"
                )
            else:
                return

    def _product(self, kind: str, reader: Reader, connection: Connection, raw: Any) -> Product | None:
        typ = connection.msgtype
        try:
            if kind == "imu":
                return self._finite_imu(decode.unpack_imu(raw, reader.is2))
            if kind == "odometry":
                told = typ in topics.KINDS["odometry"].found
                odometry = (
                    decode.unpack_odometry(raw, reader.is2)
                    if told
                    else decode.decode_twist(reader.deserialize(raw, typ))
                )
                turn = np.abs(odometry.odom_T_child[3:]).max()
                if not _sane(odometry.odom_T_child) or not _sane(odometry.twist) or turn < decode.SHORTEST:
                    self._count(f"odometry: {INFINITE}")
                    return None
                return odometry
            if kind == "points":
                scan = self._scan(reader, typ, raw)
                if scan is None:
                    return None
                finite = np.isfinite(scan.xyz)
                if not (finite[:, 0] & finite[:, 1] & finite[:, 2]).any():
                    self._count(f"points: {EMPTY}")
                    return None
                return scan
            message: Any = reader.deserialize(raw, typ)
            if kind == "fix":
                return decode.decode_fix(message)
            if kind == "heading":
                heading = decode.decode_heading(message)
                if not np.isfinite(heading.yaw):
                    self._count(f"heading: {INFINITE}")
                    return None
                return heading
            trunks = decode.decode_trunks(message)
            if not len(trunks) and (getattr(message, "detections", None) or getattr(message, "clusters", None)):
                self._count(f"trunks: {INFINITE}")
                return None
            return trunks
        except Exception as err:  # noqa: BLE001  # one message; it is counted, and read_run bounds how many
            self._count(f"{kind}: {UNDECODED}")
            self.undecoded.setdefault(kind, str(err) or type(err).__name__)
            log.debug("%s: %s", connection.topic, err)
            return None

    def _count_second(self, lidar: int) -> None:
        """Count a sweep of a LiDAR whose mounting is not that of the topic's frame."""
        self._count("points: of a second LiDAR on one topic")
        note = (
            f"several LiDARs on one topic, under one frame: those with lidar_id {self._livox} are read, those with {lidar} are not "
            "(the driver's multi_topic records them apart)"
        )
        if note not in self.notes:
            self.notes.append(note)

    def _scan(self, reader: Reader, typ: str, raw: Any) -> Scan | None:
        if typ == packets.VELODYNE:
            self._velodyne = self._velodyne or packets.Velodyne()
            return self._velodyne(raw, reader.is2)
        if typ in packets.LIVOX:
            scan, lidar = packets.unpack_livox(raw, reader.is2)
            self._livox = lidar if self._livox is None else self._livox
            if lidar != self._livox:
                self._count_second(lidar)
                return None
            return scan
        message: Any = reader.deserialize(raw, typ)
        return decode_scan(message, decode.stamp_of(message.header))

    def _fields(self, reader: Reader, connection: Connection, raw: Any) -> tuple[str, ...]:
        """Names of what a point has."""
        if connection.msgtype in packets.FIELDS:
            return packets.FIELDS[connection.msgtype]
        message: Any = reader.deserialize(raw, connection.msgtype)
        return tuple(f.name for f in message.fields)

    def _count(self, reason: str) -> None:
        self.skipped[reason] += self._counting
        if not self.skipped[reason]:
            del self.skipped[reason]

    def _finite_imu(self, imu: Imu) -> Imu | None:
        if _sane(imu.gyro) and _sane(imu.accel):
            return imu
        self._count(f"imu: {INFINITE}")
        return None


def _sane(values: NDArray[np.float64]) -> bool:
    """Finite, and of a size that something on Earth may have in SI units."""
    return bool(np.isfinite(values).all() and np.abs(values).max() < 1e9)
