"""Whose clock is to be believed: header stamps, judged against the time of recording and their own stream's median.

A stamp is never judged by the first or the newest one: one message from the future must cost one message. A stream that counts
from a start of its own (uptime, zeros) is laid onto the others by its arrival; clocks that are set in mid-run go on where they were.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from itertools import chain, pairwise
from statistics import median
from typing import Protocol

import numpy as np

BUFFER_NS = 3_000_000_000
"""Of recording are read before the first message is given: enough to know each stream's clock."""
ODD_NS = 2_000_000_000
"""A stamp whose distance from the time of recording differs by more from what is usual in its stream is no stamp of that clock:
messages that wait for the network are late by less."""
AGREE, AGREE_NS = 5, 1_000_000_000
"""So many odd stamps in a row that agree within so much: the clock was set."""
MEMORY = 25
"""Messages over which a stream's usual distance is taken."""
SMOOTH_NS = 1_500_000_000
"""A stamp that goes on from the last one by less is of the same clock, however late it was recorded: a backlog after a stall."""
AHEAD_NS = 50_000_000
"""Stamped after it was recorded, while other streams are not: a clock that runs ahead."""
RATE = (0.8, 1.25)
"""Seconds of stamps in one of recording; beyond, the time of recording says nothing of stamps (converted, or played back slowly)."""


class Stamped(Protocol):
    """A product with a stamp."""

    @property
    def stamp_ns(self) -> int: ...


@dataclass(slots=True)
class Message:
    """A product of stream `kind`, and when it was recorded."""

    kind: str
    log_ns: int
    product: Stamped


def _reach(messages: Iterable[Message]) -> int:
    """How long after its stamp a message's last point was measured, ns: a sweep is not sent before it is complete."""
    last = [offset for m in messages if (offset := getattr(m.product, "offset", None)) is not None]
    return int(median(max(float(np.nanmax(o)), 0.0) for o in last) * 1e9) if last else 0


@dataclass(slots=True)
class _Stream:
    """What is known of one stream's clock; distances are stamp less time of recording, ns."""

    usual: deque[int] = field(default_factory=lambda: deque(maxlen=MEMORY))
    shift: int = 0
    last: int | None = None
    odd: list[Message] = field(default_factory=list)


