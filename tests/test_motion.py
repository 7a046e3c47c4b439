"""Wheels, gyro and fixes against each other: what is wrong is found, what is right is left alone."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from topograph.bags import Fix, Heading, Imu, Odometry
from topograph.geometry import Array, Datum, interpolate, inverse, planar, to_quaternion, transform, wrap, yaw_of
from topograph.motion import (
    MotionConfig,
    align_imu,
    dead_reckon,
    in_radians,
    mount_turn,
    without_nonsense,
)
from topograph.motion.rates import compare, wheel_rate
from topograph.session import Streams, StreamsBuilder

T0 = 1_700_000_000 * 10**9
DATUM = Datum(40.0, -8.0, 100.0)
LEVER = np.array([-0.3, 0.2, 1.1])


def drive(seed: int = 0, seconds: float = 60.0, mount: float = 0.0) -> tuple[Streams, Array]:
    """Streams of a drive with turns and stops, and the true poses (N, 4, 4) at odometry's stamps. The IMU is turned by `mount`."""
    rng = np.random.default_rng(seed)
    hz, n = 50, int(50 * seconds)
    t = np.arange(n) / hz
    w = 0.4 * np.sin(t / 3.0)
    v = np.clip((t - 2.0) / 1.5, 0.0, 1.0) * (1.0 + 0.4 * np.sin(t / 2.0))
    yaw = np.cumsum(w) / hz
    x, y = np.cumsum(v * np.cos(yaw)) / hz, np.cumsum(v * np.sin(yaw)) / hz
    T = planar(x, y, yaw)
    ns = T0 + (t * 1e9).astype(np.int64)
    b = StreamsBuilder()
    antenna = transform(T, LEVER)
    g = DATUM.to_geodetic(antenna + rng.normal(0, 0.008, (n, 3)))
    c, s = np.cos(mount), np.sin(mount)
    ax, ay = np.gradient(v, 1 / hz), v * w
    for k in range(n):
        q = to_quaternion(T[k])
        if k % 2 == 0:
            b.add(
                Odometry(int(ns[k]), "base_link", np.concatenate([T[k, :3, 3], q]), np.array([v[k], 0, 0, 0, 0, w[k]]))
            )
        accel = np.array([c * ax[k] + s * ay[k], -s * ax[k] + c * ay[k], 9.80665]) + rng.normal(0, 0.05, 3)
        b.add(Imu(int(ns[k]), "imu", np.array([0, 0, w[k]]) + rng.normal(0, 0.003, 3), accel))
        if k % 10 == 0:
            b.add(Fix(int(ns[k]), "gnss", g[k], 1e-4 * np.diag([1, 1, 4.0]), 2))
            b.add(Heading(int(ns[k]), "gnss", float(yaw[k] + rng.normal(0, 0.005)), 0.005))
    return b.build(Counter()), T[::2]


def moved(streams: Streams, by: Array) -> Streams:
    """The streams with odometry's steps multiplied by (O-1,) `by`."""
    p = streams.odom_T_child[:, :3, 3]
    q = np.concatenate([p[:1], p[0] + np.cumsum(np.diff(p, axis=0) * by[:, None], axis=0)])
    T = streams.odom_T_child.copy()
    T[:, :3, 3] = q
    return replace(streams, odom_T_child=T)


