"""The live door: messages in, poses out. A robot node is ten lines around it (examples/ros_node.py)."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from topograph.bags import Imu, Odometry, Scan, Trunks
from topograph.errors import InsufficientDataError
from topograph.geometry import Array, from_xyz_rpy, transform, yaw_of
from topograph.localize.belief import Belief
from topograph.localize.config import LocalizeConfig
from topograph.localize.engine import Engine
from topograph.localize.method import Fix, Method, Report
from topograph.localize.submap import Move, Sweep, open_to
from topograph.motion import Leg, Reckoner
from topograph.places.index import build_index
from topograph.topomap import TopoMap
from topograph.trees import SlipWatch
from topograph.trunks import none_at

if TYPE_CHECKING:  # loading it takes a second, and recorded trunks do without
    from topograph.trunks.frontend import FrontEnd

UNKNOWN_TILT = 0.12
"""Deviation of roll and pitch on the slopes of orchards, rad, where no IMU tells them."""
HEADING_FLOOR = 0.004
"""Least deviation of a heading from trees for learning the gyro's bias, rad: its errors last over many scans."""

REMEMBERED = 1000
"""Recorded detections whose middle height is that of all: of some dozens of scans."""
AXIS_SIGMA = 0.05
"""Of the axis that one scan states, rad."""

log = logging.getLogger(__name__)

FAR_AHEAD_NS = 600_000_000_000
"""No scan is so long in coming; several in a row, and it is the clock that was set."""
UNKNOWN_S = 1.0
"""Of driving that a clock which was set back hides."""
CLOCK_SET = 3
"""So many scans in a row that are older than the last one: it is the clock that was set back."""


class Localizer:
    """Where the robot is in a map, from trunks and dead reckoning, without GNSS and from anywhere.

    Args:
        topo: the map.
        config: settings; `config.risk` is the chance of a wrong pose that is accepted.
        front_end: scan -> trunks in `base_link`; needed only when scans are fed.
        child_T_robot: (4, 4), from odometry's child frame to `base_link`.
        robot_R_imu: (3, 3), the IMU's mounting; None: from gravity.
        method: another method than the default (`thesis.ThesisMethod`).

    Attributes:
        report: what is believed since the last scan, also while there is no pose.
    """

    def __init__(
        self, topo: TopoMap, config: LocalizeConfig | None = None, *, front_end: FrontEnd | None = None,
        child_T_robot: Array | None = None, robot_R_imu: Array | None = None, method: Method | None = None,
    ) -> None:  # fmt: skip
        if len(topo) < 2:
            raise InsufficientDataError(f"a map of {len(topo)} trees cannot be localized in: map more of the orchard")
        self.config = config or LocalizeConfig()
        self.method = method or GraphMethod(topo, self.config)
        self.reckoner = Reckoner(child_T_robot, robot_R_imu)
        self.report: Report | None = None
        self._front_end = front_end
        self._heard_ns = 0
        self._old = self._ahead = 0

    def update(self, scan: Scan | Trunks, odometry: Iterable[Odometry | Imu] = ()) -> Fix | None:
        """One scan, and the odometry and IMU messages since the last one; the pose at the scan's stamp, or None.

        Messages that are newer than the scan may be among them; they are kept for the next one. A scan that is older than the
        last one changes nothing.
        """
        for m in odometry:
            self.reckoner.add(m)
            if self._front_end is not None:
                self._front_end.hear(m)
            self._heard_ns = m.stamp_ns
        if scan.stamp_ns <= 0 and self._heard_ns > 0:
            scan = replace(scan, stamp_ns=self._heard_ns)  # a driver that does not stamp: the newest message's time
        ahead = 0 if self.report is None else scan.stamp_ns - max(self.report.stamp_ns, self._heard_ns)
        self._ahead = self._ahead + 1 if ahead > FAR_AHEAD_NS else 0
        if self._ahead and self._ahead < CLOCK_SET:
            log.warning("a scan is stamped %.0f s ahead of all that came: passed over", ahead * 1e-9)
            return None
        if self._ahead:
            self.reckoner.restart(scan.stamp_ns)
        if self.report is not None and scan.stamp_ns < self.report.stamp_ns:
            self._old += 1
            if self._old < CLOCK_SET:
                return self.report.fix if self._old == 1 else None
            self.reckoner.restart(scan.stamp_ns)
        restarted, self._old = self._old >= CLOCK_SET or self._ahead > 0, 0
        if isinstance(scan, Scan):
            scan = self._seen(scan)
        self.leg = self.reckoner.advance(scan.stamp_ns)
        if restarted:  # how long it took until the clock was set is not known
            self.leg = replace(self.leg, blind=UNKNOWN_S, gyro=False)
        self.report = self.method.step(scan, self.leg)
        fix = self.report.fix
        if getattr(self.method, "contradicted", False):
            self.reckoner.forget_stretch()
        if fix is not None and np.isfinite(fix.cov[2, 2]):
            x, y = fix.map_T_robot[:2, 3]
            self.reckoner.hold(
                np.array([x, y, yaw_of(fix.map_T_robot)]), max(float(np.sqrt(fix.cov[2, 2])), HEADING_FLOOR)
            )
        return fix

    def _seen(self, scan: Scan) -> Trunks:
        """The trunks of a scan; one that breaks the front end shows nothing."""
        if self._front_end is None:
            raise TypeError("a Localizer that is fed scans needs a `front_end`")
        try:
            return self._front_end.see(scan)
        except (ArithmeticError, ValueError, IndexError, np.linalg.LinAlgError) as err:
            log.warning("the scan of %.3f s broke the front end: %r", scan.stamp_ns * 1e-9, err)
            return none_at(scan.stamp_ns)


