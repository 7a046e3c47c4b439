"""A map comes back as it was written, opens as a GeoPackage, and survives kills and damage."""

import os
import signal
import sqlite3
import struct
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from topograph import store
from topograph.errors import MapError
from topograph.geometry import Datum, exp
from topograph.store.digest import digest
from topograph.topomap import TopoMap, TopomapConfig, Viewpoint, neighbours

HERE = Datum(40.1, -8.2, 90.0)


def make(n: int, seed: int = 0, datum: Datum | None = HERE) -> TopoMap:
    rng = np.random.default_rng(seed)
    p = rng.uniform(-50, 50, (n, 3))
    A = rng.normal(size=(n, 3, 3))
    cov = 1e-4 * (A @ np.swapaxes(A, 1, 2))
    cov[:, 2, :2] = cov[:, :2, 2] = 0.0
    axis = rng.normal(size=(n, 3)) * 0.1 + [0, 0, 1]
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    edges = neighbours(p[:, :2], TopomapConfig())
    views = tuple(Viewpoint(i, axis[i], rng.uniform(-1, 1, (30, 3)).astype(np.float32)) for i in range(n))
    poses = exp(rng.normal(size=(5, 6)))
    diameter = rng.uniform(0.1, 0.5, n)
    branch = np.where(rng.random(n) < 0.5, np.nan, 1.2)
    return TopoMap(
        datum=datum,
        ids=np.arange(1, n + 1),
        p=p,
        cov=cov,
        axis=axis,
        lean_sigma=np.where(rng.random(n) < 0.2, np.nan, 0.04),
        known_at=rng.uniform(0.3, 1.2, n),
        diameter=diameter,
        first_branch=branch,
        sightings=rng.integers(1, 99, n),
        score=rng.normal(size=n),
        row=rng.integers(-1, 3, n),
        kind=rng.integers(0, 3, n),
        kind_probability=np.where(rng.random(n) < 0.5, np.nan, 0.75),
        stems=rng.integers(1, 4, n),
        edges=edges,
        lengths=np.linalg.norm(p[edges[:, 0]] - p[edges[:, 1]], axis=1),
        viewpoints=views,
        stamps_ns=np.arange(5) + 10**18,
        map_T_robot=poses,
        datum_cov=1e-4 * np.eye(3),
        meta={"config": "a: 1"},
    )


@settings(max_examples=15, deadline=None)
@given(n=st.integers(0, 40), seed=st.integers(0, 9), local=st.booleans())
def test_round_trip(tmp_path_factory: pytest.TempPathFactory, n: int, seed: int, local: bool) -> None:
    path = tmp_path_factory.mktemp("map") / "m.gpkg"
    m = make(n, seed, None if local else HERE)
    store.save(m, path)
    got = store.load(path)
    assert got.datum == m.datum
    for name in (
        "ids",
        "p",
        "cov",
        "axis",
        "lean_sigma",
        "known_at",
        "diameter",
        "first_branch",
        "kind",
        "kind_probability",
        "stems",
        "sightings",
        "score",
        "row",
        "edges",
        "stamps_ns",
    ):
        np.testing.assert_allclose(getattr(got, name), getattr(m, name), atol=1e-12, err_msg=name)
    np.testing.assert_allclose(got.map_T_robot, m.map_T_robot, atol=1e-9)
    assert got.meta == m.meta
    for a, b in zip(got.viewpoints, m.viewpoints, strict=True):
        np.testing.assert_allclose(a.cloud, b.cloud, atol=0.00051)
        assert a.tree == b.tree


def edit(path: Path, statement: str) -> int:
    """Change a map behind the program's back; how many rows."""
    c = sqlite3.connect(path)
    for name in (
        "ST_IsEmpty",
        "ST_MinX",
        "ST_MaxX",
        "ST_MinY",
        "ST_MaxY",
    ):  # GDAL and QGIS bring them; the indices' triggers name them
        c.create_function(name, 1, lambda _: 0)
    with c:
        rows = c.execute(statement).rowcount
    c.close()
    return rows


def test_it_is_a_geopackage(tmp_path: Path) -> None:
    m = make(12)
    store.save(m, tmp_path / "m.gpkg")
    c = sqlite3.connect(tmp_path / "m.gpkg")
    assert c.execute("PRAGMA application_id").fetchone()[0] == 0x47504B47
    assert c.execute("PRAGMA integrity_check").fetchone()[0] == "ok"
    assert {r[0] for r in c.execute("SELECT table_name FROM gpkg_contents WHERE data_type='features'")} == {
        "trees",
        "edges",
        "path",
        "path_lines",
        "ellipses",
    }
    blob = c.execute("SELECT geom FROM trees WHERE id=1").fetchone()[0]
    assert blob[:2] == b"GP"
    assert struct.unpack("<i", blob[4:8])[0] == 4326
    lon, lat, h = struct.unpack("<3d", blob[13:37])
    np.testing.assert_allclose([lat, lon, h], m.geodetic()[0], atol=1e-9)
    columns = {r[1] for r in c.execute("PRAGMA table_info(trees)")}
    assert {"id", "geom", "x", "y", "z", "cov_xx", "cov_xy", "cov_yy", "axis_x", "axis_y", "axis_z", "diameter",
            "sightings", "score", "row"} <= columns  # fmt: skip
    c.close()


