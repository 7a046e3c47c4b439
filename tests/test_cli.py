"""The commands as a user types them: exit codes, one line on what to do, results whole or not at all."""

import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result
from faults import FAULTS, base, write

from topograph import store
from topograph.bags.writer import BagWriter
from topograph.cli import main
from topograph.config import Config, dump, from_dict, load
from topograph.errors import UsageError
from topograph.evaluate import Truth, read_tum
from topograph.simulate import DriveConfig, SensorConfig, record

T0 = 1_700_000_000_000_000_000


def call(*words: object) -> Result:
    return CliRunner().invoke(main, [str(w) for w in words])


def drive(path: Path, fixes: str = "good", odometry: bool = True, seconds: int = 20) -> Path:
    """A bag without trunks: a straight drive with fixes of the wanted kind."""
    from topograph.geometry import Datum

    enu = np.stack([np.arange(0, seconds, 0.2), np.zeros(5 * seconds), np.zeros(5 * seconds)], axis=1)
    g = Datum(40.0, -8.0, 50.0).to_geodetic(enu)
    with BagWriter(path) as w:
        for k in range(5 * seconds):
            s = T0 + k * 200_000_000
            T = np.eye(4)
            T[0, 3] = 0.2 * k
            if odometry:
                w.odometry("/odom", s, s, ("odom", "base_link"), T, np.array([1.0, 0, 0, 0, 0, 0]))
            cov = np.diag([1e-4, 1e-4, 4e-4])
            if fixes == "bad":
                cases = [
                    (g[k], cov, -1),
                    (np.full(3, np.nan), cov, 2),
                    (g[k], np.full((3, 3), np.nan), 2),
                    (g[k], 1e9 * np.eye(3), 2),
                ]
                z, c, status = cases[k % 4]
                w.fix("/fix", s, s, "gnss", z, c, status)
            elif fixes == "good":
                w.fix("/fix", s, s, "gnss", g[k], cov, 2)
    return path


def test_map_of_a_run(tmp_path: Path, detections_run: tuple[Path, Truth]) -> None:
    path, truth = detections_run
    out = call("map", path, "-o", tmp_path / "m.gpkg", "--results", tmp_path, "--truth", f"{path}.truth", "-q")
    assert out.exit_code == 0, out.output
    topo = store.load(tmp_path / "m.gpkg")
    assert len(topo) == len(truth.trees)
    report = json.loads((tmp_path / "report.json").read_text())
    assert {"metrics", "skipped", "inputs", "seconds", "peak_rss_mb"} <= set(report)
    assert {m["name"] for m in report["metrics"]} >= {"tree error mean", "tree precision", "tree recall"}
    stamps, poses = read_tum(tmp_path / "path.tum")
    assert len(stamps) == len(poses) > 50
    page = (tmp_path / "report.html").read_text()
    assert "http://" not in page
    assert "https://" not in page
    assert page.index("<b>sound</b>") < page.index("<table")
    assert "Residuals over time" in page
    assert (tmp_path / "map.html").exists() == ('href="map.html"' in page)
    assert load(tmp_path / "config.yaml") == Config()
    for name in ("trees.geojson", "trees.csv", "path.tum"):
        assert call("export", tmp_path / "m.gpkg", tmp_path / ("x" + name)).exit_code == 0
    assert call("view", tmp_path / "m.gpkg", tmp_path / "view.html").exit_code == 0
    twice = call("map", path, "--into", tmp_path / "m.gpkg", "--results", tmp_path / "2", "-q")
    assert twice.exit_code == 2
    assert "in the map already" in twice.output
    second = tmp_path / "second"
    record(second, 3, "grid", DriveConfig(run=2), SensorConfig(detections=True, compression="zstd"))
    again = call("map", second, "--into", tmp_path / "m.gpkg", "--results", tmp_path / "2", "-q")
    assert again.exit_code == 0, again.output
    extended = store.load(tmp_path / "m.gpkg")
    assert len(extended) == len(topo)
    np.testing.assert_array_equal(extended.ids, topo.ids)
    assert (extended.sightings > topo.sightings).all()
    assert np.linalg.norm(extended.p - topo.p, axis=1).max() < 0.05
    assert (extended.p != topo.p).any(axis=1).all()  # seen again, they are placed anew
    sure, before = (np.trace(t.cov[:, :2, :2], axis1=1, axis2=2) for t in (extended, topo))
    assert (sure <= before + 1e-12).all()


