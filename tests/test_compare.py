"""Truth through one door, figures that agree with outside tools, intervals that hold, and the thesis's algorithms as they are written."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_cli import call

from topograph.config import Config, over
from topograph.errors import InputError, UsageError
from topograph.evaluate import Truth, read_truth, world_in_map, write_tum
from topograph.evaluate.chapter5 import ate, node_errors, rpe
from topograph.evaluate.frames import fit_points
from topograph.evaluate.statistics import bootstrap, paired_ratio, wilson
from topograph.geometry import Datum, exp, planar, transform
from topograph.localize import ThesisConfig, ThesisMethod
from topograph.motion import Leg
from topograph.topomap import TopoMap

HERE = Datum(40.2, -8.4, 90.0)


# -- truth --------------------------------------------------------------------------------------------------------


def trees(n: int = 9, datum: Datum | None = HERE) -> Truth:
    p = np.random.default_rng(0).uniform(-20, 20, (n, 3)) * [1, 1, 0.05]
    return Truth.of_trees(
        datum,
        p,
        axes=np.tile([0, 0, 1.0], (n, 1)),
        diameters=np.full(n, np.nan),
        stems=np.ones(n, np.int64),
        sigma=np.nan,
    )


def test_csv_and_geojson_say_the_same(tmp_path: Path) -> None:
    g = HERE.to_geodetic(trees().trees)
    (tmp_path / "a.csv").write_text(
        "name,latitude,longitude,sigma\n"
        + "\n".join(f"t{i},{a!r},{b!r},0.3" for i, (a, b, _) in enumerate(g.tolist()))
        + "\n"
    )
    features = [
        {"type": "Feature", "geometry": {"type": "Point", "coordinates": [b, a]}, "properties": {}}
        for a, b, _ in g.tolist()
    ]
    (tmp_path / "a.geojson").write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    a, b = read_truth([tmp_path / "a.csv"]), read_truth([tmp_path / "a.geojson"])
    assert a is not None
    assert a.datum is not None
    assert b is not None
    assert a.sigma == 0.3
    assert np.isnan(b.sigma)  # nobody states it
    np.testing.assert_allclose(a.trees, b.trees, atol=1e-6)
    np.testing.assert_allclose(HERE.to_enu(a.datum.to_geodetic(a.trees))[:, :2], trees().trees[:, :2], atol=1e-2)
    with pytest.raises(InputError, match="second truth"):
        read_truth([tmp_path / "a.csv", tmp_path / "a.geojson"])


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a.csv", "id,easting\n1,2\n"),
        ("a.csv", "x,y\n"),
        ("a.csv", "x,y\n1,oak\n"),
        ("a.tum", "1 2 3\n"),
        ("a.xyz", ""),
    ],
)
def test_what_is_no_truth_is_refused(tmp_path: Path, name: str, text: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError):
        read_truth([tmp_path / name])


def map_of(truth: Truth, T: np.ndarray, noise: float = 0.0) -> TopoMap:
    p = transform(T, truth.trees) + np.random.default_rng(1).normal(0, noise, truth.trees.shape)
    return replace(TopoMap.of_points(p[:, :2]), p=p)


@settings(max_examples=25, deadline=None)
@given(x=st.floats(-500, 500), y=st.floats(-500, 500), yaw=st.floats(-3.1, 3.1))
def test_a_local_map_is_laid_onto_surveyed_trees(x: float, y: float, yaw: float) -> None:
    truth = trees(14, None)
    T = planar(x, y, yaw)
    topo = map_of(truth, T, 0.02)
    world = world_in_map(topo, truth)
    assert world.how == "trees"
    np.testing.assert_allclose(world.points(truth.trees)[:, :2], transform(T, truth.trees)[:, :2], atol=0.05)
    assert len(node_errors(topo, truth).node) == 14


def test_other_trees_are_not_laid_on() -> None:
    a, b = (np.random.default_rng(k).uniform(-30, 30, (3, 2)) for k in (1, 2))
    assert fit_points(a, b) is None


def test_errors_are_clipped_nowhere() -> None:
    """A node 2.2 m off is a wrong node at a gate of one metre, and an error of 2.2 m at the widest: the thesis's worst had 2.14."""
    truth = trees(9)
    topo = replace(map_of(truth, np.eye(4)), datum=HERE)
    topo.p[4, 0] += 2.2
    near, far = node_errors(topo, truth, 1.0), node_errors(topo, truth)
    assert len(near.node) == 8
    assert np.hypot(*far.above.T).max() == pytest.approx(2.2, abs=1e-3)


