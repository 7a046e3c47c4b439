"""Columns of scans are the scans."""

from collections import Counter

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from topograph.bags import Imu, Odometry, Trunks
from topograph.geometry import exp, inverse, to_quaternion
from topograph.session import SECTORS, Driven, Scans, ScansBuilder, StreamsBuilder
from topograph.session.scans import SCANS_AT_ONCE
from topograph.trees import Detections

T0 = 1_700_000_000_000_000_000
FIELDS = ("p", "axis", "diameter", "cov", "height", "score", "kinds", "measured", "stems", "free", "eye")


def drawn(seed: int, stamp_ns: int) -> Trunks:
    """A scan of any source: with and without kinds, clouds and the like."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(0, 5))
    told = rng.random(5) < 0.5
    return Trunks(
        stamp_ns=stamp_ns,
        frame=str(rng.choice(["base_link", "lidar"])),
        p=rng.normal(size=(n, 3)),
        axis=rng.normal(size=(n, 3)),
        diameter=rng.random(n),
        cov=rng.random((n, 3, 3), dtype=np.float32).astype(float),  # kept in single precision
        height=np.full(n, np.nan),
        score=rng.normal(size=n),
        clouds=tuple(rng.normal(size=(int(k), 3)).astype(np.float32) for k in rng.integers(0, 4, n)) if told[0] else (),
        surface=bool(told[1]),
        kinds=rng.normal(size=(n if told[2] else 0, 3)),
        measured=rng.normal(size=(n if told[3] else 0, 6)),
        stems=rng.integers(1, 4, n if told[3] else 0),
        free=rng.integers(0, 2**32, SECTORS if told[4] else 0, dtype=np.uint32),
        eye=rng.normal(size=3),
    )


def same(a: Trunks, b: Trunks) -> None:
    """Every field, to the bit."""
    assert (a.stamp_ns, a.frame, len(a)) == (b.stamp_ns, b.frame, len(b))
    assert a.surface == b.surface
    assert len(a.clouds) == len(b.clouds)
    for k in FIELDS:
        np.testing.assert_array_equal(getattr(a, k), getattr(b, k), err_msg=k)
    for u, v in zip(a.clouds, b.clouds, strict=True):
        np.testing.assert_array_equal(u, v)


@given(st.lists(st.integers(0, 30), max_size=12), st.integers(0, 2**31))
def test_scans_come_out_as_they_went_in(stamps: list[int], seed: int) -> None:
    trunks = [drawn(seed + k, ns) for k, ns in enumerate(stamps)]
    scans = Scans.of(trunks)
    assert len(scans) == len(trunks)
    for a, b in zip(scans, trunks, strict=True):
        same(a, b)
    for a, b in zip(Scans.joined([scans[:2], scans[2:3], scans[3:]]), trunks, strict=True):
        same(a, b)
    ordered = sorted(trunks, key=lambda t: t.stamp_ns)
    once = [t for i, t in enumerate(ordered) if i == 0 or t.stamp_ns > ordered[i - 1].stamp_ns]
    for a, b in zip(scans.in_order(), once, strict=True):
        same(a, b)
    d = Detections.of(trunks)
    assert d.stamps_ns.tolist() == [t.stamp_ns for t in once]
    np.testing.assert_array_equal(np.bincount(d.scan, minlength=len(once)), [len(t) for t in once])
    for name, shape, missing in (
        ("p", (3,), 0.0), ("cov", (3, 3), 0.0), ("axis", (3,), 0.0), ("height", (), 0.0), ("diameter", (), 0.0), ("score", (), 0.0),
        ("kinds", (3,), np.nan), ("measured", (6,), 0.0), ("stems", (), 1.0),
    ):  # fmt: skip
        told = [
            getattr(t, name) if len(getattr(t, name)) == len(t) else np.full((len(t), *shape), missing) for t in once
        ]
        np.testing.assert_array_equal(getattr(d, name), np.concatenate([np.zeros((0, *shape)), *told]), err_msg=name)
    if len(d.free):
        free = [t.free if len(t.free) else np.zeros(SECTORS, np.uint32) for t in once]
        np.testing.assert_array_equal(d.free, free)


def test_lots_of_which_only_one_tells_what_it_saw_through() -> None:
    dumb, telling = (
        [t for t in (drawn(k, k) for k in range(60)) if (len(t.free) > 0) == told][:5] for told in (False, True)
    )
    for parts in ((dumb, telling), (telling, dumb), (dumb, dumb)):
        joined = Scans.joined([Scans.of(p) for p in parts])
        assert len(joined.free) == (len(joined) if parts != (dumb, dumb) else 0)
        for a, b in zip(joined, [*parts[0], *parts[1]], strict=True):
            same(a, b)


def test_more_may_come_after_building() -> None:
    some = SCANS_AT_ONCE + 3
    builder, trunks = ScansBuilder(), [drawn(k, k) for k in range(2 * SCANS_AT_ONCE + 7)]
    builder.extend(trunks[:some])
    first = builder.build()
    builder.extend(trunks[some:])
    assert (len(first), len(builder), builder.last_ns) == (some, len(trunks), trunks[-1].stamp_ns)
    for a, b in zip(builder.build(), trunks, strict=True):
        same(a, b)


def test_detections_share_the_memory_of_scans_in_order() -> None:
    scans = Scans.of([drawn(k, k) for k in range(20)])
    assert np.shares_memory(Detections.of(scans).cov, scans.cov)


@given(st.lists(st.tuples(st.integers(0, 9), st.booleans()), max_size=20))
def test_streams_are_put_in_order_and_repetitions_counted(messages: list[tuple[int, bool]]) -> None:
    builder, skipped = StreamsBuilder(), Counter[str]()
    for k, (ns, wheels) in enumerate(messages):
        v = np.arange(6.0) + k
        if wheels:
            builder.add(Odometry(ns, f"child{k}", np.r_[v[:3], 0, 0, 0, 1], v))
        else:
            builder.add(Imu(ns, f"imu{k}", v[:3], v[3:]))
    streams = builder.build(skipped)
    for kind, stamps, values, name in (
        (True, streams.odometry_ns, streams.twist, "odometry"),
        (False, streams.imu_ns, np.c_[streams.gyro, streams.accel], "imu"),
    ):
        came = sorted(((ns, k) for k, (ns, wheels) in enumerate(messages) if wheels == kind), key=lambda m: m[0])
        kept = [m for i, m in enumerate(came) if i == 0 or m[0] > came[i - 1][0]]
        assert stamps.tolist() == [ns for ns, _ in kept]
        np.testing.assert_array_equal(values, np.array([np.arange(6.0) + k for _, k in kept]).reshape(-1, 6))
        assert skipped[f"{name}: repeated stamp"] == len(came) - len(kept)
        if kept:
            frame = "child" if kind else "imu"
            assert streams.frames[frame] == f"{frame}{kept[0][1]}"


def told_by(ns: np.ndarray, poses: np.ndarray, twists: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Poses of a whole run, and of the same messages one by one."""
    builder, live, out = StreamsBuilder(), Driven(), []
    for stamp, T, twist in zip(ns.tolist(), poses, twists, strict=True):
        builder.add(Odometry(stamp, "base_link", np.concatenate([T[:3, 3], to_quaternion(T)]), twist))
        out.append(live(stamp, T, twist))
    return builder.build(Counter()).odom_T_child, np.array(out)


