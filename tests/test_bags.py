"""Reading what is written: layouts, frames, topics, and what is wrong with bags."""

from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from topograph.bags import BagsConfig, Fix, Heading, Imu, Odometry, Recording, Scan, Trunks
from topograph.bags.topics import choose
from topograph.bags.writer import BagWriter
from topograph.errors import FrameError, InputError, TopicError
from topograph.geometry import exp, to_quaternion

T0 = 1_700_000_000_000_000_000
VELODYNE = np.dtype({"names": ["x", "y", "z", "intensity", "ring", "time"],
                     "formats": ["<f4", "<f4", "<f4", "<f4", "<u2", "<f4"], "offsets": [0, 4, 8, 12, 16, 18], "itemsize": 22})  # fmt: skip


def points(dtype: np.dtype, n: int = 40) -> np.ndarray:
    rng = np.random.default_rng(1)
    view = np.zeros(n, dtype)
    for a in "xyz":
        view[a] = rng.normal(0, 5, n)
    return view


def scan_of(path: Path) -> Scan:
    with Recording([path]) as r:
        (scan,) = [m for _, m in r.messages(["points"])]
    assert isinstance(scan, Scan)
    return scan


@pytest.mark.parametrize("name", ["a.bag", "a"])
def test_all_streams_come_back(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    T = exp(np.array([0.0, 0.0, 0.3, 1.0, 2.0, 0.1]))
    with BagWriter(path) as w:
        w.tf_static(T0, {("base_link", "imu_link"): T})
        w.imu("/imu", T0 + 5, T0 + 1, "imu_link", np.array([1.0, 2.0, 3.0]), np.array([4.0, 5.0, 6.0]))
        w.odometry("/odom", T0 + 6, T0 + 2, ("odom", "base_link"), T, np.arange(6.0))
        w.fix("/fix", T0 + 7, T0 + 3, "gnss", np.array([40.0, -8.0, 100.0]), np.diag([1.0, 2.0, 3.0]), 2)
        w.heading("/gnss/heading", T0 + 8, T0 + 4, "gnss", to_quaternion(T))
        w.trunks(
            "/trunks",
            T0 + 9,
            T0 + 5,
            "base_link",
            np.array([[1.0, 2.0, 3.0]]),
            np.array([0.2]),
            np.array([[0, 0, 0, 1.0]]),
        )
    with Recording([path]) as r:
        got = dict(r.messages())
        np.testing.assert_allclose(r.frames.get("imu_link"), T, atol=1e-12)
    imu, odometry, fix, heading, trunks = (got[k] for k in ("imu", "odometry", "fix", "heading", "trunks"))
    assert isinstance(imu, Imu)
    np.testing.assert_array_equal(imu.gyro, [1, 2, 3])
    np.testing.assert_array_equal(imu.accel, [4, 5, 6])
    assert (imu.stamp_ns, imu.frame) == (T0 + 1, "imu_link")
    assert isinstance(odometry, Odometry)
    np.testing.assert_allclose(odometry.odom_T_child[:3], [T[0, 3], T[1, 3], T[2, 3]])
    np.testing.assert_array_equal(odometry.twist, np.arange(6))
    assert odometry.child_frame == "base_link"
    assert isinstance(fix, Fix)
    np.testing.assert_array_equal(np.diag(fix.cov), [1, 2, 3])
    assert isinstance(heading, Heading)
    assert heading.yaw == pytest.approx(0.3)
    assert isinstance(trunks, Trunks)
    np.testing.assert_allclose(trunks.p, [[1, 2, 3]])
    assert trunks.diameter[0] == pytest.approx(0.2)


@settings(max_examples=25, deadline=None)
@given(
    big=st.booleans(), pad=st.integers(0, 17), height=st.sampled_from([1, 4]), wide=st.booleans(), extra=st.booleans(),
    name=st.sampled_from(["a.bag", "a"]),
)  # fmt: skip
def test_any_layout_gives_the_same_points(
    tmp_path_factory: pytest.TempPathFactory, big: bool, pad: int, height: int, wide: bool, extra: bool, name: str
) -> None:
    o = ">" if big else "<"
    f = o + ("f8" if wide else "f4")
    fields = [("a", o + "u2")] * extra + [("x", f), ("gap", o + "i1"), ("y", f), ("z", f)]
    view = points(np.dtype(fields))
    path = tmp_path_factory.mktemp("layout") / name
    with BagWriter(path) as w:
        w.points("/p", T0, T0, "lidar", view, height=height, big_endian=big, pad=pad)
    scan = scan_of(path)
    for k, a in enumerate("xyz"):
        np.testing.assert_array_equal(scan.xyz[:, k], view[a].astype(np.float32))
    assert scan.offset is None


@pytest.mark.parametrize(
    ("field", "kind", "make", "first", "last"),
    [
        ("time", "<f4", lambda u: -0.1 + 0.1 * u, -0.1, 0.0),  # velodyne, stamped at the end
        ("time", "<f4", lambda u: 0.1 * u, 0.0, 0.1),
        ("t", "<u4", lambda u: 1e8 * u, 0.0, 0.1),  # ouster, ns
        ("timestamp", "<f8", lambda u: T0 * 1e-9 + 0.1 * u, 0.0, 0.1),  # hesai, seconds since 1970
        ("time", "<f4", lambda u: 100.0 * u - 100.0, -0.1, 0.0),  # ms
        ("t", "<u4", lambda u: 1e5 * u, 0.0, 0.1),  # µs
        ("offset_time", "<u4", lambda u: 1e8 * u, 0.0, 0.1),  # livox, ns
    ],
)
def test_time_of_points(tmp_path: Path, field: str, kind: str, make, first: float, last: float) -> None:
    view = points(np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), (field, kind)]), 50)
    view[field] = make(np.linspace(0, 1, 50))
    with BagWriter(tmp_path / "a") as w:
        w.points("/p", T0, T0, "lidar", view)
    offset = scan_of(tmp_path / "a").offset
    assert offset is not None
    assert offset[0] == pytest.approx(first, abs=2e-4)
    assert offset[-1] == pytest.approx(last, abs=2e-4)