def test_clouds_near_reads_only_those(tmp_path: Path) -> None:
    m = make(30)
    store.save(m, tmp_path / "m.gpkg")
    found = store.clouds_near(tmp_path / "m.gpkg", m.p[3, :2], 20.0)
    near = {int(i) for i in m.ids[np.linalg.norm(m.p[:, :2] - m.p[3, :2], axis=1) <= 20.0]}
    assert {t for t, _, _ in found} == near


def test_damage_and_versions(tmp_path: Path) -> None:
    path = tmp_path / "m.gpkg"
    store.save(make(3), path)
    edit(path, "UPDATE viewpoints SET cloud = zeroblob(length(cloud)) WHERE id=1")
    with pytest.raises(MapError, match="damaged"):
        store.load(path)
    store.load(path, clouds=False)
    edit(path, "UPDATE meta SET value='99' WHERE key='schema_version'")
    with pytest.raises(MapError, match="newer"):
        store.load(path)
    path.write_bytes(b"not a map at all" * 100)
    with pytest.raises(MapError):
        store.load(path)
    with pytest.raises(MapError, match="no such map"):
        store.load(tmp_path / "none.gpkg")


def test_a_killed_write_leaves_the_old_map(tmp_path: Path) -> None:
    path = tmp_path / "m.gpkg"
    old = make(5, seed=1)
    store.save(old, path)
    code = (
        "import sys; sys.path.insert(0, 'tests')\n"
        "from pathlib import Path\nfrom test_store import make\nfrom topograph import store\n"
        f"m = make(800, seed=2)\nprint('go', flush=True)\nwhile True: store.save(m, Path({str(path)!r}))\n"
    )
    root = Path(__file__).resolve().parents[1]
    for k in range(4):
        p = subprocess.Popen([sys.executable, "-c", code], cwd=root, stdout=subprocess.PIPE)
        assert p.stdout is not None
        p.stdout.readline()
        time.sleep(0.03 + 0.05 * k)
        os.kill(p.pid, signal.SIGKILL)
        p.wait()
        p.stdout.close()
        assert len(store.load(path)) in (5, 800)


def test_a_map_is_another_file_when_it_is_written_again(tmp_path: Path) -> None:
    """Who has the old one open reads it to its end: nothing is written into it."""
    path = tmp_path / "m.gpkg"
    store.save(make(5, seed=1), path)
    with path.open("rb") as held:
        before = held.read()
        store.save(make(8, seed=2), path)
        held.seek(0)
        assert held.read() == before
    assert len(store.load(path)) == 8


def test_edges_do_not_depend_on_scale() -> None:
    rng = np.random.default_rng(3)
    xy = rng.uniform(0, 50, (60, 2))
    a, b = neighbours(xy, TopomapConfig()), neighbours(100 * xy, TopomapConfig())
    np.testing.assert_array_equal(a, b)
    d = np.linalg.norm(xy[:, None] - xy[None], axis=2) + 1e9 * np.eye(60)
    nearest = {(min(i, j), max(i, j)) for i, j in enumerate(d.argmin(axis=1).tolist())}
    assert nearest <= {(int(i), int(j)) for i, j in a}  # the nearest neighbour is always a neighbour


def test_edges_are_those_of_the_gabriel_graph() -> None:
    """By its definition: no third tree in the circle over an edge; and every such pair is one, but for the long ones of the rim."""
    xy = np.stack(np.meshgrid(np.arange(7) * 5.0, np.arange(6) * 4.0), axis=2).reshape(-1, 2)
    xy = xy + np.random.default_rng(5).uniform(-0.8, 0.8, xy.shape)
    middle, half = 0.5 * (xy[:, None] + xy[None]), 0.5 * np.linalg.norm(xy[:, None] - xy[None], axis=2)
    inside = np.linalg.norm(middle[:, :, None] - xy[None, None], axis=3) < half[:, :, None] - 1e-9
    pairs = {(i, j) for i in range(len(xy)) for j in range(i + 1, len(xy)) if not inside[i, j].any()}
    found = {(int(i), int(j)) for i, j in neighbours(xy, TopomapConfig())}
    assert found <= pairs
    assert {(i, j) for i, j in pairs if half[i, j] < 4.0} <= found


