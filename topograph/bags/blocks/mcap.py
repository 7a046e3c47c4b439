"""MCAP (https://mcap.dev/spec), read record by record."""

from __future__ import annotations

import mmap
import struct
from collections.abc import Iterator
from io import BytesIO

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.records import Channel as ChannelRecord
from mcap.records import Chunk, Schema
from mcap.stream_reader import get_chunk_data_stream

from topograph.bags.blocks.channel import Channel, Entry, msgtype_of

_SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _LAST = 3, 4, 5, 6, 15
_MAGIC = b"\x89MCAP0\r\n"
_DAY_NS = 86_400 * 10**9
_FRAME = struct.Struct("<BQ")
_CHUNK_HEAD = struct.Struct("<QQQII")
_MESSAGE_HEAD = struct.Struct("<HIQQ")


class McapBlocks:
    """Blocks are chunks, and messages outside of any."""

    missing = 0

    def __init__(self, data: mmap.mmap) -> None:
        self.data = data
        self.channels: dict[int, Channel] = {}
        self.is2 = True
        self.unread = 0
        self._schemas: dict[int, Schema] = {}
        self._bare = 0  # time of recording of the first message outside of chunks

    def walk(self) -> Iterator[int]:
        at, size = len(_MAGIC), len(self.data)
        while at < size:
            if self.data[at : at + len(_MAGIC)] == _MAGIC:
                return
            op, length = self._frame(self.data, at)
            begin, end = at + _FRAME.size, at + _FRAME.size + length
            if op and end <= size and (op != _CHUNK or self._chunk_fits(begin, length)):
                if op in (_CHUNK, _MESSAGE):
                    if op == _MESSAGE and length >= _MESSAGE_HEAD.size:
                        self._bare = self._bare or _MESSAGE_HEAD.unpack_from(self.data, begin)[2]
                    yield at
                elif op in (_SCHEMA, _CHANNEL):
                    self._learn(op, self.data[begin:end])
                at = end
                continue
            if op == _CHUNK and self._uncompressed(begin):
                at = begin + _CHUNK_HEAD.size + 8  # cut, or its length is damaged: its records are read one by one
                continue
            following = min(self._next_chunk(at + 1), self._next_message(at + 1))
            self.unread += following - at
            at = following

    def load(self, at: int) -> list[Entry]:
        op, length = self._frame(self.data, at)
        raw = self.data[at + _FRAME.size : at + _FRAME.size + length]
        if op == _MESSAGE:
            return [_message(raw)]
        chunk = Chunk.read(ReadDataStream(BytesIO(raw)))
        stream, size = get_chunk_data_stream(chunk, validate_crc=True)
        inside = stream.read(size)
        out, at = [], 0
        while at + _FRAME.size <= size:
            op, length = self._frame(inside, at)
            record = inside[at + _FRAME.size : at + _FRAME.size + length]
            if not op or len(record) < length:
                self.unread += size - at
                break
            if op == _MESSAGE:
                out.append(_message(record))
            else:
                self._learn(op, record)
            at += _FRAME.size + length
        return out

    def _frame(self, data: mmap.mmap | bytes, at: int) -> tuple[int, int]:
        """Opcode and length of the record at `at`; opcode 0 where there is none (the spec leaves 128 and up to private use)."""
        if at + _FRAME.size > len(data):
            return 0, 0
        op, length = _FRAME.unpack_from(data, at)
        return (op, length) if 0 < op <= _LAST or op >= 128 else (0, 0)

    def _chunk_fits(self, begin: int, length: int) -> bool:
        """Whether what a chunk says of its own parts adds up to its length."""
        if length < _CHUNK_HEAD.size + 8:
            return False
        start, end, _, _, name = _CHUNK_HEAD.unpack_from(self.data, begin)
        if name > 8 or start > end or length < _CHUNK_HEAD.size + name + 8:
            return False
        (stored,) = struct.unpack_from("<Q", self.data, begin + _CHUNK_HEAD.size + name)
        return bool(stored == length - _CHUNK_HEAD.size - name - 8)

    def _uncompressed(self, begin: int) -> bool:
        if begin + _CHUNK_HEAD.size + 8 > len(self.data):
            return False
        start, end, _, _, name = _CHUNK_HEAD.unpack_from(self.data, begin)
        return bool(name == 0 and start <= end)

    def _next_chunk(self, at: int) -> int:
        while (at := self.data.find(bytes([_CHUNK]), at)) >= 0:
            op, length = self._frame(self.data, at)
            if op and at + _FRAME.size + length <= len(self.data) and self._chunk_fits(at + _FRAME.size, length):
                return at
            at += 1
        return len(self.data)

    def _next_message(self, at: int) -> int:
        """The next message outside of chunks: of a known channel, and with another record behind it. Only such files are searched."""
        if not self._bare:
            return len(self.data)
        while (at := self.data.find(bytes([_MESSAGE]), at)) >= 0:
            op, length = self._frame(self.data, at)
            end = at + _FRAME.size + length
            if op and _MESSAGE_HEAD.size <= length < len(self.data) and end + _FRAME.size <= len(self.data):
                channel, _, log_ns, _ = _MESSAGE_HEAD.unpack_from(self.data, at + _FRAME.size)
                known = channel in self.channels and abs(log_ns - self._bare) < _DAY_NS
                if known and self._frame(self.data, end)[0]:
                    return at
            at += 1
        return len(self.data)

    def _learn(self, op: int, raw: bytes) -> None:
        """Take in a schema or a channel; a damaged one is passed over."""
        try:
            self._take_in(op, raw)
        except (ValueError, struct.error, McapError):
            self.unread += len(raw)

    def _take_in(self, op: int, raw: bytes) -> None:
        if op == _SCHEMA:
            schema = Schema.read(ReadDataStream(BytesIO(raw)))
            self._schemas[schema.id] = schema
        elif op == _CHANNEL:
            channel = ChannelRecord.read(ReadDataStream(BytesIO(raw)))
            schema = self._schemas.get(channel.schema_id)
            if schema is not None:
                self.is2 = channel.message_encoding != "ros1"
                text = schema.data.decode(errors="replace")
                self.channels[channel.id] = Channel(
                    channel.topic, msgtype_of(schema.name), text, "idl" in schema.encoding
                )


def _message(raw: bytes) -> Entry:
    channel, _, log_ns, _ = _MESSAGE_HEAD.unpack_from(raw)
    return channel, log_ns, raw[_MESSAGE_HEAD.size :]
