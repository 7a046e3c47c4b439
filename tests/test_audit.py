"""Score tests find what a calibration is off by; the other checks speak where they should and are silent where not."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_estimate import problem

from topograph import audit
from topograph.audit.seam import common
from topograph.estimate import Estimate, EstimateConfig, Fixes, Problem, graph
from topograph.geometry import Array, exp, inverse, planar, transform, yaw_of


def run(
    seed: int,
    *,
    antenna: Array | None = None,
    yaw: float = 0.0,
    late: float = 0.0,
    scale: float = 1.0,
    scans: float = 0.0,
) -> Problem:
    """A drive in an eight with fixes and trunks whose mounting, clock or wheels are off by so much."""
    rng = np.random.default_rng(seed)
    n = 120
    s = np.linspace(0, 2 * np.pi, n)
    poses = planar(15 * np.cos(s), 9 * np.sin(2 * s), np.arctan2(18 * np.cos(2 * s), -15 * np.sin(s)))  # an eight
    grid = np.stack(np.meshgrid(np.arange(-18.0, 19.0, 6.0), [-14.0, -5.0, 4.0, 13.0]), axis=2).reshape(-1, 2)
    trees = np.column_stack([grid + rng.uniform(-1, 1, grid.shape), np.zeros(len(grid))])
    p = problem(poses, trees, 0.03, rng, reach=12.0)
    speed = np.gradient(poses[:, :3, 3], axis=0)  # per second: keyframes are a second apart
    body = (inverse(poses)[:, :3, :3] @ speed[:, :, None])[..., 0]
    turn = np.gradient(np.unwrap(yaw_of(poses)))
    lever = np.tile([-0.3, 0.2, 1.1], (n, 1))
    k = np.arange(n)
    drift = body + np.cross(np.column_stack([0 * turn, 0 * turn, turn]), lever)
    real = lever + (0 if antenna is None else antenna) + late * drift
    z = transform(poses, real) + rng.normal(0, 0.01, (n, 3))
    fixes = Fixes(k, lever, z, np.tile(1e-4 * np.eye(3), (n, 1, 1)), drift)
    k_of = p.sightings.keyframe
    past = body[k_of] + np.cross(np.column_stack([0 * turn, 0 * turn, turn])[k_of], p.sightings.p)
    q = transform(np.array(exp(np.array([0, 0, -yaw, 0, 0, 0]))), p.sightings.p - scans * past)
    step = inverse(poses[:-1]) @ poses[1:]
    step[:, :3, 3] *= scale
    odom = [poses[0]]
    for T in step:
        odom.append(odom[-1] @ T @ exp(rng.normal(0, [1e-4, 1e-4, 5e-4, 3e-3, 3e-3, 3e-3])))
    return replace(
        p, fixes=fixes, odom_T_robot=np.array(odom), sightings=replace(p.sightings, p=q, late=past), start=poses
    )


def solved(p: Problem) -> dict[str, Array]:
    e = graph.solve(p, EstimateConfig())
    return {o.name: o.value for o in e.offsets}


@settings(max_examples=4, deadline=None)
@given(seed=st.integers(0, 100), x=st.floats(-0.12, 0.12), y=st.floats(-0.12, 0.12))
def test_an_antenna_elsewhere_is_found(seed: int, x: float, y: float) -> None:
    found = solved(run(seed, antenna=np.array([x, y, 0.0])))
    np.testing.assert_allclose(found["antenna"], [x, y], atol=0.03)


@settings(max_examples=4, deadline=None)
@given(seed=st.integers(0, 100), yaw=st.sampled_from([-0.1, -0.03, 0.03, 0.1]))
def test_a_turned_lidar_is_found(seed: int, yaw: float) -> None:
    assert solved(run(seed, yaw=yaw))["trunk yaw"][0] == pytest.approx(yaw, rel=0.25)


@pytest.mark.parametrize("late", [-0.4, 0.2])
def test_a_late_receiver_is_found(late: float) -> None:
    assert solved(run(1, late=late))["fix clock"][0] == pytest.approx(late, rel=0.5)


@pytest.mark.parametrize("late", [-0.15, 0.15])
def test_late_scans_are_found(late: float) -> None:
    assert solved(run(7, scans=late))["trunk clock"][0] == pytest.approx(late, rel=0.4)


def test_wheels_that_overstate_are_found() -> None:
    assert solved(run(2, scale=1.05))["wheel scale"][0] == pytest.approx(-0.05, abs=0.02)


def test_a_sound_run_is_called_sound() -> None:
    p = run(3)
    e = graph.solve(p, EstimateConfig())
    tree = np.zeros(p.n_trees, bool)
    assert not [*audit.offsets(p, e), *audit.fixes(p, e), *audit.headings(p, e), *audit.trunks(p, e, 0.02, ~tree)]
    for o in e.offsets:
        assert np.abs(o.value).max() < 6 * o.sigma.max() + 0.01, o.name


def test_an_antenna_elsewhere_is_said_with_where() -> None:
    p = run(4, antenna=np.array([0.15, 0.0, 0.0]))
    (finding,) = audit.offsets(p, graph.solve(p, EstimateConfig()))
    assert finding.name == "antenna"
    assert "--extrinsic" in finding.sentence
    assert not finding.refuses


def test_an_antenna_far_elsewhere_is_said_too() -> None:
    """By the fixes that nobody can believe: they lie off to all sides."""
    p = run(4, antenna=np.array([0.9, 0.0, 0.0]))
    e = graph.solve(p, EstimateConfig())
    assert [*audit.offsets(p, e), *audit.fixes(p, e)]


@pytest.mark.parametrize(("share", "said"), [(0.2, False), (0.5, True)])
def test_fixes_that_disagree_for_half_of_a_run_are_said(share: float, said: bool) -> None:
    p = run(5)
    away = np.where(np.arange(len(p.fixes.keyframe)) < share * len(p.fixes.keyframe), 3.0, 0.0)
    e = Estimate(
        stamps_ns=p.stamps_ns, map_T_robot=p.start if p.start is not None else p.odom_T_robot, trees=np.zeros((0, 3)),
        tree_cov=np.zeros((0, 3, 3)), joint=None, datum_cov=np.eye(3), tree=np.zeros(0, np.int64), weights=np.zeros(0),
    )  # fmt: skip
    z = p.fixes.map_p_antenna + away[:, None] * [1.0, 0.0, 0.0]
    found = list(audit.fixes(replace(p, fixes=replace(p.fixes, map_p_antenna=z)), e))
    assert bool(found) == said
    (note,) = audit.refused_fixes(replace(p, fixes=replace(p.fixes, map_p_antenna=z)), e)
    assert note.startswith(f"from 0 to {4 * np.ceil(share * 30):.0f} s the fixes lie 3.0")
    assert not list(audit.refused_fixes(p, e))


def test_refused_until_accepted() -> None:
    p = run(6)
    e = graph.solve(p, EstimateConfig())
    verdict = audit.Verdict(tuple(audit.trunks(p, e, 0.9, np.ones(p.n_trees, bool))))
    assert verdict.word == "refused"
    assert verdict.accepting(["moving"]).word == "doubtful"
    assert verdict.accepting(["something"]).word == "refused"
    assert audit.Verdict().word == "sound"


def test_trees_that_stand_twice_are_counted() -> None:
    grid = np.stack(np.meshgrid(np.arange(6.0) * 4, np.arange(5.0) * 4), axis=2).reshape(-1, 2)
    assert audit.twice(grid) == 0.0
    assert audit.twice(np.concatenate([grid, grid[:8] + 0.4])) == pytest.approx(16 / 38)
    for aside in (0.2, 0.4, 0.6):  # all of them
        assert audit.twice(np.concatenate([grid, grid + aside])) == 1.0
    rows = np.stack(np.meshgrid(np.arange(12) * 1.0, np.arange(4) * 2.5), axis=2).reshape(-1, 2)
    assert audit.twice(rows) == 0.0
    assert audit.twice(np.random.default_rng(0).uniform(0, 60, (400, 2))) < 0.12


def test_a_lattice_that_was_laid_onto_itself_from_afar_is_doubted() -> None:
    (found,) = audit.rows(2.8)
    assert (found.name, found.refuses) == ("rows", False)
    assert "2.8 spacings" in found.sentence
    assert not list(audit.rows(0.3))
    assert not list(audit.rows(0.0))


def test_trees_that_may_be_posts_are_doubted() -> None:
    """In a recorded street half of the "trees" are masts and pillars, with probabilities of 0.6 to 0.98."""
    nan = float("nan")
    (found,) = audit.unsure(np.array([0.98, 0.97, 0.95, 0.89, 0.7, 0.6, 0.8, nan, nan]))
    assert found.name == "kinds"
    assert found.value == pytest.approx(4 / 7)
    assert not found.refuses
    assert not list(audit.unsure(np.full(20, 0.95)))
    assert not list(audit.unsure(np.r_[np.full(17, 0.95), 0.5, 0.5, 0.5, 0.5]))
    assert not list(audit.unsure(np.full(20, nan)))  # recorded detections tell no kinds


def test_trees_that_hardly_a_scan_shows_are_doubted() -> None:
    """A LiDAR that lies on its side gave "1 trees, sound" of 300 scans."""
    (found,) = audit.seldom(300, 29)
    assert not found.refuses
    assert found.value > found.bound
    assert not list(audit.seldom(300, 200))
    assert not list(audit.seldom(20, 1))


@settings(max_examples=200, deadline=None)
@given(
    sightings=st.lists(st.tuples(st.integers(0, 9), st.integers(0, 4)), max_size=40),
    reach=st.integers(1, 5),
)
def test_trees_seen_on_both_sides_are_counted(sightings: list[tuple[int, int]], reach: int) -> None:
    keyframe, tree = (np.array([s[k] for s in sightings], np.int64) for k in (0, 1))
    both, fewer = common(keyframe, tree, 10, reach)
    for k in range(10):
        before = {t for f, t in sightings if k - reach <= f < k}
        after = {t for f, t in sightings if k <= f < k + reach}
        assert both[k] == len(before & after)
        assert fewer[k] == min(len(before), len(after))


ORCHARD = np.stack(np.meshgrid(np.arange(0.0, 30.0, 2.0), [-3.0, 3.0, 6.0], [0.0]), axis=3).reshape(-1, 3)


def driven(*, gyro: bool = False, broken: bool = True) -> tuple[Problem, Estimate]:
    """30 m along three rows; with a seam at the 31st of 60 keyframes, where all trees become others."""
    poses = planar(0.5 * np.arange(60.0), 0.0, 0.0)
    p = problem(poses, ORCHARD, 0.03, np.random.default_rng(2), reach=8.0)
    p = replace(p, motion=replace(p.motion, gyro=gyro))
    e = Estimate(
        stamps_ns=p.stamps_ns, map_T_robot=poses, trees=ORCHARD, tree_cov=np.zeros((len(ORCHARD), 3, 3)),
        joint=None, datum_cov=np.zeros((3, 3)), tree=np.zeros(0, np.int64), weights=np.ones(0), seconds=0.0,
    )  # fmt: skip
    s = p.sightings
    return replace(
        p, n_trees=2 * len(ORCHARD), sightings=replace(s, tree=s.tree + len(ORCHARD) * (broken & (s.keyframe >= 31)))
    ), e


def fixes_at(e: Estimate, keyframes: range, off: float = 0.0, sigma: float = 0.01) -> Fixes:
    n, k = len(keyframes), np.array(keyframes)
    at = e.map_T_robot[k, :3, 3] + [0.0, off, 0.0]
    return Fixes(k, np.zeros((n, 3)), at, np.tile(sigma**2 * np.eye(3), (n, 1, 1)), np.zeros((n, 3)))


@pytest.mark.parametrize("gyro", [True, False])
def test_a_run_that_falls_apart_is_doubted(gyro: bool) -> None:
    """On a drive through a real orchard a turn was off by 8°; from there on the map stood beside itself, called sound."""
    assert not list(audit.seam(*driven(broken=False)))
    p, e = driven(gyro=gyro)
    (found,) = audit.seam(p, e)
    assert (found.name, found.refuses) == ("seam", False)
    assert "at 31 s" in found.sentence
    assert ("IMU" in found.sentence) != gyro
    # A few that go on are no continuity; two in three are.
    s = driven(broken=False)[0].sightings
    for share, said in ((0.2, True), (0.67, False)):
        goes_on = np.isin(s.tree, np.random.default_rng(3).permutation(len(ORCHARD))[: int(share * len(ORCHARD))])
        some = replace(s, tree=s.tree + len(ORCHARD) * ((s.keyframe >= 31) & ~goes_on))
        assert bool(list(audit.seam(replace(p, sightings=some), e))) == said


@pytest.mark.parametrize(
    ("keyframes", "off", "sigma", "said"),
    [
        (range(60), 0.0, 0.01, False),
        (range(28, 34), 0.0, 0.3, False),
        (range(31), 0.0, 0.01, True),
        (range(31, 60), 0.0, 0.01, True),
        (range(31, 32), 0.0, 0.01, True),
        (range(60), 50.0, 0.01, True),
        (range(60), 0.0, 10.0, True),
    ],
    ids=["all along", "on both sides", "before", "after", "one", "refused", "coarse"],
)
def test_believed_fixes_on_both_sides_hold_a_run_together(
    keyframes: range, off: float, sigma: float, said: bool
) -> None:
    p, e = driven()
    assert bool(list(audit.seam(replace(p, fixes=fixes_at(e, keyframes, off, sigma)), e))) == said


def test_after_a_gap_others_are_in_view() -> None:
    p, e = driven()
    later = np.arange(60) >= 31
    assert not list(audit.seam(replace(p, motion=replace(p.motion, distance=p.motion.distance + 9.0 * later)), e))
    assert not list(audit.seam(replace(p, motion=replace(p.motion, turned=p.motion.turned + 2.8 * later)), e))


@pytest.mark.parametrize(
    ("seed", "gap", "view", "shown"),
    [(0, 14.0, 7.0, 0.7), (0, 14.0, 7.0, 0.9), (1, 15.0, 15.0, 0.5), (12, 15.0, 15.0, 0.5)],
)
def test_scans_at_stops_are_no_seams(seed: int, gap: float, view: float, shown: float) -> None:
    """Two keyframes at each stop, of trees of which some are missed; the last two were seams where keyframes were counted across stops."""
    rng = np.random.default_rng(seed)
    x = np.repeat(gap * np.arange(8.0), 2)
    trees = np.column_stack([rng.uniform(-8, 7 * gap + 8, 500), rng.uniform(-7, 7, 500), np.zeros(500)])
    poses = planar(x, 0.0, 0.0)
    p = problem(poses, trees, 0.03, rng, reach=view)
    keep = rng.random(len(p.sightings)) < shown
    s = p.sightings
    s = replace(s, keyframe=s.keyframe[keep], tree=s.tree[keep], p=s.p[keep], cov=s.cov[keep], count=s.count[keep], late=s.late[keep])  # fmt: skip
    e = replace(driven()[1], stamps_ns=p.stamps_ns, map_T_robot=poses)
    assert not list(audit.seam(replace(p, sightings=s), e))


def test_trunks_of_no_tree_are_told_from_a_wrong_mounting() -> None:
    """A thicket gives 0.37 and a right map; a LiDAR that is mounted otherwise 0.85 and more, and none."""
    p = np.tile([3.0, 1.0, 0.0], (200, 1))
    for claimed, refuses in ((195, None), (120, False), (20, True)):
        tree = np.where(np.arange(200) < claimed, 0, -1)
        found = list(audit.unclaimed(p, np.ones(200), p, tree))
        assert [f.refuses for f in found] == ([] if refuses is None else [refuses])
        assert all(("bushes" in f.sentence) != refuses for f in found)


def test_a_gyro_that_drifts_while_the_robot_stands_is_no_astray_path() -> None:
    """Ten minutes at one place, in which the gyro turns by 6°, as the trees know."""
    stand, n = 600, 660
    x = np.r_[np.arange(30.0), np.full(stand, 29.0), 29.0 + np.arange(1.0, 31.0)]
    turned = np.r_[np.zeros(30), np.linspace(0, 600 * 1.7e-4, stand), np.full(30, 600 * 1.7e-4)]
    step = planar(np.diff(x), 0.0, np.diff(turned))
    odom = [np.eye(4)]
    for T in step:
        odom.append(odom[-1] @ T)
    p = problem(np.array(odom), np.zeros((1, 3)), 0.03, np.random.default_rng(0))
    motion = replace(p.motion, gyro=True)
    e = Estimate(
        stamps_ns=p.stamps_ns, map_T_robot=planar(x, np.zeros(n), 0.0), trees=np.zeros((0, 3)), tree_cov=np.zeros((0, 3, 3)),
        joint=None, datum_cov=np.zeros((3, 3)), tree=np.zeros(0, np.int64), weights=np.ones(0), seconds=0.0,
    )  # fmt: skip
    assert not list(audit.way(replace(p, motion=motion), e))


@pytest.mark.parametrize(
    ("yaw", "scale", "at_fixes", "said"),
    [(0.3, 1.0, False, True), (-0.3, 1.0, False, True), (0.3, 1.0, True, False), (0.0, 1.04, False, False)],
)
def test_a_path_that_trees_bent_where_the_wheels_went_straight_is_doubted(
    yaw: float, scale: float, at_fixes: bool, said: bool
) -> None:
    """60 m, and the estimate has a turn within the 30th; wheels that are off by 4 % are wheels; fixes that hold the path know better."""
    n = 61
    begun, arc = planar(20.0, -7.0, 2.0), 0.02 * np.arange(n)  # odometry lies elsewhere, and the way is a bend
    middle = np.cumsum(np.column_stack([np.cos(arc), np.sin(arc)]), axis=0)
    p = problem(begun @ planar(middle[:, 0], middle[:, 1], arc), np.zeros((1, 3)), 0.03, np.random.default_rng(0))
    turned = arc + np.where(np.arange(n) > 30, yaw, 0.0)
    path = np.cumsum(np.column_stack([np.cos(turned), np.sin(turned)]), axis=0) * scale
    e = Estimate(
        stamps_ns=p.stamps_ns, map_T_robot=planar(path[:, 0], path[:, 1], turned), trees=np.zeros((0, 3)), tree_cov=np.zeros((0, 3, 3)),
        joint=None, datum_cov=np.zeros((3, 3)), tree=np.zeros(0, np.int64), weights=np.ones(0), seconds=0.0,
    )  # fmt: skip
    if at_fixes:
        k = np.arange(0, n, 5)
        zeros = np.zeros((len(k), 3))
        p = replace(p, fixes=Fixes(k, zeros, path[k] @ np.eye(2, 3), np.tile(1e-4 * np.eye(3), (len(k), 1, 1)), zeros))
    found = list(audit.way(p, e))
    assert bool(found) == said
    if said:
        assert "17° within 6 m" in found[0].sentence
        assert not found[0].refuses
