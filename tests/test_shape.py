"""The shape of a tree from its sightings, and what its covariance owes to views that disagree."""

from dataclasses import replace

import numpy as np
import pytest

from topograph.evaluate.metrics import match
from topograph.geometry import from_xyz_rpy, inverse, transform
from topograph.simulate.growth import _girth
from topograph.trees import Detections, Shapes, TrackTable, TreesConfig, exists, feet, grounds, refine, shapes, tabulate
from topograph.trunks.fit import LEAN_SIGMA_PRIOR

HEIGHT = 0.8


def around(n: int, distance: float = 4.0) -> np.ndarray:
    """`n` poses (n, 4, 4) on a circle about the origin."""
    turn = np.linspace(0, 2 * np.pi, n, endpoint=False) + 0.1
    return np.array([from_xyz_rpy(distance * np.cos(a), distance * np.sin(a), 0, 0, 0, 2.0 * a) for a in turn])


def sighted(
    poses: np.ndarray, place: np.ndarray, slope: np.ndarray, tree: np.ndarray, scan: np.ndarray, stems: np.ndarray
) -> Detections:
    """Detections of trunks at `place` (N, 2) with measured `slope` (N, 2), both in the map, from the poses of `scan` (N,)."""
    n = len(scan)
    T = inverse(poses[scan])
    in_map = np.concatenate([place, np.full((n, 1), HEIGHT)], axis=1)
    up = np.einsum("nij,nj->ni", T[:, :3, :3], np.concatenate([slope, np.ones((n, 1))], axis=1))
    up /= up[:, 2:]
    weight = np.full(n, 1.0 / 0.05**2)
    measured = np.stack(
        [np.zeros(n), up[:, 0], up[:, 1], weight, np.full(n, 0.3), np.full(n, 0.02)],
        axis=1,
    )
    return Detections(
        stamps_ns=np.arange(1, len(poses) + 1) * 10**8,
        scan=scan,
        p=transform(T, in_map),
        cov=np.tile(np.diag([4e-4, 4e-4, LEAN_SIGMA_PRIOR**2]), (n, 1, 1)),
        axis=up / np.linalg.norm(up, axis=1, keepdims=True),
        height=np.full(n, HEIGHT),
        diameter=np.full(n, 0.3),
        score=np.full(n, 5.0),
        kinds=np.tile(np.log([0.98, 0.01, 0.01]), (n, 1)),
        measured=measured,
        stems=stems,
        source=np.arange(n),
        free=np.zeros((0, 360), np.uint32),
        eye=np.zeros((len(poses), 3)),
    )


