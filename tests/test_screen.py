"""What moves in the world, told track by track as a loop would tell it; and how sure a kind can be."""

from itertools import combinations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from topograph.session import SECTORS
from topograph.trees import Detections
from topograph.trees.existence import _kinds
from topograph.trees.screen import GROUPS, NOISE, parts_apart
from topograph.trunks.score import KINDS, TREE


def detections(scan, cov, kinds) -> Detections:
    """Detections 5 m ahead, of which the rest is unknown."""
    n = len(scan)
    return Detections(
        stamps_ns=np.arange(int(np.max(scan, initial=-1)) + 1), scan=scan, p=np.tile([5.0, 0, 0], (n, 1)), cov=cov, axis=np.tile([0.0, 0, 1], (n, 1)),
        height=np.full(n, np.nan), diameter=np.full(n, np.nan), score=np.zeros(n), kinds=kinds, measured=np.zeros((n, 6)), stems=np.ones(n, int),
        source=np.arange(n), free=np.zeros((0, SECTORS), np.uint32), eye=np.zeros((0, 3)),
    )  # fmt: skip


def apart_one_by_one(place, d, label, n, drift, sway):
    """Of each label the medians of its parts in time, and any two of them."""
    sigma = np.sqrt(0.5 * (d.cov[:, 0, 0] + d.cov[:, 1, 1]))
    out = np.zeros(n, bool)
    for k in range(n):
        rows = np.flatnonzero(label == k)
        if len(rows) < GROUPS:
            continue
        parts = np.array_split(rows[np.argsort(d.scan[rows], kind="stable")], GROUPS)
        noise = min(3.0 * np.median(sigma[rows]) / np.sqrt(len(rows) / GROUPS), NOISE)
        for a, b in combinations(parts, 2):
            way = abs(np.median(drift[a]) - np.median(drift[b]))
            out[k] |= np.linalg.norm(np.median(place[a], axis=0) - np.median(place[b], axis=0)) > sway + noise + way
    return out


@settings(deadline=None)
@given(st.integers(0, 2**31), st.integers(0, 120), st.integers(1, 9))
def test_parts_of_tracks_as_a_loop_compares_them(seed: int, rows: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    label = rng.integers(-1, n, rows)  # -1: of no track
    cov = np.zeros((rows, 3, 3))
    cov[:, [0, 1], [0, 1]] = rng.uniform(0, 0.02, (rows, 2))
    d = detections(np.sort(rng.integers(0, 40, rows)), cov, np.full((rows, 3), np.nan))
    place, drift = rng.normal(scale=0.3, size=(rows, 2)), np.sort(rng.uniform(0, 1, rows))
    expected = apart_one_by_one(place, d, label, n, drift, 0.1)
    np.testing.assert_array_equal(parts_apart(place, d, label, n, drift, 0.1), expected)


def test_no_kind_is_certain_however_often_it_was_seen() -> None:
    n = 400
    sure = np.log([0.999998, 1e-6, 1e-6])
    kinds = np.r_[np.tile(sure, (n, 1)), np.full((3, 3), np.nan)]
    d = detections(np.arange(n + 3), np.tile(0.01 * np.eye(3), (n + 3, 1, 1)), kinds)
    kind, probability = _kinds(d, np.r_[np.zeros(n, int), np.ones(3, int)], 2)
    assert kind.tolist() == [TREE, TREE]
    assert 0.97 < probability[0] <= 1.0 - 0.03 * (1.0 - 1.0 / len(KINDS)) + 1e-9
    assert np.isnan(probability[1])
