"""What outside tools say of our products and figures: rasterio's pictures, smfeval's verdict on covariances, a browser on the page of a comparison."""

import json
from pathlib import Path

import numpy as np
import pytest
from test_cli import call
from test_viewer import browser  # noqa: F401  # the fixture

from topograph.config import Config
from topograph.errors import InputError
from topograph.evaluate import Truth
from topograph.evaluate.frames import WorldInMap
from topograph.evaluate.outside import smfeval_metrics
from topograph.exchange import read_underlay, write_wide_tum
from topograph.geometry import Datum, exp, from_xyz_rpy, tangent_cov
from topograph.localize import Report
from topograph.localize.method import Fix
from topograph.pipeline.comparing import with_fixes
from topograph.pipeline.read import hear
from topograph.simulate import DriveConfig, SensorConfig, record

HERE = Datum(40.2, -8.4, 90.0)


# -- a GeoTIFF under the maps ---------------------------------------------------------------------------------------


@pytest.mark.filterwarnings("ignore:Use `@` matmul:PendingDeprecationWarning")  # within rasterio
@pytest.mark.parametrize("crs", ["EPSG:4326", "EPSG:32629", "EPSG:3857"])
@pytest.mark.parametrize("kind", ["uint8", "uint16"])
def test_a_picture_lies_where_its_pixels_are(tmp_path: Path, crs: str, kind: str) -> None:
    """One bright metre in a dark picture, in three coordinate systems; what was not photographed is transparent."""
    rasterio = pytest.importorskip("rasterio")
    from rasterio.transform import from_bounds, rowcol
    from rasterio.warp import transform

    low, high = np.array([-40.0, -30.0]), np.array([40.0, 30.0])
    corners = HERE.to_geodetic(np.array([[-40.0, -30.0, 0], [-40.0, 30.0, 0], [20.0, 30.0, 0], [20.0, -30.0, 0]]))
    x, y = transform("EPSG:4326", crs, corners[:, 1], corners[:, 0])
    wide, tall = 600, 600
    at = from_bounds(min(x), min(y), max(x), max(y), wide, tall)
    spot = HERE.to_geodetic(np.array([[-12.0, 7.0, 0.0]]))
    sx, sy = transform("EPSG:4326", crs, spot[:, 1], spot[:, 0])
    row, column = (int(v) for v in rowcol(at, sx[0], sy[0]))
    pixels = np.full((3, tall, wide), 10, kind)
    pixels[0, row - 5 : row + 6, column - 5 : column + 6] = 250
    path = tmp_path / "orchard.tif"
    with rasterio.open(path, "w", driver="GTiff", width=wide, height=tall, count=3, dtype=kind, crs=crs, transform=at) as f:  # fmt: skip
        f.write(pixels)
    u = read_underlay(path, HERE, low, high)
    tall, wide = u.pixels.shape[:2]
    i, j = np.nonzero((u.pixels[..., 0] > 100) & (u.pixels[..., 3] > 0))
    east = u.extent[0] + (j.mean() + 0.5) * (u.extent[1] - u.extent[0]) / wide
    north = u.extent[3] - (i.mean() + 0.5) * (u.extent[3] - u.extent[2]) / tall
    assert (east, north) == pytest.approx((-12.0, 7.0), abs=0.25)
    assert (u.pixels[:, int(0.9 * wide) :, 3] == 0).all()  # east of 20 m nothing was photographed
    assert not read_underlay(path, Datum(41.0, -8.4, 0.0), low, high).pixels[..., 3].any()  # another place
    (tmp_path / "no.tif").write_bytes(b"no picture")
    with pytest.raises(InputError, match="cannot be read"):
        read_underlay(tmp_path / "no.tif", HERE, low, high)
    bare = tmp_path / "bare.tif"
    with pytest.warns(rasterio.errors.NotGeoreferencedWarning), rasterio.open(bare, "w", driver="GTiff", width=2, height=2, count=1, dtype="uint8") as f:  # fmt: skip
        f.write(np.zeros((1, 2, 2), np.uint8))
    with pytest.raises(InputError, match="not georeferenced"), pytest.warns(rasterio.errors.NotGeoreferencedWarning):
        read_underlay(bare, HERE, low, high)


