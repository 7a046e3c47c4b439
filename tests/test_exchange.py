"""Every product opens in its own format's library, and says what the map says."""

import csv
import json
import sys
import warnings
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation
from test_cli import call
from test_store import make

from topograph import store
from topograph.errors import InputError, UsageError
from topograph.exchange import WRITERS, geodataframe, read_localization, read_tum, topomap_of, write
from topograph.topomap import KINDS
from topograph.trunks.score import TREE

MAP = make(12)


@pytest.fixture
def written(tmp_path: Path):
    def do(suffix: str) -> Path:
        path = tmp_path / f"out{suffix}"
        write(MAP, path)
        assert [p.name for p in tmp_path.iterdir()] == [path.name]  # nothing half done beside it
        return path

    return do


def test_csv(written) -> None:
    rows = list(csv.DictReader(written(".csv").read_text().splitlines()))
    np.testing.assert_array_equal([float(r["x"]) for r in rows], MAP.p[:, 0])
    np.testing.assert_array_equal([int(r["id"]) for r in rows], MAP.ids)
    assert {r["kind"] for r in rows} <= {"tree", "post", "other"}


def test_geojson(written) -> None:
    f = json.loads(written(".geojson").read_text())["features"]
    lon_lat_h = np.array([x["geometry"]["coordinates"] for x in f])
    np.testing.assert_allclose(lon_lat_h[:, [1, 0, 2]], MAP.geodetic())
    assert abs(lon_lat_h[0, 1] - MAP.datum.lat) < 0.1  # latitude stands second


def test_kml(written) -> None:
    root = ET.parse(written(".kml")).getroot()
    ns = {"k": "http://www.opengis.net/kml/2.2"}
    places = [p.text.split(",") for p in root.findall(".//k:Point/k:coordinates", ns)]
    np.testing.assert_allclose(np.array(places, float)[:, [1, 0, 2]], MAP.geodetic())
    assert len(root.findall(".//k:LineString", ns)) == 1


def test_geoparquet(written) -> None:
    geopandas = pytest.importorskip("geopandas")
    frame = geopandas.read_parquet(written(".parquet"))
    assert frame.crs.to_epsg() == 4326
    np.testing.assert_allclose(frame.geometry.y, MAP.geodetic()[:, 0])
    np.testing.assert_allclose(frame["diameter"], MAP.diameter)


def test_graphml(written) -> None:
    networkx = pytest.importorskip("networkx")
    g = networkx.read_graphml(written(".graphml"))
    assert g.number_of_nodes() == len(MAP)
    got = {frozenset(map(int, e)): d["length"] for *e, d in g.edges(data=True)}
    for (a, b), length in zip(MAP.edges, MAP.lengths, strict=True):
        assert got[frozenset((int(MAP.ids[a]), int(MAP.ids[b])))] == length
    assert g.nodes[str(MAP.ids[0])]["x"] == MAP.p[0, 0]


def test_tum(written) -> None:
    stamps, poses = read_tum(written(".tum"))
    np.testing.assert_array_equal(stamps, MAP.stamps_ns)
    np.testing.assert_allclose(poses, MAP.map_T_robot, atol=1e-8)


def cloud() -> np.ndarray:
    return np.concatenate([v.cloud + MAP.p[v.tree] for v in MAP.viewpoints])


@pytest.mark.parametrize("suffix", [".ply", ".pcd"])
def test_clouds_open_in_open3d(written, suffix: str) -> None:
    from topograph.trunks.open3d_door import open3d

    got = np.asarray(open3d().io.read_point_cloud(str(written(suffix))).points)
    np.testing.assert_allclose(got, cloud(), atol=1e-3)


@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_clouds_open_in_laspy(written, suffix: str) -> None:
    laspy = pytest.importorskip("laspy")
    got = laspy.read(written(suffix))
    np.testing.assert_allclose(np.column_stack([got.x, got.y, got.z]), cloud(), atol=1.1e-3)
    assert set(got.point_source_id) == {int(MAP.ids[v.tree]) for v in MAP.viewpoints if len(v.cloud)}


def test_rerun(written) -> None:
    chunk = pytest.importorskip("rerun.chunk")
    got = {c.entity_path: c.to_record_batch() for c in chunk.RrdReader(written(".rrd")).stream()}
    trees = got["/map/trees"]
    centre, quaternion = (np.array(trees.column(f"Cylinders3D:{k}")[0].as_py()) for k in ("centers", "quaternions"))
    np.testing.assert_allclose(Rotation.from_quat(quaternion).apply([0.0, 0.0, 1.0]), MAP.axis, atol=1e-6)
    np.testing.assert_allclose(centre - 0.75 * MAP.axis, MAP.p, atol=1e-5)
    assert trees.column("Cylinders3D:labels")[0].as_py()[0] == f"{KINDS[MAP.kind[0]]} {MAP.ids[0]}"
    robot = got["/map/robot"]
    np.testing.assert_array_equal(np.asarray(robot.column("stamp")).astype(np.int64), MAP.stamps_ns)
    at = np.array(robot.column("Transform3D:translation").to_pylist())[:, 0]
    np.testing.assert_allclose(at, MAP.map_T_robot[:, :3, 3], atol=1e-5)
    strips = np.array(got["/map/edges"].column("LineStrips3D:strips")[0].as_py())
    np.testing.assert_allclose(np.linalg.norm(strips[:, 1] - strips[:, 0], axis=1), MAP.lengths, atol=1e-4)
    assert len(got["/map/clouds"].column("Points3D:positions")[0]) == len(cloud())