# -- outside tools ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("aligned", [True, False])
def test_ate_and_rpe_are_evos(tmp_path: Path, aligned: bool) -> None:
    pytest.importorskip("evo")
    import warnings

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # evo's own imports
        from evo.core import metrics, sync
        from evo.tools import file_interface
    rng = np.random.default_rng(3)
    steps = np.array([exp(np.array([0.0, 0.0, 0.03, 0.5, 0.02, 0.01]) + rng.normal(0, 0.01, 6)) for _ in range(200)])
    true = [np.eye(4)]
    for T in steps:
        true.append(true[-1] @ T)
    poses = np.array(
        [exp(np.array([0.01, -0.02, 0.3, 4.0, -2.0, 1.0])) @ T @ exp(rng.normal(0, 0.02, 6)) for T in true]
    )
    ns: np.ndarray = 10**18 + np.arange(201, dtype=np.int64) * 100_000_000
    truth = Truth.of_path(ns, np.array(true))
    write_tum(tmp_path / "true.tum", ns, np.array(true))
    write_tum(tmp_path / "found.tum", ns, poses)
    a, b = (file_interface.read_tum_trajectory_file(tmp_path / f"{n}.tum") for n in ("true", "found"))
    a, b = sync.associate_trajectories(a, b)
    relative = metrics.RPE(metrics.PoseRelation.translation_part, 1, metrics.Unit.frames, all_pairs=False)
    relative.process_data((a, b))
    assert rpe(ns, poses, truth) == pytest.approx(relative.get_statistic(metrics.StatisticsType.rmse), rel=1e-5)
    if aligned:
        b.align(a)
    absolute = metrics.APE(metrics.PoseRelation.translation_part)
    absolute.process_data((a, b))
    assert ate(ns, poses, truth, aligned=aligned) == pytest.approx(
        absolute.get_statistic(metrics.StatisticsType.rmse), rel=1e-5
    )


def test_wilson_is_as_published() -> None:
    """Brown, Cai, DasGupta (2001); and R's binom.confint(method="wilson")."""
    np.testing.assert_allclose(wilson(7, 1500), (0.00226, 0.00960), atol=2e-5)
    np.testing.assert_allclose(wilson(0, 10), (0.0, 0.2775), atol=1e-4)
    np.testing.assert_allclose(wilson(10, 10), (0.7225, 1.0), atol=1e-4)
    assert wilson(0, 0) == (0.0, 1.0)


def test_the_bootstrap_covers() -> None:
    """95 % intervals of the mean of 20 runs hold the mean in about 93 % of cases (the percentile interval is known to be a little short)."""
    rng = np.random.default_rng(0)
    held = sum(low <= 1.0 <= high for low, high in (bootstrap(rng.normal(1.0, 0.5, 20).tolist()) for _ in range(200)))
    assert 175 <= held <= 198


def test_pairs_take_the_orchards_difficulty_out() -> None:
    """Runs of very different difficulty, a ratio that is the same in all: its interval is narrow, though the means' are wide."""
    rng = np.random.default_rng(1)
    hard = np.exp(rng.normal(0, 1.0, 20))
    ratio, low, high = paired_ratio((0.25 * hard * rng.normal(1, 0.05, 20)).tolist(), hard.tolist())
    assert low < ratio < high
    assert ratio == pytest.approx(0.25, rel=0.1)
    assert high - low < 0.04
    wide = bootstrap(hard.tolist())
    assert (wide[1] - wide[0]) / hard.mean() > 0.3


# -- the thesis as it is written ------------------------------------------------------------------------------------