@pytest.mark.parametrize("n", [0, 1, 2, 3, 5])
def test_edges_of_few_or_lined_up_trees(n: int) -> None:
    xy = np.stack([np.arange(n, dtype=float), np.zeros(n)], axis=1)
    edges = neighbours(xy, TopomapConfig())
    if n <= 3:
        assert len(edges) <= n * (n - 1) // 2
    assert {(k, k + 1) for k in range(n - 1)} <= {(int(a), int(b)) for a, b in edges}


def test_radius_rule() -> None:
    xy = np.array([[0.0, 0.0], [3.0, 0.0], [10.0, 0.0]])
    config = replace(TopomapConfig(), edges="radius", radius=5.0)
    np.testing.assert_array_equal(neighbours(xy, config), [[0, 1]])


def test_a_map_that_knows_no_leans_is_read(tmp_path: Path) -> None:
    """Schema 2 did not say how well axes are known."""
    path = tmp_path / "old.gpkg"
    m = make(7)
    store.save(m, path)
    with sqlite3.connect(path) as c:
        for column in ("lean_sigma", "known_at"):
            c.execute(f"ALTER TABLE trees DROP COLUMN {column}")
        c.execute("UPDATE meta SET value='2' WHERE key='schema_version'")
        c.execute("DELETE FROM meta WHERE key IN ('digest:trees', 'digest:meta')")
        for table in ("trees", "meta"):
            c.execute("INSERT INTO meta (key, value) VALUES (?, ?)", (f"digest:{table}", digest(c, table)))
    got = store.load(path)
    np.testing.assert_array_equal(got.kind, m.kind)
    assert np.isnan(got.lean_sigma).all()
    np.testing.assert_array_equal(got.above_ground(0.8)[1], got.cov)


def test_an_older_map_is_read_as_a_map_of_trees(tmp_path: Path) -> None:
    """Schema 1 knew no kinds: all its landmarks were meant as trees of one stem; nor did it say how well axes are known."""
    path = tmp_path / "old.gpkg"
    m = make(7)
    store.save(m, path)
    with sqlite3.connect(path) as c:
        for column in ("kind", "kind_probability", "stems", "lean_sigma", "known_at"):
            c.execute(f"ALTER TABLE trees DROP COLUMN {column}")
        c.execute("UPDATE meta SET value='1' WHERE key='schema_version'")
        c.execute("DELETE FROM meta WHERE key LIKE 'digest:%'")
    got = store.load(path)
    assert got.is_tree.all()
    assert np.isnan(got.kind_probability).all()
    np.testing.assert_array_equal(got.above_ground(0.8)[1], got.cov)
    np.testing.assert_array_equal(got.stems, 1)
    np.testing.assert_array_equal(got.p, m.p)


def test_trees_alone_keep_their_edges_and_clouds() -> None:
    """What is no tree leaves the map with its clouds; all else stays where it was."""
    m = make(12)
    edges = np.array([e for e in m.edges.tolist() if m.kind[e].max() == 0], np.int64).reshape(-1, 2)
    m = replace(m, edges=edges, lengths=np.linalg.norm(m.p[edges[:, 0]] - m.p[edges[:, 1]], axis=1))
    t = m.trees()
    assert 0 < len(t) < len(m)
    np.testing.assert_array_equal(t.ids, m.ids[m.kind == 0])
    np.testing.assert_allclose(np.linalg.norm(t.p[t.edges[:, 0]] - t.p[t.edges[:, 1]], axis=1), t.lengths)
    for v in t.viewpoints:
        (twin,) = (w for w in m.viewpoints if m.ids[w.tree] == t.ids[v.tree])
        np.testing.assert_array_equal(v.cloud, twin.cloud)


@pytest.mark.parametrize("name", ["orchard #2.gpkg", "a?mode=rwc.gpkg", "50% done.gpkg", "ö ü.gpkg"])
def test_any_file_name(tmp_path: Path, name: str) -> None:
    store.save(make(3), tmp_path / name)
    assert len(store.load(tmp_path / name)) == 3
    assert [p.name for p in tmp_path.iterdir()] == [name]


@pytest.mark.parametrize(
    "change",
    [
        "UPDATE trees SET x = x + 0.01 WHERE id = 2", "UPDATE trees SET diameter = diameter * 1.01 WHERE id = 1",
        "UPDATE edges SET length = length + 1 WHERE id = 1", "UPDATE path SET qz = -qz WHERE id = 1",
        "UPDATE meta SET value = '10,20,30' WHERE key = 'datum'", "DELETE FROM trees WHERE id = 3",
        "UPDATE viewpoints SET vx = -vx, vy = -vy", "UPDATE viewpoints SET tree = 2 WHERE id = 1",
        "DELETE FROM meta WHERE key LIKE 'digest:%'", "DELETE FROM meta WHERE key = 'digest:trees'",
    ],
)  # fmt: skip
def test_what_was_not_written_is_not_read(tmp_path: Path, change: str) -> None:
    path = tmp_path / "m.gpkg"
    store.save(make(12), path)
    assert edit(path, change) > 0
    with pytest.raises(MapError, match="repair"):
        store.load(path)


