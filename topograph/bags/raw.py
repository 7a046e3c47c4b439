"""Fields at the start of a message's bytes: ROS 1, or little-endian CDR behind its 4-byte encapsulation header."""

from __future__ import annotations

import struct


def string(raw: memoryview, at: int) -> tuple[str, int]:
    """The string at offset `at`, and the offset behind it."""
    (n,) = struct.unpack_from("<I", raw, at)
    text = bytes(raw[at + 4 : at + 4 + n]).rstrip(b"\0").decode("utf-8", "replace")
    return text, at + 4 + n


def header(raw: memoryview, ros2: bool) -> tuple[int, str, int]:
    """Stamp (ns), frame, and the offset behind a std_msgs/Header at the start of `raw`.

    Raises:
        ValueError, struct.error: another encapsulation than plain little-endian CDR, or too few bytes.
    """
    if ros2 and raw[1] != 1:
        raise ValueError("big-endian CDR, or another encapsulation than plain CDR")
    sec, nanosec = struct.unpack_from("<iI" if ros2 else "<II", raw, 4)
    frame, at = string(raw, 12)
    return sec * 1_000_000_000 + nanosec, frame.lstrip("/"), at


def aligned(at: int, size: int, ros2: bool) -> int:
    """Offset of the next field of `size` bytes: CDR aligns from behind its encapsulation header, ROS 1 does not."""
    return 4 + (at - 4 + size - 1) // size * size if ros2 else at