@pytest.mark.parametrize("suffix", [".mcap", ".bag"])
def test_ros_topics_of_the_thesis(written, suffix: str) -> None:
    with AnyReader([written(suffix)], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
        got: dict[str, Any] = {c.topic: reader.deserialize(raw, c.msgtype) for c, _, raw in reader.messages()}
    markers = got["/topological_map"].markers
    trunks = [m for m in markers if m.ns == "trees"]
    assert len(trunks) == len(MAP)
    m, axis = trunks[0], MAP.axis[0]
    q = m.pose.orientation
    up = [2 * (q.x * q.z + q.w * q.y), 2 * (q.y * q.z - q.w * q.x), 1 - 2 * (q.x**2 + q.y**2)]
    np.testing.assert_allclose(up, axis, atol=1e-9)  # the cylinder leans as the tree does
    np.testing.assert_allclose([m.pose.position.x, m.pose.position.y], (MAP.p[0] + 0.75 * axis)[:2])
    (edges,) = (m for m in markers if m.ns == "edges")
    assert len(edges.points) == 2 * len(MAP.edges)
    assert len(got["/path"].poses) == len(MAP.stamps_ns)
    assert got["/clusters"].width == len(cloud())


@pytest.mark.parametrize("suffix", [".mcap", ".bag"])
def test_a_localization_is_replayed_in_ros(tmp_path: Path, suffix: str) -> None:
    """Two scans: three places left, then a pose; stamps to the nanosecond."""
    (tmp_path / "localization.csv").write_text(
        "stamp,state,x,y,z,qx,qy,qz,qw,hypotheses,risk,trees,tree_ids,apart,sigma_along,sigma_across\n"
        "1700000000.100000007,ambiguous,,,,,,,,3,,0,,5.0,,\n"
        "1700000000.200000001,tracking,1.5,-2.0,0.1,0,0,0.6,0.8,1,1e-5,2,1 2,,0.02,0.03\n"
    )
    (tmp_path / "hypotheses.csv").write_text(
        "stamp,x,y,yaw,weight\n" + "".join(f"1700000000.100000007,{k},{2 * k},{0.1 * k},0.3\n" for k in (1, 2, 3))
    )
    run = read_localization(tmp_path)
    assert run.placed.tolist() == [False, True]
    write(MAP, tmp_path / f"out{suffix}", run)
    with AnyReader([tmp_path / f"out{suffix}"], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
        seen: list[tuple[str, int, Any]] = [
            (c.topic, stamp, reader.deserialize(raw, c.msgtype)) for c, stamp, raw in reader.messages()
        ]
    first, second = (m for topic, _, m in seen if topic == "/robot_poses")
    assert [(p.position.x, p.position.y) for p in first.poses] == [(1, 2), (2, 4), (3, 6)]
    np.testing.assert_allclose([2 * np.arctan2(p.orientation.z, p.orientation.w) for p in first.poses], [0.1, 0.2, 0.3])
    assert [(p.position.x, p.orientation.z) for p in second.poses] == [(1.5, pytest.approx(0.6))]
    assert (first.header.stamp.nanosec, second.header.stamp.nanosec) == (100000007, 200000001)
    (tf,) = (m for topic, _, m in seen if topic == "/tf")
    assert (tf.transforms[0].header.frame_id, tf.transforms[0].child_frame_id) == ("map", "base_link")
    assert tf.transforms[0].transform.translation.y == -2.0
    assert min(stamp for topic, stamp, _ in seen if topic == "/topological_map") <= 1700000000100000007
    with pytest.raises(UsageError, match=r"\.mcap"):
        write(MAP, tmp_path / "a.csv", run)
    with pytest.raises(InputError, match="no localization"):
        read_localization(tmp_path / "nowhere")


def test_what_a_map_cannot_fill_is_said(tmp_path: Path) -> None:
    local = make(5, datum=None)
    for suffix in (".geojson", ".kml"):
        with pytest.raises(UsageError, match="not georeferenced"):
            write(local, tmp_path / f"a{suffix}")
    with pytest.raises(UsageError, match=r"\.geojson"):
        write(local, tmp_path / "a.xyz")
    assert not list(tmp_path.iterdir())


def test_the_command_knows_all_of_them(tmp_path: Path) -> None:
    store.save(MAP, tmp_path / "m.gpkg")
    for suffix in WRITERS:
        assert call("export", tmp_path / "m.gpkg", tmp_path / f"x{suffix}").exit_code == 0
    before = (tmp_path / "m.gpkg").read_bytes()
    assert call("export", tmp_path / "m.gpkg", tmp_path / "m.gpkg").exit_code == 2
    assert (tmp_path / "m.gpkg").read_bytes() == before


def test_gdal_finds_no_fault(tmp_path: Path) -> None:
    """GDAL's own validator, where Debian's python3-gdal is installed."""
    import subprocess

    python = Path("/usr/bin/python3")
    if (
        not python.exists()
        or subprocess.run([python, "-c", "import osgeo_utils.samples.validate_gpkg"], capture_output=True).returncode
    ):
        pytest.skip("python3-gdal is not installed")
    for name, topo in (("a.gpkg", MAP), ("local.gpkg", make(9, datum=None))):
        store.save(topo, tmp_path / name)
        done = subprocess.run(
            [python, "-m", "osgeo_utils.samples.validate_gpkg", tmp_path / name], capture_output=True, text=True
        )
        assert done.returncode == 0, done.stdout + done.stderr
        assert not done.stdout.strip(), done.stdout


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda f: f.iloc[:0], "no trees"),
        (lambda f: f.assign(diameter=30.0), "centimetres"),
        (lambda f: f.assign(diameter="x"), "not a number"),
        (lambda f: f.set_geometry(f.translate(xoff=400.0)), "CRS"),
        (lambda f: f.set_geometry([f.geometry.iloc[0], *f.translate(yoff=3.0).iloc[1:]]), "km apart"),
    ],
)
def test_a_table_that_is_no_orchard_is_refused(change, says: str) -> None:
    pytest.importorskip("geopandas")
    frame = geodataframe(MAP)[["diameter", "geometry"]]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # geopandas on degrees
        bad = change(frame)
    with pytest.raises(InputError, match=says):
        topomap_of(bad)