@settings(max_examples=8, deadline=None)
@given(
    seed=st.integers(0, 1000),
    share=st.sampled_from([0.0, 0.4, 1.6, 3.0]),
    at=st.floats(8, 45),
    length=st.floats(2.5, 8),
)
def test_slips_are_found_and_bridged_by_fixes(seed: int, share: float, at: float, length: float) -> None:
    streams, true = drive(seed)
    t = (streams.odometry_ns[1:] - T0) * 1e-9
    inside = (t > at) & (t < at + length)
    slipped = moved(streams, np.where(inside, share, 1.0))
    motion = dead_reckon(slipped, None, np.eye(4), MotionConfig(), LEVER)
    assert motion is not None
    assert len(motion.slips) >= 1
    assert motion.slips[:, 0].min() < at + 1.5
    length_of = np.linalg.norm(np.diff(true[:, :3, 3], axis=0), axis=1).sum()
    assert motion.distance[-1] == pytest.approx(length_of, rel=0.03)
    # Where it slipped the steps are less sure, elsewhere they are as ever.
    keys = streams.odometry_ns[::25]
    sure = dead_reckon(streams, None, np.eye(4), MotionConfig(), LEVER)
    assert sure is not None
    wider = motion.sigma(MotionConfig(), keys)[:, 3] / sure.sigma(MotionConfig(), keys)[:, 3]
    assert wider.max() > 3.0
    assert np.median(wider) == pytest.approx(1.0, abs=0.1)


@given(seed=st.integers(0, 1000))
@settings(max_examples=5, deadline=None)
def test_sound_wheels_are_left_alone(seed: int) -> None:
    streams, _ = drive(seed)
    motion = dead_reckon(streams, None, np.eye(4), MotionConfig(), LEVER)
    assert motion is not None
    assert motion.wheel_scale == 1.0
    assert len(motion.slips) == 0


@pytest.mark.parametrize("jump", [1.0, 20.0])
def test_a_jump_of_gnss_is_no_slip(jump: float) -> None:
    streams, _ = drive(1)
    enu = DATUM.to_enu(streams.lat_lon_h)
    late = streams.fix_ns > T0 + 30 * 10**9
    enu[late, 0] += jump
    motion = dead_reckon(replace(streams, lat_lon_h=DATUM.to_geodetic(enu)), None, np.eye(4), MotionConfig(), LEVER)
    assert motion is not None
    assert len(motion.slips) == 0


@pytest.mark.parametrize("scale", [0.7, 1.25])
def test_scale_of_the_wheels_is_learnt_from_fixes(scale: float) -> None:
    streams, _ = drive(2)
    motion = dead_reckon(
        moved(streams, np.full(len(streams.odometry_ns) - 1, scale)), None, np.eye(4), MotionConfig(), LEVER
    )
    assert motion is not None
    assert motion.wheel_scale * scale == pytest.approx(1.0, abs=0.02)


@given(lag=st.floats(-5, 5), seed=st.integers(0, 100))
@settings(max_examples=15, deadline=None)
def test_lag_between_rates_is_found(lag: float, seed: int) -> None:
    streams, _ = drive(seed)
    late = streams.imu_ns + int(lag * 1e9)
    found = compare(late, streams.gyro[:, 2], *wheel_rate(streams))
    assert found is not None
    assert found.right
    assert found.lag == pytest.approx(lag, abs=0.03)


@pytest.mark.parametrize("late", ["imu", "odometry"])
def test_the_clock_that_is_late_is_the_one_set_right(late: str) -> None:
    """The heading decides which of the two it is."""
    streams, _ = drive(3)
    key = f"{late}_ns"
    wrong = replace(streams, **{key: getattr(streams, key) + 600_000_000})
    inertial, mended, notes = align_imu(wrong, np.eye(4))
    assert inertial is not None
    assert any("clock" in n for n in notes)
    assert np.abs(getattr(mended, key) - getattr(streams, key)).max() < 40_000_000
    other = "imu_ns" if late == "odometry" else "odometry_ns"
    np.testing.assert_array_equal(getattr(mended, other), getattr(streams, other))


@pytest.mark.parametrize("break_it", [lambda g: g * [1, 1, -1], lambda g: 0 * g, lambda g: 3.0 * g])
def test_a_gyro_that_contradicts_the_wheels_is_left_out(break_it) -> None:
    streams, _ = drive(4)
    inertial, _, notes = align_imu(replace(streams, gyro=break_it(streams.gyro)), np.eye(4))
    assert inertial is None
    assert any("left out" in n for n in notes)


