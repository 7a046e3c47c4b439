"""The trunk front end on made-up and simulated sweeps: right places, no crash on odd clouds."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from topograph.bags import Odometry, Recording, Scan
from topograph.config import Config
from topograph.evaluate import Truth, trunk_metrics
from topograph.geometry import exp, from_xyz_rpy, transform
from topograph.pipeline import read_run
from topograph.trunks import ThesisTrunksConfig, TrunksConfig, fit
from topograph.trunks.detector import Detector, candidates
from topograph.trunks.features import FEATURES
from topograph.trunks.fit import AXIS_Z, OUT_SIZE, X, suppress, vertical
from topograph.trunks.frontend import FrontEnd
from topograph.trunks.organise import rings_of
from topograph.trunks.origin import seen_from
from topograph.trunks.runs import COUNT, PX, PY, PZ, RUN_SIZE
from topograph.trunks.score import KIND_PRIOR, kinds, network
from topograph.trunks.thesis import ThesisDetector

MOUNT = np.eye(4)
MOUNT[2, 3] = 0.8


def cylinder_scene(rings: int, x: float, y: float, diameter: float, columns: int = 1800, slope: float = 0.0) -> Scan:
    """A sweep over a ramp with one upright cylinder, without noise, from a sensor 0.8 m up."""
    elevation = np.radians(np.linspace(-15, 15, rings))
    azimuth = np.linspace(np.pi, -np.pi, columns, endpoint=False)
    el, az = np.meshgrid(elevation, azimuth)
    d = np.stack([np.cos(el) * np.cos(az), np.cos(el) * np.sin(az), np.sin(el)], axis=-1).reshape(-1, 3)
    normal = np.array([-np.tan(slope), 0.0, 1.0])
    with np.errstate(divide="ignore"):
        ground = -0.8 / (d @ normal)
    ground[(ground <= 0) | (ground > 60)] = np.inf
    a = d[:, 0] ** 2 + d[:, 1] ** 2
    b = -(d[:, 0] * x + d[:, 1] * y)
    disc = b * b - a * (x * x + y * y - 0.25 * diameter**2)
    with np.errstate(invalid="ignore"):
        trunk = np.where(disc > 0, (-b - np.sqrt(disc)) / a, 1e9)
    trunk[(d[:, 2] * trunk > 3.0) | (trunk > 60) | (trunk <= 0)] = np.inf
    t = np.minimum(ground, trunk)
    keep = np.isfinite(t)
    ring = np.tile(np.arange(rings), columns)[keep]
    return Scan(
        stamp_ns=10**18,
        frame="lidar",
        xyz=(d[keep] * t[keep, None]).astype(np.float32),
        ring=ring.astype(np.int32),
        offset=None,
        intensity=None,
    )


@pytest.mark.parametrize("rings", [16, 32, 64, 128])
@pytest.mark.parametrize("place", [(4.0, 1.0, 0.25), (-7.0, 5.0, 0.35), (0.0, -12.0, 0.3)])
def test_a_cylinder_is_found_where_it_stands(rings: int, place: tuple[float, float, float]) -> None:
    x, y, diameter = place
    c = candidates(cylinder_scene(rings, x, y, diameter), MOUNT, np.zeros(6), TrunksConfig())
    error = np.hypot(c.fits[:, 0] - x, c.fits[:, 1] - y)
    best = c.fits[np.argmin(error)]
    assert error.min() < 0.03
    assert best[6] == pytest.approx(diameter, abs=0.06)
    assert abs(best[5]) > 0.99


@pytest.mark.parametrize("slope", [-0.2, 0.1, 0.2])
def test_heights_follow_the_slope(slope: float) -> None:
    c = candidates(cylinder_scene(32, 6.0, 2.0, 0.3, slope=slope), MOUNT, np.zeros(6), TrunksConfig())
    best = c.fits[np.argmin(np.hypot(c.fits[:, 0] - 6.0, c.fits[:, 1] - 2.0))]
    assert best[2] == pytest.approx(6.0 * np.tan(slope) + best[7], abs=0.1)


def test_missing_rings_are_found_from_elevation() -> None:
    scan = cylinder_scene(16, 5.0, 0.0, 0.3)
    ring, tangent = rings_of(replace(scan, ring=None))
    assert len(tangent) <= 16
    assert (np.diff(tangent) > 0).all()
    assert scan.ring is not None
    used = np.unique(scan.ring)
    np.testing.assert_array_equal(np.searchsorted(used, scan.ring), ring)


def test_order_of_points_does_not_matter() -> None:
    scan = cylinder_scene(16, 5.0, 2.0, 0.3)
    order = np.random.default_rng(0).permutation(len(scan.xyz))
    assert scan.ring is not None
    shuffled = replace(scan, xyz=scan.xyz[order], ring=scan.ring[order])
    a, b = (candidates(s, MOUNT, np.zeros(6), TrunksConfig()).fits for s in (scan, shuffled))
    for fits in (a, b):
        assert np.hypot(fits[:, 0] - 5.0, fits[:, 1] - 2.0).min() < 0.03


def test_deskew_undoes_motion() -> None:
    """A sweep taken while driving and turning gives the trunk where it is at the stamp."""
    scan = cylinder_scene(32, 5.0, 3.0, 0.3)
    twist = np.array([1.5, 0.0, 0.0, 0.0, 0.0, 0.8])
    offset = np.linspace(-0.1, 0.0, len(scan.xyz)).astype(np.float32)
    moved = np.empty_like(scan.xyz)
    for k in range(0, len(offset), 50):  # where a point is seen from depends on when
        stamp_T_then = exp(np.concatenate([twist[3:], twist[:3]]) * float(offset[k : k + 50].mean()))
        base = scan.xyz[k : k + 50] @ MOUNT[:3, :3].T + MOUNT[:3, 3]
        moved[k : k + 50] = (base - stamp_T_then[:3, 3]) @ stamp_T_then[:3, :3] - MOUNT[:3, 3]
    skewed = replace(scan, xyz=moved, offset=offset)
    still = candidates(skewed, MOUNT, np.zeros(6), TrunksConfig()).fits
    right = candidates(skewed, MOUNT, twist, TrunksConfig()).fits
    assert np.hypot(right[:, 0] - 5.0, right[:, 1] - 3.0).min() < 0.03
    assert np.hypot(still[:, 0] - 5.0, still[:, 1] - 3.0).min() > 0.05


@pytest.mark.parametrize(
    "xyz",
    [
        np.zeros((0, 3)),
        np.full((500, 3), np.nan),
        np.zeros((500, 3)),
        np.full((500, 3), np.inf),
        np.random.default_rng(0).uniform(-20, 20, (3000, 3)),
        np.column_stack([np.random.default_rng(1).uniform(-20, 20, (5000, 2)), np.full(5000, -0.8)]),
    ],
    ids=["empty", "nan", "zero", "infinite", "noise", "plane"],
)
def test_odd_clouds_do_no_harm(xyz: np.ndarray) -> None:
    detector = Detector(MOUNT, TrunksConfig())
    out = detector(
        Scan(stamp_ns=1, frame="lidar", xyz=xyz.astype(np.float32), ring=None, offset=None, intensity=None), np.zeros(6)
    )
    assert np.isfinite(out.p).all()
    assert (out.score > 0).sum() <= 3


def test_simulated_sweeps(lidar_run: tuple[Path, Truth]) -> None:
    """Unseen seed and a small orchard: most trunks within 10 m, few false ones, centimetres off."""
    path, truth = lidar_run
    run = read_run([path], Config())
    _, table = trunk_metrics(truth, np.array([t.stamp_ns for t in run.trunks]), [t.p[t.score >= 0] for t in run.trunks])
    near = table[0]
    assert near["visible"] > 100
    assert near["precision"] > 0.8
    assert near["recall"] > 0.8
    assert abs(near["radial_bias"]) < 0.02
    assert near["radial_sd"] < 0.05


def test_detection_is_a_pure_function(lidar_run: tuple[Path, Truth]) -> None:
    with Recording([lidar_run[0]]) as r:
        scans = [m for n, (_, m) in enumerate(r.messages(["points"])) if n in (5, 50) and isinstance(m, Scan)]
        mount = r.frames.get("velodyne")
    a, b = (Detector(mount, TrunksConfig()) for _ in range(2))
    for scan in scans:
        b(scans[0], np.zeros(6))
        np.testing.assert_array_equal(a(scan, np.zeros(6)).p, b(scan, np.zeros(6)).p)


def test_several_processes_find_the_same(lidar_run: tuple[Path, Truth]) -> None:
    """Bit for bit: what a sweep shows does not depend on where reading began."""
    one, two = (read_run([lidar_run[0]], Config(), jobs=jobs) for jobs in (1, 2))
    assert len(one.trunks) == len(two.trunks) > 50
    for a, b in zip(one.trunks, two.trunks, strict=True):
        assert a.stamp_ns == b.stamp_ns
        for name in ("p", "axis", "diameter", "cov", "height", "score"):
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
    np.testing.assert_array_equal(one.streams.imu_ns, two.streams.imu_ns)


def test_unorganised_clouds_lose_little(lidar_run: tuple[Path, Truth]) -> None:
    """Without ring field and order, nearly all trunks are still found."""
    rng = np.random.default_rng(0)
    with Recording([lidar_run[0]]) as r:
        scans = [m for n, (_, m) in enumerate(r.messages(["points"])) if n % 10 == 5 and isinstance(m, Scan)]
        detector = Detector(r.frames.get("velodyne"), TrunksConfig())
    found = again = 0
    for scan in scans:
        order = rng.permutation(len(scan.xyz))
        assert scan.offset is not None
        mixed = Scan(
            stamp_ns=scan.stamp_ns,
            frame=scan.frame,
            xyz=scan.xyz[order],
            ring=None,
            offset=scan.offset[order],
            intensity=None,
        )
        a, b = (k.select(k.score >= 0) for k in (detector(scan, np.zeros(6)), detector(mixed, np.zeros(6))))
        found += len(a)
        if len(b):
            again += int((np.hypot(*(a.p[:, None, :2] - b.p[None, :, :2]).transpose(2, 0, 1)).min(axis=1) < 0.1).sum())
    assert found > 30
    assert again > 0.9 * found


@pytest.mark.parametrize("lean", [(0.0, 0.0), (0.15, -0.1)])
def test_the_vertical_is_what_trunks_agree_on(lean: tuple[float, float]) -> None:
    """On a slope the base is tilted against the trees; a few crooked ones do not matter."""
    rng = np.random.default_rng(2)
    runs, chain = [], []
    for tree in range(12):
        x, y = rng.uniform(-15, 15, 2)
        crooked = rng.normal(0, 0.4, 2) if tree < 2 else rng.normal(0, 0.03, 2)
        for k in range(5):
            row = np.zeros(RUN_SIZE)
            z = 0.3 + 0.3 * k
            row[[PX, PY, PZ, COUNT]] = x + (lean[0] + crooked[0]) * z, y + (lean[1] + crooked[1]) * z, z, 8
            chain.append(5 * tree)
            runs.append(row)
    up = vertical(np.array(runs), np.array(chain), 64)
    np.testing.assert_allclose(up, np.array(lean) * 12 / 14, atol=0.03)


def test_the_thesis_front_end_finds_a_bare_trunk() -> None:
    """Its centroid lies on the surface that is seen, a radius before the axis."""
    scene = cylinder_scene(64, 5.0, 1.0, 0.4)
    rng = np.random.default_rng(0)
    noisy = replace(scene, xyz=(scene.xyz + rng.normal(0, 0.01, scene.xyz.shape)).astype(np.float32))
    found = ThesisDetector(MOUNT, ThesisTrunksConfig(cluster_max=5000))(noisy, np.zeros(6))
    assert found.surface
    d = np.hypot(found.p[:, 0] - 5.0, found.p[:, 1] - 1.0)
    assert 0.05 < d.min() < 0.25
    for cloud in (np.zeros((0, 3)), np.full((100, 3), np.nan), np.zeros((100, 3))):
        assert (
            len(ThesisDetector(MOUNT, ThesisTrunksConfig())(replace(noisy, xyz=cloud.astype(np.float32)), np.zeros(6)))
            == 0
        )


def test_missing_times_are_said_in_centimetres(lidar_run: tuple[Path, Truth], monkeypatch: pytest.MonkeyPatch) -> None:
    """A driver that drops the time of each point costs accuracy; the run's notes say how much."""
    from topograph.bags import recording

    full = recording.decode_scan
    monkeypatch.setattr(recording, "decode_scan", lambda m, stamp: replace(full(m, stamp), offset=None))
    run = read_run([lidar_run[0]], Config(), span_s=(0.0, 8.0))
    assert any("no time per point" in n and " cm off" in n for n in run.notes)
    assert not run.skipped  # they are used


