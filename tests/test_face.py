"""The package's own words, and the examples as a user runs them."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import topograph
from topograph.evaluate import Truth, map_metrics
from topograph.localize import Fix

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"


def test_importing_costs_nothing_and_names_are_there() -> None:
    code = "import sys, topograph; assert 'numpy' not in sys.modules; [getattr(topograph, n) for n in topograph.__all__]; assert 'numpy' in sys.modules"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0
    with pytest.raises(AttributeError):
        _ = topograph.nobody
    assert (Path(topograph.__file__).parent / "py.typed").exists()


def test_map_save_load_localize(tmp_path: Path, detections_run: tuple[Path, Truth]) -> None:
    path, truth = detections_run
    orchard = topograph.map_bags(path)
    assert orchard.meta["verdict"] == "sound"
    assert len(repr(orchard)) < 200
    got = {m.name: m.value for m in map_metrics(orchard, truth)}
    assert got["tree precision"] == got["tree recall"] == 1.0
    topograph.save_map(orchard, str(tmp_path / "m.gpkg"))
    again = topograph.load_map(str(tmp_path / "m.gpkg"))
    np.testing.assert_array_equal(again.p, orchard.p)
    replay = topograph.localize_bags(again, path)
    assert len(replay.fixes) > 0.9 * len(replay.reports)


def test_the_example_of_a_detector_of_ones_own(tmp_path: Path, detections_run: tuple[Path, Truth]) -> None:
    sys.path.insert(0, str(EXAMPLES))
    from own_detector import Node

    from topograph.bags import Imu, Odometry, Recording, Trunks

    path, truth = detections_run
    topograph.save_map(topograph.map_bags(path), tmp_path / "m.gpkg")
    topo = topograph.load_map(tmp_path / "m.gpkg")
    off = []
    with Recording([path]) as r:
        node = Node(str(tmp_path / "m.gpkg"), r.frames.get("imu_link")[:3, :3])
        for _, m in r.messages():
            if isinstance(m, Odometry):
                node.odometry(m.stamp_ns, m.odom_T_child, m.twist)
            elif isinstance(m, Imu):
                node.imu(m.stamp_ns, m.gyro, m.accel)
            elif isinstance(m, Trunks):
                pose = node.scan(m.stamp_ns, m.p, m.diameter)
                if pose is not None:
                    k = int(np.argmin(np.abs(truth.stamps_ns - m.stamp_ns)))
                    true = topo.datum.to_enu(truth.datum.to_geodetic(truth.world_T_robot[k, :3, 3][None]))[0]
                    off.append(np.linalg.norm((pose[:3, 3] - true)[:2]))
    assert len(off) > 300
    assert np.median(off) < 0.1


def test_the_example_of_a_ros_node_says_what_localize_says(tmp_path: Path, lidar_run: tuple[Path, Truth]) -> None:
    """Fed with the bag's own messages, as ROS would hand them over, in the order in which they were recorded."""
    sys.path.insert(0, str(EXAMPLES))
    from ros_node import Bridge
    from rosbags.highlevel import AnyReader

    from topograph.bags import Recording

    path, _ = lidar_run
    topograph.save_map(topograph.map_bags(path), tmp_path / "m.gpkg")
    with Recording([path]) as r:
        mounts = {f: r.frames.find(f) for f in ("velodyne", "imu_link", "base_link")}
    found: dict[int, tuple[Fix, np.ndarray]] = {}
    said: list[str] = []
    cloud = None
    bridge = Bridge(
        str(tmp_path / "m.gpkg"),
        mounts.get,
        lambda fix, odom: found.__setitem__(fix.stamp_ns, (fix, odom)),
        said.append,
    )
    hear = {
        "nav_msgs/msg/Odometry": bridge.odometry,
        "sensor_msgs/msg/Imu": bridge.imu,
        "sensor_msgs/msg/PointCloud2": bridge.points,
    }
    with AnyReader([path]) as reader:
        for c, _, raw in reader.messages():
            if c.msgtype in hear and "heading" not in c.topic:
                m = reader.deserialize(raw, c.msgtype)
                hear[c.msgtype](m)
                cloud = m if "PointCloud2" in c.msgtype else cloud
    replay = topograph.localize_bags(tmp_path / "m.gpkg", path)
    want = {f.stamp_ns: f.map_T_robot for f in replay.fixes}
    both = sorted(found.keys() & want.keys())
    assert len(both) > 0.95 * len(want)
    off = [np.linalg.norm((found[s][0].map_T_robot - want[s])[:2, 3]) for s in both]
    assert np.median(off) < 0.002
    assert max(off) < 0.02
    # map -> odom is what moves slowly (but in turns, where the wheels' heading drifts): a pose of another stamp would add the robot's step.
    drift = np.array([found[s][0].map_T_robot @ np.linalg.inv(found[s][1]) for s in both])[:, :2, 3]
    assert np.median(np.linalg.norm(np.diff(drift, axis=0), axis=1)) < 0.03  # it drives 20 cm a scan
    lost = Bridge(str(tmp_path / "m.gpkg"), lambda _: None, lambda *_: None, said.append)
    lost.points(cloud)
    lost._see(lost.scans.pop())
    assert "TF does not know" in said[-1]


def test_the_examples_of_tables_and_of_an_exporter(
    tmp_path: Path, detections_run: tuple[Path, Truth], capsys: pytest.CaptureFixture[str]
) -> None:
    """Surveyed trees (the truth's, as a file that QGIS might have written) are map enough to be found in, in any CRS."""
    geopandas = pytest.importorskip("geopandas")
    sys.path.insert(0, str(EXAMPLES))
    import own_exporter
    import tables

    from topograph.exchange import topomap_of

    path, truth = detections_run
    lat, lon, _ = truth.datum.to_geodetic(truth.trees).T
    frame = geopandas.GeoDataFrame({"diameter": truth.diameters}, geometry=geopandas.points_from_xy(lon, lat), crs=4326)
    frame.to_crs(frame.estimate_utm_crs()).to_file(tmp_path / "survey.geojson", driver="GeoJSON")
    tables.main(str(tmp_path / "survey.geojson"), str(path))
    assert capsys.readouterr().out.count("risk") >= 3
    surveyed = topomap_of(geopandas.read_file(tmp_path / "survey.geojson"))
    apart = [np.linalg.norm(p[:, None, :2] - p[None, :, :2], axis=2) for p in (surveyed.p, truth.trees)]
    np.testing.assert_allclose(apart[0], apart[1], atol=0.01)  # lengths are metres, not those of a map projection
    with pytest.raises(topograph.errors.InputError, match="centroids"):
        topomap_of(frame.to_crs(3857).set_geometry(frame.to_crs(3857).buffer(1.0)))
    orchard = topograph.map_bags(path)
    found = tables.thick_and_leaning(orchard)
    assert len(found) == int(((orchard.diameter > 0.2) & (orchard.axis[:, 2] < 0.996) & orchard.is_tree).sum())
    topograph.export_map(orchard, tmp_path / "trees.gpx")
    assert (tmp_path / "trees.gpx").read_text().count("<wpt") == len(orchard)
    del own_exporter.WRITERS[".gpx"]