def test_wheels_that_do_not_turn_do_not_discredit_the_gyro() -> None:
    streams, _ = drive(5)
    flat = streams.odom_T_child.copy()
    flat[:, :3, :3] = np.eye(3)
    inertial, _, _ = align_imu(replace(streams, odom_T_child=flat), np.eye(4))
    assert inertial is not None


@given(turn=st.floats(-3.1, 3.1))
@settings(max_examples=15, deadline=None)
def test_turn_of_the_imu_is_found_from_accelerations(turn: float) -> None:
    streams, _ = drive(6, mount=turn)
    found, sigma = mount_turn(streams, np.eye(4))
    assert abs((found - turn + np.pi) % (2 * np.pi) - np.pi) < max(0.15, 4 * sigma)
    assert sigma < 0.3


def test_what_no_imu_measures_is_taken_out_and_counted() -> None:
    streams, _ = drive(7)
    gyro, accel = streams.gyro.copy(), streams.accel.copy()
    gyro[100, 2], gyro[200, 0], accel[300, 1] = 1e300, 12.0, -400.0
    gyro[1000:1100] = gyro[1000]
    skipped: Counter[str] = Counter()
    clean = without_nonsense(replace(streams, gyro=gyro, accel=accel), skipped)
    assert len(streams.imu_ns) - len(clean.imu_ns) == 103 == sum(skipped.values())
    assert set(streams.imu_ns[[100, 200, 300, 1050]]).isdisjoint(clean.imu_ns)
    assert without_nonsense(streams, Counter()) is streams


def test_an_imu_upside_down_is_left_out() -> None:
    streams, _ = drive(8)
    down = np.diag([1.0, -1.0, -1.0, 1.0])
    inertial, _, notes = align_imu(streams, down)
    assert inertial is None
    assert "180°" in notes[0]


def test_degrees_are_converted_and_radians_are_not() -> None:
    streams, _ = drive(9)
    same, notes = in_radians(streams)
    assert same is streams
    assert not notes
    mended, notes = in_radians(replace(streams, gyro=np.degrees(streams.gyro)))
    np.testing.assert_allclose(mended.gyro, streams.gyro)
    assert notes


def test_an_arc_of_slow_odometry_is_laid_along_the_gyro() -> None:
    """Half of a step's turn lies before its middle: with odometry at 2.5 Hz the path would else be off by decimetres."""
    streams, true = drive(10)
    thin = replace(streams, odometry_ns=streams.odometry_ns[::10], odom_T_child=streams.odom_T_child[::10], twist=streams.twist[::10],
                   fix_ns=streams.fix_ns[:0], lat_lon_h=streams.lat_lon_h[:0], fix_cov=streams.fix_cov[:0])  # fmt: skip
    inertial, _, _ = align_imu(thin, np.eye(4))
    slow, quick = (dead_reckon(x, inertial, np.eye(4), MotionConfig()) for x in (thin, streams))
    assert slow is not None
    assert quick is not None
    assert slow.gyro
    off = np.linalg.norm((slow.odom_T_robot[:, :3, 3] - quick.odom_T_robot[::10, :3, 3])[:, :2], axis=1)
    assert off.max() < 0.12
    assert np.linalg.norm((slow.odom_T_robot[:, :3, 3] - true[::10, :3, 3])[:, :2], axis=1).max() < 0.4


@pytest.mark.parametrize(("roll", "pitch"), [(0.12, 0.0), (-0.1, 0.08), (0.0, -0.15)])
def test_attitude_is_held_to_gravity_against_a_drifting_gyro(roll: float, pitch: float) -> None:
    streams, _ = drive(11)
    R = np.array(planar(0.0, 0.0, 0.0))
    up = np.array([-np.sin(pitch), np.sin(roll) * np.cos(pitch), np.cos(roll) * np.cos(pitch)])
    tilted = replace(
        streams, accel=streams.accel + 9.80665 * (up - [0, 0, 1]), gyro=streams.gyro[:, 2:] * up + [0.01, -0.01, 0.0]
    )
    inertial, _, _ = align_imu(tilted, R)
    assert inertial is not None
    motion = dead_reckon(tilted, replace(inertial, gyro_bias=np.zeros(3)), np.eye(4), MotionConfig(), LEVER)
    assert motion is not None
    seen = motion.odom_T_robot[200:, 2, :3]
    assert np.degrees(np.arccos(np.clip(seen @ up, -1, 1))).max() < 4.5