@pytest.mark.filterwarnings("ignore:Use `@` matmul:PendingDeprecationWarning")  # within rasterio
def test_palettes_and_what_is_no_number(tmp_path: Path) -> None:
    """A palette gives its colours; no-data and NaN are transparent and have no part in the contrast."""
    rasterio = pytest.importorskip("rasterio")
    from rasterio.transform import from_origin

    low, high = np.array([-5.0, -5.0]), np.array([5.0, 5.0])
    corner = HERE.to_geodetic(np.array([[-10.0, 10.0, 0.0]]))[0]
    at = from_origin(corner[1], corner[0], 2e-6, 2e-6)
    shape = {"driver": "GTiff", "width": 200, "height": 200, "crs": "EPSG:4326", "transform": at}
    with rasterio.open(tmp_path / "p.tif", "w", count=1, dtype="uint8", **shape) as f:
        f.write(np.full((1, 200, 200), 3, np.uint8))
        f.write_colormap(1, {3: (200, 30, 40, 255)})
    u = read_underlay(tmp_path / "p.tif", HERE, low, high)
    assert (u.pixels[..., :3] == [200, 30, 40]).all()
    values = np.tile(np.linspace(1.0, 2.0, 200, dtype=np.float32), (200, 1))
    values[:35], values[35:45] = -9999.0, np.nan
    with rasterio.open(tmp_path / "n.tif", "w", count=1, dtype="float32", nodata=-9999.0, **shape) as f:
        f.write(values[None])
    u = read_underlay(tmp_path / "n.tif", HERE, low, high)
    opaque = u.pixels[..., 3] > 0
    assert 0.3 < opaque.mean() < 0.9
    assert np.ptp(u.pixels[opaque][:, 0]) > 150


# -- smfeval's verdict on stated covariances --------------------------------------------------------------------------


def stated(scale: float, n: int = 800) -> tuple[list[Report], Truth, WorldInMap]:
    """Poses that err by their covariance, which is stated `scale` times too large."""
    rng = np.random.default_rng(5)
    true = np.array([from_xyz_rpy(0.3 * k, np.sin(0.05 * k), 0.02 * k, 0.05, -0.1, 0.02 * k) for k in range(n)])
    stamps = 1_690_000_000_000_000_000 + np.arange(n) * 10**8
    cov = np.diag([0.01, 0.01, 0.02, 0.05, 0.15, 0.4]) ** 2  # of roll, pitch, yaw, x, y, z about the map's axes
    reports = []
    for T, s in zip(true, stamps.tolist(), strict=True):
        e = rng.multivariate_normal(np.zeros(6), cov)
        found = T.copy()
        found[:3, :3] = exp(np.concatenate([e[:3], np.zeros(3)]))[:3, :3] @ T[:3, :3]
        found[:3, 3] += e[3:]
        none = np.zeros(0, np.int64)
        reports.append(
            Report(stamp_ns=s, state="tracking", fix=Fix(s, found, scale * cov, 1e-4), hypotheses=1, risk=1e-4, places=np.zeros((0, 3)), trees=none, pairs=np.zeros((0, 2), np.int64), along=0.1, across=0.1)
        )  # fmt: skip
    return reports, Truth.of_path(stamps, true, HERE), WorldInMap("WGS84", np.eye(4), HERE, HERE)


@pytest.mark.parametrize(("scale", "z"), [(1.0, 1.0), (0.01, 10.0), (4.0, 0.5)])
def test_smfeval_finds_covariances_right_and_wrong(scale: float, z: float) -> None:
    """Also a check of our conventions: axes and their order. With x and y swapped, z would be 2 where it is 1."""
    pytest.importorskip("smfeval")
    found = {m.name: m.value for m in smfeval_metrics(*stated(scale))}
    assert found["smfeval: z of positions (0.92 is right)"] == pytest.approx(
        0.92 * z, rel=0.06
    )  # mean of chi_3 / sqrt(3)
    inside = found["smfeval: in the stated 90 % ellipsoid (0.9 is right)"]
    assert inside == pytest.approx(0.9, abs=0.04) if scale == 1.0 else (inside < 0.1 or inside > 0.97)


