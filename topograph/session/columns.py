"""Columns that grow by a row at a time: an hour of messages as objects takes ten times the memory of their numbers."""

from __future__ import annotations

from array import array
from typing import Any

import numpy as np
from numpy.typing import NDArray

from topograph.geometry import Array, Stamps


def rising(stamps_ns: Stamps) -> NDArray[np.int64]:
    """Rows (K,) of stamps (N,) in the order of time, each stamp once: the first that came."""
    order = np.argsort(stamps_ns, kind="stable")
    return order[np.diff(stamps_ns[order], prepend=-(2**62)) > 0]


def alike(values: NDArray[Any]) -> bool:
    """Whether one value stands for all of a column (`np.broadcast_to`): what a source does not tell takes no memory."""
    return len(values) > 0 and values.strides[0] == 0


def picked(values: NDArray[Any], rows: NDArray[Any]) -> NDArray[Any]:
    """`values[rows]`, rows as a mask (N,) or as indices; a column of which one value stands for all stays one."""
    if not alike(values):
        return np.asarray(values[rows])
    count = int(rows.sum()) if rows.dtype == bool else len(rows)
    return np.broadcast_to(values[0], (count, *values.shape[1:]))


class Column:
    """Stamps and values of one stream, in the order of their coming.

    Attributes:
        last_ns: stamp of the newest message.
        frame: of the message with the earliest stamp.
    """

    def __init__(self, width: int) -> None:
        """Of messages of `width` values."""
        self._width = width
        self._ns, self._values = array("q"), array("d")
        self._earliest_ns = 0
        self.last_ns = 0
        self.frame = ""

    def __len__(self) -> int:
        return len(self._ns)

    def add(self, stamp_ns: int, frame: str, *values: Array) -> None:
        """One message."""
        assert sum(v.size for v in values) == self._width
        if not self._ns or stamp_ns < self._earliest_ns:
            self._earliest_ns, self.frame = stamp_ns, frame
        self.last_ns = stamp_ns
        self._ns.append(stamp_ns)
        for v in values:
            self._values.frombytes(np.ascontiguousarray(v, float).tobytes())

    def in_order(self) -> tuple[Stamps, Array, int]:
        """Stamps (N,), rising, values (N, width), and how many messages were dropped since they repeat a stamp."""
        # Copies: a column that is looked at cannot grow.
        ns, values = np.array(self._ns, np.int64), np.array(self._values, float).reshape(-1, self._width)
        rows = rising(ns)
        return ns[rows], values[rows], len(ns) - len(rows)