def test_absurd_rows_are_refused_whatever_their_digests(tmp_path: Path) -> None:
    for change in (
        "UPDATE meta SET value = '95,500,1e9' WHERE key = 'datum'", "UPDATE meta SET value = 'nan,0,0' WHERE key = 'datum'",
        "UPDATE trees SET axis_x = NULL WHERE id = 2", "UPDATE trees SET x = 1e308 WHERE id = 1",
        "INSERT INTO meta (key, value) VALUES ('zz', zeroblob(100000000))", "UPDATE meta SET value = '-5' WHERE key = 'schema_version'",
    ):  # fmt: skip
        path = tmp_path / "m.gpkg"
        store.save(make(12), path)
        edit(path, change)
        with pytest.raises(MapError):
            store.load(path, check=False)


def test_views_and_triggers_are_not_run(tmp_path: Path) -> None:
    path = tmp_path / "m.gpkg"
    store.save(make(3), path)
    edit(path, "CREATE VIEW v AS SELECT * FROM trees")
    with pytest.raises(MapError, match="view or a trigger"):
        store.load(path)


def test_damaged_maps_are_refused_and_never_crash(tmp_path: Path) -> None:
    """Bytes changed anywhere: the map is refused, or it is the map that was written."""
    path = tmp_path / "m.gpkg"
    m = make(40, seed=4)
    store.save(m, path)
    data = path.read_bytes()
    rng = np.random.default_rng(0)
    refused = 0
    for _ in range(150):
        bad = bytearray(data)
        for at in rng.integers(0, len(data), 1 + int(rng.integers(4))):
            bad[at] = int(rng.integers(256))
        path.write_bytes(bytes(bad[: len(data) - int(rng.integers(2)) * int(rng.integers(5000))]))
        try:
            got = store.load(path)
        except MapError:
            refused += 1
            continue
        np.testing.assert_array_equal(got.p, m.p)
        np.testing.assert_allclose(got.map_T_robot, m.map_T_robot, atol=1e-9)
        np.testing.assert_array_equal(got.edges, m.edges)
    assert refused > 50


def test_one_writer_at_a_time(tmp_path: Path) -> None:
    path = tmp_path / "m.gpkg"
    with store.locked(path), pytest.raises(MapError, match=str(os.getpid())), store.locked(path):
        pass
    with store.locked(path):
        pass
    lock = tmp_path / ".m.gpkg.lock"
    lock.write_text("process 1 on another machine")  # its writer was killed
    (tmp_path / ".m.999999999.part.gpkg").write_bytes(b"x")
    with store.locked(path):
        store.save(make(3), path)
    assert [p.name for p in tmp_path.iterdir()] == ["m.gpkg"]


def test_ten_writers_at_once(tmp_path: Path) -> None:
    """One writes, nine say who does; when it is killed, the next one writes."""
    path = tmp_path / "m.gpkg"
    code = f"from pathlib import Path\nfrom topograph import store\nimport time\nwith store.locked(Path({str(path)!r})):\n    print('in', flush=True)\n    time.sleep(60)\n"
    holder = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE)
    assert holder.stdout is not None
    assert holder.stdout.readline().strip() == b"in"
    for _ in range(9):
        with pytest.raises(MapError, match=f"process {holder.pid}"), store.locked(path):
            pass
    holder.kill()
    holder.wait()
    holder.stdout.close()
    with store.locked(path):
        store.save(make(3), path)
    assert [p.name for p in tmp_path.iterdir()] == ["m.gpkg"]


def test_an_ellipse_holds_what_the_covariance_says() -> None:
    """Its larger half axis lies along the direction that is known worst, and 95 % of what is drawn from the covariance falls into it."""
    t = TopoMap.of_points(np.zeros((1, 2)))
    a = 0.7
    turn = np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]])
    cov = np.zeros((1, 3, 3))
    cov[0, :2, :2] = turn @ np.diag([0.3**2, 0.1**2]) @ turn.T
    cov[0, 2, 2] = 1.0
    radii, angle = replace(t, cov=cov).ellipses()
    assert np.isclose(np.tan(angle[0]), np.tan(a))
    drawn = np.random.default_rng(2).multivariate_normal([0, 0], cov[0, :2, :2], 20000)
    c, s = np.cos(angle[0]), np.sin(angle[0])
    own = drawn @ np.array([[c, -s], [s, c]])
    assert np.isclose((np.sum((own / radii[0]) ** 2, axis=1) < 1).mean(), 0.95, atol=0.01)
    assert np.isnan(replace(t, cov=np.full((1, 3, 3), np.nan)).ellipses()[1]).all()