FILLED = ("nothing", "orientation", "all", "all, but late")


@given(st.integers(0, 10**6), st.integers(10, 60), st.floats(0.2, 2.0), st.floats(-0.8, 0.8), st.sampled_from(FILLED))
def test_what_wheels_do_not_fill_in_is_driven(seed: int, n: int, speed: float, rate: float, filled: str) -> None:
    """A circle ends where the closed form says, for a whole run and message by message, whatever part of the pose stands still."""
    rng = np.random.default_rng(seed)
    ns = T0 + np.concatenate([[0], np.cumsum(rng.integers(20_000_000, 90_000_000, n - 1))])
    twist = np.tile([speed, 0.0, 0.0, 0.0, 0.0, rate], (n, 1))
    start = exp(rng.normal(0, 1, 6))
    moved = exp(twist[:, [3, 4, 5, 0, 1, 2]] * ((ns - T0) * 1e-9)[:, None])
    told = start @ moved
    if filled in ("nothing", "orientation"):
        told[:, :3, 3] = start[:3, 3]
    if filled == "nothing":
        told[:, :3, :3] = start[:3, :3]
    if filled == "all, but late":
        late = int(rng.integers(1, n))
        told[late:] = start @ inverse(moved[late - 1]) @ moved[late:]
        told[:late] = start
    whole, live = told_by(ns, told, twist)
    np.testing.assert_allclose(whole, live, atol=1e-9)
    np.testing.assert_allclose(
        inverse(whole[0]) @ whole[-1], moved[-1], atol=0.021 if filled == "all, but late" else 1e-9
    )