def fixes_of(streams: Streams, true: Array, hz: float, sigma: float, lever: Array, seed: int = 0) -> Streams:
    """Other fixes of the same drive."""
    rng = np.random.default_rng(seed)
    ns = np.arange(streams.odometry_ns[0], streams.odometry_ns[-1], int(1e9 / hz))
    p = transform(interpolate(streams.odometry_ns, true, ns), lever) + rng.normal(0, sigma, (len(ns), 3))
    cov = np.tile(sigma**2 * np.diag([1.0, 1.0, 4.0]), (len(ns), 1, 1))
    return replace(streams, fix_ns=ns, lat_lon_h=DATUM.to_geodetic(p), fix_cov=cov, fix_status=np.full(len(ns), 2))


@pytest.mark.parametrize(("hz", "sigma"), [(5.0, 0.01), (10.0, 0.02), (20.0, 0.01), (5.0, 0.1), (1.0, 0.02)])
def test_a_robot_that_stands_stays(hz: float, sigma: float) -> None:
    """Noise of fixes is no motion, however often they come."""
    streams, true = drive(12)
    n = len(streams.odometry_ns)
    still = replace(streams, odom_T_child=np.tile(streams.odom_T_child[:1], (n, 1, 1)), twist=0 * streams.twist)
    half = n // 2
    T = np.concatenate([np.tile(true[:1], (half, 1, 1)), true[: n - half]])
    mixed = replace(still, odom_T_child=np.concatenate([still.odom_T_child[:half], streams.odom_T_child[: n - half]]))
    motion = dead_reckon(fixes_of(mixed, T, hz, sigma, LEVER), None, np.eye(4), MotionConfig(), LEVER)
    assert motion is not None
    assert motion.distance[half] < 0.05
    assert not len(motion.slips)


@pytest.mark.parametrize("way", ["spot", "reverse"])
def test_an_antenna_beside_the_middle_is_no_slip(way: str) -> None:
    lever = np.array([-0.2, 0.5, 1.0])
    t = np.arange(0, 60, 0.04)
    w = 0.5 * np.sign(np.sin(t / 4)) if way == "spot" else 0.35 * np.sin(t / 3)
    v = np.zeros(len(t)) if way == "spot" else np.where(t < 2, 0.0, -0.8 * np.sin(t / 5))
    if way == "spot":
        v = np.where(t > 45, 0.8, 0.0) * np.clip(t - 45, 0, 1)
    yaw = np.cumsum(w) * 0.04
    T = planar(np.cumsum(v * np.cos(yaw)) * 0.04, np.cumsum(v * np.sin(yaw)) * 0.04, yaw)
    streams, _ = drive(13)
    ns = T0 + (t * 1e9).astype(np.int64)
    s = replace(streams, odometry_ns=ns, odom_T_child=T, twist=np.column_stack([v, 0 * v, 0 * v, 0 * v, 0 * v, w]))
    motion = dead_reckon(fixes_of(s, T, 5.0, 0.01, lever), None, np.eye(4), MotionConfig(), lever)
    assert motion is not None
    assert not len(motion.slips)
    assert motion.distance[-1] == pytest.approx(np.abs(v).sum() * 0.04, abs=0.1)


