"""One simulated run as a bag, with the truth in a folder beside it."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from topograph.bags.writer import BagWriter
from topograph.evaluate.truth import Truth
from topograph.geometry import Array, Datum, Stamps, to_quaternion
from topograph.simulate import sensors
from topograph.simulate.config import DESIGNS, DriveConfig, OrchardConfig, SensorConfig
from topograph.simulate.detections import DetectionNoise, detect
from topograph.simulate.drive import Drive, drive
from topograph.simulate.growth import TRUNK
from topograph.simulate.lidar import Sweep, sweep
from topograph.simulate.orchard import Orchard, plant

_POINT = np.dtype(
    {
        "names": ["x", "y", "z", "intensity", "ring", "time"],
        "formats": ["<f4", "<f4", "<f4", "<f4", "<u2", "<f4"],
        "offsets": [0, 4, 8, 12, 16, 18],
        "itemsize": 22,
    }
)
"""velodyne_pointcloud's XYZIRT."""

DATUM = Datum(40.1863, -8.4152, 95.0)
"""Near the thesis's orchard in Coimbra; each seed shifts it."""


Event = tuple[int, Callable[[], None]]
Look = Callable[[Orchard, SensorConfig, Array, float, int], Sweep]
"""Casts a sweep into a scene, as `lidar.sweep`."""


def record(
    path: Path,
    seed: int,
    orchard: OrchardConfig | str = "grid",
    run: DriveConfig | None = None,
    sensor: SensorConfig | None = None,
    noise: DetectionNoise | None = None,
    progress: Callable[[float], None] | None = None,
) -> Truth:
    """Simulate one run into `path` (`.bag`: ROS 1; else a ROS 2 folder with mcap); the truth goes to `<stem>.truth/`.

    Runs of the same seed share the orchard. Raises InputError when `path` exists.
    """
    run, sensor = run or DriveConfig(), sensor or SensorConfig()
    scene = plant(DESIGNS[orchard] if isinstance(orchard, str) else orchard, seed)
    return record_in(path, scene, drive(scene, run, seed), seed, run, sensor, noise or DetectionNoise(), progress)


def record_in(
    path: Path,
    scene: Orchard,
    way: Drive,
    seed: int,
    run: DriveConfig,
    sensor: SensorConfig,
    noise: DetectionNoise,
    progress: Callable[[float], None] | None = None,
    look: Look = sweep,
) -> Truth:
    """`record` in any scene, on any way through it; `look` casts the sweeps."""
    rng = np.random.default_rng([seed, 41, run.run])
    datum = Datum(DATUM.lat + 1e-3 * (seed % 97), DATUM.lon - 1e-3 * (seed % 89), DATUM.h)
    seen: list[Any] = []
    scan_stamps: list[int] = []
    with BagWriter(path, sensor.compression) as bag:
        start = int(way.stamps_ns[0])
        mounts = sensors.MOUNTS | {"velodyne": sensors.mounting(sensor)}
        bag.tf_static(start, {("base_link", name): T for name, T in mounts.items()})
        streams = [_small(bag, way, sensor, datum, rng)]
        if sensor.detections:
            streams.append(_trunks(bag, scene, way, sensor, noise, rng, run))
        else:
            streams.append(_clouds(bag, scene, way, sensor, seed, seen, scan_stamps, run=run, look=look))
        span = float(way.stamps_ns[-1] - start)
        for log_ns, write in heapq.merge(*streams, key=lambda e: e[0]):
            write()
            if progress is not None:
                progress(min(1.0, (log_ns - start) / span))
    truth = Truth(
        datum=datum,
        trees=scene.trees,
        axes=scene.axes,
        diameters=scene.diameters,
        stems=scene.stems,
        stamps_ns=way.stamps_ns[::5],
        world_T_robot=way.world_T_robot[::5],
        scan_stamps_ns=np.array(scan_stamps, np.int64),
        returns=np.array(seen, np.int32).reshape(len(scan_stamps), len(scene.trees)),
    )
    truth.save(path.with_name(path.stem + ".truth"))
    return truth


