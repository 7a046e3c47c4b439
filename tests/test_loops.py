"""Loops that trees close: the drift's covariance against a sampled one, the place search under a prior, and what is decided."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from topograph.geometry import Array, planar, transform
from topograph.motion import Motion, MotionConfig
from topograph.places import Landmarks, PlacesConfig, Prior, build_index, search
from topograph.trees import TreesConfig
from topograph.trees.drift import Way, bounded, deviation, drift
from topograph.trees.loops import Closed, LoopCloser, Recognised, TrackTable, moved_pose, recognise

seeds = st.integers(0, 2**32 - 1)
PLACES = PlacesConfig(
    map_sigma=0.05, anchors=1e-3, bound=25.0, modes=100, felled=0.04, scales=(1.0,), scale_prior=(1.0,)
)


def motion_of(distance: Array, *, gyro: bool) -> Motion:
    n = len(distance)
    stamps = np.arange(n) * 10**9
    return Motion(
        stamps_ns=stamps, odom_T_robot=np.tile(np.eye(4), (n, 1, 1)), distance=distance, turned=np.zeros(n), gyro=gyro, wheels=True
    )  # fmt: skip


def u_turn() -> tuple[Array, Array]:
    """Distances (K,) and poses (K, 3): 30 m out, a half circle of 3 m, 30 m back, every half metre."""
    turn = np.linspace(0.0, np.pi, 20)[1:]
    out = np.arange(0.0, 30.0, 0.5)
    pose = np.concatenate(
        [
            np.column_stack([out, 0 * out, 0 * out]),
            np.column_stack([30 + 3 * np.sin(turn), 3 - 3 * np.cos(turn), turn]),
            np.column_stack([30 - out[1:], 6 + 0 * out[1:], np.pi + 0 * out[1:]]),
        ]
    )
    return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(pose[:, :2], axis=0).T))]), pose


def test_the_drift_is_that_of_ways_driven_with_wrong_scales() -> None:
    """The same way with the wheels' scale, the turns' scale and the straight wrong, many times: their spread is the stated one."""
    distance, pose = u_turn()
    noise = MotionConfig(along=0.005, yaw_wheels=0.02, yaw_distance=1e-6)
    centre = np.array([10.0, 8.0])
    stated = drift(
        Way(distance=distance, pose=pose), 0.0, float(distance[-1]), centre, motion_of(distance, gyro=False), noise
    )
    rng = np.random.default_rng(0)
    step, turn, d = np.diff(pose[:, :2], axis=0), np.diff(pose[:, 2]), np.diff(distance)
    ends = []
    for _ in range(4000):
        longer, wider, bend = 0.01 * rng.normal(), 0.02 * rng.normal(), 1e-3 * rng.normal()
        yaw = np.concatenate([[0.0], np.cumsum(wider * turn + bend * d)])
        c, s = np.cos(0.5 * (yaw[1:] + yaw[:-1])), np.sin(0.5 * (yaw[1:] + yaw[:-1]))
        at = (1 + longer) * np.stack([c * step[:, 0] - s * step[:, 1], s * step[:, 0] + c * step[:, 1]]).sum(axis=1)
        arm = centre - pose[-1, :2]  # the piece rides on the last pose
        c, s = np.cos(yaw[-1]), np.sin(yaw[-1])
        there = at + pose[0, :2] + [c * arm[0] - s * arm[1], s * arm[0] + c * arm[1]]
        ends.append([*(there - centre), yaw[-1]])
    sampled = np.cov(np.array(ends).T)
    slips = 0.01**2 * 10.0 * distance[-1] + 0.05**2
    np.testing.assert_allclose(stated - np.diag([slips, slips, 1e-6]), sampled, rtol=0.1, atol=2e-3)


def test_a_drift_is_bounded_by_what_holds_the_path() -> None:
    distance, pose = u_turn()
    free = drift(
        Way(distance=distance, pose=pose),
        0.0,
        60.0,
        np.array([5.0, 6.0]),
        motion_of(distance, gyro=False),
        MotionConfig(),
    )
    held = bounded(free, 0.5)
    assert deviation(free) > 1.0
    assert deviation(held) <= 0.5
    assert np.sqrt(held[2, 2]) <= 0.02
    np.testing.assert_allclose(bounded(free, 1e6)[:2, :2], free[:2, :2], rtol=1e-3)


def lattice(rng: np.random.Generator, jitter: float, n: int = 12) -> Array:
    """(n * n, 2) trees, 5 m apart."""
    grid = np.stack(np.meshgrid(np.arange(n) * 5.0, np.arange(n) * 5.0), axis=2).reshape(-1, 2)
    return grid + jitter * rng.normal(size=grid.shape)


def test_a_prior_picks_among_places_that_are_alike() -> None:
    """In a perfect lattice every step of it fits: with a prior, what lies within it comes first, and what lies far off not at all."""
    trees = lattice(np.random.default_rng(0), 0.0)
    index = build_index(trees, np.full(len(trees), 1e-4), np.full(len(trees), np.nan), 25.0, 16.0, 0.05)
    at = np.array([22.0, 27.0, 0.0])
    m = trees[np.hypot(*(trees - at[:2]).T) < 8.0] - at[:2]
    n = len(m)
    marks = Landmarks(
        m=m, cov=1e-3 * np.eye(2 * n), var=np.full(n, 1e-3), diameter=np.full(n, np.nan), diameter_var=np.full(n, np.nan),
        tree=np.full(n, np.log(0.9)), other=np.full(n, np.log(0.1 * index.density)), lasting=np.full(n, 0.9),
    )  # fmt: skip
    free = search(marks, index, PLACES)
    assert len(free.pose) > 50
    held = search(marks, index, PLACES, Prior(at + [0.3, -0.2, 0.01], np.diag([0.25, 0.25]), 0.05))
    np.testing.assert_allclose(held.pose[0], at, atol=0.05)
    assert np.hypot(*(held.pose[:, :2] - at[:2]).T).max() < 4.0
    # A prior that is wide across and narrow along lets through what lies across.
    wide = search(marks, index, PLACES, Prior(at, np.diag([0.01, 100.0]), 0.05))
    off = wide.pose[:, :2] - at[:2]
    assert np.abs(off[:, 0]).max() < 1.0
    assert np.abs(off[:, 1]).max() > 4.0


def seen_again(
    rng: np.random.Generator, trees: Array, drifted: Array, fresh: int = 2, sigma: float = 0.05
) -> tuple[Recognised | None, Array, Array]:
    """What `recognise` says of the trees of a corner, moved by `drifted` about their centre, with `fresh` new ones; here (N, 2) and their trees (N,)."""
    rows = np.flatnonzero((trees[:, 0] < 17.0) & (trees[:, 1] < 17.0))
    true = np.concatenate([trees[rows], rng.uniform(0, 17, (fresh, 2))])
    centre = true.mean(0)
    T = moved_pose(np.eye(4), centre, -drifted)
    here = transform(T, np.column_stack([true, np.zeros(len(true))]))[:, :2] + sigma * rng.normal(size=true.shape)
    off = np.diag([2.0**2, 2.0**2, 0.1**2])
    found = recognise(
        here, sigma**2 * np.eye(len(here)), trees, np.full(len(trees), sigma), off, 7.0, np.full(len(here), 0.5)
    )
    return found, here, np.concatenate([rows, np.full(fresh, -1)])


@given(seeds, st.floats(-2.5, 2.5), st.floats(-2.5, 2.5), st.floats(-0.15, 0.15))
@settings(max_examples=20, deadline=None)
def test_scattered_trees_are_recognised_and_put_back(seed: int, x: float, y: float, yaw: float) -> None:
    rng = np.random.default_rng(seed)
    trees = lattice(rng, 1.3, 8)
    found, here, is_tree = seen_again(rng, trees, np.array([x, y, yaw]))
    if found is None:  # undecided is allowed, wrong is not
        return
    assert found.slid == 0.0  # no lattice
    beside = np.linalg.norm(trees[[j for _, j in found.pairs]] - trees[is_tree[[i for i, _ in found.pairs]]], axis=1)
    assert (beside > 0.5).sum() <= 1  # two that stand nearer may be taken for each other
    back = transform(moved_pose(np.eye(4), found.centre, found.move), np.column_stack([here, np.zeros(len(here))]))[
        :, :2
    ]
    i, j = np.array([(i, j) for i, j in found.pairs if is_tree[i] >= 0]).T
    assert np.linalg.norm(back[i] - trees[j], axis=1).mean() < 0.3


def test_scattered_trees_are_recognised_nearly_always() -> None:
    rng = np.random.default_rng(1)
    found = [seen_again(rng, lattice(rng, 1.3, 8), rng.normal(0, [1.5, 1.5, 0.07]))[0] for _ in range(30)]
    assert sum(f is not None for f in found) >= 28


def test_a_lattice_is_left_undecided() -> None:
    """Steps of the lattice are as good as each other; the drift of 2 m cannot tell two rows that are 5 m apart surely enough."""
    rng = np.random.default_rng(2)
    wrong = 0
    for _ in range(30):
        found, _, is_tree = seen_again(rng, lattice(rng, 0.02, 8), rng.normal(0, [2.0, 2.0, 0.05]))
        wrong += found is not None and sum(is_tree[i] == j for i, j in found.pairs) < len(found.pairs) - 1
    assert wrong == 0


def test_trees_that_are_not_there_are_not_recognised() -> None:
    rng = np.random.default_rng(3)
    trees = lattice(rng, 1.3, 8)
    for _ in range(20):
        here = rng.uniform(0, 20, (14, 2))
        off = np.diag([2.0**2, 2.0**2, 0.1**2])
        got = recognise(here, 0.0025 * np.eye(14), trees, np.full(len(trees), 0.05), off, 7.0, np.full(14, 0.5))
        assert got is None


def test_a_piece_that_is_bent_is_recognised_where_its_parts_hang_together() -> None:
    """Half of the piece is 0.5 m off: as errors of each tree by itself that says little, as one of a half it says where it is."""
    rng = np.random.default_rng(4)
    trees = lattice(rng, 1.3, 8)
    corner = trees[(trees < 12.0).all(axis=1)]
    here = np.asarray(corner + 0.03 * rng.normal(size=corner.shape))
    late = here[:, 0] > 6.0
    here[late] += [0.4, -0.3]
    n, bend = len(here), 0.7
    off = np.diag([2.0**2, 2.0**2, 0.1**2])
    together = 0.0025 * np.eye(n) + bend**2 * (late[:, None] == late)
    alone = (0.0025 + bend**2) * np.eye(n)
    few = np.full(n, 0.5)
    assert recognise(here, together, trees, np.full(len(trees), 0.05), off, 14.0, few) is not None
    assert recognise(here, alone, trees, np.full(len(trees), 0.05), off, 14.0, few) is None


def test_a_move_is_taken_about_its_centre() -> None:
    pose = planar(3.0, 4.0, 0.2)
    got = moved_pose(pose, np.array([1.0, 4.0]), np.array([10.0, -1.0, np.pi / 2]))
    np.testing.assert_allclose(got, planar(11.0, 5.0, 0.2 + np.pi / 2), atol=1e-12)


def test_the_way_is_read_between_its_poses() -> None:
    distance, pose = u_turn()
    poses = np.array([planar(*p) for p in pose])
    way = Way.of(distance, poses)
    np.testing.assert_allclose(way.pose, pose, atol=1e-9)
    assert way.at(np.array([0.25]))[0] == pytest.approx([0.25, 0.0, 0.0])
    assert replace(way, pose=way.pose + 1.0).at(np.array([0.0]))[0] == pytest.approx([1.0, 1.0, 1.0])


def test_a_loop_is_shut_over_the_way_since() -> None:
    distance, pose = u_turn()
    poses = np.array([planar(*p) for p in pose])
    loop = Closed(before=5.0, since=20.0, now=50.0, centre=np.array([10.0, 6.0]), move=np.array([2.0, -1.0, 0.3]))
    got = loop.bent(distance, poses, motion_of(distance, gyro=False), MotionConfig())
    early, late = distance <= 20.0, distance >= 50.0
    np.testing.assert_array_equal(got[early], poses[early])
    np.testing.assert_allclose(got[late], [moved_pose(T, loop.centre, loop.move) for T in poses[late]], atol=0.03)
    longer = np.linalg.norm(np.diff(got[:, :2, 3], axis=0), axis=1) - np.diff(distance)
    assert np.abs(longer).max() < 0.2  # nothing is torn


def alley(rng: np.random.Generator, first: int, rows: int, gap: float, jitter: float) -> Array:
    """(N, 2) trees of some rows along x, 12 in a row, from the row number `first` on."""
    x, y = np.meshgrid(np.arange(12) * gap, np.arange(first, first + rows) * gap)
    trees = np.column_stack([x.ravel(), y.ravel()])
    return trees + jitter * rng.normal(size=trees.shape)


def test_the_next_rows_of_a_lattice_are_not_taken_for_the_last() -> None:
    """Two rows are mapped, the two beyond are new: with a drift of a spacing they would fit, tree by tree."""
    rng = np.random.default_rng(5)
    for _ in range(20):
        there, here = alley(rng, 0, 2, 5.0, 0.03), alley(rng, 2, 2, 5.0, 0.03)[2:20]
        off = np.diag([3.0**2, 3.0**2, 0.05**2])
        assert (
            recognise(
                here, 0.0025 * np.eye(len(here)), there, np.full(len(there), 0.05), off, 7.0, np.full(len(here), 0.6)
            )
            is None
        )


def test_a_lattice_is_recognised_where_dead_reckoning_knows_the_row() -> None:
    rng = np.random.default_rng(6)
    for _ in range(10):
        there = alley(rng, 0, 3, 5.0, 0.03)
        here = there[4:24] + [0.2, -0.15] + 0.03 * rng.normal(size=(20, 2))
        off = np.diag([0.3**2, 0.3**2, 0.01**2])
        found = recognise(here, 0.0025 * np.eye(20), there, np.full(len(there), 0.05), off, 7.0, np.full(20, 0.6))
        assert found is not None
        assert found.pairs == [(i, i + 4) for i in range(20)]
        np.testing.assert_allclose(found.move[:2], [-0.2, 0.15], atol=0.06)
        assert 0.0 < found.slid < 0.1


def test_what_is_turned_and_shifted_together_is_put_back_by_a_drift_that_says_so() -> None:
    """An error of yaw far away shifts and turns the piece at once: a prior with that correlation lets it through, its mirror image does not."""
    rng = np.random.default_rng(7)
    trees = lattice(rng, 1.3, 8)
    centre, yaw = trees[(trees < 17.0).all(axis=1)].mean(0), 0.08
    shift = np.array([-60.0 * yaw, 0.0])  # the turn was 60 m below
    T = moved_pose(np.eye(4), centre, -np.array([*shift, yaw]))
    corner = trees[(trees < 17.0).all(axis=1)]
    here = transform(T, np.column_stack([corner, np.zeros(len(corner))]))[:, :2]
    arm = np.array([-60.0, 0.0, 1.0])
    few, sigma = np.full(len(here), 0.5), np.full(len(trees), 0.05)
    small = np.diag([0.1**2, 0.1**2, 0.003**2])
    right = recognise(here, 0.0025 * np.eye(len(here)), trees, sigma, 0.08**2 * np.outer(arm, arm) + small, 7.0, few)
    assert right is not None
    np.testing.assert_allclose(right.move, [*shift, yaw], atol=0.1)
    arm[2] = -1.0
    wrong = recognise(here, 0.0025 * np.eye(len(here)), trees, sigma, 0.08**2 * np.outer(arm, arm) + small, 7.0, few)
    assert wrong is None


def walked(jitter: float, drifted: Array) -> tuple[LoopCloser, Array]:
    """A closer at the end of the U-turn's way, tracks of both ways seen; the second way's are off by `drifted`; and the tree of each track."""
    rng = np.random.default_rng(8)
    distance, pose = u_turn()
    trees = lattice(rng, jitter, 9) - [5.0, 12.0]
    tracks, whose = [], []
    for half in (distance <= 30.0, distance > 38.0):
        for k, tree in enumerate(trees):
            near = half & (np.hypot(*(pose[:, :2] - tree).T) < 8.0)
            if near.sum() >= 3:
                off = drifted if half[-1] else np.zeros(2)
                tracks.append(
                    [*(tree + off + 0.03 * rng.normal(size=2)), distance[near].min(), distance[near].max(), near.sum()]
                )
                whose.append(k)
    x, y, first, last, hits = np.array(tracks).T
    n = len(x)
    place = np.column_stack([x, y])
    table = TrackTable(
        place=place, foot=place, width=np.zeros(n), post=np.zeros(n), sigma=np.full(n, 0.05), first=first, last=last, hits=hits.astype(np.int64),
        known=np.zeros(n, bool), single=np.zeros(n, bool),
    )  # fmt: skip
    closer = LoopCloser(n, motion_of(distance, gyro=False), TreesConfig(), MotionConfig())
    while closer.advance(table, Way(distance=distance, pose=pose), float(distance[-1]), 1e6):
        pass
    return closer, np.array(whose)


def test_a_walk_to_and_fro_closes_its_loop() -> None:
    closer, whose = walked(1.2, np.array([0.5, -1.2]))
    assert closer.loops >= 1
    assert closer.closed is not None
    np.testing.assert_allclose(closer.closed.move[:2], [-0.5, 1.2], atol=0.25)
    assert closer.closed.since < closer.closed.now
    for tree in np.unique(closer.tree):
        assert len(set(whose[closer.tree == tree].tolist())) == 1  # no two trees have become one


def test_a_drift_knows_of_slips_and_of_gaps_of_the_gyro() -> None:
    distance, pose = u_turn()
    way, centre = Way(distance=distance, pose=pose), np.array([5.0, 6.0])
    good = motion_of(distance, gyro=True)
    blind = replace(good, unseen=np.where(distance > 35.0, np.pi, 0.0))
    slipped = replace(good, doubt=np.where(distance > 20.0, 1.5, 0.0))
    end = float(distance[-1])
    plain, gap, slip = (drift(way, 0.0, end, centre, m, MotionConfig()) for m in (good, blind, slipped))
    assert np.sqrt(gap[2, 2]) == pytest.approx(0.08 * np.pi, rel=0.05)
    assert deviation(gap) > 4.0
    np.testing.assert_allclose(slip - plain, np.diag([2.25, 2.25, 0.0]), atol=1e-9)
    assert np.sqrt(plain[2, 2]) < 0.03  # with a gyro; by the wheels, ten times that
    assert np.sqrt(drift(way, 0.0, end, centre, motion_of(distance, gyro=False), MotionConfig())[2, 2]) > 0.2


def test_more_trees_of_a_lattice_do_not_outvote_where_it_is() -> None:
    """Six columns are mapped, the piece begins at the fourth and goes on: laid three columns back all of it fits, where it is a third of it."""
    rng = np.random.default_rng(9)
    for _ in range(10):
        there = alley(rng, 0, 3, 5.0, 0.03)
        there, here = there[there[:, 0] < 27.0], alley(rng, 0, 3, 5.0, 0.03)
        here = here[(here[:, 0] > 13.0) & (here[:, 0] < 43.0)]
        off = np.diag([8.0**2, 1.0**2, 0.05**2])
        got = recognise(
            here, 0.0025 * np.eye(len(here)), there, np.full(len(there), 0.05), off, 7.0, np.full(len(here), 0.6)
        )
        assert got is None or np.abs(got.move[:2]).max() < 1.0