@pytest.mark.parametrize("scale", [0.55, 1.8])
def test_skid_steered_wheels_do_not_discredit_the_gyro(scale: float) -> None:
    streams, true = drive(14)
    yaw = np.unwrap(np.arctan2(true[:, 1, 0], true[:, 0, 0]))
    T = planar(np.zeros(len(yaw)), np.zeros(len(yaw)), scale * yaw)
    T[:, :3, 3] = true[:, :3, 3]
    bare = replace(streams, odom_T_child=T, heading_ns=streams.heading_ns[:0], heading=streams.heading[:0], fix_ns=streams.fix_ns[:0],
                   fix_cov=streams.fix_cov[:0], lat_lon_h=streams.lat_lon_h[:0])  # fmt: skip
    inertial, same, notes = align_imu(bare, np.eye(4))
    assert inertial is not None
    np.testing.assert_array_equal(same.imu_ns, bare.imu_ns)
    assert not notes


@pytest.mark.parametrize("what", ["imu", "odometry"])
@pytest.mark.parametrize("days", [0, 200])
def test_a_gap_is_no_lag(what: str, days: int) -> None:
    """Neither a gap in one stream, nor a clock that all streams followed when it was set."""
    streams, _ = drive(15)
    gap = 86_400 * 10**9 * days
    late = {
        f"{k}_ns": getattr(streams, f"{k}_ns") + gap * (getattr(streams, f"{k}_ns") > T0 + 30 * 10**9)
        for k in ("imu", "odometry", "heading", "fix")
    }
    s = replace(streams, **late)
    out = (getattr(streams, f"{what}_ns") > T0 + 20 * 10**9) & (getattr(streams, f"{what}_ns") < T0 + 38 * 10**9)
    if what == "imu":
        s = replace(s, imu_ns=s.imu_ns[~out], gyro=s.gyro[~out], accel=s.accel[~out])
    else:
        s = replace(s, odometry_ns=s.odometry_ns[~out], odom_T_child=s.odom_T_child[~out], twist=s.twist[~out])
    inertial, same, notes = align_imu(s, np.eye(4))
    assert inertial is not None, notes
    assert not notes
    np.testing.assert_array_equal(same.imu_ns, s.imu_ns)


def test_a_shaking_yaw_of_the_wheels_on_a_straight_line_says_nothing_of_the_gyro() -> None:
    streams, _ = drive(16)
    rng = np.random.default_rng(0)
    n = len(streams.odometry_ns)
    T = planar(np.arange(n) * 0.04, np.zeros(n), rng.normal(0, 0.002, n))
    s = replace(
        streams,
        odom_T_child=T,
        gyro=rng.normal(0, 0.003, streams.gyro.shape),
        heading_ns=streams.heading_ns[:0],
        heading=streams.heading[:0],
    )
    inertial, _, notes = align_imu(s, np.eye(4))
    assert inertial is not None
    assert not notes


def test_turns_within_a_gap_of_the_imu_are_the_wheels() -> None:
    streams, true = drive(17)
    out = (streams.imu_ns > T0 + 15 * 10**9) & (streams.imu_ns < T0 + 30 * 10**9)
    s = replace(streams, imu_ns=streams.imu_ns[~out], gyro=streams.gyro[~out], accel=streams.accel[~out])
    inertial, s, _ = align_imu(s, np.eye(4))
    motion = dead_reckon(s, inertial, np.eye(4), MotionConfig())
    assert motion is not None
    assert motion.gyro
    assert np.abs(wrap(yaw_of(motion.odom_T_robot) - yaw_of(true))).max() < 0.05
    at = T0 + np.array([10, 12, 20, 22]) * 10**9
    sigma = motion.sigma(MotionConfig(), at)[:, 2]
    assert sigma[2] > 2 * sigma[0]


@pytest.mark.parametrize("scale", [0.9, 1.0, 1.1])
def test_scale_of_the_gyro_is_learnt_from_the_heading(scale: float) -> None:
    streams, _ = drive(18)
    inertial, _, notes = align_imu(replace(streams, gyro=scale * streams.gyro), np.eye(4))
    assert inertial is not None
    assert bool(notes) == (scale != 1.0)
    turned = float(inertial.gyro[:, 2] @ streams.gyro[:, 2] / (streams.gyro[:, 2] @ streams.gyro[:, 2]))
    assert turned == pytest.approx(1.0, abs=0.015)