GROUND_SIGMA = 0.08
"""What the grounds that a sweep sees under its trees are off by in common (grass, slope within a cell), m."""


SHARED = 0.7
"""Of the deviation of the best known tree in view, what its neighbours have in common with it, having been mapped from the same stretch of path: thirty of
them do not take it away."""
STAMPS_S = 0.01
"""What stamps of scans are off by against those of the wheels; a robot that stands owes it nothing. (Both: runs in orchards of another simulator than ours,
30 trees in view, poses 2 cm off: NEES 10-30 without, 1-7 with them.)"""


@dataclass(slots=True)
class _Common:
    """What the trees in view have in common, and no number of them takes away.

    Attributes:
        place: variance of their places in the map, m².
        ground: of the ground under them, m², a running mean.
        above: height above the base at which they are seen, m.
    """

    place: float = 0.0
    ground: float = GROUND_SIGMA**2
    above: float = 0.0


class GraphMethod:
    """Ours: submap, search, evidence, track (see `Engine`), lifted from the plane to six degrees of freedom."""

    def __init__(self, topo: TopoMap, config: LocalizeConfig) -> None:
        self.topo, self.config = topo, config
        self.engine: Engine | None = None
        self._tilt = np.zeros(3)  # z of the base in the map (m), and roll and pitch (rad) beyond what gravity says
        self._tilt_cov = np.diag([100.0, 0.0, 0.0])
        self._vertical = np.array([0.0, 0.0, 1.0])
        self._row = row_direction(topo)
        self._slip = SlipWatch()
        self.contradicted = False
        self._last_p = np.zeros((0, 3))
        self._common = _Common()
        self._above: deque[float] = deque(maxlen=REMEMBERED)

    def _stated(self, trunks: Trunks) -> Array:
        """Heights (N,) above ground at which a scan's trunks are stated, m. Recorded detections lie at one height, which each scan says from the
        ground that the robot stands on, as if it went on like that: all scans together say it better.
        """
        if len(trunks.kinds):  # our own front end measures each
            return trunks.height
        self._above.extend(trunks.height[np.isfinite(trunks.height)].tolist())
        return np.full(len(trunks), np.median(self._above) if self._above else np.nan)

    def _begin(self, heights: Array) -> Engine:
        """The index is built at the height (of `heights`, (N,)) at which this front end states its trunks."""
        above = heights[np.isfinite(heights)]
        self.height = float(np.median(above)) if len(above) else 0.0
        t = self.topo
        p, cov = t.above_ground(self.height)
        var = 0.5 * (cov[:, 0, 0] + cov[:, 1, 1])
        var = np.where(
            np.isfinite(var), np.clip(var - 0.5 * np.trace(t.datum_cov[:2, :2]), 0.0, 1.0), self.config.map_unknown**2
        )
        return Engine(
            build_index(p[:, :2], var, t.diameter, self.config.view, self.config.pair, self.config.map_sigma),
            self.config,
        )

    def remember(self, former: GraphMethod) -> None:
        """What another method has learnt of this detector."""
        self._above.extend(former._above)

    def begin_at(self, map_T_robot: Array, cov: Array, trunks: Trunks) -> None:
        """Track from a pose (4, 4) that somebody else is sure of, with the covariance (3, 3) of its x, y and yaw; `trunks` say at
        which height this front end states them.
        """
        self.engine = self._begin(self._stated(trunks))
        self.engine.begin_at(np.array([*map_T_robot[:2, 3], yaw_of(map_T_robot)]), cov)
        self._tilt[:] = map_T_robot[2, 3], 0.0, 0.0
        tilt = 0.02**2
        self._tilt_cov[:] = np.diag([0.1**2, tilt, tilt])

    def step(self, trunks: Trunks, leg: Leg) -> Report:
        """One scan further."""
        if len(trunks) and leg.seconds > 0 and np.array_equal(trunks.p, self._last_p):
            trunks = trunks.select(np.zeros(len(trunks), bool))  # a driver that repeats itself: nothing was seen
        else:
            self._last_p = trunks.p
        heights = self._stated(trunks)
        if self.engine is None:
            if not len(trunks):
                return Report(
                    stamp_ns=trunks.stamp_ns, state="searching", fix=None, hypotheses=0, risk=1.0, places=np.zeros((0, 3)),
                    trees=np.zeros(0, np.int64), pairs=np.zeros((0, 2), np.int64), along=np.nan, across=np.nan,
                )  # fmt: skip
            self.engine = self._begin(heights)
        if not leg.level:
            leg = self._upright(leg, trunks)
        level_T_robot = from_xyz_rpy(0, 0, 0, leg.roll, leg.pitch, 0)
        flat = transform(level_T_robot, trunks.p) if len(trunks) else np.zeros((0, 3))
        watched = self._slip.check(flat, leg)
        self.move = move_of(watched, self.config)
        self.sweep, rows = sweep_of(trunks, level_T_robot, leg, self.config, np.nan_to_num(heights - self.height))
        if len(rows):
            self._common.above = float(np.median(np.abs(flat[rows, 2])))
        self.contradicted = watched is not leg
        belief = self.engine.step(
            move_of(leg, self.config),
            self.sweep,
            self.move if self.contradicted else None,
            self._slip.slips,
            self._slip.stands,
        )
        self.sweep_pairs = belief.pairs
        belief = replace(belief, pairs=np.stack([rows[belief.pairs[:, 0]], belief.pairs[:, 1]], axis=1))
        if len(belief.pairs):
            self._common.place = SHARED**2 * float(self.engine.index.var[belief.pairs[:, 1]].min())
        self._rise(leg, belief, heights, flat)
        fix, flat_cov = None, belief.cov[:2, :2]
        if belief.pose is not None:
            map_T_robot, cov = self._placed(belief.pose, belief.cov, leg)
            flat_cov = cov[3:5, 3:5].copy()
            cov[3:, 3:] += np.nan_to_num(self.topo.datum_cov)  # where the map lies on Earth
            fix = Fix(trunks.stamp_ns, map_T_robot, cov, belief.risk)
        side = np.array([-self._row[1], self._row[0]])
        along, across = self._row @ flat_cov @ self._row, side @ flat_cov @ side
        ids = self.topo.ids[np.unique(belief.pairs[:, 1])]
        return Report(
            stamp_ns=trunks.stamp_ns,
            state=belief.state,
            fix=fix,
            hypotheses=belief.hypotheses,
            risk=belief.risk,
            places=belief.places,
            trees=ids,
            pairs=belief.pairs,
            along=float(np.sqrt(along)),
            across=float(np.sqrt(across)),
            weights=belief.weights,
            why=belief.why,
        )

    def _upright(self, leg: Leg, trunks: Trunks) -> Leg:
        """Without an IMU the trunks say which way is up: on average they grow vertically."""
        if len(trunks) >= 5 and (trunks.axis[:, 2] < 1.0 - 1e-9).any():
            up = np.median(trunks.axis, axis=0)
            if float(up[2]) > 0.5:  # False for NaN
                self._vertical += 0.5 * (up / np.linalg.norm(up) - self._vertical)
        x, y, z = self._vertical / np.linalg.norm(self._vertical)
        return replace(leg, roll=float(np.arctan2(y, z)), pitch=float(-np.arcsin(x)))

    def _rise(self, leg: Leg, belief: Belief, heights: Array, flat: Array) -> None:
        """Height, and what gravity leaves open of roll and pitch, from where known trees are seen at `heights` (N,) above their feet."""
        x, P = self._tilt, self._tilt_cov
        if belief.pose is None:
            x[:] = 0.0
            P[:] = np.diag([1e4, 0.0, 0.0])
            return
        if P[0, 0] > 1e3:
            tilt = (0.01 if leg.level else UNKNOWN_TILT) ** 2
            P[:] = np.diag([100.0, tilt, tilt])
        x[0] += leg.up
        drift = (0.001 if leg.level else 0.02) ** 2 * leg.distance
        P += np.diag([(0.03 * leg.distance) ** 2 + 1e-6, drift, drift])
        for i, t in belief.pairs:
            self._common.ground += 0.02 * (GROUND_SIGMA**2 + _known(self.topo.cov[t, 2, 2]) - self._common.ground)
            place = self.topo.p[t, 2] + (heights[i] if np.isfinite(heights[i]) else self.height)
            H = np.array([1.0, flat[i, 1], -flat[i, 0]])
            S = H @ P @ H + 0.12**2 + (0.01 * np.hypot(*flat[i, :2])) ** 2
            r = place - flat[i, 2] - H @ x
            if r * r < 12.0 * S:
                K = P @ H / S
                x += K * r
                P -= np.outer(K, H @ P)

    def _placed(self, pose: Array, flat_cov: Array, leg: Leg) -> tuple[Array, Array]:
        """map_T_robot (4, 4) of a `pose` (3,) in the plane, and what is open of it within the map, (6, 6)."""
        px, py, yaw = pose
        T = from_xyz_rpy(px, py, self._tilt[0], leg.roll + self._tilt[1], leg.pitch + self._tilt[2], yaw)
        cov = np.zeros((6, 6))
        cov[np.ix_([3, 4, 2], [3, 4, 2])] = flat_cov
        turn = np.eye(3)  # roll and pitch are the robot's; the map's axes are turned from them by its heading
        turn[1:, 1:] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
        cov[np.ix_([5, 0, 1], [5, 0, 1])] = turn @ self._tilt_cov @ turn.T
        cov[[0, 1], [0, 1]] += 0.01**2
        # Trunks that are seen so high above the base are shifted by the tilt, all alike.
        tilt = (leg.tilt_sigma if leg.level else UNKNOWN_TILT) * self._common.above
        cov[[3, 4], [3, 4]] += self._slip.standing**2 + self._common.place + tilt**2
        ahead = np.array([np.cos(yaw), np.sin(yaw)]) * STAMPS_S * leg.distance / max(leg.seconds, STAMPS_S)
        cov[3:5, 3:5] += np.outer(ahead, ahead)
        cov[5, 5] += self._common.ground
        return T, cov


