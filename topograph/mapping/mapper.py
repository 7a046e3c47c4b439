"""A run while it is driven: what came so far, and the solve of it."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterable

import numpy as np

from topograph.bags import Fix, Heading, Imu, Odometry, Trunks
from topograph.errors import InsufficientDataError
from topograph.geometry import Array, Datum, inverse
from topograph.mapping.config import MappingConfig
from topograph.mapping.known import KnownMap, Placed
from topograph.mapping.solve import Solved, solve_session
from topograph.session import ScansBuilder, Session, StreamsBuilder, unknown_mounts

FIRST_S = 5.0
"""Before so much was recorded there is no map worth the name."""
FAR_NS = 60_000_000_000
"""A scan that is stamped further from everything else was stamped by another clock."""
DUTY = 4.0
"""Between two solves lies so many times what the last one took: mapping costs a quarter of a core, however long the run."""


class Mapper:
    """Feed it scans and messages as they come; `solve` makes path and trees of all that came, as `map` does of a recording.

    Args:
        find: frame of a sensor -> its mounting (4, 4), or None where nobody knows.
        mount: `Recording.frames.of`: kind and frame -> its mounting, or None.
        start_ns: when the recording began; the first scan's stamp where nobody says.

    Attributes:
        took: CPU seconds of the last solve.
        datum: of the first map with GNSS: later ones on the way keep to it, so that a place has one pair of coordinates.
    """

    def __init__(
        self,
        config: MappingConfig,
        find: Callable[[str], Array | None],
        mount: Callable[[str, str], Array | None],
        chosen: dict[str, str] | None = None,
        start_ns: int | None = None,
    ) -> None:
        self.config, self.chosen = config, chosen or {}
        self.datum: Datum | None = None
        self._find, self._mount = find, mount
        self._builder = StreamsBuilder()
        self._trunks = ScansBuilder()
        self.skipped: Counter[str] = Counter()
        self.took = 0.0
        self._start_ns = start_ns
        self._solved_ns: int | None = None

    def hear(self, messages: Iterable[Odometry | Imu | Fix | Heading]) -> None:
        """Messages without a scan."""
        for m in messages:
            self._builder.add(m)

    def process(self, trunks: Trunks, messages: Iterable[Odometry | Imu | Fix | Heading] = ()) -> bool:
        """One scan's trunks in `base_link`, and the messages since the last; whether it is time to solve."""
        self.hear(messages)
        trunks = self._sound(trunks)
        if not self._in_time(trunks.stamp_ns):
            self.skipped["scan: stamped far from all other messages"] += 1
            return False
        self._trunks.add(trunks)
        now = trunks.stamp_ns
        if self._start_ns is None:
            self._start_ns = now
        since = (now - (self._start_ns if self._solved_ns is None else self._solved_ns)) * 1e-9
        return since >= max(FIRST_S, DUTY * self.took)

    @staticmethod
    def _sound(trunks: Trunks) -> Trunks:
        """The trunks that are somewhere, and point somewhere."""
        ok = np.isfinite(trunks.p).all(axis=1) & np.isfinite(trunks.axis).all(axis=1)
        ok &= np.linalg.norm(trunks.axis, axis=1) > 0.5
        return trunks if ok.all() else trunks.select(ok)

    def _in_time(self, stamp_ns: int) -> bool:
        """A scan's stamp is near the newest message of wheels or IMU, or near the last scan's."""
        near = [m.last_ns for m in (self._builder.odometry, self._builder.imu, self._trunks) if len(m)]
        return not near or min(abs(stamp_ns - n) for n in near) < FAR_NS

    def session(self) -> Session:
        """What came so far."""
        skipped = Counter(self.skipped)
        streams = self._builder.build(skipped)
        mounts: dict[str, Array | None] = {
            k: self._mount(k, streams.frames[k]) for k in ("imu", "fix", "heading") if k in streams.frames
        }
        child = self._find(streams.frames.get("child", ""))
        trunks = self._trunks.build()
        span = float(trunks.stamps_ns[-1] - trunks.stamps_ns[0]) * 1e-9 if len(trunks) else 0.0
        return Session(
            streams=streams,
            trunks=trunks,
            mounts=mounts,
            child_T_robot=np.eye(4) if child is None else inverse(child),
            chosen=self.chosen,
            skipped=skipped,
            notes=unknown_mounts(streams, mounts),
            scans=len(trunks),
            seconds=0.0,
            duration_s=span,
            start_ns=self._start_ns or 0,
        )

    def begin(self) -> None:
        """A solve of what came so far, which is something, begins, here or elsewhere."""
        assert len(self._trunks)
        self._solved_ns = self._trunks.last_ns

    def solve(self) -> Solved | None:
        """Path and trees of what came so far; None while that does not determine them."""
        if not len(self._trunks):
            return None
        self.begin()
        began = time.process_time()
        try:
            solved = solve_session(self.session(), self.config, datum=self.datum)
        except InsufficientDataError:
            return None
        finally:
            self.took = time.process_time() - began
        self.datum = self.datum or solved.problem.datum
        return solved

    def finish(self, session: Session, known: KnownMap | None = None, placed: Placed | None = None) -> Solved:
        """As `map` solves a recording: into the `known` map, if there is one.

        Raises:
            InsufficientDataError: what came does not determine the path.
        """
        return solve_session(session, self.config, known=known, placed=placed)