@pytest.mark.parametrize("share", [0.3, 0.6])
def test_fixes_that_jump_about_tell_nothing_of_the_wheels(share: float) -> None:
    streams, _ = drive(19)
    rng = np.random.default_rng(1)
    enu = DATUM.to_enu(streams.lat_lon_h) + 5.0 * rng.normal(size=(len(streams.fix_ns), 3)) * (
        rng.random((len(streams.fix_ns), 1)) < share
    )
    motion = dead_reckon(replace(streams, lat_lon_h=DATUM.to_geodetic(enu)), None, np.eye(4), MotionConfig(), LEVER)
    assert motion is not None
    assert motion.wheel_scale == 1.0
    sound = dead_reckon(streams, None, np.eye(4), MotionConfig(), LEVER)
    assert sound is not None
    assert motion.distance[-1] == pytest.approx(sound.distance[-1], rel=0.02)


def test_a_frozen_receiver_is_counted() -> None:
    b = StreamsBuilder()
    for k in range(60):
        at = np.array([40.0 + 1e-6 * min(k, 20), -8.0, 100.0])
        b.add(Fix(T0 + k * 10**8, "gnss", at, 1e-4 * np.eye(3), 2))
    skipped: Counter[str] = Counter()
    assert len(b.build(skipped).fix_ns) == 21
    assert skipped == Counter({"fix: position repeated (frozen)": 39})


def test_the_map_teaches_the_wheels_scale_and_whom_to_believe() -> None:
    """Wheels that say 0.8 of the way; a gyro in degrees; one that is dead while the wheels turn with the map."""
    from topograph.motion.against import Against

    def drive(gyro: float, wheels: float, way: float = 1.0, seconds: float = 40.0) -> Against:
        against, pose = Against(), np.zeros(3)
        against.see(pose.copy())
        for k in range(int(seconds * 10)):
            rate = 0.3 * np.sin(0.2 * k / 10)
            pose = pose + [0.1 * np.cos(pose[2]), 0.1 * np.sin(pose[2]), 0.1 * rate]
            step = np.array([0.1 * way * against.scale, 0.0])
            against.take(0.1 * rate * gyro, 0.1 * rate * wheels, step, 0.1)
            against.see(pose.copy())
        return against

    assert drive(1.0, 1.0, way=0.8).scale == pytest.approx(1 / 0.8, abs=0.02)
    sound = drive(1.0, 0.6)
    assert not sound.gyro_is_wrong
    assert not sound.degrees
    assert sound.scale == pytest.approx(1.0, abs=0.01)
    assert sound.take(0.0, 0.0, np.zeros(2), 0.1) == 0.0  # wheels that skid in turns do not discredit a gyro
    assert drive(57.3, 1.0).degrees
    assert drive(0.0, 1.0).gyro_is_wrong
    assert drive(-1.0, 1.0).take(0.0, 0.0, np.zeros(2), 0.1) > 0.1


@pytest.mark.parametrize("seed", range(3))
def test_trunks_watch_wheels_and_gyro(seed: int) -> None:
    from topograph.motion import Leg
    from topograph.trees.slip import SlipWatch

    rng = np.random.default_rng(seed)
    trees = rng.uniform(-25, 25, (70, 2))

    def drive(wheels: float, gyro: float) -> tuple[float, float]:
        watch, x, y, yaw = SlipWatch(), -15.0, 0.0, 0.0
        blind = doubted = 0
        for _ in range(100):
            x, y, yaw = x + 0.1 * np.cos(yaw), y + 0.1 * np.sin(yaw), yaw + 0.02
            R = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
            seen = (trees - [x, y]) @ R + rng.normal(0, 0.03, trees.shape)
            leg = Leg(
                step=np.array([0.1 * wheels, 0.0, 0.02 * gyro]), distance=0.1 * wheels, turned=0.02 * gyro, seconds=0.1
            )
            out = watch.check(seen[rng.random(len(seen)) < 0.8], leg)
            blind += out.slip > 0
            doubted += out.rate_sigma > 0
        return blind / 100, doubted / 100

    assert max(drive(1.0, 1.0)) <= 0.02
    assert drive(1.05, 1.0)[0] <= 0.1
    assert drive(0.0, 1.0)[0] > 0.9
    assert drive(3.0, 1.0)[0] > 0.9
    assert drive(-1.0, 1.0)[0] > 0.9
    assert drive(1.0, 0.0)[1] > 0.8
    assert drive(1.0, 1.3)[1] > 0.5