def test_presets_are_names_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    explained = call("config", "-c", "thesis").output
    assert "rule: halving" in explained
    assert "# " in explained
    (tmp_path / "x.yaml").write_text(explained)
    assert call("config", "-c", tmp_path / "x.yaml", "--bare").output == call("config", "-c", "thesis", "--bare").output
    written, best = over(Config(), "thesis"), over(Config(), "thesis_best")
    assert not written.thesis.reset
    assert best.thesis.reset
    assert written.trunks.front_end == best.trunks.front_end == "thesis"
    assert written.thesis_trunks == best.thesis_trunks == Config().thesis_trunks  # the same front end in both
    with pytest.raises(UsageError):
        over(Config(), "nobody")


def leg(x: float) -> Leg:
    return Leg(step=np.array([x, 0.0, 0.0]), distance=abs(x), turned=0.0, seconds=0.1)


def seen(at: np.ndarray, robot: np.ndarray, stamp: int):
    from topograph.bags import Trunks

    n = len(at)
    p = np.column_stack([at - robot, np.zeros(n)])
    none = np.full(n, np.nan)
    up = np.tile([0.0, 0.0, 1.0], (n, 1))
    return Trunks(
        stamp_ns=stamp,
        frame="base_link",
        p=p,
        axis=up,
        diameter=none,
        cov=np.tile(1e-4 * np.eye(3), (n, 1, 1)),
        height=none,
        score=np.full(n, 2.0),
    )


TREES = np.array([[0.0, 0.0], [6.0, 1.0], [9.2, -4.1], [3.0, 7.3], [13.0, 5.5]])


def drive(config: ThesisConfig, blind: set[int], scans: int = 20) -> list[str]:
    method = ThesisMethod(TopoMap.of_points(TREES), config)
    out = []
    for k in range(scans):
        robot = np.array([1.0 + 0.3 * k, 3.0])
        at = TREES if k not in blind else TREES[:0]
        out.append(method.step(seen(at, robot, k + 1), leg(0.3 if k else 0.0)).state)
    return out


def test_the_counter_is_never_set_back_as_written() -> None:
    """Algorithm 6 counts all iterations without a measurement; a reset forgives those before the last one."""
    blind = {3, 4, 6, 7, 9, 10, 12, 13}  # two at a time, eight in all
    kind = drive(ThesisConfig(count=5, reset=True, icp=0.0), blind)
    strict = drive(ThesisConfig(count=5, reset=False, icp=0.0), blind)
    assert "lost" not in kind
    assert "lost" in strict


def test_the_counter_in_metres() -> None:
    blind = set(range(5, 20))
    assert drive(ThesisConfig(count_distance=1.0, icp=0.0), blind).index("lost") < drive(
        ThesisConfig(count_distance=3.0, icp=0.0), blind
    ).index("lost")


def test_between_two_clouds_odometry_predicts() -> None:
    """A cloud every two metres (5.3): trunks in between are not looked at."""
    method = ThesisMethod(TopoMap.of_points(TREES), ThesisConfig(step=1.9, icp=0.0))
    used = []
    for k in range(20):
        report = method.step(seen(TREES, np.array([1.0 + 0.3 * k, 3.0]), k + 1), leg(0.3 if k else 0.0))
        used.append(len(report.trees) > 0)
        assert report.fix is not None
        np.testing.assert_allclose(report.fix.map_T_robot[:2, 3], [1.0 + 0.3 * k, 3.0], atol=1e-3)
    assert np.flatnonzero(used).tolist() == [0, 7, 14]


def test_icp_tells_a_post_from_a_tree() -> None:
    """Algorithm 5: two trees at equal distances, one thin and one thick; the cloud says which one it is, from either heading."""
    rng = np.random.default_rng(0)

    def bark(radius: float, towards: float, n: int = 150) -> np.ndarray:
        a = towards + rng.uniform(-1.2, 1.2, n)
        return np.column_stack([radius * np.cos(a), radius * np.sin(a), rng.uniform(0.2, 1.5, n)]).astype(np.float32)

    from topograph.topomap import Query, Target

    thick, thin = Target(bark(0.3, 0.4)), Target(bark(0.05, 0.4))
    query = Query(bark(0.3, 2.0))
    assert query.fitness(thick, 0.4 - 2.0) < 0.3 * query.fitness(thin, 0.4 - 2.0)
    assert query.fitness(thick, 0.4 - 2.0) < query.fitness(thick, 0.0)