def test_a_return_on_the_sensors_axis_does_no_harm() -> None:
    """Straight above and straight below the sensor there is no direction to divide by."""
    scan = cylinder_scene(16, 5.0, 2.0, 0.3)
    assert scan.ring is not None
    odd = np.array([[0, 0, 2.5], [0, 0, -1.2], [0, 0, 0], [np.nan, 0, 1], [np.inf, np.inf, np.inf]], np.float32)
    xyz, ring = np.concatenate([odd, scan.xyz]), np.concatenate([np.arange(5, dtype=np.int32), scan.ring])
    with_odd = candidates(replace(scan, xyz=xyz, ring=ring), MOUNT, np.zeros(6), TrunksConfig()).fits
    assert np.hypot(with_odd[:, 0] - 5.0, with_odd[:, 1] - 2.0).min() < 0.03


def test_the_patch_tells_met_from_passed() -> None:
    """A bare cylinder: beams meet it over all its height and pass beside it, 0.3 to 1.1 m off on both sides."""
    c = candidates(cylinder_scene(32, 4.0, 1.0, 0.3), MOUNT, np.zeros(6), TrunksConfig())
    f = dict(zip(FEATURES, c.features[np.argmin(np.hypot(c.fits[:, 0] - 4.0, c.fits[:, 1] - 1.0))], strict=True))
    for row in (2, 3, 4):
        assert f[f"met_{row}_0"] > 0.6
    for row in (1, 2):  # beyond, the ground is met within the sensor's reach
        assert f[f"met_{row}_4"] < -0.6
        assert f[f"seen_{row}_4"] > 0.6