@given(st.integers(0, 50), st.floats(0.5, 1.0), st.floats(-3.1, 3.1), st.floats(-0.4, 0.4), st.integers(500, 900))
@settings(max_examples=8, deadline=None, phases=[Phase.explicit, Phase.generate])
def test_a_step_in_which_wheels_and_fixes_part_tells_nothing(
    seed: int, size: float, way: float, turn: float, at: int
) -> None:
    """Odometry that jumps (a scan that was matched wrongly) looks like fixes that jump: that step is wide, the others are as they were."""
    streams, true = drive(seed)
    streams = fixes_of(streams, true, 5.0, 0.015, LEVER, seed)
    sound = dead_reckon(streams, None, np.eye(4), MotionConfig(), LEVER)
    assert sound is not None
    assert not len(sound.breaks)
    T = streams.odom_T_child.copy()
    broken = inverse(T[at]) @ T[at + 1] @ planar(size * np.cos(way), size * np.sin(way), turn)
    T[at + 1 :] = T[at] @ broken @ (inverse(T[at + 1]) @ T[at + 1 :])
    motion = dead_reckon(replace(streams, odom_T_child=T), None, np.eye(4), MotionConfig(), LEVER)
    assert motion is not None
    seconds = (streams.odometry_ns - streams.odometry_ns[0]) * 1e-9
    assert len(motion.breaks) + len(motion.slips) >= 1
    if not len(motion.breaks):  # forward, it may be taken for a slip
        return
    assert motion.breaks[0, 0] == pytest.approx(seconds[at], abs=0.5)
    assert motion.breaks[0, 1] == pytest.approx(size, abs=0.15 + 0.1 * size)
    stamps = streams.odometry_ns[::5]
    before, after = (m.sigma(MotionConfig(), stamps) for m in (sound, motion))
    away = np.abs(seconds[::5][:-1] - seconds[at]) > 0.6
    np.testing.assert_allclose(after[away, 3:5], before[away, 3:5], rtol=0.3, atol=0.01)
    near = ~away
    if not len(motion.slips):
        assert np.sum(after[near, 4] - before[near, 4]) > 0.5 * size


@pytest.mark.parametrize("back_s", [1.0, 30.0])
def test_fixes_that_jump_are_left_to_the_trees_too(back_s: float) -> None:
    """From outside nobody can tell: fixes that step aside for good part from the wheels in one step. A jump that comes back within the
    windows is none of it."""
    streams, true = drive(7)
    streams = fixes_of(streams, true, 5.0, 0.015, LEVER)
    enu = streams.fixes_enu()
    seconds = (streams.fix_ns - streams.fix_ns[0]) * 1e-9
    enu[(seconds > 12.0) & (seconds < 12.0 + back_s), 0] += 0.8
    streams = replace(streams, lat_lon_h=Datum(*np.median(streams.lat_lon_h, axis=0)).to_geodetic(enu))
    motion = dead_reckon(streams, None, np.eye(4), MotionConfig(), LEVER)
    assert motion is not None
    assert len(motion.breaks) == (2 if back_s > 20.0 else 0)  # aside, and back
    np.testing.assert_allclose(motion.odom_T_robot, streams.odom_T_child, atol=1e-6)
