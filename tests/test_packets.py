"""What drivers record before clouds are made, messages that recordings hold no definitions of, and compressed files."""

import sqlite3
from inspect import signature
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st
from packets import FIRING_S, LASER_S, convert, livox_message, packets_of, store_of, velodyne_message
from rosbags import rosbag1, rosbag2

from topograph.bags import BagsConfig, Fix, Odometry, Recording, Scan, Trunks
from topograph.bags.definitions import typestore
from topograph.bags.packets import Velodyne, unpack_livox
from topograph.bags.topics import choose
from topograph.bags.writer import BagWriter
from topograph.config import Config
from topograph.errors import InputError, TopicError
from topograph.pipeline import read_run, solve_run, topo_map
from topograph.simulate import DriveConfig, OrchardConfig, SensorConfig, record
from topograph.topomap import TopoMap

T0 = 1_700_000_000_123_456_000


def header(store: Any, ros1: bool, stamp_ns: int, frame: str = "velodyne") -> Any:
    stamp = store.types["builtin_interfaces/msg/Time"](sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    return store.types["std_msgs/msg/Header"](stamp=stamp, frame_id=frame, **({"seq": 1} if ros1 else {}))


def serialized(store: Any, ros1: bool, message: Any) -> bytes:
    name = message.__msgtype__
    return bytes(store.serialize_ros1(message, name) if ros1 else store.serialize_cdr(message, name))


def turn(seed: int, firings: int, start_deg: float) -> Scan:
    """Part of a VLP-16's turn as its manual has it: each laser of each firing may have a return."""
    rng = np.random.default_rng(seed)
    laser = np.tile(np.arange(16), firings)
    at = np.repeat(np.arange(firings), 16) * FIRING_S + laser * LASER_S
    ring = np.where(laser % 2 == 0, laser // 2, laser // 2 + 8)
    up = np.radians(-15.0 + 2.0 * ring)
    along = -np.radians(start_deg + 3600.0 * at)
    distance = rng.uniform(1.0, 60.0, len(at))
    keep = rng.random(len(at)) < 0.7
    keep[0] = keep[-1] = True
    xyz = distance[:, None] * np.stack([np.cos(up) * np.cos(along), np.cos(up) * np.sin(along), np.sin(up)], axis=1)
    end = (firings - 1) // 24 * 24 * FIRING_S  # the last packet's first firing
    return Scan(
        stamp_ns=T0, frame="velodyne", xyz=xyz[keep].astype(np.float32), ring=ring[keep].astype(np.int32),
        offset=(at[keep] - end).astype(np.float32), intensity=None,
    )  # fmt: skip


@settings(max_examples=30, deadline=None)
@given(
    st.integers(0, 10**6), st.integers(2, 80), st.floats(0, 360), st.booleans(), st.sampled_from(["", "v", "velodyne"])
)
def test_packets_of_a_velodyne_are_the_turn(seed: int, firings: int, start: float, ros1: bool, frame: str) -> None:
    """Ranges to the 2 mm that a packet has and what the sensor's own corrections add, directions to its 0.01°, each point's time."""
    scan = turn(seed, firings, start)
    store = store_of(ros1)
    got = Velodyne()(serialized(store, ros1, velodyne_message(store, header(store, ros1, T0, frame), scan)), not ros1)
    assert (got.stamp_ns, got.frame, len(got.xyz)) == (T0, frame, len(scan.xyz))
    assert got.ring is not None
    assert got.offset is not None
    assert scan.ring is not None
    assert scan.offset is not None
    ours, theirs = np.lexsort((got.offset, got.ring)), np.lexsort((scan.offset, scan.ring))
    np.testing.assert_array_equal(got.ring[ours], scan.ring[theirs])
    np.testing.assert_allclose(got.offset[ours], scan.offset[theirs], atol=2e-6)
    distance = np.linalg.norm(scan.xyz, axis=1)[theirs]
    off = got.xyz[ours] - scan.xyz[theirs]
    assert (
        np.linalg.norm(off, axis=1) < 0.015 + np.radians(0.03) * distance
    ).all()  # lasers sit up to 11 mm off the middle


def test_a_header_may_have_the_first_packets_time_or_the_last() -> None:
    scan = turn(1, 72, 30.0)
    store = store_of(False)
    last = Velodyne()(serialized(store, False, velodyne_message(store, header(store, False, T0), scan)), True)
    first_ns = packets_of(scan)[0][0]
    first = Velodyne()(serialized(store, False, velodyne_message(store, header(store, False, first_ns), scan)), True)
    assert first.offset is not None
    assert last.offset is not None
    assert last.offset.min() == pytest.approx(-48 * FIRING_S, abs=1e-6)
    np.testing.assert_allclose(first.offset + (first_ns - T0) * 1e-9, last.offset, atol=1e-6)


@pytest.mark.parametrize("ros1", [True, False])
def test_packets_that_do_not_tell_their_model_say_what_to_do(ros1: bool) -> None:
    store = store_of(ros1)
    message = velodyne_message(store, header(store, ros1, T0), turn(1, 24, 0.0))
    message.packets[0].data = np.concatenate([message.packets[0].data[:-1], [0x7F]]).astype(np.uint8)
    with pytest.raises(InputError, match="velodyne_pointcloud"):
        Velodyne()(serialized(store, ros1, message), not ros1)
    empty = store.types["velodyne_msgs/msg/VelodyneScan"](header=message.header, packets=[])
    with pytest.raises(InputError, match="without packets"):
        Velodyne()(serialized(store, ros1, empty), not ros1)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10**6), st.integers(2, 60), st.booleans(), st.sampled_from(["", "l", "li", "liv", "livox_frame"]),
       st.sampled_from(["livox_ros_driver", "livox_ros_driver2"]))  # fmt: skip