def test_kinds_do_not_depend_on_the_order_of_candidates_and_do_on_their_company() -> None:
    rng = np.random.default_rng(0)
    n = network()
    x = np.asarray(n.mean + 0.7 * n.deviation * rng.normal(size=(30, len(n.mean))))
    x = np.clip(x, n.low, n.high)
    order = rng.permutation(30)
    np.testing.assert_allclose(kinds(x, n)[order], kinds(x[order], n), atol=1e-4)
    np.testing.assert_allclose(np.exp(kinds(x, n)).sum(axis=1), 1.0)
    assert np.abs(kinds(x, n)[:1] - kinds(x[:1], n)).max() > 1e-3


def test_what_lies_outside_of_the_training_is_drawn_to_the_prior_and_blinds_nobody() -> None:
    n = network()
    x = np.tile(n.mean, (4, 1))
    x[1, 0], x[2] = np.nan, n.high + 100.0
    log_p = kinds(x, n)
    assert np.isfinite(log_p).all()
    evidence = np.abs(log_p - KIND_PRIOR).max(axis=1)
    inside = replace(n, low=np.full_like(n.low, -np.inf), high=np.full_like(n.high, np.inf))
    assert evidence[2] < 0.7 * np.abs(kinds(x, inside)[2] - KIND_PRIOR).max()