def test_clusters_of_the_thesis(tmp_path: Path) -> None:
    cloud = np.array([[3.0, 0.1, 0.0], [3.0, -0.1, 0.1], [2.9, 0.0, 0.2]], np.float32)
    with BagWriter(tmp_path / "a.bag") as w:
        w.clusters("/clusters", T0, T0, "base_link", [cloud])
    with Recording([tmp_path / "a.bag"]) as r:
        ((_, trunks),) = r.messages()
    assert isinstance(trunks, Trunks)
    assert trunks.surface
    np.testing.assert_allclose(trunks.p[0], cloud.mean(0), atol=1e-6)
    np.testing.assert_allclose(trunks.clouds[0], cloud)


def test_several_bags_are_one_run_in_order(tmp_path: Path) -> None:
    for name, stamps in (("a.bag", [0, 2, 4]), ("b", [1, 3, 5])):
        with BagWriter(tmp_path / name) as w:
            for s in stamps:
                w.imu("/imu", T0 + s * 10**8, T0 + s * 10**8, "imu", np.zeros(3), np.ones(3))
    with Recording([tmp_path / "a.bag", tmp_path / "b"]) as r:
        stamps = [m.stamp_ns for _, m in r.messages()]
    assert stamps == [T0 + s * 10**8 for s in range(6)]
    with Recording([tmp_path / "b" / "b.mcap"]) as r:  # the lone file
        assert len(list(r.messages())) == 3


def imus(path: Path, stamps: list[float], logs: list[float] | None = None, topic: str = "/imu") -> Path:
    """A bag of IMU samples stamped and recorded at so many seconds."""
    with BagWriter(path) as w:
        for s, at in zip(stamps, logs or stamps, strict=True):
            w.imu(topic, T0 + int(at * 1e9), T0 + int(s * 1e9), "imu", np.zeros(3), np.ones(3))
    return path