@pytest.mark.parametrize("views", [1, 3, 8])
def test_views_that_disagree_are_in_the_covariance(views: int) -> None:
    """Each side of a tree is off by its own error, which a thousand more scans of that side repeat. The variance of place and
    slope must be that of the mean of sides, not of scans.
    """
    rng = np.random.default_rng(7)
    trees, per_view, of_place, of_slope = 400, 12, 0.02, 0.04
    poses = around(8)
    place, slope, tree, scan, error = [], [], [], [], []
    for t in range(trees):
        sides = (
            rng.permutation(8)[:views] if t < trees // 2 else rng.permutation(8)
        )  # the others are seen from all sides
        at, lean = rng.normal(0, of_place, (len(sides), 2)), rng.normal(0, of_slope, (len(sides), 2))
        place.append(np.repeat(at, per_view, axis=0) + rng.normal(0, 0.005, (len(sides) * per_view, 2)))
        slope.append(np.repeat(lean, per_view, axis=0) + rng.normal(0, 0.01, (len(sides) * per_view, 2)))
        tree.append(np.full(len(sides) * per_view, t))
        scan.append(np.repeat(sides, per_view))
        error.append(at.mean(axis=0))
    scans = np.concatenate(scan)
    order = np.argsort(scans, kind="stable")
    rows = [np.concatenate(k)[order] for k in (place, slope, tree)]
    d = sighted(poses, rows[0], rows[1], rows[2], scans[order], np.ones(len(scans), np.int64))
    s = shapes(d, rows[2], poses, trees)
    few = slice(0, trees // 2)
    assert np.mean(np.array(error)[few] ** 2 / s.place_var[few, None]) == pytest.approx(1.0, abs=0.35)
    assert 0.4 < np.mean(s.slope[few] ** 2 / s.slope_var[few, None]) < 1.3


def test_a_stem_seen_more_often_does_not_pull_the_axis() -> None:
    """Two stems lean away from each other by 0.3; one is seen five times as often, every second scan sees both. The tree below
    them stands upright, and each sighting is taken down along what it saw.
    """
    rng = np.random.default_rng(3)
    poses = around(60)
    scan = np.arange(60)
    first = scan % 12 != 1
    both = np.arange(60) % 2 == 0
    lean = np.where(both[:, None], [0.0, 0.0], np.where(first[:, None], [0.3, 0.0], [-0.3, 0.0]))
    place = lean * (HEIGHT - 0.4) + rng.normal(0, 0.01, (60, 2))
    stems = np.where(both, 2, 1)
    d = sighted(poses, place, lean + rng.normal(0, 0.03, (60, 2)), np.zeros(60, int), scan, stems)
    s = shapes(d, np.zeros(60, int), poses, 1)
    assert s.stems[0] == 2
    assert np.abs(s.slope[0]).max() < 0.03
    assert np.mean(np.abs(s.own_slope - lean).max(axis=1) < 0.05) > 0.9
    known = shapes(d, np.zeros(60, int), poses, 1, np.array([0]))
    assert known.stems[0] == 2  # counted,
    assert not known.forked[0]  # and stated at its own height all the same


@pytest.mark.parametrize(
    ("feet_apart", "slopes", "trees"),
    [(0.3, (-0.25, 0.25), 1), (0.75, (0.0, 0.0), 2), (0.75, (0.2, 0.2), 2)],
)
def test_stems_of_one_foot_are_one_tree(feet_apart: float, slopes: tuple[float, float], trees: int) -> None:
    """Two stems, 0.7 m apart where they are seen, which part from one foot, against trees that stand, or lean alike. Each scan
    takes two thirds of the lean for granted to be none; what it measured, whole tracks know.
    """
    rng = np.random.default_rng(8)
    poses = around(40, 6.0)
    scan, track = np.repeat(np.arange(40), 2), np.tile([0, 1], 40)
    foot = np.array([[-0.5, 0.0], [0.5, 0.0]]) * feet_apart
    lean = np.stack([np.array(slopes), np.zeros(2)], axis=1)
    place = foot[track] + HEIGHT * lean[track] + rng.normal(0, 0.02, (80, 2))
    d = sighted(poses, place, lean[track] + rng.normal(0, 0.03, (80, 2)), track, scan, np.ones(80, np.int64))
    shrunk = d.axis * [1 / 3, 1 / 3, 1.0]
    d = replace(d, axis=shrunk / np.linalg.norm(shrunk, axis=1, keepdims=True))
    np.testing.assert_allclose(feet(d, track, poses), foot[track], atol=0.08)
    table = tabulate(d, track, poses, np.arange(40.0), feet(d, track, poses))
    tree = refine(table, np.arange(2), TreesConfig())
    assert len(np.unique(tree)) == trees
    assert len(np.unique(refine(table, tree, TreesConfig()))) == trees  # and it stays so


@pytest.mark.parametrize("widths", [(0.6, 0.6), (0.25, 0.8)])
@pytest.mark.parametrize("apart", [0.5, 0.6, 0.9])
def test_pieces_of_a_thick_trunk_do_not_go_to_and_fro(apart: float, widths: tuple[float, float]) -> None:
    """Many tracks of two faces of one trunk: what was joined by its width does not leave for its distance, only to be joined again."""
    face = np.repeat([0, 1], (20, 16))
    n = len(face)
    for seed in range(10):
        rng = np.random.default_rng(seed)
        at = np.column_stack([apart * face, 0.0 * face]) + rng.normal(0, 0.03, (n, 2))
        table = TrackTable(
            place=at, foot=at, width=np.array(widths)[face], post=np.full(n, -3.0), sigma=rng.uniform(0.01, 0.03, n),
            first=np.zeros(n), last=np.ones(n), hits=rng.integers(3, 400, n), known=np.zeros(n, bool), single=np.zeros(n, bool),
        )  # fmt: skip
        tree = refine(table, np.arange(n), TreesConfig())
        trees = []
        for _ in range(6):
            tree = refine(table, tree, TreesConfig())
            trees.append(len(np.unique(tree)))
        assert set(trees[2:]) == {2 if apart > 0.7 else 1}


def test_recorded_axes_that_disagree_widen_the_lean() -> None:
    """Detections that state an axis and no kinds: the variance of the lean is that of sides, too."""
    rng = np.random.default_rng(5)
    poses = around(8)
    trees, again = 150, 12
    tree, scan = np.tile(np.repeat(np.arange(trees), again), 8), np.repeat(np.arange(8), again * trees)
    n = len(tree)
    lean = np.repeat(rng.normal(0, 0.08, (8 * trees, 2)), again, axis=0) + rng.normal(0, 0.01, (n, 2))
    d = sighted(poses, np.zeros((n, 2)), lean, tree, scan, np.ones(n, int))
    d = replace(d, kinds=np.full((n, 3), np.nan), measured=np.zeros((n, 6)))
    s = shapes(d, tree, poses, trees)
    assert 0.5 < np.mean(s.slope**2 / s.slope_var[:, None]) < 1.4


@pytest.mark.parametrize("score", [0.1, 0.3, 50.0])
def test_scores_of_other_sources_count_against_each_other_only(score: float) -> None:
    """A confidence of 0..1, or any other scale, is no log-odds: what all trees of a run score is enough."""
    poses = around(8)
    tree, scan = np.tile(np.arange(5), 8), np.repeat(np.arange(8), 5)
    place = np.stack([tree % 5 - 2.0, np.zeros(40)], axis=1)
    d = sighted(poses, place, np.zeros((40, 2)), tree, scan, np.ones(40, int))
    d = replace(d, kinds=np.full((40, 3), np.nan), score=np.full(40, score))
    places = np.stack([np.arange(5) - 2.0, np.zeros(5), np.full(5, HEIGHT)], axis=1)
    assert exists(d, tree, poses, places, TreesConfig()).ok.all()


def test_a_girth_of_one_circle_and_of_two() -> None:
    assert _girth(np.array([[0.0, 0.0, 0.2]]))[1] == 0.4
    middle, diameter = _girth(np.array([[-0.1, 0.0, 0.2], [0.1, 0.0, 0.2]]))
    np.testing.assert_allclose(middle, 0.0, atol=5e-3)
    assert diameter == pytest.approx(
        (2 * np.pi * 0.2 + 2 * 0.2) / np.pi, rel=0.01
    )  # a tape: two half circles and two straights


def test_a_false_node_at_the_end_of_a_row_pushes_nobody_aside() -> None:
    """A dense row, its last tree missed, a false node before its first: one miss, one false, all others are themselves."""
    true = np.stack([np.arange(12) * 0.95, np.zeros(12)], axis=1)
    found = np.concatenate([[[-0.95, 0.0]], true[:-1] + 0.01])
    i, j = match(found, true)
    assert len(i) == 11
    np.testing.assert_array_equal(i, j + 1)


def test_the_ground_is_that_of_the_near_sweeps() -> None:
    """From afar beams graze the grass and the ground seems higher; the near sweeps know better, though they are fewer. What a tree's
    sweeps disagree about is in its sigma."""
    rng = np.random.default_rng(3)
    poses = np.concatenate([around(8), around(40, 15.0)])
    scan = np.tile(np.arange(48), 2)
    tree = np.repeat([0, 1], 48)
    d = sighted(poses, np.zeros((96, 2)), np.zeros((96, 2)), tree, scan, np.ones(96, np.int64))
    far = scan >= 8
    off = np.where(far, 0.12, 0.0) + rng.normal(0, np.where(tree == 0, 0.01, 0.2))
    d = replace(d, height=d.height - off)
    z, sigma = grounds(d, tree, poses, 3)
    assert abs(z[0]) < 0.02
    assert abs(z[1]) < 0.2
    assert 0.04 <= sigma[0] < 0.06
    assert sigma[1] > 0.08
    assert np.isnan(z[2])
    recorded = replace(d, kinds=np.full((96, 3), np.nan))
    assert np.isnan(grounds(recorded, tree, poses, 3)[0]).all()


def test_a_second_stem_is_believed_where_trees_fork() -> None:
    """The same share of sightings that tell two stems apart is a branch in an orchard of single trunks, and a stem where most trees fork;
    a tree whose second stem nobody saw is the less sure the more others have one."""
    poses = around(100)

    def run(shares: list[float]) -> Shapes:
        tree, scan = np.repeat(np.arange(len(shares)), 100), np.tile(np.arange(100), len(shares))
        stems = np.concatenate([np.where(np.arange(100) % 25 < 25 * s, 2, 1) for s in shares])
        place = 5.0 * tree[:, None] * np.array([1.0, 0.0])
        return shapes(sighted(poses, place, np.zeros((len(tree), 2)), tree, scan, stems), tree, poses, len(shares))

    alone, among = run([0.12] + 19 * [0.0]), run([0.12, 0.0] + 8 * [0.6] + 8 * [0.0])
    assert alone.stems[0] == 1
    assert among.stems[0] == 2
    assert among.stems[1] == 1
    assert among.place_var[1] > alone.place_var[1] + 0.01**2
    assert (among.stems[2:10] == 2).all()
    assert (alone.stems[1:] == 1).all()


@pytest.mark.parametrize("apart", [0.0, 0.3, 0.5])
def test_something_beside_a_trunk_that_is_taken_for_it_is_in_the_covariance(apart: float) -> None:
    """Most sightings of a trunk are of a heap beside it, or of both: the mean of them is wherever, and must say so. Sightings that
    scatter as they state add nothing.
    """
    rng = np.random.default_rng(11)
    trees, scans, stated = 60, 40, 0.02
    poses = around(scans)
    scan = np.tile(np.arange(scans), trees)
    tree = np.repeat(np.arange(trees), scans)
    side = rng.uniform(0, 2 * np.pi, trees)[tree]
    of_heap = rng.random(len(tree)) < 0.7
    heap = apart * np.stack([np.cos(side), np.sin(side)], axis=1) + rng.normal(0, 0.4 * apart, (len(tree), 2))
    place = rng.normal(0, stated, (len(tree), 2)) + of_heap[:, None] * heap
    order = np.argsort(scan, kind="stable")
    d = sighted(poses, place[order], np.zeros((len(tree), 2)), tree[order], scan[order], np.ones(len(tree), np.int64))
    s = shapes(d, tree[order], poses, trees)
    sigma = np.sqrt(s.place_var)
    if apart == 0.0:
        assert sigma.max() < stated
        return
    off = np.array([np.median(place[tree == t], axis=0) for t in range(trees)])  # the trunk stands at the origin
    nees = np.sum(off**2, axis=1) / s.place_var
    assert 0.3 < nees.mean() < 8.0
    assert np.median(sigma) > 0.2 * apart
