"""A second season: trees of an earlier map stay themselves, what was planted beside a stump is another tree, and what never comes is gone."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_shape import sighted

from topograph.geometry import from_xyz_rpy
from topograph.trees import TrackTable, TreesConfig, refine
from topograph.trees.existence import overdue

CONFIG = TreesConfig()


def table(
    known: np.ndarray, single: np.ndarray, fresh: np.ndarray, hits: np.ndarray, sigma: float = 0.02
) -> TrackTable:
    """Tracks at `fresh` (F, 2) with `hits` (F,), then the trees of an earlier map at `known` (K, 2)."""
    place, n = np.concatenate([fresh, known]), len(fresh) + len(known)
    old = np.arange(n) >= len(fresh)
    return TrackTable(
        place=place, foot=place, width=np.where(old, 0.0, 0.15), post=np.zeros(n), sigma=np.where(old, 0.012, sigma),
        first=np.where(old, -1e9, 0.0), last=np.where(old, -1e9, 1.0), hits=np.concatenate([hits, np.full(len(known), 1000)]),
        known=old, single=np.concatenate([np.zeros(len(fresh), bool), single]),
    )  # fmt: skip


def settled(t: TrackTable, tree: np.ndarray) -> np.ndarray:
    """What is decided in the end: with patience while the map is bent, then without."""
    for patience in (4.0, 2.0, 1.0, 0.0, 0.0, 0.0):
        tree = refine(t, tree, CONFIG, patience)
    return tree


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), spacing=st.floats(0.15, 1.5), joined=st.booleans())
def test_two_trees_of_a_map_never_become_one(seed: int, spacing: float, joined: bool) -> None:
    """However near each other, and whatever was joined before."""
    rng = np.random.default_rng(seed)
    known = np.column_stack([spacing * np.arange(6), np.zeros(6)])
    fresh = known[rng.integers(0, 6, 30)] + rng.normal(0, 0.2, (30, 2))
    t = table(known, rng.random(6) < 0.7, fresh, rng.integers(1, 300, 30))
    tree = settled(t, np.zeros(36, np.int64) if joined else np.arange(36))
    assert len(np.unique(tree[t.known])) == 6


@pytest.mark.parametrize(
    ("what", "aside", "seen_at_home", "single", "one"),
    [
        ("as it was", 0.02, 0, True, True),
        ("felled, and another planted beside it", 0.35, 0, True, False),
        ("the same, and twigs at the old place", 0.35, 20, True, False),
        ("a branch beside the trunk", 0.35, 400, True, True),
        ("a stem of a forked tree", 0.35, 0, False, True),
        ("a neighbour", 1.2, 0, True, False),
    ],
)
def test_what_stands_beside_a_known_tree(what: str, aside: float, seen_at_home: int, single: bool, one: bool) -> None:
    known = np.array([[0.0, 0.0], [8.0, 0.0]])
    fresh, hits = [[aside, 0.0], [8.01, 0.0]], [300, 300]
    if seen_at_home:
        fresh, hits = [*fresh, [0.03, 0.02]], [*hits, seen_at_home]
    t = table(known, np.array([single, True]), np.array(fresh), np.array(hits))
    n = len(fresh)
    for start in (np.arange(n + 2), np.zeros(n + 2, np.int64)):
        tree = settled(t, start)
        np.testing.assert_array_equal(refine(t, tree, CONFIG), tree)  # and it stays so
        assert (tree[0] == tree[n]) == one, what
        assert tree[1] == tree[n + 1]
        assert tree[n] != tree[n + 1]


def test_what_never_comes_is_overdue() -> None:
    """A row walked along: all trees are seen from 10 m around, but for one that is gone and one of which a twig was seen."""
    way = np.arange(0.0, 60.0, 0.1)
    poses = np.array([from_xyz_rpy(x, 0.0, 0.0, 0.0, 0.0, 0.0) for x in way])
    trees = np.column_stack([np.arange(0.0, 61.0, 4.0), np.full(16, 3.0)])
    rng = np.random.default_rng(3)
    scan, tree = np.nonzero((np.abs(way[:, None] - trees[:, 0]) < 10.0) & (rng.random((len(way), 16)) < 0.8))
    keep = (tree != 5) & ((tree != 9) | (rng.random(len(tree)) < 0.03))
    scan, tree = scan[keep], tree[keep]
    n = len(tree)
    d = sighted(poses, trees[tree], np.zeros((n, 2)), tree, scan, np.ones(n, np.int64))
    places = np.column_stack([trees, np.full(16, 0.8)])
    lacking = overdue(d, tree, poses, places)
    assert set(np.flatnonzero(lacking).tolist()) == {5, 9}
    assert 40 < lacking[5] < 100  # looks every 0.2 m over 20 m, four of five
    near = scan < 30  # from 3 m of the way nobody can tell
    few = sighted(
        poses[:30], trees[tree[near]], np.zeros((near.sum(), 2)), tree[near], scan[near], np.ones(near.sum(), np.int64)
    )
    assert not overdue(few, tree[near], poses[:30], places).any()