@pytest.mark.parametrize("where", [0, 1, 150])
@pytest.mark.parametrize("by", [3600.0, 3.2e7, -3600.0])
def test_one_stamp_of_another_time_costs_one_message(tmp_path: Path, where: int, by: float) -> None:
    at = [0.1 * k for k in range(200)]
    stamps = [s + (by if k == where else 0.0) for k, s in enumerate(at)]
    with Recording([imus(tmp_path / "a.bag", stamps, at)]) as r:
        got = [m.stamp_ns for _, m in r.messages()]
    assert got == [T0 + int(s * 1e9) for k, s in enumerate(at) if k != where]
    assert r.skipped == Counter({"imu: stamp is not of its stream's clock": 1})


@pytest.mark.parametrize("by", [-5.0, 30.0, 3600.0])
def test_a_clock_that_is_set_goes_on(tmp_path: Path, by: float) -> None:
    at = [0.1 * k for k in range(200)]
    with Recording([imus(tmp_path / "a.bag", [s + by * (s > 10) for s in at], at)]) as r:
        got = np.array([m.stamp_ns - T0 for _, m in r.messages()]) * 1e-9
    np.testing.assert_allclose(got, at, atol=1e-6)
    assert any("its clock was set" in n for n in r.clocks.notes)


def test_a_backlog_that_newer_messages_overtake(tmp_path: Path) -> None:
    at = [0.01 * k for k in range(4000)]
    logs = [25.02 + 1e-6 * k if 20.0 <= s < 25.0 else s for k, s in enumerate(at)]
    with Recording([imus(tmp_path / "a.bag", at, logs)]) as r:
        got = [m.stamp_ns for _, m in r.messages()]
    assert sorted(got) == [T0 + int(s * 1e9) for s in at]
    assert not r.skipped
    assert not r.clocks.notes


@pytest.mark.parametrize("stall", [3.0, 8.0])
def test_a_backlog_is_late_and_no_clock_that_was_set(tmp_path: Path, stall: float) -> None:
    """A recorder or a link that stalls delivers in one burst what waited: the stamps are as good as ever."""
    at = [0.05 * k for k in range(800)]
    logs = [20.0 + stall - 0.01 + 1e-5 * (k - 400) if 20.0 <= s < 20.0 + stall else s for k, s in enumerate(at)]
    with Recording([imus(tmp_path / "a.bag", at, logs)]) as r:
        assert [m.stamp_ns for _, m in r.messages()] == [T0 + int(s * 1e9) for s in at]
    assert not r.skipped
    assert not r.clocks.notes


@pytest.mark.parametrize(
    "stamp", [lambda s: s + 18, lambda s: s - 37, lambda s: s + 1000 - T0 * 1e-9, lambda s: -T0 * 1e-9]
)
def test_a_stream_on_its_own_clock_is_laid_onto_the_others(tmp_path: Path, stamp) -> None:
    with BagWriter(tmp_path / "a.bag") as w:
        for k in range(200):
            at = T0 + k * 10**8
            w.odometry("/odom", at + 2 * 10**6, at, ("odom", "base_link"), np.eye(4), np.zeros(6))
            w.imu("/imu", at + 10**6, T0 + int(stamp(0.1 * k) * 1e9), "imu", np.zeros(3), np.ones(3))
    with Recording([tmp_path / "a.bag"]) as r:
        got = [m.stamp_ns for kind, m in r.messages() if kind == "imu"]
    assert len(got) == 200
    assert np.abs(np.array(got) - T0 - np.arange(200) * 10**8).max() < 5_000_000
    assert any("imu" in n for n in r.clocks.notes)
    assert not r.skipped