@given(st.integers(0, 10**6), st.floats(-0.02, 0.02), st.floats(-0.02, 0.02))
def test_wheels_that_stand_do_not_creep(seed: int, creep: float, bias: float) -> None:
    """However long, though a gyro in the wheels' driver has a bias."""
    ns = T0 + np.arange(200) * 50_000_000
    rng = np.random.default_rng(seed)
    twist = np.tile([creep, 0.0, 0.0, 0.0, 0.0, bias], (200, 1)) + rng.normal(0, 0.005, (200, 6))
    pose = exp(rng.normal(0, 1, 6))
    for out in told_by(ns, np.tile(pose, (200, 1, 1)), twist):
        np.testing.assert_allclose(out[-1], pose, atol=0.02)


@given(st.integers(0, 10**6), st.integers(2, 9))
def test_twists_that_overtake_each_other_are_driven_once(seed: int, every: int) -> None:
    """Messages that are late, doubled, or no numbers do not add to the way; a clock that is set back goes on."""
    n = 100
    ns = T0 + np.arange(n) * 50_000_000
    order = np.arange(n)
    order[every - 1 :: every][:-1], order[every::every][: len(order[every - 1 :: every][:-1])] = (
        order[every::every][: len(order[every - 1 :: every][:-1])].copy(),
        order[every - 1 :: every][:-1].copy(),
    )
    live, still = Driven(), exp(np.random.default_rng(seed).normal(0, 1, 6))
    twist = np.array([1.0, 0, 0, 0, 0, 0])
    for k in order.tolist():
        out = live(int(ns[k]), still, twist)
    assert np.linalg.norm(out[:3, 3] - still[:3, 3]) == pytest.approx((n - 1) * 0.05, abs=0.06)
    live(int(ns[-1]) + 50_000_000, still, np.full(6, np.nan))
    after = live(int(ns[-1]) + 100_000_000, still, twist)
    assert np.isfinite(after).all()
    back = [live(T0 - 3_600_000_000_000 + k * 50_000_000, still, twist) for k in range(21)]
    assert np.linalg.norm(back[-1][:3, 3] - back[0][:3, 3]) == pytest.approx(1.0, abs=1e-6)


@given(st.integers(0, 10**6), st.integers(0, 5), st.floats(-1.0, 1.0))
def test_wheels_that_tell_poses_are_taken_at_their_word(seed: int, standing: int, wrong: float) -> None:
    """Whatever their twists say; they may stand at first, and the steps between poses are as told."""
    rng = np.random.default_rng(seed)
    steps = exp(rng.normal(0, 0.05, (12, 6)))
    poses = [exp(rng.normal(0, 1, 6))] * (standing + 1)
    for s in steps:
        poses.append(poses[-1] @ s)
    twist = np.tile([wrong, 0.0, 0.0, 0.0, 0.0, 0.0], (len(poses), 1))
    twist[: standing + 1] = 0.0
    builder, live = StreamsBuilder(), Driven()
    given_poses = []
    for k, T in enumerate(poses):
        m = Odometry(T0 + k * 50_000_000, "base_link", np.concatenate([T[:3, 3], to_quaternion(T)]), twist[k])
        builder.add(m)
        given_poses.append(live(m.stamp_ns, T, m.twist))
    np.testing.assert_allclose(builder.build(Counter()).odom_T_child, poses, atol=1e-9)
    out = np.array(given_poses)
    told = np.array(poses)
    late = slice(standing + 2, None)  # twists that are wrong may have moved it before the first pose that changed
    np.testing.assert_allclose(
        inverse(out[:-1])[late] @ out[1:][late], inverse(told[:-1])[late] @ told[1:][late], atol=1e-9
    )