def test_a_post_beside_a_tree_is_kept_apart() -> None:
    """Two columns 0.3 m apart are one thing with two stems, unless one is surely a post and the other surely none."""
    fits = np.zeros((2, OUT_SIZE))
    fits[:, AXIS_Z], fits[1, X] = 1.0, 0.3
    odds = np.array([3.0, 2.0])
    assert suppress(fits, odds, np.array([-1.0, 0.0]), 0.45).tolist() == [0, 0]
    assert suppress(fits, odds, np.array([-1.0, 1.0]), 0.45).tolist() == [0, 1]
    fits[1, X] = 0.05
    assert suppress(fits, odds, np.array([-1.0, 1.0]), 0.45).tolist() == [0, 0]


@pytest.mark.parametrize(("begins", "stems"), [(0.3, 2), (0.8, 1)])
def test_a_branch_is_no_stem_and_does_not_move_the_trunk(begins: float, stems: int) -> None:
    """Two thin things of one tree, 0.3 m apart: one beside the other from the ground on, or from breast height."""
    fits = np.zeros((2, OUT_SIZE))
    fits[:, X], fits[:, AXIS_Z] = [4.0, 4.3], 1.0
    fits[:, fit.RINGS], fits[:, fit.POINTS], fits[:, fit.WIDE], fits[:, fit.STEMS] = 6, [60, 40], 0.08, 1
    lowest, highest = np.array([0.3, begins]), np.array([1.6, 1.6])
    best, merged = fit.merge_stems(fits, np.array([5.0, 4.0]), np.array([0, 0]), lowest, highest)
    np.testing.assert_array_equal(best, [0])
    assert merged[0, fit.STEMS] == stems
    assert merged[0, X] == pytest.approx(4.12 if stems == 2 else 4.0)


