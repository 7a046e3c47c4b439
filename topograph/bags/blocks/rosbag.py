"""ROS 1 bags (http://wiki.ros.org/Bags/Format/2.0), read chunk by chunk."""

from __future__ import annotations

import bz2
import mmap
from collections.abc import Iterator

import lz4.frame

from topograph.bags.blocks.channel import Channel, Entry, msgtype_of

_MESSAGE, _HEADER, _INDEX, _CHUNK, _INFO, _CONNECTION = 2, 3, 4, 5, 6, 7
_LONGEST_HEADER = 1 << 16
LARGEST_CHUNK = 1 << 28
"""Bytes of a chunk when it is decompressed, at most: recorders write less than a thousandth of it."""
_BEFORE_OP = 64
"""Bytes of a record's header that come before its field `op` at most, where it is looked for without knowing where it begins."""

Fields = dict[bytes, bytes]
Record = tuple[int, Fields, int, int]
"""op, header's fields, begin and end of its data."""


class RosbagBlocks:
    """Blocks are chunks, and messages outside of any: a chunk that was never closed says that its length is zero."""

    missing = 0

    def __init__(self, data: mmap.mmap) -> None:
        self.data = data
        self.channels: dict[int, Channel] = {}
        self.is2 = False
        self.unread = 0

    def walk(self) -> Iterator[int]:
        for at, (op, fields, begin, end) in self._records(self.data, len(b"#ROSBAG V2.0\n"), (_CHUNK, _MESSAGE)):
            if op in (_CHUNK, _MESSAGE):
                yield at
            elif op == _CONNECTION:
                self._connect(fields, self.data[begin:end])

    def load(self, at: int) -> list[Entry]:
        record = _record(self.data, at)
        if record is None:
            return []
        op, fields, begin, end = record
        raw = self.data[begin:end]
        if op == _MESSAGE:
            return [(_uint(fields[b"conn"]), _time(fields[b"time"]), raw)]
        compression = fields[b"compression"]
        size = min(_uint(fields.get(b"size", b"")) or LARGEST_CHUNK, LARGEST_CHUNK)
        if compression == b"bz2":
            raw = bz2.BZ2Decompressor().decompress(raw, size)
        elif compression == b"lz4":
            raw = lz4.frame.LZ4FrameDecompressor().decompress(raw, size)
        out = []
        for _, (op, fields, begin, end) in self._records(raw, 0, (_MESSAGE, _CONNECTION)):
            if op == _MESSAGE:
                out.append((_uint(fields[b"conn"]), _time(fields[b"time"]), raw[begin:end]))
            elif op == _CONNECTION:
                self._connect(fields, raw[begin:end])
        return out

    def _records(self, data: mmap.mmap | bytes, at: int, wanted: tuple[int, ...]) -> Iterator[tuple[int, Record]]:
        """(place, record), passing over what is damaged to the next record with one of the `wanted` ops."""
        nearest = _Nearest(data, wanted)
        while at < len(data):
            record = _record(data, at)
            if record is not None and record[3] <= len(data):
                yield at, record
                at = record[3]
                continue
            if record is not None and record[0] == _CHUNK and record[1].get(b"compression") == b"none":
                at = record[2]  # cut, or its length is damaged: its messages are read one by one
                continue
            following = nearest.after(at + 1)
            self.unread += following - at
            at = following

    def _connect(self, fields: Fields, raw: bytes) -> None:
        inside = _fields(raw)
        if inside is None or b"conn" not in fields or b"type" not in inside:
            return
        topic = fields.get(b"topic", inside.get(b"topic", b"")).decode(errors="replace")
        typ = msgtype_of(inside[b"type"].decode(errors="replace"))
        definition = inside.get(b"message_definition", b"").decode(errors="replace")
        self.channels.setdefault(_uint(fields[b"conn"]), Channel(topic, typ, definition))


def _fields(raw: bytes) -> Fields | None:
    out: Fields = {}
    at = 0
    while at < len(raw):
        size = int.from_bytes(raw[at : at + 4], "little")
        name, sep, value = raw[at + 4 : at + 4 + size].partition(b"=")
        if not sep or at + 4 + size > len(raw):
            return None
        out[name] = value
        at += 4 + size
    return out


def _record(data: mmap.mmap | bytes, at: int) -> Record | None:
    """The record at `at`; None where none is. Its end may lie beyond that of the data."""
    size = int.from_bytes(data[at : at + 4], "little")
    if not 0 < size < _LONGEST_HEADER or at + 8 + size > len(data):
        return None
    fields = _fields(data[at + 4 : at + 4 + size])
    if fields is None or len(fields.get(b"op", b"")) != 1:
        return None
    op, begin = fields[b"op"][0], at + 8 + size
    needed: dict[int, tuple[bytes, ...]] = {_MESSAGE: (b"conn", b"time"), _CHUNK: (b"compression",), _CONNECTION: (b"conn",)}  # fmt: skip
    if op not in range(_MESSAGE, _CONNECTION + 1) or any(n not in fields for n in needed.get(op, ())):
        return None
    return op, fields, begin, begin + int.from_bytes(data[begin - 4 : begin], "little")


class _Nearest:
    """Where whole records with one of some ops begin; every op is looked for once over the data, however often one asks."""

    def __init__(self, data: mmap.mmap | bytes, wanted: tuple[int, ...]) -> None:
        self.data = data
        self._known = dict.fromkeys(wanted, -1)

    def after(self, at: int) -> int:
        """The place of the next one at `at` or later; the end of the data where none is."""
        for op, known in self._known.items():
            if known < at:
                self._known[op] = self._find(op, at)
        return min(self._known.values())

    def _find(self, op: int, at: int) -> int:
        pattern, found = b"\x04\0\0\0op=" + bytes([op]), at
        while (found := self.data.find(pattern, found)) >= 0:
            for begin in range(max(at, found - 4 - _BEFORE_OP), found - 3):
                record = _record(self.data, begin)
                if record is not None and record[0] == op and begin + 4 <= found < record[2]:
                    return begin
            found += len(pattern)
        return len(self.data)


def _uint(value: bytes) -> int:
    return int.from_bytes(value, "little")


def _time(value: bytes) -> int:
    return _uint(value[:4]) * 10**9 + _uint(value[4:8])
