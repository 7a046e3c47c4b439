"""Injected faults: does a bad recording give a right map, or is it said?  python tools/faults.py [NAME...] [--seed 2101] [--every 1]

A simulated run with trunk detections is written anew with one fault each (clocks, frames, GNSS, IMU, wheels, topics, mountings, things that move),
mapped, and held against the truth. Wrong is a tree more than 10 cm off at more than three of its stated deviations, or a tree that is none.
Ends with the counts: right and called sound, right but doubted, wrong and said, refused, WRONG without a word, lost messages, tracebacks.
"""

from __future__ import annotations

import argparse
import tempfile
import traceback
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from itertools import pairwise
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from topograph.bags import Fix, Heading, Imu, Odometry, Recording, Trunks
from topograph.bags.writer import BagWriter
from topograph.config import Config
from topograph.errors import TopographError
from topograph.evaluate import Truth
from topograph.evaluate.metrics import tree_errors
from topograph.geometry import from_xyz_rpy, interpolate, inverse, transform
from topograph.pipeline import audited, read_run, solve_run, topo_map
from topograph.simulate import DESIGNS, DriveConfig, SensorConfig, record
from topograph.simulate.sensors import MOUNTS

S = 1_000_000_000
YEAR = 365 * 86400 * S
TOPICS = {"odometry": "/odom", "imu": "/imu/data", "fix": "/gnss/fix", "heading": "/gnss/heading", "trunks": "/trunks"}


@dataclass
class Event:
    """One message: its kind, time of recording, and product; `topic` where it is not the kind's own."""

    kind: str
    log_ns: int
    it: Any
    topic: str = ""


@dataclass
class Bag:
    """All that is written: events, mounts (child -> base_T_child), and what the fault must not touch: start and length, s."""

    events: list[Event]
    mounts: dict[str, np.ndarray]
    start_ns: int
    seconds: float
    truth: Truth

    def at(self, e: Event) -> float:
        """Seconds into the run."""
        return (e.it.stamp_ns - self.start_ns) * 1e-9

    def of(self, kind: str) -> list[Event]:
        return [e for e in self.events if e.kind == kind]


Fault = Callable[[Bag, np.random.Generator], None]
FAULTS: dict[str, Fault] = {}


class _Writer(BagWriter):
    """Takes poses as (7,) too, whatever is in them."""

    def _pose(self, T: Any) -> Any:
        if np.shape(T) == (7,):
            return self._msg("geometry_msgs/msg/Pose", position=self._point(T[:3]), orientation=self._quaternion(T[3:]))
        return super()._pose(T)


def write(bag: Bag, path: Path) -> None:
    """The bag as a recording."""
    with _Writer(path) as w:
        first = min((e.log_ns for e in bag.events), default=bag.start_ns)
        if bag.mounts:
            w.tf_static(first, {("base_link", k): T for k, T in bag.mounts.items()})
        for e in sorted(bag.events, key=lambda e: e.log_ns):
            m, topic = e.it, e.topic or TOPICS[e.kind]
            if isinstance(m, Odometry):
                w.odometry(topic, e.log_ns, m.stamp_ns, ("odom", m.child_frame), m.odom_T_child, m.twist)
            elif isinstance(m, Imu):
                w.imu(topic, e.log_ns, m.stamp_ns, m.frame, m.gyro, m.accel)
            elif isinstance(m, Fix):
                w.fix(topic, e.log_ns, m.stamp_ns, m.frame, m.lat_lon_h, m.cov, m.status)
            elif isinstance(m, Heading):
                q = (
                    np.array([0, 0, np.sin(m.yaw / 2), np.cos(m.yaw / 2)])
                    if np.isfinite(m.yaw)
                    else np.full(4, m.sigma)
                )
                w.heading(topic, e.log_ns, m.stamp_ns, m.frame, q)
            else:
                z = np.array([0.0, 0.0, 1.0])
                v = np.cross(z, m.axis)
                n = np.linalg.norm(v, axis=1, keepdims=True)
                q = (
                    Rotation.from_rotvec(v / np.maximum(n, 1e-12) * np.arctan2(n, m.axis[:, 2:])).as_quat()
                    if len(m)
                    else np.zeros((0, 4))
                )
                w.trunks(topic, e.log_ns, m.stamp_ns, m.frame, m.p, np.nan_to_num(m.diameter), q)


