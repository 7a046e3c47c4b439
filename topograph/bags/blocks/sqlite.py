"""rosbag2's SQLite files (https://www.sqlite.org/fileformat.html), read leaf page by leaf page.

SQLite itself stops at the first page that is missing, and its own `.recover` writes a new file; a recording is never written to.
"""

from __future__ import annotations

import mmap
from collections.abc import Iterator

from topograph.bags.blocks.channel import Channel, Entry

_HEADER = 100
_TABLE_LEAF = 0x0D
_USUAL = 4096
_PAGES = tuple(2**k for k in range(9, 17))
Value = int | bytes | float | None


class SqliteBlocks:
    """Blocks are leaf pages of tables. Rows are known by their shape: that of `messages`, `topics`, `message_definitions`."""

    def __init__(self, data: mmap.mmap) -> None:
        self.data = data
        page = int.from_bytes(data[16:18], "big")
        told = {1: 65536}.get(page, page)
        # Pages that begin as leaves of tables do are seen at the right size: one flipped bit must not cost the file.
        self.page = max(_PAGES, key=lambda size: (self._leaves(size), size == told, size == _USUAL))
        self.usable = self.page - (data[20] if len(data) > 20 and data[20] < 64 else 0)
        self.channels: dict[int, Channel] = {}
        self.is2 = True
        self.unread = 0
        self.ids: set[int] = set()
        self._definitions: dict[str, tuple[str, bool]] = {}
        self._topics: dict[int, tuple[str, str]] = {}

    def _leaves(self, size: int) -> int:
        """How many of the pages, were they of this size, begin as a table's leaf with its rows behind it; the first few thousand."""
        found = 0
        for at in range(size, min(len(self.data) - 8, 4096 * size), size):
            if self.data[at] == _TABLE_LEAF:
                cells, start = (int.from_bytes(self.data[at + k : at + k + 2], "big") for k in (3, 5))
                found += cells > 0 and 8 + 2 * cells <= (start or 65536) < size
        return found

    @property
    def missing(self) -> int:
        """Rows of `messages` that the numbers of the others say there were."""
        return max(self.ids) - min(self.ids) + 1 - len(self.ids) if self.ids else 0

    def walk(self) -> Iterator[int]:
        for at in range(0, len(self.data) - self.page + 1, self.page):
            if self.data[at + (_HEADER if at == 0 else 0)] == _TABLE_LEAF:
                yield at
        self.unread += len(self.data) % self.page

    def load(self, at: int) -> list[Entry]:
        head = at + (_HEADER if at == 0 else 0)
        cells = int.from_bytes(self.data[head + 3 : head + 5], "big")
        out: list[Entry] = []
        if cells * 2 + 8 > self.page:
            return out
        for n in range(cells):
            place = head + 8 + 2 * n
            try:
                rowid, row = self._row(at, int.from_bytes(self.data[place : place + 2], "big"))
            except (ValueError, IndexError):
                continue  # the gap in the rows' numbers tells of it
            match row:
                case [None | int(), int(topic), int(log_ns), bytes(message)] if log_ns >= 0:
                    out.append((topic, log_ns, message))
                    self.ids.add(rowid)
                case [None | int(), bytes(name), bytes(typ), bytes(b"cdr"), *_]:
                    self._topics[rowid] = name.decode(errors="replace"), typ.decode(errors="replace")
                    self._join()
                case [None | int(), bytes(typ), bytes(b"ros2msg" | b"ros2idl") as kind, bytes(text), *_]:
                    self._definitions[typ.decode(errors="replace")] = text.decode(errors="replace"), kind == b"ros2idl"
                    self._join()
                case _:
                    pass
        return out

    def _join(self) -> None:
        for i, (topic, typ) in self._topics.items():
            self.channels[i] = Channel(topic, typ, *self._definitions.get(typ, ("", False)))

    def _row(self, page: int, offset: int) -> tuple[int, list[Value]]:
        """Row id and values of a cell. Raises ValueError where the cell or its overflow pages are damaged or missing."""
        at = page + offset
        if not 8 <= offset < self.page:
            raise ValueError("a cell outside its page")
        size, at = self._varint(at)
        rowid, at = self._varint(at)
        if size > len(self.data):
            raise ValueError("a row that is longer than its file")
        payload = self._payload(at, size, page + self.page)
        length, place = _varint(payload, 0)
        kinds = []
        while place < length:
            kind, place = _varint(payload, place)
            kinds.append(kind)
        values = []
        for kind in kinds:
            value, place = _value(payload, place, kind)
            values.append(value)
        return rowid, values

    def _varint(self, at: int) -> tuple[int, int]:
        value, used = _varint(self.data[at : at + 9], 0)
        return value, at + used

    def _payload(self, at: int, size: int, page_end: int) -> bytes:
        most = self.usable - 35
        if size <= most:
            if at + size > page_end:
                raise ValueError("a cell beyond its page")
            return self.data[at : at + size]
        least = (self.usable - 12) * 32 // 255 - 23
        local = least + (size - least) % (self.usable - 4)
        local = local if local <= most else least
        parts, left = [self.data[at : at + local]], size - local
        following = int.from_bytes(self.data[at + local : at + local + 4], "big")
        passed: set[int] = set()
        while left > 0:
            begin = (following - 1) * self.page
            if following < 2 or begin + self.page > len(self.data) or following in passed:
                raise ValueError("an overflow page is missing")
            passed.add(following)
            part = self.data[begin + 4 : begin + 4 + min(left, self.usable - 4)]
            following = int.from_bytes(self.data[begin : begin + 4], "big")
            parts.append(part)
            left -= len(part)
        return b"".join(parts)


def _varint(raw: bytes, at: int) -> tuple[int, int]:
    value = 0
    for n in range(9):
        byte = raw[at + n]
        if n == 8:
            return value << 8 | byte, at + 9
        value = value << 7 | byte & 0x7F
        if byte < 0x80:
            return value, at + n + 1
    raise AssertionError("nine bytes are the longest")


_INTEGERS = {1: 1, 2: 2, 3: 3, 4: 4, 5: 6, 6: 8}


def _value(raw: bytes, at: int, kind: int) -> tuple[Value, int]:
    if kind == 0:
        return None, at
    if kind in _INTEGERS:
        end = at + _INTEGERS[kind]
        return int.from_bytes(raw[at:end], "big", signed=True), end
    if kind == 7:
        return 0.0, at + 8  # no column of a recording is a real number
    if kind in (8, 9):
        return kind - 8, at
    size = (kind - 12) // 2
    if kind < 12 or at + size > len(raw):
        raise ValueError("a value beyond its row")
    return raw[at : at + size], at + size
