"""A run as it is driven: where the robot is, which trees there are, and a map at the end. Replaying a bag is one way of calling it."""

from __future__ import annotations

import ctypes
import os
import signal
import time
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing import get_context
from multiprocessing.connection import Connection

import numpy as np

from topograph.bags import Fix, Heading, Imu, Odometry, Trunks
from topograph.config import Config
from topograph.errors import InsufficientDataError
from topograph.geometry import Array, Datum, inverse, planar
from topograph.localize import GraphMethod, Localizer
from topograph.mapping import Mapper, Placed, Solved
from topograph.motion import Reckoner
from topograph.pipeline.mapping import known_map, topo_map
from topograph.pipeline.placing import LEAST, has_no_common_gnss, refuse_twice, spread
from topograph.topomap import TopoMap

DRIFT, DRIFT_YAW = 0.03, 0.01
"""What dead reckoning may be off by since the last solve: share of the way, and rad per metre."""


@dataclass(frozen=True, slots=True, kw_only=True)
class State:
    """What is known after one scan.

    Attributes:
        state: starting (no map yet), mapping, or what the localizer says where there is a map (searching, tracking, ...).
        map_T_robot: (4, 4), or None; `sigma` the larger horizontal deviation, m.
        trees: of the map as it is now.
        solved_ns: stamp of the scan at which the map was last renewed, 0 never.
        datum: of the map's frame, ENU there; None: the frame is local.
        seconds: what this scan took, without a solve; `solve_s` what the solve took, 0 without one.
    """

    stamp_ns: int
    state: str
    map_T_robot: Array | None
    sigma: float
    trees: int
    solved_ns: int
    datum: Datum | None
    seconds: float
    solve_s: float

    @property
    def georeferenced(self) -> bool:
        """The frame is ENU."""
        return self.datum is not None


class Live:
    """Maps while driving; with a map, localizes in it and extends it at the end.

    Between two solves the robot is tracked on the trees of the last one, as it would be on anybody's map; where they are out of sight,
    by wheels and gyro. `background`: solves run beside the driving, and no scan waits for one.
    """

    def __init__(
        self,
        mapper: Mapper,
        config: Config,
        reckoner: Reckoner,
        topo: TopoMap | None = None,
        *,
        background: bool = False,
    ) -> None:
        self.mapper, self.config, self.old = mapper, config, topo
        self._background = background
        self._solving: _Solving | None = None
        self._solved_ns = 0
        self.topo = topo
        self._reckoner = reckoner
        self._localizer = None if topo is None else Localizer(topo, config.localize)
        if self._localizer is not None:
            self._localizer.reckoner = reckoner
        self._odom: list[tuple[int, Array]] = []  # planar poses of the scans in dead reckoning
        self._anchor: tuple[Array, Array] | None = None  # map_T_robot and odom_T_robot of one scan
        self._placed: list[tuple[int, Array]] = []

    def process(self, trunks: Trunks, messages: Iterable[Odometry | Imu | Fix | Heading] = ()) -> State:
        """One scan's trunks in `base_link` and the messages since the last one."""
        began = time.perf_counter()
        messages = list(messages)
        due = self.mapper.process(trunks, messages)
        heard = [m for m in messages if isinstance(m, (Odometry, Imu))]
        pose, sigma, state = self._follow(trunks, heard)
        seconds = time.perf_counter() - began
        solve_s = 0.0
        if self._solving is not None and self._solving.poll():
            found, self._solving = self._solving.result(), None
            if found is not None:
                self.mapper.took = found.took
                self.mapper.datum = self.mapper.datum or found.topo.datum
            solve_s = self.mapper.took
            self._renew(trunks, found)
        elif due and self.old is None and self._solving is None:
            if self._background:
                self.mapper.begin()
                self._solving = _Solving(self.mapper, self.config)
            else:
                self._renew(trunks, _renewed(self.mapper, self.config))
                solve_s = self.mapper.took
        if solve_s:
            self._solved_ns = trunks.stamp_ns
        return State(
            stamp_ns=trunks.stamp_ns,
            state=state,
            map_T_robot=pose,
            sigma=sigma,
            trees=0 if self.topo is None else int(self.topo.is_tree.sum()),
            solved_ns=self._solved_ns,
            datum=None if self.topo is None else self.topo.datum,
            seconds=seconds,
            solve_s=solve_s,
        )

    def finish(self) -> Solved:
        """The solve of the whole run, as `map` makes it; into the map that was given.

        Raises:
            InsufficientDataError: the run does not determine its path, or was never found in the map.
        """
        if self._solving is not None:
            self._solving.stop()
            self._solving = None
        known, placed = None, None
        session = self.mapper.session()
        if self.old is not None:
            refuse_twice(self.old, session)
            known = known_map(self.old)
        if self.old is not None and has_no_common_gnss(self.old, session):
            poses = np.array([p for _, p in self._placed]).reshape(-1, 4, 4)
            kept = spread(poses)
            if len(kept) < LEAST:
                raise InsufficientDataError("the run was not found in the map often enough to extend it")
            stamps = np.array([ns for ns, _ in self._placed], np.int64)
            placed = Placed(stamps[kept], poses[kept])
        return self.mapper.finish(session, known, placed)

    # -- where the robot is ---------------------------------------------------------------------------------------

    def _follow(self, trunks: Trunks, heard: list[Odometry | Imu]) -> tuple[Array | None, float, str]:
        """The robot's pose, its deviation and the state after one scan."""
        if self._localizer is None:
            for m in heard:
                self._reckoner.add(m)
            leg = self._reckoner.advance(trunks.stamp_ns)
        else:
            self._localizer.update(trunks, heard)
            leg = self._localizer.leg
        last = self._odom[-1][1] if self._odom else np.eye(4)
        self._odom.append((trunks.stamp_ns, last @ planar(float(leg.step[0]), float(leg.step[1]), float(leg.step[2]))))
        if self.old is not None:  # a map that is given is not renewed on the way: nobody asks for earlier poses
            del self._odom[:-1]
        report = None if self._localizer is None else self._localizer.report
        if report is not None and report.fix is not None:
            self._anchor = report.fix.map_T_robot, self._odom[-1][1]
            if self.old is not None:
                self._placed.append((trunks.stamp_ns, report.fix.map_T_robot))
            state = "mapping" if self.old is None and report.state == "tracking" else report.state
            return report.fix.map_T_robot, float(np.sqrt(report.fix.cov[[3, 4], [3, 4]].max())), state
        if self.old is not None:
            return None, np.nan, "searching" if report is None else report.state
        if self._anchor is None:
            return None, np.nan, "starting"
        pose = self._reckoned()
        way = float(np.linalg.norm(pose[:2, 3] - self._anchor[0][:2, 3]))
        return pose, 0.02 + DRIFT * way, "mapping"

    def _reckoned(self) -> Array:
        """The pose (4, 4) now by dead reckoning from the last one that trees or a solve gave."""
        assert self._anchor is not None
        there, odom = self._anchor
        return there @ inverse(odom) @ self._odom[-1][1]

    def _renew(self, trunks: Trunks, found: _Renewed | None) -> None:
        """A new map of all that came until a while ago, and the robot on it."""
        if found is None:
            return
        self.topo = found.topo
        stamps = np.array([ns for ns, _ in self._odom])
        k = max(int(np.searchsorted(stamps, found.stamp_ns, side="right")) - 1, 0)
        # The last keyframe is a scan's stamp: dead reckoning leads from there to now.
        self._anchor = found.map_T_robot, self._odom[k][1]
        del self._odom[:k]
        now = self._reckoned()
        self._anchor = now, self._odom[-1][1]
        if len(self.topo) < LEAST:
            return
        if self._localizer is None:
            self._localizer = Localizer(self.topo, self.config.localize)
            self._localizer.reckoner = self._reckoner
            self._localizer.leg = self._reckoner.advance(trunks.stamp_ns)
        method = GraphMethod(self.topo, self.config.localize)
        if isinstance(self._localizer.method, GraphMethod):
            method.remember(self._localizer.method)
        way = float(np.linalg.norm(now[:2, 3] - found.map_T_robot[:2, 3]))
        off, turn = 0.03 + DRIFT * way, 0.005 + DRIFT_YAW * way
        method.begin_at(now, np.diag([off**2, off**2, turn**2]), trunks)
        self._localizer.method = method


