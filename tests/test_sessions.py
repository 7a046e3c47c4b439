"""Sessions, identities and addresses: from a run to the file and back, over a second run."""

import sqlite3
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from topograph import store
from topograph.config import Config
from topograph.errors import MapError
from topograph.pipeline import extend, read_run, solve_run, topo_map
from topograph.simulate import DriveConfig, SensorConfig, record
from topograph.topomap import Seen, SessionRecord, TopoMap
from topograph.topomap.addresses import blocks_of, places_of
from topograph.topomap.sessions import MISSING, MOST_PASSED, STANDING


@pytest.fixture(scope="module")
def two_sessions(tmp_path_factory: pytest.TempPathFactory) -> tuple[TopoMap, TopoMap]:
    """A map of one run, and the same extended by another that went the other way."""
    folder = tmp_path_factory.mktemp("sessions")
    maps: list[TopoMap] = []
    for run in (1, 2):
        bag = folder / f"run{run}.bag"
        record(bag, 62, "grid", DriveConfig(run=run, longest_s=40.0), SensorConfig(detections=True))
        session = read_run([bag], Config())
        old = maps[0] if maps else None
        solved = solve_run(session, Config(), known=old)
        topo = topo_map(solved, Config(), {"inputs": f'[{{"path": "run{run}.bag"}}]'})
        maps.append(topo if old is None else extend(old, topo, solved, Config()))
    return maps[0], maps[1]


def test_two_runs_are_two_sessions(two_sessions: tuple[TopoMap, TopoMap]) -> None:
    one, both = two_sessions
    assert [s.name for s in both.sessions][:1] == [s.name for s in one.sessions]
    assert len({s.name for s in both.sessions}) == 2
    assert both.meta["inputs"] == '[{"path": "run1.bag"}, {"path": "run2.bag"}]'
    assert np.bincount(both.session).tolist() == [len(one.stamps_ns), len(both.stamps_ns) - len(one.stamps_ns)]


def test_identities_last(two_sessions: tuple[TopoMap, TopoMap]) -> None:
    """A tree keeps its id through the second run, though that one found them in another order; new ones get new ids."""
    one, both = two_sessions
    assert both.ids[: len(one)].tolist() == one.ids.tolist()
    assert len(set(both.ids.tolist())) == len(both)
    assert np.linalg.norm(both.p[: len(one), :2] - one.p[:, :2], axis=1).max() < 0.1


def test_sightings_add_up(two_sessions: tuple[TopoMap, TopoMap]) -> None:
    _, both = two_sessions
    total = np.bincount(both.seen.tree, both.seen.count, len(both))
    assert total.tolist() == both.sightings.tolist()
    seen = both.seen.count > 0
    assert (both.seen.first_ns[seen] <= both.seen.last_ns[seen]).all()
    for k, s in enumerate(both.sessions):
        mine = seen & (both.seen.session == k)
        assert both.seen.last_ns[mine].max() <= s.end_ns + 10**9


def test_sessions_come_back_from_the_file(two_sessions: tuple[TopoMap, TopoMap], tmp_path: Path) -> None:
    _, both = two_sessions
    store.save(both, tmp_path / "m.gpkg")
    got = store.load(tmp_path / "m.gpkg")
    assert got.sessions == both.sessions
    assert got.session.tolist() == both.session.tolist()
    for name in Seen.__slots__:
        assert getattr(got.seen, name).tolist() == getattr(both.seen, name).tolist()
    with sqlite3.connect(tmp_path / "m.gpkg") as c:
        rows = c.execute("SELECT id, state, block, place FROM trees ORDER BY id").fetchall()
    assert [r[0] for r in rows] == both.ids.tolist()
    assert len({r[3] for r in rows if r[3]}) == int(both.is_tree.sum())  # an address is of one tree
    assert {r[1] for r in rows} == {STANDING}