def _small(bag: BagWriter, way: Drive, sensor: SensorConfig, datum: Datum, rng: np.random.Generator) -> Iterator[Event]:
    """Wheels, IMU, fixes and heading, in time order; each arrives a few milliseconds after its stamp."""
    w = sensors.wheels(way, sensor, rng)
    s_imu, gyro, accel = sensors.imu(way, sensor, rng)
    fixes = sensors.gnss(way, sensor, rng)
    geodetic = datum.to_geodetic(fixes.world_p_antenna) if len(fixes.stamps_ns) else np.zeros((0, 3))
    s_head, yaw = sensors.heading(way, sensor, fixes, rng)
    turn = to_quaternion(sensors.level(yaw)) if len(yaw) else np.zeros((0, 4))

    def events(stamps: Stamps, delay_ns: int, write: Callable[[int, int], None]) -> Iterator[Event]:
        for k, s in enumerate(stamps.tolist()):
            yield s + delay_ns, lambda k=k, s=s: write(k, s)  # type: ignore[misc]  # mypy cannot type a lambda's defaults

    streams = [
        events(w.stamps_ns, 3_000_000, lambda k, s: bag.odometry(
            "/odom", s + 3_000_000, s, ("odom", "base_link"), w.odom_T_robot[k], w.twist[k])),
        events(s_imu, 1_000_000, lambda k, s: bag.imu("/imu/data", s + 1_000_000, s, "imu_link", gyro[k], accel[k])),
        events(fixes.stamps_ns, 60_000_000, lambda k, s: bag.fix(
            "/gnss/fix", s + 60_000_000, s, "gnss", geodetic[k], fixes.cov[k], int(fixes.status[k]))),
    ]  # fmt: skip
    if sensor.heading_sigma > 0:
        streams.append(
            events(
                s_head,
                60_000_000,
                lambda k, s: bag.heading("/gnss/heading", s + 60_000_000, s, "gnss_baseline", turn[k]),
            )
        )
    return heapq.merge(*streams, key=lambda e: e[0])


def _clouds(
    bag: BagWriter,
    scene: Orchard,
    way: Drive,
    sensor: SensorConfig,
    seed: int,
    seen: list[Any],
    stamps: list[int],
    run: DriveConfig,
    look: Look,
) -> Iterator[Event]:
    span, period = int(1e9 * sensor.sweep_s), int(1e9 / sensor.sweep_hz)
    starts = np.arange(int(way.stamps_ns[0]), int(way.stamps_ns[-1]) - span, period, dtype=np.int64)
    for k in np.flatnonzero(_taken(way, starts, span, period, run)).tolist():
        start = int(starts[k])
        end = start + span  # velodyne_driver stamps the last packet: times are negative

        def write(k: int = k, start: int = start, end: int = end) -> None:
            s = look(
                scene,
                sensor,
                sensors.columns(way, sensor, start),
                (start - way.stamps_ns[0]) * 1e-9,
                seed * 100_003 + k,
            )
            bag.points("/velodyne_points", end + 5_000_000, end, "velodyne", _view(s, span * 1e-9))
            stamps.append(end)
            trunk = s.tree[(s.tree >= 0) & (s.material == TRUNK)]
            seen.append(np.bincount(trunk, minlength=len(scene.trees))[: len(scene.trees)])

        yield end + 5_000_000, write


STANDS = 0.002
"""A robot that moves less during a sweep stands, m."""
AT_STOPS_NS = 500_000_000
"""Time between two sweeps at a stop."""


def _taken(way: Drive, starts: Stamps, span: int, period: int, run: DriveConfig) -> NDArray[np.bool_]:
    """(S,) sweeps of `span` ns from `starts` on, one each `period` ns, that are recorded."""
    if not run.scans_at_stops:
        return np.ones(len(starts), bool)
    moved = np.interp(starts + span, way.stamps_ns, way.distance) - np.interp(starts, way.stamps_ns, way.distance)
    every = np.arange(len(starts)) % max(AT_STOPS_NS // period, 1) == 0
    return np.asarray((moved < STANDS) & every)


def _view(s: Sweep, span_s: float) -> Any:
    view = np.zeros(len(s.xyz), _POINT)
    for k, a in enumerate("xyz"):
        view[a] = s.xyz[:, k]
    view["intensity"], view["ring"], view["time"] = s.intensity, s.ring, s.time - np.float32(span_s)
    return view


def _trunks(
    bag: BagWriter,
    scene: Orchard,
    way: Drive,
    sensor: SensorConfig,
    noise: DetectionNoise,
    rng: np.random.Generator,
    run: DriveConfig,
) -> Iterator[Event]:
    span = int(1e9 / sensor.sweep_hz)
    stamps = np.arange(int(way.stamps_ns[0]), int(way.stamps_ns[-1]), span, dtype=np.int64)
    stamps = stamps[_taken(way, stamps, span, span, run)]
    poses: Array = way.at(stamps)
    for T, s in zip(poses, stamps.tolist(), strict=True):

        def write(T: Array = T, s: int = s) -> None:
            p, diameter, axis = detect(scene, T, noise, rng)
            turn = np.array([_tilt(a) for a in axis]).reshape(-1, 4)
            bag.trunks("/trunks", s + 10_000_000, s, "base_link", p, diameter, turn)

        yield s + 10_000_000, write


def _tilt(axis: Array) -> Array:
    v = np.cross([0.0, 0.0, 1.0], axis)
    n = np.linalg.norm(v)
    angle = np.arctan2(n, axis[2])
    return np.asarray(Rotation.from_rotvec(v / n * angle if n > 1e-9 else np.zeros(3)).as_quat())