def test_a_livox_message_is_the_sweep(seed: int, n: int, ros1: bool, frame: str, package: str) -> None:
    rng = np.random.default_rng(seed)
    offset = np.sort(rng.uniform(-0.1, 0.0, n)).astype(np.float32)
    scan = Scan(stamp_ns=T0, frame=frame, xyz=rng.normal(0, 20, (n, 3)).astype(np.float32),
                ring=rng.integers(0, 6, n).astype(np.int32), offset=offset, intensity=None)  # fmt: skip
    store = store_of(ros1)
    message = livox_message(store, header(store, ros1, T0, frame), scan, package)
    tags = rng.integers(0, 64, n)
    for p, t in zip(message.points, tags.tolist(), strict=True):
        p.tag = t
    keep = ((tags & 3) != 1) & ((tags >> 2 & 3) != 1)
    message.points.append(type(message.points[0])(offset_time=0, x=0.0, y=0.0, z=0.0, reflectivity=0, tag=0, line=0))
    got, _ = unpack_livox(serialized(store, ros1, message), not ros1)
    np.testing.assert_array_equal(got.xyz, scan.xyz[keep])
    assert got.ring is None  # a line is no ring: it wanders over the whole view
    assert (got.stamp_ns, got.frame) == (T0, frame)
    if keep.sum() > 1:
        assert got.offset is not None
        np.testing.assert_allclose(got.offset, offset[keep], atol=2e-7)


def test_a_livox_clock_that_began_with_the_sensor_counts_from_the_stamp() -> None:
    scan = turn(3, 4, 0.0)
    store = store_of(True)
    message = livox_message(store, header(store, True, T0), scan, base_ns=7_000_000_000)
    offset = unpack_livox(serialized(store, True, message), False)[0].offset
    assert offset is not None
    assert offset[0] == pytest.approx(0.0, abs=1e-6)


def test_two_livox_on_one_topic_are_told_apart(tmp_path: Path) -> None:
    """Their clouds are in frames of their own, of which the topic names one."""
    store = store_of(True)
    with rosbag1.Writer(tmp_path / "a.bag") as w:
        c = w.add_connection("/livox/lidar", "livox_ros_driver/msg/CustomMsg", typestore=store)
        for k in range(10):
            at = T0 + k * 50_000_000
            message = livox_message(store, header(store, True, at), turn(k, 20, 0.0))
            message.lidar_id = 3 + k % 2
            w.write(c, at, serialized(store, True, message))
    with Recording([tmp_path / "a.bag"]) as r:
        assert len(list(r.messages())) == 5
        assert r.skipped == {"points: of a second LiDAR on one topic": 5}
        assert any("lidar_id 3" in n for n in r.notes)


