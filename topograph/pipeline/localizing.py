"""A map and a bag in, poses over time out: the bag is streamed through the same engine that runs live."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from topograph.bags import Imu, Odometry, Recording, Trunks
from topograph.config import Config
from topograph.errors import InsufficientDataError
from topograph.geometry import Array
from topograph.localize import Fix, GraphMethod, Localizer, Method, Move, Report, Sweep, ThesisMethod, smooth
from topograph.mapping import Progress, silent
from topograph.pipeline.read import WHOLE, Heard, child_mount, refuse_damaged, stream
from topograph.topomap import TopoMap


@dataclass(slots=True, kw_only=True)
class Replay:
    """A localized run.

    Attributes:
        reports: one per scan, in time order.
        distance: (S,) metres driven at each scan.
        smoothed: stamps (K,) and poses (K, 4, 4) of the committed scans, with what came later taken in.
        skipped, notes, chosen: as in mapping.
        seconds: per stage; `update_ms` of each scan.
        trunks_seen: (S,) trunks nearer than 10 m in each scan.
        exploded: scans in which the thesis's combinations exceeded their cap.
    """

    reports: list[Report] = field(default_factory=list)
    distance: list[float] = field(default_factory=list)
    smoothed: tuple[NDArray[np.int64], Array] = (np.zeros(0, np.int64), np.zeros((0, 4, 4)))
    skipped: Counter[str] = field(default_factory=Counter)
    notes: list[str] = field(default_factory=list)
    chosen: dict[str, str] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    update_ms: list[float] = field(default_factory=list)
    trunks_seen: list[int] = field(default_factory=list)
    duration_s: float = 0.0
    exploded: int = 0

    @property
    def fixes(self) -> list[Fix]:
        """Committed poses."""
        return [r.fix for r in self.reports if r.fix is not None]


def localize_bags(
    topo: TopoMap, paths: Sequence[Path], config: Config, method: str = "graph", progress: Progress = silent,
    span_s: tuple[float, float] = WHOLE,
) -> Replay:  # fmt: skip
    """Replay bags against a map; `method` is "graph" or "thesis". GNSS in the bags is not read.

    Only what lies within `span_s` (from, to) seconds of the first message counts.

    Raises:
        InsufficientDataError: neither scans nor odometry.
    """
    out = Replay()
    began = time.perf_counter()
    with Recording(paths, config.bags) as recording:
        for kind in ("fix", "heading"):
            recording.chosen.pop(kind, None)
        out.chosen, out.duration_s, out.skipped = dict(recording.chosen), recording.duration_s, recording.skipped
        if "odometry" not in recording.chosen and not recording.moved_by_lidar:
            raise InsufficientDataError(
                "localization needs wheel odometry: name it with --topic-odometry"
                + "".join(f" ({t}, if that is the robot's own velocity)" for t in recording.to_name("odometry"))
                + ", or take the motion from the point clouds with --topic-odometry lidar"
            )
        if not {"points", "trunks"} & set(recording.chosen):
            raise InsufficientDataError(
                "no point cloud and no trunk detections; name one with --topic-points or --topic-trunks"
            )
        player = _Player(out, lambda heard: _begin(topo, recording, heard, config, method, out.notes))
        for m in stream(recording, config, partial(_show, progress), span_s):
            player.take(m)
        refuse_damaged(recording, span_s != WHOLE)
        out.notes += [*recording.notes, *recording.clocks.notes]
    out.seconds["read, detect and localize"] = time.perf_counter() - began
    player.finish(progress)
    return out


def localize_heard(
    topo: TopoMap,
    heard: Heard,
    config: Config,
    method: MethodOf,
    *,
    first: int = 0,
    until_committed: bool = False,
    most: float = float("inf"),
) -> Replay:
    """The same from what was read before: a run is detected once, and localized in many maps by many methods.

    It begins with the scan number `first`; `until_committed`: it ends with the first pose, or after `most` m.
    """
    out = Replay(duration_s=heard.session.duration_s, chosen=dict(heard.session.chosen))
    imu = heard.session.mounts.get("imu")
    child_T_robot, R = heard.session.child_T_robot, None if imu is None else imu[:3, :3]
    player = _Player(
        out,
        lambda _: Localizer(
            topo, config.localize, child_T_robot=child_T_robot, robot_R_imu=R, method=method(topo, config)
        ),
    )
    scan = -1
    before: list[Imu | Odometry] = []
    for m in heard.messages:
        scan += isinstance(m, Trunks)
        if scan < first:
            if not isinstance(m, Trunks):
                before = [*before[-LEAD:], m]
            continue
        for earlier in before:
            player.take(earlier)
        before = []
        player.take(m)
        if until_committed and out.reports and (out.reports[-1].fix is not None or out.distance[-1] > most):
            return out
    player.finish(silent)
    return out


LEAD = 150
"""Small messages before a start that say how the robot stands and moves."""
MethodOf = Callable[[TopoMap, Config], Method]


class _Player:
    """Hands messages to a localizer as they come, and keeps what it reports."""

    def __init__(self, out: Replay, begin: Callable[[Sequence[Imu | Odometry]], Localizer]) -> None:
        self.out, self._begin = out, begin
        self.localizer: Localizer | None = None
        self._buffer: list[Imu | Odometry] = []
        self._stretch = _Stretch()

    def take(self, m: object) -> None:
        if isinstance(m, (Imu, Odometry)):
            self._buffer.append(m)
        if not isinstance(m, Trunks):
            return
        if self.localizer is None:
            self.localizer = self._begin(self._buffer)
        local, out = self.localizer, self.out
        began = time.perf_counter()
        local.update(m, self._buffer)
        out.update_ms.append(1e3 * (time.perf_counter() - began))
        self._buffer.clear()
        assert local.report is not None
        out.reports.append(local.report)
        out.trunks_seen.append(int((np.hypot(m.p[:, 0], m.p[:, 1]) < NEAR).sum()) if len(m) else 0)
        out.distance.append((out.distance[-1] if out.distance else 0.0) + local.leg.distance)
        if isinstance(local.method, GraphMethod):
            self._stretch.add(local.report, local.method)

    def finish(self, progress: Progress) -> None:
        """Smooth what was committed.

        Raises:
            InsufficientDataError: there was no scan.
        """
        if self.localizer is None:
            raise InsufficientDataError("no scan in the recording (or in the part that was asked for)")
        if isinstance(self.localizer.method, ThesisMethod):
            self.out.exploded = self.localizer.method.exploded
        began = time.perf_counter()
        progress("smooth", 0.0)
        self.out.smoothed = self._stretch.solve()
        progress("smooth", 1.0)
        self.out.seconds["smooth"] = time.perf_counter() - began


NEAR = 10.0
"""Trunks that the thesis's method can use, m (`thesis.view`)."""