def base(seed: int, folder: Path) -> Bag:
    """A clean run of a minute: RTK at 5 Hz, heading, IMU, wheels, trunks at 10 Hz."""
    path = folder / f"base_{seed}"
    orchard = replace(DESIGNS["olive"], rows=3, columns=5, multi_stem=0.0)
    if not path.exists():
        record(path, seed, orchard, DriveConfig(run=1, longest_s=60.0), SensorConfig(detections=True))
    truth = Truth.load(folder / f"base_{seed}.truth")
    with Recording([path]) as r:
        events = [Event(kind, r.log_ns, product) for kind, product in r.messages()]
    start = min(e.it.stamp_ns for e in events)
    return Bag(events, dict(MOUNTS), start, max(e.it.stamp_ns for e in events) * 1e-9 - start * 1e-9, truth)


# -- the faults -----------------------------------------------------------------------------------------------------


def fault(name: str) -> Callable[[Fault], Fault]:
    def keep(f: Fault) -> Fault:
        assert name not in FAULTS, name
        FAULTS[name] = f
        return f

    return keep


def each(kind: str, change: Callable[[Any, float], Any], when: Callable[[float], bool] = lambda t: True) -> Fault:
    """Change every message of a kind; None removes it."""

    def run(bag: Bag, rng: np.random.Generator) -> None:
        out = []
        for e in bag.events:
            if e.kind == kind and when(bag.at(e)):
                new = change(e.it, bag.at(e))
                if new is None:
                    continue
                e = Event(e.kind, e.log_ns, new, e.topic)
            out.append(e)
        bag.events = out

    return run