def test_smfeval_reads_the_wide_tum(tmp_path: Path) -> None:
    load = pytest.importorskip("smfeval.io.load")
    reports, _, _ = stated(1.0, 50)
    fixes = [r.fix for r in reports if r.fix is not None]
    poses, cov = np.array([f.map_T_robot for f in fixes]), np.array([f.cov for f in fixes])
    write_wide_tum(tmp_path / "w.tum", np.array([f.stamp_ns for f in fixes]), poses, tangent_cov(poses, cov))
    _, steps = load.load_estimate(tmp_path / "w.tum", body_frame="base_link")
    assert len(steps) == 50
    for k in (0, 20, 49):
        np.testing.assert_allclose(steps[k].translation, poses[k, :3, 3], atol=1e-8)
        back = poses[k, :3, :3] @ steps[k].covariance[:3, :3] @ poses[k, :3, :3].T
        np.testing.assert_allclose(back, cov[k, 3:, 3:], rtol=1e-5, atol=1e-7)


# -- fixes withheld as truth, and the page in a browser ----------------------------------------------------------------


@pytest.fixture(scope="module")
def compared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two short runs of detections, compared with every third fix as truth, over a picture."""
    at = tmp_path_factory.mktemp("compared")
    for k in (1, 2):
        record(at / f"r{k}.bag", 23, "grid", DriveConfig(run=k, longest_s=25.0), SensorConfig(detections=True))
    words = [str(at / f"r{k}.bag") for k in (1, 2)]
    out = call("compare", *words, "--truth", "fixes/3", "--starts", 2, "--results", at / "r", "-q")
    assert out.exit_code == 0, out.output
    assert "withheld from all maps" in out.output
    return at


def test_withheld_fixes_are_in_no_map_and_judge_all(compared: Path) -> None:
    heard = hear([compared / "r1.bag"], Config())
    third, rest = with_fixes(heard, 3, True).session.streams, with_fixes(heard, 3, False).session.streams
    both = np.sort(np.concatenate([third.fix_ns, rest.fix_ns]))
    np.testing.assert_array_equal(both, heard.session.streams.fix_ns)
    assert len(third.fix_ns) == pytest.approx(len(both) / 3, abs=1)
    np.testing.assert_array_equal(with_fixes(heard, 1, True).session.streams.fix_ns, both)
    found = {m["key"]: m["value"] for m in json.loads((compared / "r" / "metrics.json").read_text())["metrics"]}
    assert found["A/graph/path error mean (horizontal)"] < 0.03
    assert found["C/graph/distance error mean"] < 0.05
    pytest.importorskip("smfeval")
    assert 0.2 < found["C/graph/smfeval: z of positions (0.92 is right)"] < 2.0


@pytest.mark.parametrize("width", [390, 1150])
def test_the_page_of_a_comparison_in_a_browser(browser, compared: Path, width: int) -> None:  # noqa: F811  # the fixture
    """A phone and a laptop: nothing to scroll sideways but tables in their own frames, all pictures are there, no request leaves it."""
    page = browser.new_page(viewport={"width": width, "height": 800})
    errors, requests = [], []
    page.on("console", lambda m: errors.append(m.text) if m.type == "error" else None)
    page.on("pageerror", lambda e: errors.append(str(e)))
    page.on("request", lambda r: requests.append(r.url))
    page.goto((compared / "r" / "report.html").as_uri())
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    assert page.locator("table").count() >= 5
    sizes = page.evaluate("Array.from(document.images, i => [i.naturalWidth, i.getBoundingClientRect().width])")
    assert len(sizes) >= 4
    assert all(natural > 200 and 200 < drawn <= width for natural, drawn in sizes)
    titles = page.locator("h2").all_inner_texts()
    for letter in ("A:", "B:", "C:"):
        assert any(t.startswith(letter) for t in titles)
    tall = page.evaluate("document.documentElement.scrollHeight")
    shot = page.screenshot(full_page=True, path=compared / f"page_{width}.png")
    assert len(shot) > 20_000
    assert tall < 40_000
    assert [r for r in requests if not r.startswith(("file:", "data:"))] == []
    assert not errors
    page.close()
