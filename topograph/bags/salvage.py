"""Recordings whose index is missing or wrong: whole blocks are read in sequence, and what was lost is said."""

from __future__ import annotations

import heapq
import logging
import mmap
from collections import Counter, OrderedDict
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path

import numpy as np
from rosbags.interfaces import Connection, ConnectionExtRosbag2
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from topograph.bags.blocks import Channel, Entry, blocks_of
from topograph.bags.definitions import typestore
from topograph.errors import InputError

log = logging.getLogger(__name__)

LARGEST = 1 << 62
"""Times and channels beyond are damaged."""
LONGEST_NS = 30 * 86_400 * 10**9
"""From the middle of a recording to its ends."""
_KEPT = 6
"""Blocks that are kept while messages are given in order of time: chunks of one recording overlap a little."""


class Salvaged:
    """One file, read without its index; gives what `AnyReader` would.

    Attributes:
        is2: messages are CDR (ROS 2).
        connections: topics with the messages that were found of them.
        start_time, end_time: ns of recording, from the first message until after the last.
        lost: what could not be read, in words; "" when all was.

    Raises:
        InputError: no message was found.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        with path.open("rb") as f:
            if path.stat().st_size == 0:
                raise InputError(f"{path}: the file is empty")
            self._data = mmap.mmap(f.fileno(), 0, access=mmap.ACCESS_READ)
        blocks = blocks_of(self._data, path.name)
        if blocks is None:
            raise InputError(f"{path}: neither a ROS 1 bag (version 2.0), nor mcap, nor rosbag2's SQLite")
        self._blocks = blocks
        self._recent: OrderedDict[int, list[Entry]] = OrderedDict()
        channel, log_ns, at, row = self._index()
        self.is2 = blocks.is2
        known = np.isin(channel, list(blocks.channels))
        if known.any():  # a flipped bit in a time makes a recording of centuries
            known &= np.abs(log_ns - np.median(log_ns[known])) < LONGEST_NS
        self._homeless = int((~known).sum())
        order = np.argsort(log_ns[known], kind="stable")
        self._channel, self._log_ns, self._at, self._row = (v[known][order] for v in (channel, log_ns, at, row))
        if not len(self._channel):
            raise InputError(f"{path}: no message could be found in it; record again, or restore a copy of it")
        counts = Counter(self._channel.tolist())
        self.connections = [
            Connection(i, c.topic, c.msgtype, c.msgdef, "", counts[i], ConnectionExtRosbag2("cdr", []), self)
            for i, c in sorted(blocks.channels.items())
        ]
        self.message_count = len(self._channel)
        self.start_time, self.end_time = int(self._log_ns[0]), int(self._log_ns[-1]) + 1
        self._types = _typestore(blocks.channels.values())

    def _index(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Channel, time of recording (ns), block and place in it of each message that can be read."""
        found: list[tuple[int, int, int, int]] = []
        self._broken = 0
        for at in self._blocks.walk():
            try:
                found += [
                    (c, t, at, n) for n, (c, t, _) in enumerate(self._blocks.load(at)) if c < LARGEST and t < LARGEST
                ]
            except Exception as err:  # noqa: BLE001  # whatever decompressors raise on damage; it is counted and said
                self._broken += 1
                log.debug("%s: block at %d: %r", self.path, at, err)
        table = np.array(found, np.int64).reshape(-1, 4)
        return table[:, 0], table[:, 1], table[:, 2], table[:, 3]

    @property
    def lost(self) -> str:
        missing = self._blocks.missing
        parts = [
            f"{self._broken} damaged blocks" if self._broken else "",
            f"{self._blocks.unread} bytes that are no whole record" if self._blocks.unread else "",
            f"{self._homeless} messages of topics that it does not name, or of another year" if self._homeless else "",
            f"{missing} messages that the numbers of the others tell of" if missing else "",
        ]
        return ", ".join(filter(None, parts))

    def messages(
        self, connections: Collection[Connection], start: int | None = None, stop: int | None = None
    ) -> Iterator[tuple[Connection, int, bytes]]:
        """Messages in order of time of recording, from `start` until before `stop` (ns)."""
        by_id = {c.id: c for c in connections}
        first = 0 if start is None else int(np.searchsorted(self._log_ns, start))
        last = len(self._log_ns) if stop is None else int(np.searchsorted(self._log_ns, stop))
        for n in first + np.flatnonzero(np.isin(self._channel[first:last], list(by_id))):
            at = int(self._at[n])
            if at not in self._recent:
                self._recent[at] = self._blocks.load(at)
                if len(self._recent) > _KEPT:
                    self._recent.popitem(last=False)
            self._recent.move_to_end(at)
            channel, log_ns, raw = self._recent[at][int(self._row[n])]
            yield by_id[channel], log_ns, raw

    def deserialize(self, raw: bytes, msgtype: str) -> object:
        """The message of type `msgtype`; raises what rosbags raises."""
        if self.is2:
            return self._types.deserialize_cdr(raw, msgtype)
        return self._types.deserialize_ros1(raw, msgtype)

    def close(self) -> None:
        self._data.close()