def _known(variance: float) -> float:
    return float(variance) if np.isfinite(variance) else 0.0


def row_direction(topo: TopoMap) -> Array:
    """Unit vector (2,) along the rows; east where there are none."""
    total = np.zeros(2)
    for row in np.unique(topo.row[topo.row >= 0]):
        p = topo.p[topo.row == row, :2]
        if len(p) > 1:
            d = np.linalg.svd(p - p.mean(0))[2][0]
            total += d if d @ total >= 0 else -d
    n = float(np.linalg.norm(total))
    return total / n if n > 0 else np.array([1.0, 0.0])


def move_of(leg: Leg, config: LocalizeConfig) -> Move:
    """A leg's planar motion with its covariance."""
    c = config
    along = c.along * leg.distance + (c.step if leg.distance > 1e-4 else 1e-4)
    across = c.across * leg.distance + (c.step if leg.distance > 1e-4 else 1e-4)
    if leg.blind > 0:  # a robot drives at a walking pace
        along = across = float(np.hypot(along, 0.5 * leg.blind + 0.05))
    along, across = float(np.hypot(along, leg.slip)), float(np.hypot(across, leg.slip))
    if leg.gyro:
        yaw = np.hypot(c.yaw_gyro * leg.turned, c.yaw_rate * np.sqrt(max(leg.seconds, 0.0)))
        yaw = np.hypot(yaw, leg.rate_sigma * leg.seconds)
    else:
        yaw = np.hypot(c.yaw_wheels * leg.turned, c.yaw_distance * np.sqrt(leg.distance))
    if leg.blind > 0 and not leg.gyro:
        yaw = float(np.hypot(yaw, 0.3 * leg.blind + 0.02))
    return Move(leg.step, np.diag([along**2, across**2, yaw**2 + 1e-8]), leg.distance)


