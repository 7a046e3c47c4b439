"""What a recording holds when its index is gone or wrong: blocks of messages, in the order of the file.

One reader per format, over the file's bytes; each finds its way again behind what is damaged.
"""

from __future__ import annotations

import mmap
from collections.abc import Iterator
from typing import Protocol

from topograph.bags.blocks.channel import Channel, Entry
from topograph.bags.blocks.mcap import McapBlocks
from topograph.bags.blocks.rosbag import RosbagBlocks
from topograph.bags.blocks.sqlite import SqliteBlocks

__all__ = ["Blocks", "Channel", "Entry", "blocks_of"]


class Blocks(Protocol):
    """A format's reader.

    Attributes:
        channels: id -> channel, filled by `walk` and `load`.
        is2: messages are CDR (ROS 2); of mcap, once `walk` has passed.
        unread: bytes passed over, filled by `walk` and `load`.
        missing: messages that those that were found tell of.
    """

    channels: dict[int, Channel]
    is2: bool
    unread: int

    @property
    def missing(self) -> int: ...

    def walk(self) -> Iterator[int]:
        """Where blocks begin, in the order of the file."""
        ...

    def load(self, at: int) -> list[Entry]:
        """The messages of the block at `at`; raises whatever its decompressor does where it is damaged."""
        ...


def blocks_of(data: mmap.mmap, name: str) -> Blocks | None:
    """The reader for a file by its first bytes, or by its name where those are damaged; None for what is no recording."""
    head = data[:_LONGEST_MAGIC]
    for magic, _, kind in _FORMATS:
        if head.startswith(magic):
            return kind(data)
    words = name.removesuffix(".active").split(".")
    return next((kind(data) for _, suffix, kind in _FORMATS if words[-1] == suffix), None)


_FORMATS: tuple[tuple[bytes, str, type[RosbagBlocks] | type[McapBlocks] | type[SqliteBlocks]], ...] = (
    (b"#ROSBAG V2.0\n", "bag", RosbagBlocks),
    (b"\x89MCAP0\r\n", "mcap", McapBlocks),
    (b"SQLite format 3\0", "db3", SqliteBlocks),
)
_LONGEST_MAGIC = max(len(m) for m, _, _ in _FORMATS)