@pytest.mark.parametrize("bearing", [0.0, 0.7, np.pi / 2, 2.5])
def test_covariances_lie_along_the_line_of_sight(bearing: float) -> None:
    """A trunk is unsure in range as stated, and across it as stated, wherever it stands."""
    fits = np.zeros((1, fit.OUT_SIZE))
    fits[0, fit.AXIS_X + 2] = 1.0
    fits[0, fit.RADIAL], fits[0, fit.TANGENTIAL] = 0.2, 0.01
    line, side = np.array([np.cos(bearing), np.sin(bearing)]), np.array([-np.sin(bearing), np.cos(bearing)])
    fits[0, fit.LINE_X], fits[0, fit.LINE_Y] = line
    cov = fit.covariances(fits, np.array([[1.5, 2.0]]))[0, :2, :2]
    assert np.sqrt(line @ cov @ line) == pytest.approx(0.3, rel=1e-3)
    assert np.sqrt(side @ cov @ side) == pytest.approx(0.02, rel=1e-2)


@pytest.mark.parametrize("value", [1e39, 1e200, 1e20, np.nan, np.inf])
def test_a_broken_wheel_message_costs_itself(value: float) -> None:
    """Beyond what single precision holds: a point that is no number must not be looked up anywhere."""
    front_end = FrontEnd(lambda _: MOUNT, lambda _: None)
    scan = cylinder_scene(16, 5.0, 1.0, 0.3)
    front_end.hear(Odometry(scan.stamp_ns, "base_link", np.array([0, 0, 0, 0, 0, 0, 1.0]), np.full(6, value)))
    found = front_end.see(scan)
    assert np.isfinite(found.p).all()
    assert len(found) > 0
    still = Detector(MOUNT, TrunksConfig())(scan, np.zeros(6))
    assert len(Detector(MOUNT, TrunksConfig())(scan, np.full(6, value))) == len(still)