@pytest.mark.parametrize("stamp", [lambda s: s + 1000 - T0 * 1e-9, lambda s: -T0 * 1e-9])
@pytest.mark.parametrize("first", [0.0, -0.1])
def test_sweeps_on_their_own_clock_were_complete_when_they_arrived(tmp_path: Path, stamp, first: float) -> None:
    """Stamped at their first point or at their last: it is the last that was measured just before the arrival."""
    view = points(np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("time", "<f4")]))
    view["time"] = first + np.linspace(0.0, 0.1, len(view))
    with BagWriter(tmp_path / "a.bag") as w:
        for k in range(100):
            end = T0 + k * 10**8
            w.odometry("/odom", end + 2 * 10**6, end, ("odom", "base_link"), np.eye(4), np.zeros(6))
            w.imu("/imu", end + 10**6, end, "imu", np.zeros(3), np.ones(3))
            header = T0 + int(stamp(0.1 * k - (0.1 + first)) * 1e9)
            w.points("/points", end + 3 * 10**6, header, "lidar", view)
    with Recording([tmp_path / "a.bag"]) as r:
        got = [m for kind, m in r.messages() if kind == "points"]
    last = [m.stamp_ns + float(m.offset.max()) * 1e9 - T0 - k * 10**8 for k, m in enumerate(got)]
    assert len(got) == 100
    assert np.abs(last).max() < 5_000_000


def test_a_clock_that_runs_ahead_is_told(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "a.bag") as w:
        for k in range(200):
            at = T0 + k * 10**8
            w.odometry("/odom", at, at, ("odom", "base_link"), np.eye(4), np.zeros(6))
            w.imu("/imu", at, at + 3 * 10**8, "imu", np.zeros(3), np.ones(3))
    with Recording([tmp_path / "a.bag"]) as r:
        assert len(list(r.messages())) == 400
    assert r.clocks.ahead == {"imu": pytest.approx(0.3)}


def test_recordings_whose_time_says_nothing_are_taken_as_they_are(tmp_path: Path) -> None:
    """Converted bags put all messages at one time of recording."""
    stamps = [0.1 * k for k in range(100)]
    with Recording([imus(tmp_path / "a.bag", stamps, [1e-9 * k for k in range(100)])]) as r:
        assert [m.stamp_ns for _, m in r.messages()] == [T0 + int(s * 1e9) for s in stamps]
    assert not r.skipped


def test_nonsense_is_counted(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "a.bag") as w:
        for k in range(3):
            w.imu("/imu", T0 + k * 10**8, T0 + k * 10**8, "imu", np.full(3, np.nan if k == 1 else 0.0), np.ones(3))
    with Recording([tmp_path / "a.bag"]) as r:
        assert len(list(r.messages())) == 2
        assert r.skipped == Counter({"imu: not finite": 1})


def test_topics() -> None:
    two = {"/a": "nav_msgs/msg/Odometry", "/b": "nav_msgs/msg/Odometry", "/gps/heading": "sensor_msgs/msg/Imu"}
    with pytest.raises(TopicError, match="--topic-odometry /a"):
        choose(two, BagsConfig())
    chosen = choose(two, BagsConfig(topic_odometry="/b"))
    assert chosen == {"odometry": "/b", "heading": "/gps/heading"}
    assert choose(two, BagsConfig(topic_odometry="none", topic_heading="none")) == {}
    with pytest.raises(TopicError, match="no such topic"):
        choose(two, BagsConfig(topic_odometry="/c"))
    with pytest.raises(TopicError, match="wanted is"):
        choose(two, BagsConfig(topic_odometry="/gps/heading"))


def test_unknown_frame_says_what_to_type(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "a.bag") as w:
        w.points("/p", T0, T0, "velodyne", points(VELODYNE))
    with Recording([tmp_path / "a.bag"]) as r:
        frames = r.frames
    with pytest.raises(FrameError, match="--extrinsic velodyne="):
        frames.get("velodyne")
    config = BagsConfig(extrinsics={"velodyne": (1, 2, 3, 0, 0, np.pi / 2)})
    with Recording([tmp_path / "a.bag"], config) as r:
        np.testing.assert_allclose(r.frames.get("velodyne")[:3, 3], [1, 2, 3])