def test_compare_prints_both(tmp_path: Path, detections_run: tuple[Path, Truth]) -> None:
    path, _ = detections_run
    out = call("compare", path, "--truth", f"{path}.truth", "--starts", 2, "--results", tmp_path, "-q")
    assert out.exit_code == 0, out.output
    assert "thesis" in out.output
    found = {m["key"]: m["value"] for m in json.loads((tmp_path / "metrics.json").read_text())["metrics"]}
    # The ladder climbs, and the graph stands at its end.
    rungs = [
        found[f"A/{r}/tree error at 0.8 m, mean"] for r in ("eq. 4.14, filter's path", "mean, filter's path", "graph")
    ]
    assert rungs[0] > 1.5 * rungs[2]
    assert rungs[1] > rungs[2]
    assert found["B/graph/share of poses wrong"] == 0
    page = (tmp_path / "report.html").read_text()
    assert "http://" not in page
    assert "https://" not in page
    for caption in ("Fig. 5.7", "Fig. 5.8", "Fig. 5.9", "Fig. 5.10", "Fig. 5.11", "Fig. 5.14", "Fig. 5.15"):
        assert caption in page


def test_no_trunks_is_said(tmp_path: Path) -> None:
    bag = drive(tmp_path / "a.bag")
    out = call("map", bag, "-o", tmp_path / "m.gpkg", "--results", tmp_path / "r", "-q")
    assert out.exit_code == 4
    assert "no trunks" in out.output
    assert not (tmp_path / "m.gpkg").exists()
    stamps, poses = read_tum(tmp_path / "r" / "path.tum")
    assert abs(poses[-1, 0, 3] - poses[0, 0, 3]) == pytest.approx((stamps[-1] - stamps[0]) * 1e-9, rel=0.02)


def test_bad_fixes_are_counted_and_the_map_is_local(tmp_path: Path) -> None:
    bag = drive(tmp_path / "a.bag", fixes="bad")
    out = call("map", bag, "--results", tmp_path / "r", "-q")
    assert out.exit_code == 4
    report = json.loads((tmp_path / "r" / "report.json").read_text())
    assert sum(v for k, v in report["skipped"].items() if k.startswith("fix")) == 100
    assert any("not georeferenced" in n for n in report["notes"])


@pytest.mark.parametrize(
    ("words", "code", "says"),
    [
        (["map", "nothing.bag"], 3, "no such file"),
        (["map", "{no_motion}"], 4, "--topic-odometry"),
        (["map", "{good}", "--topic-odometry", "/wheels"], 3, "no such topic"),
        (["map", "{good}", "-o", "m.txt"], 2, ".gpkg"),
        (["map", "{good}", "-o", "a.gpkg", "--into", "b.gpkg"], 2, "one of them"),
        (["map", "{good}", "--into", "none.gpkg"], 5, "no such map"),
        (["map", "{good}", "--extrinsic", "gnss=1,2"], 2, "FRAME=X,Y,Z"),
        (["map", "{empty}"], 3, "empty"),
        (["map", "{good}", "--config", "none.yaml"], 2, "no such file"),
        (["export", "none.gpkg", "x.csv"], 5, "no such map"),
        (["simulate", "x.bag", "--design", "jungle"], 2, "known are"),
        (["map"], 2, "Missing argument"),
    ],
)
def test_bad_input(tmp_path: Path, words: list[str], code: int, says: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    names = {
        "{good}": drive(tmp_path / "good.bag", seconds=5),
        "{no_motion}": drive(tmp_path / "still.bag", "bad", odometry=False, seconds=5),
        "{empty}": tmp_path / "empty.bag",
    }
    names["{empty}"].write_bytes(b"")
    out = call(*[names.get(w, w) for w in words])
    assert out.exit_code == code, out.output
    assert says in out.output
    assert "Traceback" not in out.output
    assert not list(tmp_path.glob("*.gpkg"))


def test_a_refused_map_is_not_saved_until_it_is_accepted(tmp_path: Path) -> None:
    bag = base(74, tmp_path)
    FAULTS["trunks' mount yaw 180"](bag, np.random.default_rng(0))
    write(bag, tmp_path / "bad.bag")
    words = ["map", tmp_path / "bad.bag", "-o", tmp_path / "m.gpkg", "--results", tmp_path / "r", "-q"]
    out = call(*words)
    assert out.exit_code == 4, out.output
    assert "REFUSED" in out.output
    assert not (tmp_path / "m.gpkg").exists()
    report = json.loads((tmp_path / "r" / "report.json").read_text())
    assert report["verdict"]["word"] == "refused"
    assert len(read_tum(tmp_path / "r" / "path.tum")[0]) > 50
    out = call(*words, "--accept", "moving")
    assert out.exit_code == 0, out.output
    assert "DOUBTFUL" in out.output
    assert store.load(tmp_path / "m.gpkg").meta["verdict"] == "doubtful"
    out = call(*words)
    assert out.exit_code == 2
    assert "--force" in out.output


def test_a_map_that_was_edited_is_repaired_into_a_new_one(tmp_path: Path) -> None:
    from test_store import edit, make

    store.save(make(5), tmp_path / "m.gpkg")
    assert edit(tmp_path / "m.gpkg", "UPDATE trees SET diameter = 0.5 WHERE id = 2") == 1
    out = call("export", tmp_path / "m.gpkg", tmp_path / "x.csv")
    assert out.exit_code == 5
    assert "topograph repair" in out.output
    assert call("repair", tmp_path / "m.gpkg", tmp_path / "n.gpkg").exit_code == 0
    assert store.load(tmp_path / "n.gpkg").diameter[1] == 0.5
    assert call("repair", tmp_path / "m.gpkg", tmp_path / "n.gpkg").exit_code == 2


def test_failed_commands_leave_no_folders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "notabag.laz").write_bytes(b"LASF" * 100)
    (tmp_path / "broken.bag").write_bytes(b"#ROSBAG V2.0\n" + bytes(range(256)) * 20)
    for words in (["map", "notabag.laz"], ["map", "broken.bag"], ["inspect", "notabag.laz"], ["inspect", "broken.bag"]):
        out = call(*words)
        assert out.exit_code == 3, out.output
        assert "Traceback" not in out.output
    good = drive(tmp_path / "good.bag", seconds=5)
    out = call("map", good, "--from", "1000")
    assert out.exit_code == 3
    assert "s long" in out.output
    assert not list((tmp_path / "results").glob("*"))


