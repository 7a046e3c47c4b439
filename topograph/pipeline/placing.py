"""A run without common fixes is put into a map by finding the robot in it: see mapping/known.py."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from topograph.bags import Imu, Odometry
from topograph.config import Config
from topograph.errors import InsufficientDataError, UsageError
from topograph.estimate.assemble import LEAST_FIXES
from topograph.geometry import Array, to_quaternion
from topograph.localize import Localizer
from topograph.mapping import Placed, Progress, silent
from topograph.session import Session
from topograph.topomap import TopoMap

APART = 2.0
"""Between two places that hold a run, m: they come from the same trunks as the graph's own factors, and must not outvote them."""
LEAST = 3
"""Places that hold a run."""


def place(topo: TopoMap, session: Session, config: Config, progress: Progress = silent) -> Placed:
    """Find a run in a map, from anywhere, without GNSS.

    Raises:
        InsufficientDataError: it has no wheels, or is nowhere on the map as surely as `config.localize.risk` asks for.
    """
    if not len(session.streams.odometry_ns):
        raise InsufficientDataError(
            "a run without GNSS is laid onto a map by its wheels and trunks: it has no wheel odometry"
        )
    imu = session.mounts.get("imu")
    localizer = Localizer(
        topo,
        config.localize,
        child_T_robot=session.child_T_robot,
        robot_R_imu=None if imu is None else imu[:3, :3],
    )
    messages = _messages(session)
    ahead = next(messages, None)
    stamps: list[int] = []
    poses: list[Array] = []
    reasons: Counter[str] = Counter()
    for n, trunks in enumerate(session.trunks):
        heard = []
        while ahead is not None and ahead.stamp_ns <= trunks.stamp_ns + AHEAD_NS:
            heard.append(ahead)
            ahead = next(messages, None)
        fix = localizer.update(trunks, heard)
        if localizer.report is not None and localizer.report.why:
            reasons[localizer.report.why] += 1
        if fix is not None:
            stamps.append(fix.stamp_ns)
            poses.append(fix.map_T_robot)
        if n % 100 == 0:
            progress("place", n / len(session.trunks))
    progress("place", 1.0)
    kept = spread(np.array(poses).reshape(-1, 4, 4))
    if len(kept) < LEAST:
        why = reasons.most_common(1)[0][0] if reasons else "too few of its scans could be placed"
        raise InsufficientDataError(
            f"the run has no GNSS in common with the map, and was not found in it by its trees: {why}. Drive further, or through more of "
            "what the map knows"
        )
    return Placed(np.array(stamps, np.int64)[kept], np.array(poses)[kept])


def has_no_common_gnss(topo: TopoMap, session: Session) -> bool:
    """Whether a run can be put into a map by its trees alone."""
    return topo.datum is None or len(session.streams.fix_ns) < LEAST_FIXES


def refuse_twice(topo: TopoMap, session: Session) -> None:
    """The same recording says nothing new.

    Raises:
        UsageError: it is in the map already.
    """
    if session.id in {s.name for s in topo.sessions}:
        raise UsageError(
            f"this recording is in the map already (session {session.id}): it would only seem to make it surer"
        )


AHEAD_NS = 100_000_000
"""Messages so much newer than a scan are heard with it, as live: wheels on both sides of it."""


def _messages(session: Session) -> Iterator[Odometry | Imu]:
    """The wheels and the IMU of a run, as they were recorded, in order of stamps."""
    s = session.streams
    child, imu = s.frames.get("child", ""), s.frames.get("imu", "")
    pose = np.concatenate([s.odom_T_child[:, :3, 3], to_quaternion(s.odom_T_child)], axis=1)
    i = 0
    for k, ns in enumerate(s.odometry_ns.tolist()):
        while i < len(s.imu_ns) and s.imu_ns[i] <= ns:
            yield Imu(int(s.imu_ns[i]), imu, s.gyro[i], s.accel[i])
            i += 1
        yield Odometry(ns, child, pose[k], s.twist[k])
    for j in range(i, len(s.imu_ns)):
        yield Imu(int(s.imu_ns[j]), imu, s.gyro[j], s.accel[j])


def spread(poses: Array) -> NDArray[np.int64]:
    """Rows of poses (F, 4, 4) that are at least `APART` from the one before."""
    kept: list[int] = []
    for k, p in enumerate(poses[:, :2, 3]):
        if not kept or np.linalg.norm(p - poses[kept[-1], :2, 3]) > APART:
            kept.append(k)
    return np.array(kept, np.int64)