def test_maps_without_sessions_are_read(two_sessions: tuple[TopoMap, TopoMap], tmp_path: Path) -> None:
    """A map of the program before sessions: one session of everything, and it can be extended."""
    one, _ = two_sessions
    store.save(one, tmp_path / "m.gpkg")
    with sqlite3.connect(tmp_path / "m.gpkg") as c:
        c.executescript(
            "DROP TABLE sessions; DROP TABLE sightings; ALTER TABLE path DROP COLUMN session;"
            "ALTER TABLE viewpoints DROP COLUMN session; ALTER TABLE trees DROP COLUMN state;"
            "ALTER TABLE trees DROP COLUMN block; ALTER TABLE trees DROP COLUMN place; DELETE FROM meta WHERE key LIKE 'digest:%'"
        )
    old = store.load(tmp_path / "m.gpkg")
    assert len(old.sessions) == 1
    assert old.seen.count.tolist() == one.sightings.tolist()
    assert old.session.tolist() == [0] * len(one.stamps_ns)


def test_a_map_that_somebody_took_a_tree_out_of_can_be_repaired(
    two_sessions: tuple[TopoMap, TopoMap], tmp_path: Path
) -> None:
    _, both = two_sessions
    store.save(both, tmp_path / "m.gpkg")
    gone = int(both.ids[2])
    with sqlite3.connect(tmp_path / "m.gpkg") as c:
        c.execute("DELETE FROM trees WHERE id = ?", (gone,))
    with pytest.raises(MapError):
        store.load(tmp_path / "m.gpkg")
    got = store.load(tmp_path / "m.gpkg", check=False)
    assert gone not in got.ids
    assert len(got) == len(both) - 1
    assert len(got.seen) == len(both.seen) - int((both.seen.tree == 2).sum())


def _seen(*rows: tuple[int, int, int, int]) -> Seen:
    tree, session, count, passed = np.array(rows, np.int64).reshape(-1, 4).T
    return Seen(tree=tree, session=session, count=count, first_ns=count, last_ns=count, passed=passed)


def test_the_last_session_that_looked_decides() -> None:
    gone = _seen((0, 0, 9, 0), (0, 1, 0, MOST_PASSED), (1, 0, 9, 0), (1, 1, 0, MOST_PASSED - 1))
    assert gone.states(2) == [MISSING, STANDING]
    stray = gone.and_(_seen((0, 2, 1, 40)))
    assert stray.states(2) == [MISSING, STANDING]
    back = gone.and_(_seen((0, 2, 3, 0)))
    assert back.states(2) == [STANDING, STANDING]
    assert gone.moved(np.array([-1, 0]), 0).states(1) == [STANDING]


@given(st.integers(2, 5), st.integers(2, 6), st.floats(0, 3.1))
def test_addresses_count_along_the_rows(rows: int, columns: int, turn: float) -> None:
    """However an orchard is turned: one block, each row counted from its southern end, none twice."""
    r, c = (v.ravel() for v in np.mgrid[0:rows, 0:columns])
    R = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    xy = np.column_stack([3.0 * c, 6.0 * r]) @ R.T
    edges = np.array([(i, i + 1) for i in range(len(xy) - 1)])
    tree = np.ones(len(xy), bool)
    block = blocks_of(len(xy), edges, tree)
    assert set(block.tolist()) == {1}
    names = places_of(xy, block, r.astype(np.int64), tree)
    assert len(set(names)) == len(xy)
    for row in range(rows):
        mine = [(n, p) for n, p, k in zip(names, xy, r, strict=True) if k == row]
        ordered = [p for _, p in sorted(mine, key=lambda m: m[0])]
        step = ordered[-1] - ordered[0]
        assert step[1] > -1e-6
        assert (np.diff([p @ step for p in ordered]) > 0).all()


def test_blocks_are_what_edges_join_the_largest_first() -> None:
    edges = np.array([[0, 1], [3, 4], [4, 5]])
    chosen = np.array([True, True, False, True, True, True])
    assert blocks_of(6, edges, chosen).tolist() == [2, 2, 0, 1, 1, 1]


def test_a_record_says_what_it_was_made_of(two_sessions: tuple[TopoMap, TopoMap]) -> None:
    one, _ = two_sessions
    record = one.sessions[0]
    assert isinstance(record, SessionRecord)
    assert record.distance == pytest.approx(
        np.linalg.norm(np.diff(one.map_T_robot[:, :2, 3], axis=0), axis=1).sum(), rel=0.03
    )
    assert replace(record, name="x").name == "x"