class SalvagedFolder:
    """The files of a ROS 2 folder, each read without its index; see `Salvaged`.

    Raises:
        InputError: no message was found in any file.
    """

    is2 = True

    def __init__(self, files: Sequence[Path]) -> None:
        self._parts: list[Salvaged] = []
        why = InputError("a folder without a recording")
        for path in files:
            try:
                self._parts.append(Salvaged(path))
            except InputError as err:
                why = err
        if not self._parts:
            raise why
        self.connections = [c for p in self._parts for c in p.connections]
        self.message_count = sum(p.message_count for p in self._parts)
        self.start_time, self.end_time = min(p.start_time for p in self._parts), max(p.end_time for p in self._parts)
        self.lost = ", ".join(f"{p.path.name}: {p.lost}" for p in self._parts if p.lost)

    def messages(
        self, connections: Collection[Connection], start: int | None = None, stop: int | None = None
    ) -> Iterator[tuple[Connection, int, bytes]]:
        """Messages in order of time of recording, from `start` until before `stop` (ns)."""
        mine = [(p, [c for c in connections if c.owner is p]) for p in self._parts]
        return heapq.merge(*(p.messages(cs, start, stop) for p, cs in mine if cs), key=lambda m: m[1])

    def deserialize(self, raw: bytes, msgtype: str) -> object:
        """The message of type `msgtype`; raises what rosbags raises."""
        own = next((p for p in self._parts if any(c.msgtype == msgtype for c in p.connections)), self._parts[0])
        return own.deserialize(raw, msgtype)

    def close(self) -> None:
        for p in self._parts:
            p.close()


def _typestore(channels: Collection[Channel]) -> Typestore:
    types = {}
    for c in channels:
        try:
            if c.definition and c.idl:
                for part in c.definition.split("=" * 80 + "\n"):  # rosbag2 joins several files
                    text = part.split("\n", 1)[1] if part.startswith("IDL: ") else part
                    types.update(get_types_from_idl(text) if text.strip() else {})
            elif c.definition:
                types.update(get_types_from_msg(c.definition, c.msgtype))
        except Exception as err:  # noqa: BLE001  # a damaged definition costs its topic, which then cannot be decoded
            log.info("the definition of %s is damaged (%r)", c.msgtype, err)
    if not any(c.definition for c in channels):
        return typestore(ros1=False)
    store = get_typestore(Stores.EMPTY)
    store.register(types)
    return store


def why_unreadable(path: Path, err: BaseException) -> str:
    """One line for a bag that cannot be opened as it was written: the reason, and the command that mends it."""
    size = path.stat().st_size if path.is_file() else 0
    if path.is_file() and size == 0:
        return "the file is empty"
    if path.suffix == ".bag":
        with path.open("rb") as f:
            magic = f.read(13)
        if not magic.startswith(b"#ROSBAG V2.0"):
            return "not a ROS 1 bag (version 2.0)"
        return f"truncated or never closed ({err}); make it whole with `rosbag reindex {path.name}`"
    if path.suffix == ".mcap":
        return f"truncated or damaged ({err}); make it whole with `mcap recover {path.name} -o recovered.mcap`"
    if path.suffix == ".db3":
        return f"damaged ({err}); try `sqlite3 {path.name} .recover`"
    return f"cannot be opened ({err}); check metadata.yaml, or name the .mcap or .db3 inside"