@dataclass(frozen=True, slots=True)
class _Renewed:
    """The map of what came so far, and the pose (4, 4) of its last keyframe."""

    topo: TopoMap
    stamp_ns: int
    map_T_robot: Array
    took: float


def _renewed(mapper: Mapper, config: Config) -> _Renewed | None:
    solved = mapper.solve()
    if solved is None:
        return None
    e = solved.estimate
    topo = topo_map(solved, config, {}, clouds=False)
    return _Renewed(topo, int(e.stamps_ns[-1]), e.map_T_robot[-1], mapper.took)


PR_SET_PDEATHSIG = 1
"""Of prctl(2)."""


def _alone(keep: int) -> None:
    """In a child: give back all that is open but one file and the standard ones (the lock of a map dies with its process), and end when
    the parent does.
    """
    with suppress(OSError, AttributeError):
        ctypes.CDLL("libc.so.6").prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    os.closerange(3, keep)
    os.closerange(keep + 1, 4096)


class _Solving:
    """A solve beside the driving: a child of this process, which has all that came until now, and whose map comes back."""

    def __init__(self, mapper: Mapper, config: Config) -> None:
        context = get_context("fork")  # the child needs all that came: nothing of it is sent
        self._result, mine = context.Pipe(duplex=False)
        self._process = context.Process(target=self._work, args=(mine, mapper, config), daemon=True)
        self._process.start()
        mine.close()

    @staticmethod
    def _work(back: Connection, mapper: Mapper, config: Config) -> None:
        _alone(back.fileno())
        back.send(_renewed(mapper, config))
        back.close()

    def poll(self) -> bool:
        """Whether it is done."""
        return self._result.poll() or not self._process.is_alive()

    def stop(self) -> None:
        """Nobody wants it any more."""
        self._process.kill()
        self._process.join()
        self._result.close()

    def result(self) -> _Renewed | None:
        """What it found; None where that did not determine the path, or the child died."""
        try:
            found = (
                self._result.recv()
            )  # before joining: a child that writes more than a pipe holds waits for its reader
        except EOFError:
            found = None
        self._process.join()
        self._result.close()
        return found if isinstance(found, _Renewed) else None