def _show(progress: Progress, _: str, share: float) -> None:
    progress("localize", share)


def _begin(
    topo: TopoMap, recording: Recording, buffer: Sequence[Imu | Odometry], config: Config, method: str, notes: list[str]
) -> Localizer:
    """A localizer with the mountings that the recording knows."""
    frames = {type(m): (m.frame if isinstance(m, Imu) else m.child_frame) for m in buffer}
    child_T_robot = child_mount(recording.frames.find, frames.get(Odometry, config.bags.base_frame), config, notes)
    robot_R_imu = None
    if Imu in frames:
        mount = recording.frames.find(frames[Imu])
        if mount is None:
            notes.append(f"IMU frame {frames[Imu]!r} is not in TF: levelled by gravity at the start")
        else:
            robot_R_imu = mount[:3, :3]
    else:
        notes.append("no IMU: turns rest on the wheels, and the ground is taken as level")
    other = ThesisMethod(topo, config.thesis) if method == "thesis" else None
    return Localizer(topo, config.localize, child_T_robot=child_T_robot, robot_R_imu=robot_R_imu, method=other)


@dataclass(slots=True)
class _Scan:
    """What the smoother needs of one committed scan."""

    fix: Fix
    move: Move
    sweep: Sweep
    pairs: NDArray[np.int64]


class _Stretch:
    """Committed stretches of a run, kept for the smoother."""

    def __init__(self) -> None:
        self.parts: list[list[_Scan]] = [[]]
        self.method: GraphMethod | None = None

    def add(self, report: Report, method: GraphMethod) -> None:
        self.method = method
        part = self.parts[-1]
        if report.fix is None:
            if part:
                self.parts.append([])
            return
        if part:  # carried elsewhere: odometry does not join the two
            jump = np.linalg.norm(report.fix.map_T_robot[:2, 3] - part[-1].fix.map_T_robot[:2, 3])
            if jump > 1.0 + 3.0 * float(np.hypot(*method.move.step[:2])):
                self.parts.append([])
        self.parts[-1].append(_Scan(report.fix, method.move, method.sweep, method.sweep_pairs))

    def solve(self) -> tuple[NDArray[np.int64], Array]:
        """Stamps (K,) and poses (K, 4, 4) of all stretches."""
        parts = [p for p in self.parts if p]
        if not parts or self.method is None or self.method.engine is None:
            return np.zeros(0, np.int64), np.zeros((0, 4, 4))
        index = self.method.engine.index
        var = index.var + self.method.config.map_sigma**2
        poses = [
            smooth([s.fix for s in p], [s.move for s in p], [s.sweep for s in p], [s.pairs for s in p], index.xy, var)
            for p in parts
        ]
        return np.array([s.fix.stamp_ns for p in parts for s in p], np.int64), np.concatenate(poses)