def test_the_thesiss_map_is_saved_with_clouds(tmp_path: Path, lidar_run) -> None:
    from topograph import store

    out = call(
        "map",
        lidar_run[0],
        "--method",
        "thesis",
        "-c",
        "thesis_best",
        "-o",
        tmp_path / "t.gpkg",
        "--results",
        tmp_path / "r",
        "-q",
    )
    assert out.exit_code == 0, out.output
    topo = store.load(tmp_path / "t.gpkg")
    assert topo.viewpoints
    assert np.isnan(topo.cov[:, :2, :2]).all()  # it states none
    assert topo.meta["method"] == "thesis"
    out = call(
        "localize",
        tmp_path / "t.gpkg",
        lidar_run[0],
        "--method",
        "thesis",
        "-c",
        "thesis_best",
        "--results",
        tmp_path / "l",
        "-q",
    )
    assert out.exit_code == 0, out.output


def test_a_suite_goes_on_where_it_was_stopped(tmp_path: Path) -> None:
    words = (
        "compare",
        "--suite",
        "--designs",
        "grid",
        "--seeds",
        "11",
        "--detections",
        "--starts",
        0,
        "--longest",
        15,
        "--jobs",
        1,
        "--results",
        tmp_path,
        "-q",
    )
    assert call(*words).exit_code == 0
    (job,) = (tmp_path / "jobs").iterdir()
    first = (tmp_path / "metrics.json").read_text()
    stamp = job.stat().st_mtime_ns
    assert call(*words).exit_code == 0
    assert job.stat().st_mtime_ns == stamp  # not done again
    assert json.loads((tmp_path / "metrics.json").read_text())["metrics"] == json.loads(first)["metrics"]
    assert call("compare").exit_code == 2


def test_the_readmes_figures_are_those_that_were_measured() -> None:
    import subprocess
    import sys

    tool = Path(__file__).resolve().parents[1] / "tools" / "readme_figures.py"
    assert subprocess.run([sys.executable, tool, "--check"]).returncode == 0


def test_a_later_run_is_judged_in_the_frame_of_the_mapped_one(tmp_path: Path) -> None:
    """Without GNSS, and with stamps that overlap: run 2 was once laid onto run 1's path, and 3 cm came out as 12 m."""
    from topograph.simulate import DriveConfig, SensorConfig, record

    for k in (1, 2):
        record(
            tmp_path / f"n{k}.bag",
            21,
            "grid",
            DriveConfig(run=k, longest_s=25.0),
            SensorConfig(gnss="none", detections=True),
        )
    words = [str(tmp_path / f"n{k}.bag") for k in (1, 2)]
    truths = [w for k in (1, 2) for w in ("--truth", str(tmp_path / f"n{k}.truth"))]
    out = call("compare", *words, *truths, "--starts", 0, "--results", tmp_path / "r", "-q")
    assert out.exit_code == 0, out.output
    assert "laid onto the map by its path" in out.output
    found = {m["key"]: m["value"] for m in json.loads((tmp_path / "r" / "metrics.json").read_text())["metrics"]}
    assert found["C/graph/distance error mean"] < 0.3
    (tmp_path / "far.csv").write_text("\ufefflat,lon\n10.0,10.0\n10.0001,10.0\n10.0,10.0001\n")
    out = call("compare", words[0], "--truth", tmp_path / "far.csv", "--starts", 0, "--results", tmp_path / "f", "-q")
    assert "unexpected" not in out.output
    assert out.exit_code in (0, 3), out.output


def test_exports_and_pages_do_not_overwrite(tmp_path: Path) -> None:
    from test_store import make

    from topograph import store

    store.save(make(5), tmp_path / "m.gpkg")
    for name in ("rec.bag", "x.csv", "page.html"):
        (tmp_path / name).write_text("mine")
        command = "view" if name.endswith("html") else "export"
        assert call(command, tmp_path / "m.gpkg", tmp_path / name).exit_code == 2
        assert (tmp_path / name).read_text() == "mine"
        assert call(command, tmp_path / "m.gpkg", tmp_path / name, "--force").exit_code == 0
    assert sorted(p.name for p in tmp_path.iterdir()) == ["m.gpkg", "page.html", "rec.bag", "x.csv"]