class Clocks:
    """Corrects and refuses stamps of one recording.

    Attributes:
        skipped: reason -> count, the caller's.
        notes: what was found and done, a sentence each.
        ahead: kind -> seconds that its clock runs ahead of the others.
    """

    def __init__(self, skipped: Counter[str]) -> None:
        self.skipped = skipped
        self.notes: list[str] = []
        self.ahead: dict[str, float] = {}
        self._streams: dict[str, _Stream] = {}
        self._judge = True
        self._begin_ns = 0
        self._common = 0

    def pass_on(self, messages: Iterable[Message]) -> Iterator[Message]:
        """The messages with stamps of one clock, in the order of recording; the rest is counted."""
        source = iter(messages)
        first: list[Message] = []
        for m in source:
            self._begin_ns = self._begin_ns or m.log_ns
            first.append(m)
            if m.log_ns - self._begin_ns >= BUFFER_NS:
                break
        self._start(first)
        for m in chain(first, source):
            yield from self._take(m)
        for kind, s in self._streams.items():
            self._drop(kind, s)

    def _start(self, first: list[Message]) -> None:
        by: dict[str, list[Message]] = {}
        for m in first:
            by.setdefault(m.kind, []).append(m)
        rates = []
        for kind, mine in by.items():
            stamped = [m for m in mine if m.product.stamp_ns > 0]
            s = self._streams[kind] = _Stream()
            s.usual.extend(m.product.stamp_ns - m.log_ns for m in stamped[-MEMORY:])
            logged = mine[-1].log_ns - mine[0].log_ns
            if len(stamped) > 2:
                steps = [b.product.stamp_ns - a.product.stamp_ns for a, b in pairwise(stamped)]
                rates.append(median(steps) * (len(stamped) - 1) / max(logged, 1))
        self._judge = not rates or RATE[0] < median(rates) < RATE[1]
        if not self._judge:
            self.notes.append("the time of recording does not run as the stamps do: stamps are taken as they are")
            return
        middle = {k: int(median(s.usual)) for k, s in self._streams.items() if s.usual}
        if not middle:
            return
        self._common = int(median(sorted(middle.values(), key=abs)[: max(1, len(middle) // 2)]))
        if len([v for v in middle.values() if abs(v - self._common) < ODD_NS]) * 2 < len(middle):
            self._common = int(median(middle.values()))
        for kind, v in middle.items():
            s = self._streams[kind]
            if abs(v - self._common) > ODD_NS:
                s.shift = self._common - v - _reach(by[kind])
                self.notes.append(
                    f"{kind}: its stamps are of another clock ({-s.shift * 1e-9:+.0f} s from the others): laid onto theirs by its "
                    "arrival, which is late by the unknown time of transport"
                )
        behind = [v for v in middle.values() if abs(v - self._common) < ODD_NS]
        for kind, v in middle.items():
            if len(behind) > 1 and v - min(behind) > AHEAD_NS and v > AHEAD_NS and abs(v - self._common) < ODD_NS:
                self.ahead[kind] = v * 1e-9
                self.notes.append(
                    f"{kind}: stamped {v * 1e-9:.2f} s after it was recorded, unlike the others: its clock runs ahead; synchronise it"
                )

    def _take(self, m: Message) -> Iterator[Message]:
        s = self._streams.setdefault(m.kind, _Stream())
        stamp = m.product.stamp_ns
        if stamp <= 0:
            yield from self._unstamped(m)
            return
        if not self._judge:
            yield m
            return
        distance = stamp - m.log_ns
        if not s.usual:  # a stream that begins late
            if abs(distance - self._common) > ODD_NS:
                s.shift = self._common - distance - _reach([m])
                self.notes.append(f"{m.kind}: its stamps are of another clock: laid onto the others by its arrival")
            s.usual.append(distance)
        usual = int(median(s.usual))
        goes_on = s.last is not None and 0 < stamp - s.last < SMOOTH_NS
        if abs(distance - usual) <= ODD_NS or goes_on:
            if s.odd:
                self._drop(m.kind, s)
            if abs(distance - usual) <= ODD_NS:
                s.usual.append(distance)
            s.last = stamp if s.last is None else max(s.last, stamp)
            yield self._moved(m, s.shift)
            return
        s.odd.append(m)
        recent = [o.product.stamp_ns - o.log_ns for o in s.odd[-AGREE:]]
        if len(recent) < AGREE or max(recent) - min(recent) > AGREE_NS:
            return
        first = s.odd[-AGREE]
        logged, stamped = m.log_ns - first.log_ns, stamp - first.product.stamp_ns
        # Delivered at once: a backlog, overtaken by a newer message.
        if abs(stamped - logged) > 0.5 * max(logged, stamped):
            held, s.odd = s.odd, []
            s.last = stamp
            yield from (self._moved(h, s.shift) for h in held)
            return
        jump = int(median(recent)) - usual
        s.shift -= jump
        s.usual.clear()
        s.usual.extend(recent)
        s.last = stamp
        kept, s.odd = s.odd[-AGREE:], s.odd[:-AGREE]
        self._drop(m.kind, s)
        at = (kept[0].log_ns - self._begin_ns) * 1e-9
        self.notes.append(
            f"{m.kind}: its clock was set by {jump * 1e-9:+.1f} s at {at:.0f} s; stamps go on as before it (check the clocks' synchronisation)"
        )
        for k in kept:
            yield self._moved(k, s.shift)

    def _unstamped(self, m: Message) -> Iterator[Message]:
        if not self._judge:
            self.skipped[f"{m.kind}: no header stamp"] += 1
            return
        note = f"{m.kind}: no header stamps: the time of recording stands in, which is late by the unknown time of transport"
        if note not in self.notes:
            self.notes.append(note)
        stamp = m.log_ns + self._common - _reach([m])
        yield Message(m.kind, m.log_ns, replace(m.product, stamp_ns=stamp))  # type: ignore[type-var]  # products are dataclasses

    def _moved(self, m: Message, shift: int) -> Message:
        if not shift:
            return m
        return Message(m.kind, m.log_ns, replace(m.product, stamp_ns=m.product.stamp_ns + shift))  # type: ignore[type-var]  # products are dataclasses

    def _drop(self, kind: str, s: _Stream) -> None:
        if s.odd:
            self.skipped[f"{kind}: stamp is not of its stream's clock"] += len(s.odd)
            s.odd = []