def test_committed_configuration_is_the_default() -> None:
    text = (Path(__file__).resolve().parents[1] / "configs" / "default.yaml").read_text()
    assert text == dump(Config()), "run: topograph config --bare > configs/default.yaml"


def test_configuration_round_trip_and_refusals(tmp_path: Path) -> None:
    path = tmp_path / "c.yaml"
    path.write_text(dump(Config()))
    assert load(path) == Config()
    with pytest.raises(UsageError, match=r"trees\.gat"):
        from_dict({"trees": {"gat": 3}})
    with pytest.raises(UsageError, match="forest"):
        from_dict({"forest": {}})
    path.write_text("trees: {gate: many}")
    with pytest.raises(UsageError, match="gate"):
        load(path)
    path.write_text("a: &x 1\nb: *x\n")
    with pytest.raises(UsageError, match="alias"):
        load(path)
    path.write_text("trees: {gate: 1}\ntrees: {gate: 2}\n")
    with pytest.raises(UsageError, match="twice"):
        load(path)


def test_detect_writes_the_csv(tmp_path: Path, lidar_run: tuple[Path, Truth]) -> None:
    path, _ = lidar_run
    out = call("detect", path, "--csv", tmp_path / "t.csv", "--picture", tmp_path / "p.png", "--truth",
               path.with_name("lidar.truth"), "-q")  # fmt: skip
    assert out.exit_code == 0, out.output
    head, *rows = (tmp_path / "t.csv").read_text().splitlines()
    assert head == "stamp,x,y,z,height,diameter,score"
    assert len(rows) > 100
    assert (tmp_path / "p.png").stat().st_size > 10_000


def test_inspect_says_what_map_will_find(tmp_path: Path) -> None:
    """A stream that stops early, a frame that nobody knows, and a recording without wheels and fixes: exit 3."""
    out = call("inspect", drive(tmp_path / "a.bag", seconds=5))
    assert "/odom" in out.output
    assert out.exit_code == 3  # no trunks
    t0 = 1_700_000_000 * 10**9
    with BagWriter(tmp_path / "b.bag") as w:
        for k in range(100):
            t = t0 + k * 50_000_000
            if k < 60:
                w.imu("/imu", t, t - 2_000_000_000, "imu", np.zeros(3), np.array([0.0, 0.0, 9.81]))
            w.heading("/heading", t, t, "antenna", np.array([0.0, 0.0, 0.0, 1.0]))
    out = call("inspect", tmp_path / "b.bag")
    assert out.exit_code == 3
    for words in ("silent for 2.0 s from 3.0 s on", "-2.00 s from the other streams'", "frame 'imu' is not in TF: add --extrinsic imu=",
                  "neither point clouds nor recorded trunks", "neither wheel odometry nor ten usable fixes"):  # fmt: skip
        assert words in out.output, (words, out.output)


def test_inspect_sees_a_wrong_mounting(lidar_run: tuple[Path, Truth]) -> None:
    bag, _ = lidar_run
    out = call("inspect", bag)
    assert "16 rings, -15° to 15°; ring field counts from below" in out.output
    assert "above the ground: LiDAR" in out.output
    assert "believed" not in out.output
    assert "status 2 (RTK or DGNSS)" in out.output
    out = call("inspect", bag, "--extrinsic", "velodyne=0,0,9,0,0,0")
    assert "are not to be believed" in out.output


def test_doctor() -> None:
    out = call("doctor")
    assert out.exit_code == 0, out.output
    assert "✗" not in out.output