@pytest.mark.parametrize("dual", [False, True])
def test_both_returns_of_a_beam_have_its_direction_and_time(dual: bool) -> None:
    """A packet of dual returns holds each firing twice, the last return and the strongest, over half the time."""
    scan = turn(5, 24, 40.0)
    store = store_of(True)
    message = velodyne_message(store, header(store, True, T0), scan)
    once = message.packets[0].data
    if dual:
        blocks = once[:1200].reshape(12, 100)
        further = blocks.copy()
        for c in range(32):  # a metre behind, in units of 2 mm
            distance = further[:, 4 + 3 * c : 6 + 3 * c].copy().view("<u2")
            further[:, 4 + 3 * c : 6 + 3 * c] = np.where(distance > 0, distance + 500, 0).astype("<u2").view(np.uint8)
        tail = np.array([*once[1200:1204], 0x39, once[1205]], np.uint8)
        halves = [np.stack([blocks[k : k + 6], further[k : k + 6]], axis=1).reshape(-1) for k in (0, 6)]
        message.packets = [
            type(message.packets[0])(message.packets[0].stamp, np.concatenate([h, tail])) for h in halves
        ]
        later = int.from_bytes(once[1200:1204].tobytes(), "little") + round(12 * FIRING_S * 1e6)
        message.packets[1].data[1200:1204] = np.frombuffer(later.to_bytes(4, "little"), np.uint8)
    got = Velodyne()(serialized(store, True, message), False)
    assert len(got.xyz) == len(scan.xyz) * (1 + dual)
    assert got.offset is not None
    assert scan.offset is not None
    assert np.ptp(got.offset) == pytest.approx(np.ptp(scan.offset), abs=3e-6)
    if dual:
        assert np.linalg.norm(got.xyz, axis=1).max() - np.linalg.norm(scan.xyz, axis=1).max() == pytest.approx(
            1.0, abs=0.02
        )


@pytest.mark.parametrize("kind", ["velodyne", "livox"])
@pytest.mark.parametrize("cut", [3, 500])
def test_a_message_that_ends_too_early_is_counted(tmp_path: Path, kind: str, cut: int) -> None:
    store = store_of(True)
    make = {"velodyne": velodyne_message, "livox": livox_message}[kind]
    message = make(store, header(store, True, T0), turn(2, 48, 0.0))
    raw = serialized(store, True, message)
    with rosbag1.Writer(tmp_path / "a.bag") as w:
        c = w.add_connection("/packets", message.__msgtype__, typestore=store)
        w.write(c, T0, raw[:-cut])
        w.write(c, T0 + 1, raw)
    with Recording([tmp_path / "a.bag"]) as r:
        assert len(list(r.messages())) == 1
        assert r.skipped == {"points: cannot be decoded": 1}
        assert "truncated" in r.undecoded["points"]


def test_packets_are_taken_where_there_are_no_clouds() -> None:
    packets = {"/velodyne_packets": "velodyne_msgs/msg/VelodyneScan"}
    clouds = {"/velodyne_points": "sensor_msgs/msg/PointCloud2"}
    assert choose(packets, BagsConfig())["points"] == "/velodyne_packets"
    assert choose(packets | clouds, BagsConfig())["points"] == "/velodyne_points"
    assert choose(packets | clouds, BagsConfig(topic_points="/velodyne_packets"))["points"] == "/velodyne_packets"


@pytest.mark.parametrize("clouds", [["/camera/depth/points"], ["/cloud_registered", "/Laser_map"]])
def test_packets_are_an_option_beside_clouds_of_something_else(clouds: list[str]) -> None:
    """A depth camera, or the map of an odometry that had the LiDAR: neither is taken without being asked for."""
    types = {"/livox/lidar": "livox_ros_driver2/msg/CustomMsg"} | dict.fromkeys(clouds, "sensor_msgs/msg/PointCloud2")
    with pytest.raises(TopicError, match="--topic-points /livox/lidar"):
        choose(types, BagsConfig())
    assert choose(types, BagsConfig(topic_points="/livox/lidar"))["points"] == "/livox/lidar"