def _clocks() -> None:
    for kind in ("trunks", "odometry", "imu", "fix", "heading"):
        for dt in (-0.5, -0.05, 0.05, 0.2, 0.5, 1.0, 5.0):
            FAULTS[f"clock {kind} {dt:+g} s"] = each(
                kind, lambda m, t, dt=dt: replace(m, stamp_ns=m.stamp_ns + int(dt * S))
            )

        def uptime(bag: Bag, rng: np.random.Generator, kind: str = kind) -> None:
            each(kind, lambda m, t: replace(m, stamp_ns=int(m.stamp_ns - bag.start_ns + 1000 * S)))(bag, rng)

        FAULTS[f"uptime clock {kind}"] = uptime
        FAULTS[f"zero stamps {kind}"] = each(kind, lambda m, t: replace(m, stamp_ns=0))
        for ahead, what in ((3600 * S, "an hour"), (YEAR, "a year")):

            def one(
                bag: Bag, rng: np.random.Generator, kind: str = kind, ahead: int = ahead, first: bool = False
            ) -> None:
                mine = bag.of(kind)
                e = mine[0 if first else len(mine) // 3]
                e.it = replace(e.it, stamp_ns=e.it.stamp_ns + ahead)

            FAULTS[f"one {kind} stamp {what} ahead"] = one
            FAULTS[f"first {kind} stamp {what} ahead"] = lambda b, r, one=one: one(b, r, first=True)

    def all_jump(by: float) -> Fault:
        def run(bag: Bag, rng: np.random.Generator) -> None:
            for e in bag.events:
                if bag.at(e) > 30:
                    e.it = replace(e.it, stamp_ns=e.it.stamp_ns + int(by * S))

        return run

    for by in (-5.0, -0.5, 30.0, 3600.0):
        FAULTS[f"all clocks jump {by:+g} s half way"] = all_jump(by)

    for kind in ("trunks", "odometry", "imu", "fix", "heading"):
        for dt, what in ((18.0, "GPS without leap seconds"), (37.0, "TAI")):
            FAULTS[f"{what} clock {kind}"] = each(
                kind, lambda m, t, dt=dt: replace(m, stamp_ns=m.stamp_ns + int(dt * S))
            )

    def stall(kinds: tuple[str, ...], seconds: float) -> Fault:
        def run(bag: Bag, rng: np.random.Generator) -> None:
            late = bag.start_ns + int((30 + seconds) * S)
            for n, e in enumerate(sorted(bag.events, key=lambda e: e.log_ns)):
                if e.kind in kinds and bag.start_ns + 30 * S < e.log_ns < late:
                    e.log_ns = late + 1000 * n

        return run

    for seconds in (3.0, 8.0):
        FAULTS[f"recorder stalls for {seconds:g} s"] = stall(tuple(TOPICS), seconds)
        FAULTS[f"GNSS link stalls for {seconds:g} s"] = stall(("fix", "heading"), seconds)

    def host_set(bag: Bag, rng: np.random.Generator) -> None:
        for e in bag.events:
            if bag.at(e) > 30:
                e.log_ns += 7200 * S
        all_jump(7200.0)(bag, rng)

    FAULTS["host clock set by 2 h, stamps and all"] = host_set

    @fault("uptime clock everywhere")
    def _(bag: Bag, rng: np.random.Generator) -> None:
        for e in bag.events:
            e.it = replace(e.it, stamp_ns=e.it.stamp_ns - bag.start_ns + 1000 * S)
        t = bag.truth
        bag.truth = replace(t, stamps_ns=t.stamps_ns - bag.start_ns + 1000 * S)

    @fault("each message twice")
    def _(bag: Bag, rng: np.random.Generator) -> None:
        bag.events = bag.events + [Event(e.kind, e.log_ns + 1000, e.it) for e in bag.events]

    for late in (0.2, 0.9):

        def shuffle(bag: Bag, rng: np.random.Generator, late: float = late) -> None:
            for e in bag.events:
                e.log_ns += int(rng.uniform(0, late) * S)

        FAULTS[f"arrival shuffled by {late} s"] = shuffle


def _topics() -> None:
    for kind in ("trunks", "odometry", "imu", "fix", "heading"):
        FAULTS[f"no {kind}"] = each(kind, lambda m, t: None)
        FAULTS[f"{kind} stops half way"] = each(kind, lambda m, t: None, lambda t: t > 30)
        FAULTS[f"{kind} starts half way"] = each(kind, lambda m, t: None, lambda t: t < 30)
        FAULTS[f"{kind} gap of 8 s"] = each(kind, lambda m, t: None, lambda t: 20 < t < 28)

        def thin(bag: Bag, rng: np.random.Generator, kind: str = kind) -> None:
            bag.events = [e for e in bag.events if e.kind != kind or rng.random() < 0.2]

        FAULTS[f"{kind} loses 80 %"] = thin

        def two(bag: Bag, rng: np.random.Generator, kind: str = kind) -> None:
            bag.events += [Event(e.kind, e.log_ns, e.it, "/other") for e in bag.of(kind)]

        FAULTS[f"two {kind} topics"] = two


def _mount(name: str, pose: tuple[float, ...], after: bool = True) -> Fault:
    def run(bag: Bag, rng: np.random.Generator) -> None:
        bag.mounts[name] = bag.mounts.get(name, np.eye(4)) @ from_xyz_rpy(*pose) if after else from_xyz_rpy(*pose)

    return run


def _frames() -> None:
    @fault("no tf")
    def _(bag: Bag, rng: np.random.Generator) -> None:
        bag.mounts = {}

    for kind in ("imu", "fix", "heading", "trunks"):
        FAULTS[f"{kind} frame unknown"] = each(kind, lambda m, t: replace(m, frame="nowhere"))
        FAULTS[f"{kind} frame empty"] = each(kind, lambda m, t: replace(m, frame=""))
    FAULTS["odometry child unknown"] = each("odometry", lambda m, t: replace(m, child_frame="wheels"))
    pi = np.pi
    poses = {"yaw 180": (0, 0, 0, 0, 0, pi), "yaw 90": (0, 0, 0, 0, 0, pi / 2), "yaw 5": (0, 0, 0, 0, 0, 0.087),
             "upside down": (0, 0, 0, pi, 0, 0), "x + 1 m": (1, 0, 0, 0, 0, 0), "y + 0.3 m": (0, 0.3, 0, 0, 0, 0), "pitch 10": (0, 0, 0, 0, 0.17, 0)}  # fmt: skip
    for frame in ("imu_link", "gnss", "gnss_baseline"):
        for what, pose in poses.items():
            if frame == "imu_link" and "m" in what.split()[-1]:
                continue
            FAULTS[f"{frame} {what}"] = _mount(frame, pose)
    for what, pose in poses.items():  # the trunks' sensor as it is really mounted, and the mount that TF tells of it

        def lidar(bag: Bag, rng: np.random.Generator, pose: tuple[float, ...] = pose) -> None:
            real = inverse(from_xyz_rpy(*pose))
            for e in bag.of("trunks"):
                m = e.it
                e.it = replace(m, p=transform(real, m.p), axis=m.axis @ real[:3, :3].T)

        FAULTS[f"trunks' mount {what}"] = lidar


def _gnss() -> None:
    def of(change: Callable[[Fix, float], Any], when: Callable[[float], bool] = lambda t: True) -> Fault:
        return each("fix", change, when)

    FAULTS["fix status -1"] = of(lambda m, t: replace(m, status=-1))
    FAULTS["fix status -2 (unknown)"] = of(lambda m, t: replace(m, status=-2))
    FAULTS["fix status 0"] = of(lambda m, t: replace(m, status=0))
    for name, value in (("NaN", np.nan), ("0", 0.0), ("inf", np.inf), ("1e300", 1e300), ("95", 95.0)):
        FAULTS[f"fix lat, lon {name}"] = of(
            lambda m, t, v=value: replace(m, lat_lon_h=np.array([v, v, m.lat_lon_h[2]]))
        )
    for name, value in (("NaN", np.nan), ("-2e10", -2e10), ("+500", 500.0)):
        FAULTS[f"fix altitude {name}"] = of(lambda m, t, v=value: replace(m, lat_lon_h=np.array([*m.lat_lon_h[:2], v])))
    FAULTS["fix -2e10 for 4 s"] = of(lambda m, t: replace(m, lat_lon_h=np.full(3, -2e10)), lambda t: t < 4)
    FAULTS["fix altitude jumps 40 m half way"] = _moved(lambda t: [0, 0, 40.0 * (t > 30)])
    FAULTS["fix lat and lon swapped"] = of(lambda m, t: replace(m, lat_lon_h=m.lat_lon_h[[1, 0, 2]]))
    for name, cov in (("zeros", np.zeros((3, 3))), ("1e-10", 1e-10 * np.eye(3)), ("1e8", 1e8 * np.eye(3)), ("NaN", np.full((3, 3), np.nan)),
                      ("inf", np.full((3, 3), np.inf)), ("negative", -np.eye(3)), ("not PSD", np.ones((3, 3)) * 4 - 3.9 * np.eye(3)), ("25 m2", 25 * np.eye(3))):  # fmt: skip
        FAULTS[f"fix covariance {name}"] = of(lambda m, t, c=cov: replace(m, cov=c))
    for by in (0.5, 1.0, 2.0, 5.0, 10.0):
        FAULTS[f"fix jumps {by} m for 8 s"] = _moved(lambda t, by=by: [by * (20 < t < 28), 0, 0])
        FAULTS[f"fix jumps {by} m half way"] = _moved(lambda t, by=by: [by * (t > 30), 0, 0])
        FAULTS[f"fix jumps {by} m until half way"] = _moved(lambda t, by=by: [0, by * (t < 30), 0])
    FAULTS["fix jumps 2 m for the last third"] = _moved(lambda t: [0, 2.0 * (t > 40), 0])
    FAULTS["fix ramp to 2 m"] = _moved(lambda t: [t / 30, 0, 0])
    FAULTS["fix ramp to 2 m and back"] = _moved(lambda t: [2 * max(0, 1 - abs(t - 30) / 10), 0, 0])
    FAULTS["fix wanders by 1 m"] = _moved(lambda t: [np.sin(t / 4), np.cos(t / 5), 0])
    for share in (0.2, 0.4, 0.6):

        def outliers(bag: Bag, rng: np.random.Generator, share: float = share) -> None:
            _moved(lambda t: 5 * rng.normal(size=3) * (rng.random() < share))(bag, rng)

        FAULTS[f"fix {100 * share:.0f} % outliers of 5 m"] = outliers

    @fault("fix frozen")
    def _(bag: Bag, rng: np.random.Generator) -> None:
        first = bag.of("fix")[0].it
        each("fix", lambda m, t: replace(m, lat_lon_h=first.lat_lon_h))(bag, rng)

    FAULTS["two fixes"] = of(lambda m, t: None, lambda t: t > 0.5)
    FAULTS["fixes of the first second"] = of(lambda m, t: None, lambda t: t > 1.0)
    FAULTS["heading clockwise from north"] = each("heading", lambda m, t: replace(m, yaw=np.pi / 2 - m.yaw))
    for off in (10, 45, 90, 180):
        FAULTS[f"heading off by {off}"] = each("heading", lambda m, t, off=off: replace(m, yaw=m.yaw + np.radians(off)))
    FAULTS["heading NaN"] = each("heading", lambda m, t: replace(m, yaw=np.nan, sigma=np.nan))
    FAULTS["heading quaternion zero"] = each("heading", lambda m, t: replace(m, yaw=np.nan, sigma=0.0))
    FAULTS["heading frozen"] = each("heading", lambda m, t: replace(m, yaw=0.3))


def _moved(by: Callable[[float], Any]) -> Fault:
    """Fixes moved by metres east, north, up."""

    def run(bag: Bag, rng: np.random.Generator) -> None:
        datum = bag.truth.datum
        for e in bag.of("fix"):
            enu = datum.to_enu(e.it.lat_lon_h[None])[0] + np.asarray(by(bag.at(e)), float)
            e.it = replace(e.it, lat_lon_h=datum.to_geodetic(enu[None])[0])

    return run


def _imu() -> None:
    def of(change: Callable[[Imu, float], Any], when: Callable[[float], bool] = lambda t: True) -> Fault:
        return each("imu", change, when)

    FAULTS["imu gap of 2 s"] = of(lambda m, t: None, lambda t: 20 < t < 22)
    FAULTS["imu accel in g"] = of(lambda m, t: replace(m, accel=m.accel / 9.80665))
    FAULTS["imu gyro in degrees"] = of(lambda m, t: replace(m, gyro=np.degrees(m.gyro)))
    FAULTS["imu without gravity"] = of(lambda m, t: replace(m, accel=m.accel - [0, 0, 9.8]))
    FAULTS["imu accel zero"] = of(lambda m, t: replace(m, accel=0 * m.accel))
    FAULTS["imu gyro dead"] = of(lambda m, t: replace(m, gyro=0 * m.gyro))
    FAULTS["imu gyro dies half way"] = of(lambda m, t: replace(m, gyro=0 * m.gyro), lambda t: t > 30)
    FAULTS["imu NED"] = of(lambda m, t: replace(m, gyro=m.gyro * [1, -1, -1], accel=m.accel * [1, -1, -1]))
    FAULTS["imu gyro z flipped"] = of(lambda m, t: replace(m, gyro=m.gyro * [1, 1, -1]))
    FAULTS["imu gyro scaled by 1.1"] = of(lambda m, t: replace(m, gyro=1.1 * m.gyro))
    FAULTS["imu NaN half"] = each(
        "imu", lambda m, t: replace(m, gyro=np.full(3, np.nan)), lambda t: int(t * 100) % 2 == 0
    )
    FAULTS["imu NaN"] = of(lambda m, t: replace(m, gyro=np.full(3, np.nan)))
    FAULTS["imu bias 0.2 rad/s"] = of(lambda m, t: replace(m, gyro=m.gyro + [0, 0, 0.2]))
    FAULTS["imu frozen"] = of(lambda m, t: replace(m, gyro=np.array([0.01, 0, 0.02]), accel=np.array([0.1, 0, 9.8])))
    for value in (1e300, 1000.0, 20.0):

        def spike(bag: Bag, rng: np.random.Generator, value: float = value) -> None:
            e = bag.of("imu")[1500]
            e.it = replace(e.it, gyro=np.array([0, 0, value]))

        FAULTS[f"imu one rate of {value:g}"] = spike


def _wheels() -> None:
    def slip(by: float, span: tuple[float, float]) -> Fault:
        def run(bag: Bag, rng: np.random.Generator) -> None:
            mine = sorted(bag.of("odometry"), key=lambda e: e.it.stamp_ns)
            p = np.array([e.it.odom_T_child for e in mine])
            step = np.diff(p[:, :3], axis=0)
            t = np.array([bag.at(e) for e in mine])
            inside = (t[1:] > span[0]) & (t[1:] < span[1])
            step[inside] *= by
            p[1:, :3] = p[0, :3] + np.cumsum(step, axis=0)
            for e, q, w in zip(mine, p, np.concatenate([[False], inside]), strict=True):
                twist = e.it.twist * np.array([by, 1, 1, 1, 1, 1]) if w else e.it.twist
                e.it = replace(e.it, odom_T_child=q, twist=twist)

        return run

    for by in (0.0, 0.5, 1.5, 3.0):
        for length in (1, 3, 6):
            FAULTS[f"wheels x {by} for {length} s"] = slip(by, (20, 20 + length))
    for by in (0.7, 0.95, 1.05, 1.3):
        FAULTS[f"wheels x {by}"] = slip(by, (0, 1e9))
    FAULTS["wheels x 1.2 for 15 s"] = slip(1.2, (15, 30))

    def moved(change: Callable[[np.ndarray, float], np.ndarray], when: Callable[[float], bool]) -> Fault:
        return each("odometry", lambda m, t: replace(m, odom_T_child=change(m.odom_T_child, t)), when)

    for by in (0.4, 2.0, 5.0):
        FAULTS[f"odometry teleports {by} m"] = moved(lambda p, t, by=by: p + [by, 0, 0, 0, 0, 0, 0], lambda t: t > 30)
    FAULTS["odometry x = 1e300 once"] = moved(lambda p, t: np.array([1e300, *p[1:]]), lambda t: 20 < t < 20.05)
    FAULTS["odometry NaN for 2 s"] = moved(lambda p, t: np.full(7, np.nan), lambda t: 20 < t < 22)
    FAULTS["odometry quaternions zero"] = moved(lambda p, t: np.array([*p[:3], 0, 0, 0, 0]), lambda t: True)
    FAULTS["odometry pose zero, twist good"] = moved(lambda p, t: np.array([0, 0, 0, 0, 0, 0, 1.0]), lambda t: True)
    FAULTS["odometry frozen"] = each(
        "odometry", lambda m, t: replace(m, odom_T_child=np.array([1, 2, 0, 0, 0, 0, 1.0]), twist=np.zeros(6))
    )
    FAULTS["odometry backwards"] = moved(lambda p, t: p * [-1, -1, 1, 1, 1, 1, 1], lambda t: True)

    def turning(by: float, alone: bool) -> Fault:
        """Skid steering: the wheels overstate turns."""

        def run(bag: Bag, rng: np.random.Generator) -> None:
            mine = sorted(bag.of("odometry"), key=lambda e: e.it.stamp_ns)
            T = np.array([_pose(e.it.odom_T_child) for e in mine])
            now = T[0]
            out = [now]
            for a, b in pairwise(T):
                step = inverse(a) @ b
                turn = Rotation.from_matrix(step[:3, :3]).as_rotvec() * np.array([1, 1, by])
                step[:3, :3] = Rotation.from_rotvec(turn).as_matrix()
                now = now @ step
                out.append(now)
            for e, P in zip(mine, out, strict=True):
                q = np.concatenate([P[:3, 3], Rotation.from_matrix(P[:3, :3]).as_quat()])
                e.it = replace(e.it, odom_T_child=q, twist=e.it.twist * np.array([1, 1, 1, 1, 1, by]))
            if alone:
                bag.events = [e for e in bag.events if e.kind not in ("fix", "heading")]

        return run

    for by in (0.6, 1.8):
        FAULTS[f"wheels' turns x {by}"] = turning(by, False)
        FAULTS[f"wheels' turns x {by}, no GNSS"] = turning(by, True)

    def dark(bag: Bag, rng: np.random.Generator) -> None:
        bag.events = [
            e for e in bag.events if e.kind not in ("fix", "heading") and not (e.kind == "imu" and 15 < bag.at(e) < 35)
        ]

    FAULTS["imu gap of 20 s, no GNSS"] = dark

    def stands(bag: Bag, rng: np.random.Generator) -> None:
        """Half a minute before the start, with noisy fixes at 10 Hz."""
        pause = 30 * S
        first = {k: min(bag.of(k), key=lambda e: e.it.stamp_ns).it for k in TOPICS}
        for e in bag.events:
            e.it = replace(e.it, stamp_ns=e.it.stamp_ns + pause)
            e.log_ns += pause
        t = bag.truth
        bag.truth = replace(
            t,
            stamps_ns=np.concatenate([t.stamps_ns[:1], t.stamps_ns + pause]),
            world_T_robot=np.concatenate([t.world_T_robot[:1], t.world_T_robot]),
        )
        for kind, hz in (("odometry", 20), ("imu", 100), ("fix", 10), ("heading", 5)):
            for k in range(30 * hz):
                ns = bag.start_ns + k * S // hz
                m = replace(first[kind], stamp_ns=ns)
                if kind == "imu":
                    m = replace(m, gyro=m.gyro + rng.normal(0, 0.003, 3), accel=m.accel + rng.normal(0, 0.05, 3))
                if kind == "fix":
                    z = t.datum.to_enu(first[kind].lat_lon_h[None]) + rng.normal(0, [0.02, 0.02, 0.04])
                    m = replace(m, lat_lon_h=t.datum.to_geodetic(z)[0], cov=4e-4 * np.diag([1, 1, 4.0]))
                if kind == "odometry":
                    m = replace(m, twist=0 * m.twist)
                bag.events.append(Event(kind, ns + 3_000_000, m))

    FAULTS["stands for half a minute"] = stands

    @fault("odometry reset half way")
    def _(bag: Bag, rng: np.random.Generator) -> None:
        at = min((e for e in bag.of("odometry") if bag.at(e) > 30), key=lambda e: e.it.stamp_ns).it.odom_T_child
        zero = inverse(_pose(at))
        for e in bag.of("odometry"):
            if bag.at(e) > 30:
                T = zero @ _pose(e.it.odom_T_child)
                e.it = replace(e.it, odom_T_child=np.concatenate([T[:3, 3], Rotation.from_matrix(T[:3, :3]).as_quat()]))


def _pose(p: np.ndarray) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_quat(p[3:]).as_matrix(), p[:3]
    return T


def _things() -> None:
    def add(where: Callable[[np.ndarray, float], np.ndarray]) -> Fault:
        """A thing at a place in the world, given the robot's pose and time; seen in every scan."""

        def run(bag: Bag, rng: np.random.Generator) -> None:
            for e in bag.of("trunks"):
                T = interpolate(bag.truth.stamps_ns, bag.truth.world_T_robot, [e.it.stamp_ns])[0]
                p = where(T, bag.at(e)) + rng.normal(0, 0.02, 3)
                m = e.it
                e.it = replace(
                    m,
                    p=np.vstack([m.p, p]),
                    axis=np.vstack([m.axis, [0, 0, 1.0]]),
                    diameter=np.append(m.diameter, 0.2),
                    score=np.append(m.score, 0.0),
                )

        return run

    FAULTS["a person beside the robot"] = add(
        lambda T, t: np.array([0.5 * np.sin(t / 3), 1.5 + 0.3 * np.sin(t / 7), 0.8])
    )
    FAULTS["a mast on the robot"] = add(lambda T, t: np.array([-0.9, 0.3, 0.8]))
    FAULTS["a trailer"] = add(lambda T, t: np.array([-2.5, 0.1 * np.sin(t), 0.8]))
    FAULTS["a person overtakes"] = add(lambda T, t: np.array([-10 + 0.5 * t, 1.2, 0.8]))

    def per_trunk(change: Callable[[Trunks, np.random.Generator], Trunks]) -> Fault:
        def run(bag: Bag, rng: np.random.Generator) -> None:
            for e in bag.of("trunks"):
                e.it = change(e.it, rng)

        return run

    FAULTS["trunks NaN now and then"] = per_trunk(
        lambda m, r: replace(m, p=np.where(r.random((len(m), 1)) < 0.1, np.nan, m.p))
    )
    FAULTS["trunks mirrored"] = per_trunk(lambda m, r: replace(m, p=m.p * [1, -1, 1]))
    FAULTS["trunks scaled by 1.05"] = per_trunk(lambda m, r: replace(m, p=m.p * [1.05, 1.05, 1]))
    FAULTS["trunks in centimetres"] = per_trunk(lambda m, r: replace(m, p=m.p * 100))
    FAULTS["trunks noisier by 0.3 m"] = per_trunk(lambda m, r: replace(m, p=m.p + r.normal(0, 0.3, m.p.shape)))
    FAULTS["half of the trunks are clutter"] = per_trunk(lambda m, r: replace(
        m, p=np.where(r.random((len(m), 1)) < 0.5, np.column_stack([r.uniform(-12, 12, (len(m), 2)), np.full(len(m), 0.8)]), m.p)))  # fmt: skip


def _sites() -> None:
    for name, lat, lon in (
        ("equator", 0.0005, 10.0),
        ("Greenwich", 51.0, 0.0001),
        ("180", 10.0, 179.9999),
        ("85 north", 85.0, 20.0),
        ("north pole", 89.9999, 0.0),
    ):

        def site(bag: Bag, rng: np.random.Generator, lat: float = lat, lon: float = lon) -> None:
            from topograph.geometry import Datum

            old, new = bag.truth.datum, Datum(lat, lon, bag.truth.datum.h)
            for e in bag.of("fix"):
                e.it = replace(e.it, lat_lon_h=new.to_geodetic(old.to_enu(e.it.lat_lon_h[None]))[0])
            bag.truth = replace(bag.truth, datum=new)

        FAULTS[f"site at {name}"] = site


FAULTS["clean"] = lambda bag, rng: None
for group in (_clocks, _topics, _frames, _gnss, _imu, _wheels, _things, _sites):
    group()


# -- judging --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Outcome:
    """What came of a fault: verdict "sound", "doubtful", "refused" or "traceback", and what the map is in truth."""

    name: str
    verdict: str
    says: str
    wrong: bool
    ghosts: int
    lost: int
    worst: float
    path: float
    missing: int

    @property
    def kind(self) -> str:
        """The bin that it counts in."""
        if self.verdict == "traceback":
            return "TRACEBACK"
        if self.missing:
            return "LOST MESSAGES"
        if self.verdict == "refused":
            return "refused"
        if self.wrong:
            return "wrong, said" if self.verdict == "doubtful" else "WRONG"
        return "right, doubted" if self.verdict == "doubtful" else "right"


def attempt(name: str, bag: Bag, path: Path) -> Outcome:
    """Write, map, judge."""
    write(bag, path)
    config = Config()
    try:
        with Recording([path], config.bags) as r:
            announced = sum(r.counts[t] for t in r.chosen.values())
        run = read_run([path], config)
        s = run.streams
        used = len(s.odometry_ns) + len(s.imu_ns) + len(s.fix_ns) + len(s.heading_ns) + len(run.trunks)
        missing = announced - used - sum(run.skipped.values())
        solved = solve_run(run, config)
        topo = topo_map(solved, config, {})
        verdict = audited(solved)
    except TopographError as err:
        return Outcome(name, "refused", f"{type(err).__name__}: {err}", False, 0, 0, 0.0, 0.0, 0)
    except Exception as err:  # noqa: BLE001  # what the suite is there to find
        where = traceback.extract_tb(err.__traceback__)[-1]
        return Outcome(
            name, "traceback", f"{type(err).__name__}: {err} ({where.filename}:{where.lineno})", True, 0, 0, 0.0, 0.0, 0
        )
    says = "; ".join(verdict.reasons or tuple(run.notes))
    if not len(topo):
        return Outcome(name, "refused", f"no trees; {says}", False, 0, 0, 0.0, 0.0, missing)
    i, _, e = tree_errors(topo, bag.truth)
    trees = topo.trees()
    error = np.linalg.norm(e[:, :2], axis=1)
    sigma = np.sqrt(0.5 * (trees.cov[i, 0, 0] + trees.cov[i, 1, 1]))
    ghosts = len(trees) - len(i)
    wrong = ghosts > 0 or bool(((error > 0.10) & (error > 3 * sigma)).any())
    est = solved.estimate
    off = 0.0
    if topo.datum is not None:
        assert bag.truth.datum is not None
        true = interpolate(bag.truth.stamps_ns, bag.truth.world_T_robot, est.stamps_ns)[:, :3, 3]
        off = float(
            np.linalg.norm(
                (est.map_T_robot[:, :3, 3] - topo.datum.to_enu(bag.truth.datum.to_geodetic(true)))[:, :2],
                axis=1,
            ).max()
        )
    seen = len(bag.truth.trees)
    return Outcome(name, verdict.word, says, wrong, ghosts, seen - len(i), float(error.max(initial=0)), off, missing)


def one(job: tuple[str, int, Path]) -> Outcome:
    """One fault, in a process of its own choosing."""
    name, seed, folder = job
    bag = base(seed, folder)
    rng = np.random.default_rng([seed, sum(map(ord, name))])
    FAULTS[name](bag, rng)
    with tempfile.TemporaryDirectory(dir=folder) as at:
        return attempt(name, bag, Path(at) / "fault.bag")


def suite(names: list[str], seed: int, folder: Path, jobs: int = 2) -> list[Outcome]:
    """All of `names`, in order."""
    base(seed, folder)
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
        return list(pool.map(one, [(n, seed, folder) for n in names], chunksize=4))


def main() -> None:
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("names", nargs="*", help="faults whose names contain one of these; all by default")
    p.add_argument("--seed", type=int, default=2101)
    p.add_argument("--every", type=int, default=1, help="every N-th fault only")
    p.add_argument("--work", type=Path, help="keep the clean run here")
    a = p.parse_args()
    names = [n for n in FAULTS if not a.names or any(w in n for w in a.names)][:: a.every]
    with tempfile.TemporaryDirectory() as folder:
        work = a.work or Path(folder)
        work.mkdir(parents=True, exist_ok=True)
        out = suite(names, a.seed, work)
    for o in out:
        print(
            f"{o.kind:<15} {o.name:<38} ghosts {o.ghosts:>2} lost {o.lost:>2} worst {o.worst:5.2f} path {o.path:6.2f} missing {o.missing:>5}  {o.says[:170]}"
        )
    print(
        "\n"
        + ", ".join(f"{k} {n}" for k, n in sorted(Counter(o.kind for o in out).items()))
        + f"; {len(out)} faults, seed {a.seed}"
    )


if __name__ == "__main__":
    main()
