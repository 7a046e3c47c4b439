"""The trunks of many scans, in columns; one by one they look as they came."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, overload

import numpy as np
from numpy.typing import NDArray

from topograph.bags import Trunks
from topograph.geometry import Array, Stamps
from topograph.session.columns import alike, picked, rising

SECTORS = 360
"""Words of a scan's record of passage (trunks/passage.py)."""
ROWS = ("p", "axis", "diameter", "cov", "height", "score", "kinds", "measured", "stems")
"""What there is of each trunk."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Scans(Sequence[Trunks]):
    """N trunks of S scans; `scans[k]` are the trunks of one of them, on the same memory.

    Attributes:
        stamps_ns: (S,) as they came; `frames` of each; `ends` (S + 1,) rows where each begins.
        p, axis, diameter, height, score: (N, ...) as in `Trunks`; `cov` too, in single precision: it is half of a trunk, and known to a digit.
        kinds: (N, 3), NaN where the source tells none; `measured` (N, 6), zeros; `stems` (N,), one.
        free: (S, SECTORS), zeros where a scan tells nothing, or (0, SECTORS) where none does; `eye` (S, 3).
        points: (M, 3) of all clouds; `cloud_ends` (N + 1,) where each begins.
        given: (S, 6) what each scan's source told: kinds, measured, stems, clouds, what it saw through; and whether `p` is on the surface.
    """

    stamps_ns: Stamps
    frames: tuple[str, ...]
    ends: NDArray[np.int64]
    p: Array
    axis: Array
    diameter: Array
    cov: NDArray[np.float32]
    height: Array
    score: Array
    kinds: Array
    measured: Array
    stems: NDArray[np.int64]
    free: NDArray[np.uint32]
    eye: Array
    points: NDArray[np.float32]
    cloud_ends: NDArray[np.int64]
    given: NDArray[np.bool_]

    @staticmethod
    def of(trunks: Iterable[Trunks]) -> Scans:
        """The columns of scans; themselves, where they are columns already."""
        if isinstance(trunks, Scans):
            return trunks
        builder = ScansBuilder()
        builder.extend(trunks)
        return builder.build()

    def __len__(self) -> int:
        return len(self.stamps_ns)

    @overload
    def __getitem__(self, k: int) -> Trunks: ...
    @overload
    def __getitem__(self, k: slice) -> Scans: ...
    def __getitem__(self, k: int | slice) -> Trunks | Scans:
        if isinstance(k, slice):
            return self.take(np.arange(len(self))[k])
        if not -len(self) <= k < len(self):
            raise IndexError(k)
        k %= len(self)
        a, b = (int(v) for v in self.ends[k : k + 2])
        kinds, measured, stems, clouds, free, surface = self.given[k].tolist()
        return Trunks(
            stamp_ns=int(self.stamps_ns[k]),
            frame=self.frames[k],
            p=self.p[a:b],
            axis=self.axis[a:b],
            diameter=self.diameter[a:b],
            cov=self.cov[a:b].astype(float),
            height=self.height[a:b],
            score=self.score[a:b],
            clouds=tuple(self.cloud(i) for i in range(a, b)) if clouds else (),
            surface=surface,
            kinds=self.kinds[a : b if kinds else a],
            measured=self.measured[a : b if measured else a],
            stems=self.stems[a : b if stems else a],
            free=self.free[k] if free else np.zeros(0, np.uint32),
            eye=self.eye[k],
        )

    def __iter__(self) -> Iterator[Trunks]:
        return (self[k] for k in range(len(self)))

    def cloud(self, row: int) -> NDArray[np.float32]:
        """Points (M, 3) of one trunk."""
        return self.points[self.cloud_ends[row] : self.cloud_ends[row + 1]]

    def in_order(self) -> Scans:
        """The scans in the order of time, each stamp once: themselves, where they are so already."""
        if (np.diff(self.stamps_ns) > 0).all():
            return self
        return self.take(rising(self.stamps_ns))

    def take(self, scans: NDArray[np.int64]) -> Scans:
        """Some of the scans (K,), in that order."""
        count = np.diff(self.ends)[scans]
        row = _ranges(self.ends[:-1][scans], count)
        size = np.diff(self.cloud_ends)[row]
        return Scans(
            stamps_ns=self.stamps_ns[scans],
            frames=tuple(self.frames[k] for k in scans.tolist()),
            ends=_sum(count),
            free=self.free[scans] if len(self.free) else self.free,
            eye=self.eye[scans],
            points=self.points[_ranges(self.cloud_ends[:-1][row], size)],
            cloud_ends=_sum(size),
            given=self.given[scans],
            **{k: picked(getattr(self, k), row) for k in ROWS},
        )

    @staticmethod
    def joined(parts: list[Scans]) -> Scans:
        """One after the other. The list is emptied on the way, so that memory never holds all of them twice."""
        if len(parts) == 1:
            return parts.pop()
        scans, rows, points = (sum(q) for q in zip(*((len(q), len(q.p), len(q.points)) for q in parts), strict=True))
        told = any(len(q.free) for q in parts)
        same = {
            k: np.broadcast_to(v, (rows, *v.shape))
            for k in ROWS
            if (v := _same([getattr(q, k) for q in parts])) is not None
        }
        own = [k for k in ROWS if k not in same]
        length = {"points": points, "free": scans * told, **dict.fromkeys(_SCANS, scans), **dict.fromkeys(own, rows)}
        whole = {k: np.zeros((n, *(v := getattr(parts[0], k)).shape[1:]), v.dtype) for k, n in length.items()}
        at = dict.fromkeys(length, 0)
        frames: list[str] = []
        count, size = [], []
        while parts:
            q = parts.pop(0)
            for k in length:
                v = getattr(q, k)
                whole[k][at[k] : at[k] + len(v)] = v
                at[k] += len(q) * told if k == "free" else len(v)  # zeros where a part tells nothing
            frames += q.frames
            count.append(np.diff(q.ends))
            size.append(np.diff(q.cloud_ends))
        ends, cloud_ends = _sum(np.concatenate(count)), _sum(np.concatenate(size))
        return Scans(frames=tuple(frames), ends=ends, cloud_ends=cloud_ends, **whole, **same)


_SCANS = ("stamps_ns", "eye", "given")


def _same(parts: list[NDArray[Any]]) -> NDArray[Any] | None:
    """The value that stands for all rows of all parts, if there is one."""
    parts = [v for v in parts if len(v)]
    if not parts or not all(alike(v) and np.array_equal(v[0], parts[0][0], equal_nan=True) for v in parts):
        return None
    return np.array(parts[0][0])


def _sum(count: NDArray[np.int64]) -> NDArray[np.int64]:
    """Where each of so many begins, and the last ends."""
    return np.concatenate([[0], np.cumsum(count)]).astype(np.int64)


def _ranges(start: NDArray[np.int64], count: NDArray[np.int64]) -> NDArray[np.int64]:
    """Rows of ranges, one after the other."""
    return np.asarray(np.arange(count.sum()) + np.repeat(start - _sum(count)[:-1], count), np.int64)


SCANS_AT_ONCE = 512
"""Scans that are kept as they came, until they are put into columns together."""


class ScansBuilder:
    """Collects scans as they come."""

    def __init__(self) -> None:
        self._lots: list[Scans] = []
        self._new: list[Trunks] = []
        self.last_ns = 0

    def __len__(self) -> int:
        return sum(map(len, self._lots)) + len(self._new)

    def add(self, trunks: Trunks) -> None:
        """One scan."""
        self._new.append(trunks)
        self.last_ns = trunks.stamp_ns
        if len(self._new) == SCANS_AT_ONCE:
            self._lots.append(_columns(self._new))
            self._new = []

    def extend(self, trunks: Iterable[Trunks]) -> None:
        """Several scans."""
        for t in trunks:
            self.add(t)

    def build(self) -> Scans:
        """What came so far; more may come."""
        if self._new or not self._lots:
            self._lots.append(_columns(self._new))
            self._new = []
        self._lots = [Scans.joined(self._lots)]
        return self._lots[0]


def _columns(trunks: Sequence[Trunks]) -> Scans:
    def rows(name: str, *shape: int, missing: float = 0.0, dtype: type = float) -> NDArray[Any]:
        if not any(len(getattr(t, name)) for t in trunks):
            return np.broadcast_to(np.full(shape, missing, dtype), (sum(map(len, trunks)), *shape))
        parts: list[NDArray[Any]] = [np.zeros((0, *shape), dtype)]
        for t in trunks:
            part: NDArray[Any] = np.asarray(getattr(t, name), dtype)
            parts.append(part if len(part) == len(t) else np.full((len(t), *shape), missing, dtype))
        return np.concatenate(parts)

    n = len(trunks)
    given = np.zeros((n, 6), bool)
    free = np.zeros((n, SECTORS), np.uint32)
    for k, t in enumerate(trunks):
        full = [len(v) == len(t) for v in (t.kinds, t.measured, t.stems)]
        looked = len(t.free) == SECTORS
        given[k] = [*full, len(t.clouds) > 0, looked, t.surface]
        if looked:
            free[k] = t.free
    clouds = [c for t in trunks for c in (t.clouds or [_NOTHING] * len(t))]
    return Scans(
        stamps_ns=np.array([t.stamp_ns for t in trunks], np.int64),
        frames=tuple(t.frame for t in trunks),
        ends=_sum(np.array([len(t) for t in trunks], np.int64)),
        p=rows("p", 3),
        axis=rows("axis", 3),
        diameter=rows("diameter"),
        cov=rows("cov", 3, 3, dtype=np.float32),
        height=rows("height"),
        score=rows("score"),
        kinds=rows("kinds", 3, missing=np.nan),
        measured=rows("measured", 6),
        stems=rows("stems", missing=1, dtype=np.int64),
        free=free if any(len(t.free) == SECTORS for t in trunks) else free[:0],
        eye=np.array([t.eye for t in trunks], float).reshape(-1, 3),
        points=np.concatenate([_NOTHING, *clouds]).astype(np.float32, copy=False),
        cloud_ends=_sum(np.array([len(c) for c in clouds], np.int64)),
        given=given,
    )


_NOTHING = np.zeros((0, 3), np.float32)