def test_a_twist_is_odometry_when_it_is_named() -> None:
    types = {"/vel": "geometry_msgs/msg/TwistStamped"}
    assert "odometry" not in choose(types, BagsConfig())  # it may be a command, or GNSS's velocity in ENU
    assert choose(types, BagsConfig(topic_odometry="/vel"))["odometry"] == "/vel"
    with pytest.raises(TopicError, match="wanted is nav_msgs/msg/Odometry or geometry_msgs"):
        choose({"/a": "sensor_msgs/msg/Imu"}, BagsConfig(topic_odometry="/a"))


def humble(path: Path, messages: list[tuple[str, Any]]) -> None:
    """A ROS 2 folder as Humble leaves it: SQLite, no definitions."""
    store = typestore(ros1=False)
    with rosbag2.Writer(path, version=8, storage_plugin=rosbag2.StoragePlugin.SQLITE3) as w:
        for k, (topic, m) in enumerate(messages):
            c = w.add_connection(topic, m.__msgtype__, typestore=store)
            w.write(c, T0 + k, serialized(store, False, m))
    (db3,) = path.glob("*.db3")
    with sqlite3.connect(db3) as db:
        db.execute("DROP TABLE message_definitions")
        db.execute("UPDATE schema SET schema_version = 3")


def test_humble_leaves_no_definitions(tmp_path: Path) -> None:
    """Trunks, a GPSFix and a twist are read all the same."""
    s = typestore(ros1=False).types
    at = header(typestore(ros1=False), False, T0)
    pose = s["geometry_msgs/msg/Pose"](
        position=s["geometry_msgs/msg/Point"](x=3.0, y=1.0, z=0.5),
        orientation=s["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0),
    )
    box = s["vision_msgs/msg/BoundingBox3D"](center=pose, size=s["geometry_msgs/msg/Vector3"](x=0.2, y=0.2, z=1.0))
    detection = s["vision_msgs/msg/Detection3D"](header=at, results=[], bbox=box, id="")
    trunks = s["vision_msgs/msg/Detection3DArray"](header=at, detections=[detection])
    none = np.zeros(0, np.int32)
    status = s["gps_msgs/msg/GPSStatus"](
        header=at, satellites_used=9, satellite_used_prn=none, satellites_visible=9, satellite_visible_prn=none,
        satellite_visible_z=none, satellite_visible_azimuth=none, satellite_visible_snr=none, status=19, motion_source=1,
        orientation_source=1, position_source=1,
    )  # fmt: skip
    gps = s["gps_msgs/msg/GPSFix"]
    numbers = {
        f: 0.0 for f in signature(gps).parameters if f not in ("header", "status", "position_covariance", "__msgtype__")
    }
    numbers |= {"latitude": 40.0, "longitude": -8.0, "altitude": 100.0, "err_horz": 0.04, "err_vert": 0.08}
    fix = gps(header=at, status=status, position_covariance=np.zeros(9), **(numbers | {"position_covariance_type": 0}))
    vector = s["geometry_msgs/msg/Vector3"]
    twist = s["geometry_msgs/msg/TwistStamped"](
        header=at,
        twist=s["geometry_msgs/msg/Twist"](linear=vector(x=1.5, y=0.0, z=0.0), angular=vector(x=0.0, y=0.0, z=0.3)),
    )
    humble(tmp_path / "run", [("/trunks", trunks), ("/gps", fix), ("/wheels", twist)])
    with Recording([tmp_path / "run"], BagsConfig(topic_odometry="/wheels")) as r:
        got = dict(r.messages())
        assert not r.skipped
    assert isinstance(got["trunks"], Trunks)
    np.testing.assert_allclose(got["trunks"].p, [[3.0, 1.0, 0.5]])
    assert isinstance(got["fix"], Fix)
    np.testing.assert_allclose(got["fix"].lat_lon_h, [40.0, -8.0, 100.0])
    np.testing.assert_allclose(got["fix"].cov, np.diag([0.02, 0.02, 0.04]) ** 2)
    assert got["fix"].status == 2  # RTK
    assert isinstance(got["odometry"], Odometry)
    np.testing.assert_allclose(got["odometry"].twist, [1.5, 0, 0, 0, 0, 0.3])


@pytest.mark.parametrize("plugin", [rosbag2.StoragePlugin.MCAP, rosbag2.StoragePlugin.SQLITE3])
@pytest.mark.parametrize("mode", [rosbag2.CompressionMode.FILE, rosbag2.CompressionMode.MESSAGE])
def test_compressed_recordings_need_no_metadata(
    tmp_path: Path, plugin: rosbag2.StoragePlugin, mode: rosbag2.CompressionMode
) -> None:
    """As folders, as lone files, and without the metadata.yaml that a robot without power never wrote."""
    store = typestore(ros1=False)
    point = store.types["geometry_msgs/msg/Vector3"](x=0.5, y=0.0, z=0.0)
    twist = store.types["geometry_msgs/msg/Twist"](linear=point, angular=point)
    writer = rosbag2.Writer(tmp_path / "run", version=8, storage_plugin=plugin)
    writer.set_compression(mode, rosbag2.CompressionFormat.ZSTD)
    with writer as w:
        c = w.add_connection("/wheels", "geometry_msgs/msg/TwistStamped", typestore=store)
        for k in range(20):
            m = store.types["geometry_msgs/msg/TwistStamped"](header=header(store, False, T0 + k * 10**7), twist=twist)
            w.write(c, T0 + k * 10**7, serialized(store, False, m))
    config = BagsConfig(topic_odometry="/wheels")
    (file,) = (p for p in (tmp_path / "run").iterdir() if p.suffix != ".yaml")
    bare = tmp_path / "bare"
    bare.mkdir()
    (bare / file.name).write_bytes(file.read_bytes())
    for path in (tmp_path / "run", file, bare):
        with Recording([path], config) as r:
            assert len(list(r.messages())) == 20
            assert not r.skipped
            assert not r.notes


def test_a_compressed_file_that_was_cut_gives_what_is_whole(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    with BagWriter(tmp_path / "run") as w:
        for k in range(4000):
            w.imu("/imu", T0 + k * 10**7, T0 + k * 10**7, "imu", rng.normal(size=3), rng.normal(size=3))
    (file,) = (tmp_path / "run").glob("*.mcap")
    packed = zstandard.ZstdCompressor().compress(file.read_bytes())
    (tmp_path / "cut.mcap.zstd").write_bytes(packed[: len(packed) * 2 // 3])
    with Recording([tmp_path / "cut.mcap.zstd"]) as r:
        assert 1000 < len(list(r.messages())) < 4000
        assert "truncated" in r.notes[0]
    with pytest.raises(InputError, match="--strict"), Recording([tmp_path / "cut.mcap.zstd"], BagsConfig(strict=True)):
        pass
    (tmp_path / "none.mcap.zstd").write_bytes(b"no zstd")
    with pytest.raises(InputError, match="nothing of it can be decompressed"), Recording([tmp_path / "none.mcap.zstd"]):
        pass


def mapped(path: Path) -> TopoMap:
    config = Config()
    run = read_run([path], config)
    return topo_map(solve_run(run, config), config, {}, clouds=False)


def test_a_run_in_packets_is_the_map_of_its_clouds(tmp_path: Path) -> None:
    """To the centimetre, though a packet rounds ranges to 2 mm and lasers sit beside the sensor's middle."""
    orchard = OrchardConfig(rows=3, columns=4, posts=0, people=0, walkers=0, hedges=0, vehicles=0)
    record(tmp_path / "clouds.bag", 9, orchard, DriveConfig(run=1, longest_s=16.0), SensorConfig())
    assert convert(tmp_path / "clouds.bag", tmp_path / "packets.bag", "velodyne") > 100
    clouds, packets = mapped(tmp_path / "clouds.bag"), mapped(tmp_path / "packets.bag")
    trees = clouds.p[clouds.kind == 0]
    assert len(trees) > 3
    off = np.linalg.norm(packets.p[packets.kind == 0][:, None, :2] - trees[None, :, :2], axis=2)
    assert off.shape[0] == off.shape[1]
    assert off.min(axis=0).max() < 0.01
