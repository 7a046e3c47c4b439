"""The small streams of a run as arrays in time order."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from topograph.bags import Fix, Heading, Imu, Odometry
from topograph.geometry import Array, Datum, Stamps, from_quaternion
from topograph.session.columns import Column, rising
from topograph.session.driven import driven


@dataclass(frozen=True, slots=True, kw_only=True)
class Streams:
    """All of a run but its scans; each block is sorted by stamp and may be empty.

    Attributes:
        odometry_ns, odom_T_child, twist: (O,), (O, 4, 4), (O, 6) linear (m/s), angular (rad/s). Where the driver fills in the twist
            alone, the poses are integrated from it.
        imu_ns, gyro, accel: (I,), (I, 3) rad/s, (I, 3) m/s², in the IMU's frame.
        fix_ns, lat_lon_h, fix_cov, fix_status: (F,), (F, 3), (F, 3, 3) m², (F,).
        heading_ns, heading, heading_sigma: (H,), (H,) rad, (H,) rad or NaN.
        frames: of "child", "imu", "fix" and "heading", as far as there are any.
    """

    odometry_ns: Stamps
    odom_T_child: Array
    twist: Array
    imu_ns: Stamps
    gyro: Array
    accel: Array
    fix_ns: Stamps
    lat_lon_h: Array
    fix_cov: Array
    fix_status: NDArray[np.int64]
    heading_ns: Stamps
    heading: Array
    heading_sigma: Array
    frames: dict[str, str]

    def without(self, kind: str) -> Streams:
        """The streams without one: "odometry", "imu", "fix" or "heading"."""
        of = {
            "odometry": ("odometry_ns", "odom_T_child", "twist"),
            "imu": ("imu_ns", "gyro", "accel"),
            "fix": ("fix_ns", "lat_lon_h", "fix_cov", "fix_status"),
            "heading": ("heading_ns", "heading", "heading_sigma"),
        }[kind]
        frame = "child" if kind == "odometry" else kind
        frames = {k: v for k, v in self.frames.items() if k != frame}
        return replace(self, frames=frames, **{name: getattr(self, name)[:0] for name in of})

    def fixes_enu(self) -> Array:
        """All fixes (F, 3) east, north, up of their median, m: a frame to compare them with the wheels in, not the map's."""
        if not len(self.fix_ns):
            return np.zeros((0, 3))
        return Datum(*(float(v) for v in np.median(self.lat_lon_h, axis=0))).to_enu(self.lat_lon_h)

    def fix_sigma(self) -> Array:
        """(F,) the larger horizontal standard deviation of each fix as stated, m."""
        return np.asarray(np.sqrt(self.fix_cov[:, [0, 1], [0, 1]].max(axis=1)))


UNSOUND = "not finite, or no rotation"


def _sound(m: Odometry | Imu | Fix | Heading) -> bool:
    """It holds numbers that mean something."""
    if isinstance(m, Imu):
        values = np.concatenate([m.gyro, m.accel])
    elif isinstance(m, Odometry):
        values = np.concatenate([m.odom_T_child, m.twist])
        if not 1e-6 < np.abs(m.odom_T_child[3:]).max() < 1e3:  # False for NaN
            return False
    elif isinstance(m, Heading):
        values = np.array([m.yaw])
    else:
        return True  # fixes have a door of their own
    return bool((np.abs(values) < 1e9).all())