def test_posts_of_a_table_are_no_trees() -> None:
    pytest.importorskip("geopandas")
    assert len(topomap_of(geodataframe(MAP))) == int((MAP.kind == TREE).sum())


@pytest.mark.parametrize(("suffix", "module"), [(".parquet", "pyarrow"), (".laz", "lazrs"), (".rrd", "rerun")])
def test_an_extra_that_is_missing_is_named(
    tmp_path: Path, suffix: str, module: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(UsageError, match=r"pip install 'topograph\["):
        write(MAP, tmp_path / f"a{suffix}")
    assert not list(tmp_path.iterdir())


def test_a_link_stays_one_and_a_private_file_private(tmp_path: Path) -> None:
    real, link = tmp_path / "real.csv", tmp_path / "link.csv"
    real.write_text("old")
    real.chmod(0o600)
    link.symlink_to(real)
    write(MAP, link)
    assert link.is_symlink()
    assert real.read_text().startswith("id")
    assert real.stat().st_mode & 0o777 == 0o600
    write(MAP, tmp_path / f"{'x' * 245}.csv")


QGIS = """
import os, sys
os.environ["QT_QPA_PLATFORM"] = "offscreen"
from qgis.core import QgsApplication, QgsMapRendererParallelJob, QgsMapSettings, QgsVectorLayer
from qgis.PyQt.QtCore import QSize
from qgis.PyQt.QtGui import QColor
app = QgsApplication([], False)
app.initQgis()
layers = [QgsVectorLayer(f"{sys.argv[1]}|layername={name}", name, "ogr") for name in ("trees", "edges", "path_lines", "ellipses")]
assert all(layer.isValid() and layer.loadDefaultStyle()[1] for layer in layers)
s = QgsMapSettings()
s.setLayers(layers)
s.setOutputSize(QSize(600, 600))
s.setBackgroundColor(QColor(255, 255, 255))
s.setDestinationCrs(layers[0].crs())
box = layers[0].extent()
box.scale(1.2)
s.setExtent(box)
job = QgsMapRendererParallelJob(s)
job.start()
job.waitForFinished()
picture = job.renderedImage()
green = sum(QColor(picture.pixel(x, y)).green() > QColor(picture.pixel(x, y)).red() + 60 for x in range(600) for y in range(600))
print(layers[0].featureCount(), green)
sys.stdout.flush()
os._exit(0)
"""


def test_qgis_draws_the_map_with_its_own_styles(tmp_path: Path) -> None:
    """Headless QGIS, where Debian's python3-qgis is installed."""
    import subprocess

    python = Path("/usr/bin/python3")
    if not python.exists() or subprocess.run([python, "-c", "import qgis.core"], capture_output=True).returncode:
        pytest.skip("python3-qgis is not installed")
    store.save(MAP, tmp_path / "m.gpkg")
    done = subprocess.run([python, "-c", QGIS, tmp_path / "m.gpkg"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    trees, green = map(int, done.stdout.split())
    assert trees == len(MAP)
    assert green > 50  # trees are green dots, not QGIS's random colour