@pytest.mark.parametrize("cut", [0, 10, 500, 3000])
def test_truncated_bags_are_named(tmp_path: Path, cut: int) -> None:
    with BagWriter(tmp_path / "a.bag") as w:
        for k in range(50):
            w.imu("/imu", T0 + k, T0 + k, "imu", np.zeros(3), np.ones(3))
    data = (tmp_path / "a.bag").read_bytes()
    (tmp_path / "cut.bag").write_bytes(data[:cut])
    with pytest.raises(InputError, match=r"cut\.bag"), Recording([tmp_path / "cut.bag"]) as r:
        list(r.messages())


def test_no_file_and_no_recording(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        Recording([tmp_path / "nothing.bag"])
    (tmp_path / "notes.txt").write_text("x")
    with pytest.raises(InputError, match="not a recording"):
        Recording([tmp_path / "notes.txt"])


def test_a_writer_that_fails_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="could not convert"), BagWriter(tmp_path / "a.bag") as w:
        w.imu("/imu", T0, T0, "imu", np.array(["no number", "0", "0"]), np.ones(3))
    assert list(tmp_path.iterdir()) == []


def test_real_bags(shared: Path) -> None:
    with Recording([shared / "victoria_park_first_half.bag"]) as r:
        assert set(r.chosen) == {"odometry", "fix", "trunks"}
        assert Counter(k for k, _ in r.messages()) == Counter(odometry=31123, trunks=3643, fix=2267)
    with Recording([shared / "luminar_pointcloud2.bag"]) as r:
        scan = next(m for _, m in r.messages(["points"]))
        assert isinstance(scan, Scan)
        assert scan.offset is not None
        assert -0.2 < scan.offset.min() < 0
        assert scan.ring is not None


def test_mounts_are_found_from_child_to_parent() -> None:
    """TF may hang the base below a sensor: the chain is walked both ways."""
    from topograph.bags.frames import Frames
    from topograph.geometry import from_xyz_rpy, inverse

    T = from_xyz_rpy(1.0, 2.0, 3.0, 0.1, 0.2, 1.0)
    frames = Frames("base_link", {})
    frames.add("velodyne", "base_link", T)
    frames.add("velodyne", "camera", T)
    np.testing.assert_allclose(frames.get("velodyne"), inverse(T), atol=1e-12)
    np.testing.assert_allclose(frames.get("camera"), np.eye(4), atol=1e-12)


def test_covariances_that_are_not_known_are_wide_and_headings_have_their_own() -> None:
    from types import SimpleNamespace as Message

    from topograph.bags.decode import decode_fix, decode_heading

    header = Message(stamp=Message(sec=1, nanosec=0), frame_id="gnss")
    fix = Message(header=header, latitude=1.0, longitude=2.0, altitude=3.0, position_covariance=np.zeros(9),
                  position_covariance_type=0, status=Message(status=0))  # fmt: skip
    assert np.sqrt(np.diag(decode_fix(fix).cov)) == pytest.approx([5.0, 5.0, 10.0])
    q = Message(x=0.0, y=0.0, z=np.sin(0.4), w=np.cos(0.4))
    imu = Message(header=header, orientation=q, orientation_covariance=np.diag([0.04, 0.09, 0.01]).ravel())
    heading = decode_heading(imu)
    assert heading.yaw == pytest.approx(0.8)
    assert heading.sigma == pytest.approx(0.1)


@pytest.mark.parametrize("seed", range(6))
def test_every_announced_message_is_given_or_counted(tmp_path: Path, seed: int) -> None:
    """Whatever is damaged: what the index announces is used, or skipped with a reason."""
    imus(tmp_path / "a", [0.05 * k for k in range(400)])
    (path,) = (tmp_path / "a").glob("*.mcap")
    data = bytearray(path.read_bytes())
    rng = np.random.default_rng(seed)
    at = int(rng.integers(len(data) // 4, len(data) // 2))
    data[at : at + 3000] = bytes(3000) if seed % 2 else rng.bytes(3000)
    path.write_bytes(bytes(data))
    with Recording([tmp_path / "a"]) as r:
        given = len(list(r.messages()))
        assert given < 400
        assert given + sum(r.skipped.values()) == r.counts["/imu"] == 400