class StreamsBuilder:
    """Collects messages as they come: the many in columns, the few as they are."""

    def __init__(self) -> None:
        self.odometry, self.imu = Column(13), Column(6)
        self.fixes: list[Fix] = []
        self.headings: list[Heading] = []
        self.unsound: Counter[str] = Counter()

    def add(self, message: Odometry | Imu | Fix | Heading) -> None:
        """Append one message; what is not finite is passed over and counted (recordings have been through such a door already)."""
        if not _sound(message):
            self.unsound[f"{type(message).__name__.lower()}: {UNSOUND}"] += 1
            return
        if isinstance(message, Imu):
            self.imu.add(message.stamp_ns, message.frame, message.gyro, message.accel)
        elif isinstance(message, Odometry):
            self.odometry.add(message.stamp_ns, message.child_frame, message.odom_T_child, message.twist)
        elif isinstance(message, Fix):
            self.fixes.append(message)
        else:
            self.headings.append(message)

    def build(self, skipped: Counter[str]) -> Streams:
        """Arrays in time order; repeated stamps and unusable fixes are dropped and counted."""
        skipped.update(self.unsound)
        odometry_ns, moved, odometry_again = self.odometry.in_order()
        imu_ns, felt, imu_again = self.imu.in_order()
        skipped.update({f"{k}: {REPEATED}": n for k, n in (("odometry", odometry_again), ("imu", imu_again)) if n})
        fixes = _moving([f for f in map(_flat, _in_order(self.fixes, "fix", skipped)) if _usable(f, skipped)], skipped)
        headings = _in_order(self.headings, "heading", skipped)
        frames = {name: stream.frame for name, stream in (("child", self.odometry), ("imu", self.imu)) if len(stream)}
        frames |= {name: few[0].frame for name, few in (("fix", fixes), ("heading", headings)) if few}
        poses = from_quaternion(moved[:, :3], moved[:, 3:7]) if len(moved) else np.zeros((0, 4, 4))
        return Streams(
            odometry_ns=odometry_ns,
            odom_T_child=driven(odometry_ns, poses, moved[:, 7:]),
            twist=moved[:, 7:].copy(),
            imu_ns=imu_ns,
            gyro=felt[:, :3].copy(),
            accel=felt[:, 3:].copy(),
            fix_ns=np.array([f.stamp_ns for f in fixes], np.int64),
            lat_lon_h=np.array([f.lat_lon_h for f in fixes]).reshape(-1, 3),
            fix_cov=np.array([f.cov for f in fixes]).reshape(-1, 3, 3),
            fix_status=np.array([f.status for f in fixes], np.int64),
            heading_ns=np.array([h.stamp_ns for h in headings], np.int64),
            heading=np.array([h.yaw for h in headings]),
            heading_sigma=np.array([h.sigma for h in headings]),
            frames=frames,
        )


REPEATED = "repeated stamp"
_P = TypeVar("_P", Fix, Heading)


def _in_order(products: list[_P], name: str, skipped: Counter[str]) -> list[_P]:
    rows = rising(np.array([p.stamp_ns for p in products], np.int64))
    if len(rows) < len(products):
        skipped[f"{name}: {REPEATED}"] += len(products) - len(rows)
    return [products[k] for k in rows.tolist()]


HIGHEST = 20_000.0
"""m; above (or as far below), and where it is not finite, an altitude is none."""
NO_HEIGHT = 1e4
"""Variance of the height of a fix without altitude, m²."""
UNKNOWN = -2
"""NavSatStatus: it says that the receiver does not tell: its covariance does."""


def _flat(f: Fix) -> Fix:
    """The fix without its altitude, where that is no altitude: the position is as good as ever."""
    if np.isfinite(f.lat_lon_h[2]) and abs(f.lat_lon_h[2]) < HIGHEST:
        return f
    cov = np.zeros((3, 3))
    cov[:2, :2], cov[2, 2] = f.cov[:2, :2], NO_HEIGHT
    return replace(f, lat_lon_h=np.array([*f.lat_lon_h[:2], 0.0]), cov=cov)


FROZEN = 8
"""So many fixes in a row at one place to the last bit are a receiver that repeats itself."""


def _moving(fixes: list[Fix], skipped: Counter[str]) -> list[Fix]:
    """Fixes without repetitions of a receiver that froze; the first of them stays."""
    out: list[Fix] = []
    run: list[Fix] = []
    for f in [*fixes, None]:
        if run and (f is None or not np.array_equal(f.lat_lon_h, run[0].lat_lon_h)):
            keep = run[:1] if len(run) >= FROZEN else run
            if len(run) > len(keep):
                skipped["fix: position repeated (frozen)"] += len(run) - len(keep)
            out += keep
            run = []
        if f is not None:
            run.append(f)
    return out


def _usable(f: Fix, skipped: Counter[str]) -> bool:
    variance = np.diag(f.cov)
    lat, lon = f.lat_lon_h[:2]
    if f.status < 0 and f.status != UNKNOWN:
        skipped["fix: status says no fix"] += 1
    elif not np.isfinite(f.lat_lon_h).all() or abs(lat) > 90 or abs(lon) > 360:
        skipped["fix: position not finite"] += 1
    elif abs(lat) < 1e-9 and abs(lon) < 1e-9:
        skipped["fix: position is 0, 0"] += 1
    elif (
        not np.isfinite(variance).all()
        or (variance < 0).any()
        or variance[:2].max() > 1e4
        or (np.abs(f.cov - np.diag(variance))[:2, :2].max() > 0.999 * variance[:2].max() and variance[:2].max() > 0)
    ):
        skipped["fix: absurd covariance"] += 1
    else:
        return True
    return False