def sweep_of(
    trunks: Trunks, level_T_robot: Array, leg: Leg, config: LocalizeConfig, above: Array
) -> tuple[Sweep, NDArray[np.int64]]:
    """A scan's trunks seen from above, in the levelled robot frame, and their rows. They are stated `above` (N,) the height at which the map's
    trees are compared, m, and brought down to it along their own axes.
    """
    if not len(trunks):
        return Sweep(np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros(0), np.zeros(0)), np.zeros(0, np.int64)
    R = level_T_robot[:3, :3]
    axis = trunks.axis @ R.T
    p = trunks.p @ R.T - (above / np.maximum(axis[:, 2], 0.3))[:, None] * axis
    across = np.eye(3) - trunks.axis[:, :, None] * trunks.axis[:, None, :]  # along itself a trunk may be anywhere
    sound = np.isfinite(trunks.cov).all(axis=(1, 2))
    sound &= np.asarray(np.diagonal(trunks.cov, axis1=1, axis2=2) >= 0).all(axis=1)
    cov = across @ np.where(np.reshape(sound, (-1, 1, 1)), trunks.cov, 0.0) @ across
    flat = np.array((R @ cov @ R.T)[:, :2, :2])
    flat[:, [0, 1], [0, 1]] += ((AXIS_SIGMA * above) ** 2)[:, None]
    reach = np.hypot(p[:, 0], p[:, 1])
    least = (0.02 + 0.001 * reach) ** 2
    if not leg.level:
        least = least + (reach * config.planar_tilt**2) ** 2
    flat[:, [0, 1], [0, 1]] = np.maximum(flat[:, [0, 1], [0, 1]], least[:, None])
    torn = np.atleast_1d(
        flat[:, 0, 1] ** 2 >= flat[:, 0, 0] * flat[:, 1, 1]
    )  # no covariance: only its size is believed
    flat[torn, 0, 1] = flat[torn, 1, 0] = 0.0
    ok = np.isfinite(p).all(axis=1) & (reach > 0.3) & trunks.likely
    sweep = Sweep(p[ok, :2], flat[ok], trunks.diameter[ok], np.full(int(ok.sum()), 0.04**2), open_to(trunks.free))
    return sweep, np.flatnonzero(ok)