@settings(max_examples=15, deadline=None)
@given(
    rings=st.sampled_from([16, 32]),
    place=st.tuples(*[st.floats(-0.8, 0.8)] * 2, st.floats(0.4, 2.0)),
    turn=st.tuples(*[st.floats(-0.4, 0.4)] * 2, st.floats(-3.0, 3.0)),
    field=st.booleans(),
)
def test_clouds_that_were_moved_out_of_the_lidars_frame_give_the_same_trunks(
    rings: int, place: tuple[float, float, float], turn: tuple[float, float, float], field: bool
) -> None:
    """Drivers and filters publish clouds in `base_link`, often without the ring field: about the base there are no rings, and half of the trunks were missed."""
    scan = cylinder_scene(
        rings, 4.0, 1.0, 0.3, slope=0.12
    )  # a level plane shows circles, which are rings about all that is above their middle
    base_T_lidar = from_xyz_rpy(*place, *turn)
    frames = {"base_link": np.eye(4), "imu": from_xyz_rpy(0.1, -0.3, 0.35, 0, 0, 0.5), "lidar": base_T_lidar}
    as_taken = FrontEnd(frames.__getitem__, frames.get, frames=lambda: frames)
    moved = replace(scan, frame="base_link", xyz=transform(base_T_lidar, scan.xyz).astype(np.float32))
    moved = moved if field else replace(moved, ring=None)
    as_moved = FrontEnd(frames.__getitem__, frames.get, frames=lambda: frames)
    expected, found = as_taken.see(scan), as_moved.see(moved)
    assert not as_taken.notes
    assert "'lidar'" in as_moved.notes[0]
    assert len(found) == len(expected)
    np.testing.assert_allclose(found.p, expected.p, atol=2e-3)
    np.testing.assert_allclose(found.eye, expected.eye, atol=1e-6)
    again = as_moved.see(moved)
    np.testing.assert_array_equal(again.p, found.p)
    assert len(as_moved.notes) == 1


def test_a_cloud_is_where_it_says_where_no_frame_shows_rings() -> None:
    """A LiDAR without rings, one whose frame is unknown, and a scan of few points, which decides for none."""
    rng = np.random.default_rng(0)
    direction = rng.normal(size=(6000, 3)) * [1.0, 1.0, 0.3]
    cloud = (direction / np.linalg.norm(direction, axis=1, keepdims=True) * rng.uniform(2, 30, (6000, 1))).astype(np.float32)  # fmt: skip
    frames = {"base_link": np.eye(4), "imu": from_xyz_rpy(0.2, 0.0, 0.4, 0, 0, 0), "lidar": MOUNT}
    assert seen_from(cloud, frames) is None
    scan = cylinder_scene(16, 4.0, 1.0, 0.3, slope=0.12)
    unknown = transform(from_xyz_rpy(0.1, 0.2, 1.3, 0.1, 0.0, 0.0), scan.xyz).astype(np.float32)
    assert seen_from(unknown, frames) is None
    moved = replace(scan, frame="base_link", ring=None, xyz=transform(MOUNT, scan.xyz).astype(np.float32))
    lost = FrontEnd(frames.__getitem__, frames.get)
    lost.see(moved)
    assert "--extrinsic lidar=" in lost.notes[0]  # which makes it one of the frames
    at_home = FrontEnd(lambda _: np.eye(4), frames.get)
    at_home.see(replace(scan, ring=None))
    assert not at_home.notes
    door = FrontEnd(frames.__getitem__, frames.get, frames=lambda: frames)
    door.see(replace(moved, xyz=moved.xyz[:400]))
    assert not door.notes
    assert door.see(moved).eye[2] == pytest.approx(0.8)
