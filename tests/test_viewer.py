"""The viewer as a person uses it, in headless Chromium: clicks, slider, keyboard; nothing fails and no request leaves the page."""

import shutil
import threading
from dataclasses import replace
from http.server import ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest
from test_cli import call
from test_store import make

from topograph import store
from topograph.cli.viewing import _handler
from topograph.report.viewer import localization_data, page, write_viewer
from topograph.topomap import TopoMap, TopomapConfig, Viewpoint, neighbours

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
GPU = [
    "--no-sandbox",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
]


@pytest.fixture(scope="module")
def browser():
    sync = pytest.importorskip("playwright.sync_api")
    if CHROMIUM is None:
        pytest.skip("Chromium is not installed")
    with sync.sync_playwright() as p:
        b = p.chromium.launch(executable_path=CHROMIUM, args=GPU)
        yield b
        b.close()


class Page:
    def __init__(self, browser, url: str, width: int = 1100, height: int = 750) -> None:
        self.page = browser.new_page(viewport={"width": width, "height": height})
        self.errors: list[str] = []
        self.requests: list[str] = []
        self.page.on("console", lambda m: self.errors.append(m.text) if m.type == "error" else None)
        self.page.on("pageerror", lambda e: self.errors.append(str(e)))
        self.page.on("request", lambda r: self.requests.append(r.url))
        self.page.goto(url)
        self.page.wait_for_function("document.body.dataset.drawn", timeout=60_000)

    def click_tree(self, i: int) -> None:
        self.page.keyboard.press("Escape")  # the facts may lie over it
        x, y = self.page.evaluate(f"topograph.project({i})")[:2]
        box = self.page.locator("#map").bounding_box()
        self.page.mouse.click(box["x"] + x, box["y"] + y)
        self.page.wait_for_function(f"topograph.ui.selected === {i}", timeout=10_000)


def orchard(n: int) -> TopoMap:
    side = int(np.sqrt(n))
    xy = np.stack(np.meshgrid(4.0 * np.arange(side), 5.0 * np.arange(-(-n // side))), axis=2).reshape(-1, 2)[:n]
    xy = xy + np.random.default_rng(0).normal(0, 0.3, (n, 2))
    t = TopoMap.of_points(xy, 0.03)
    e = neighbours(xy, TopomapConfig())
    return replace(t, edges=e, lengths=np.linalg.norm(xy[e[:, 0]] - xy[e[:, 1]], axis=1), diameter=np.full(n, 0.2))


def test_sixty_clicks_without_an_error(browser, tmp_path: Path) -> None:
    m = make(12)
    write_viewer(tmp_path / "m.html", m, "twelve trees")
    p = Page(browser, (tmp_path / "m.html").as_uri())
    for k in range(60):
        if k % 10 == 9:
            p.page.click("#home")
            p.page.click("#show-edges")
            continue
        p.click_tree(k % 12)
        shown = p.page.locator("#rows").inner_text()
        assert f"{m.ids[k % 12]}" in shown.splitlines()[0]
    assert p.page.locator("#cloud canvas").count() == 1
    p.page.keyboard.press("Escape")
    assert p.page.locator("#facts").is_hidden()
    p.page.keyboard.press("/")
    p.page.keyboard.type(m.place[3] or str(m.ids[3]))
    p.page.keyboard.press("Enter")
    p.page.wait_for_timeout(100)
    assert p.page.evaluate("topograph.ui.selected") == 3
    assert not p.errors
    assert p.page.evaluate("document.body.dataset.error || ''") == ""
    assert [r for r in p.requests if not r.startswith(("data:", "blob:"))] == [(tmp_path / "m.html").as_uri()]


@pytest.mark.parametrize("n", [10_000, 100_000])
def test_large_maps_are_drawn(browser, tmp_path: Path, n: int) -> None:
    """How fast is told by tools/bench_viewer.py: a timed test is no test."""
    write_viewer(tmp_path / "m.html", orchard(n), f"{n} trees")
    p = Page(browser, (tmp_path / "m.html").as_uri())
    p.page.evaluate(f"topograph.goTo({n // 2}, 5)")
    p.page.wait_for_timeout(200)
    p.click_tree(n // 2)
    assert p.page.evaluate("topograph.ui.selected") == n // 2
    assert not p.errors


def test_a_phone_shows_the_facts_and_the_map(browser, tmp_path: Path) -> None:
    write_viewer(tmp_path / "m.html", make(12), "on a phone")
    p = Page(browser, (tmp_path / "m.html").as_uri(), 390, 800)
    p.click_tree(2)
    facts, stage = (p.page.locator(k).bounding_box() for k in ("#facts", "#map"))
    assert facts["width"] > 380
    assert facts["y"] > stage["y"] + 100  # the map is still to be seen
    assert p.page.evaluate("document.documentElement.scrollWidth") <= 390
    assert not p.errors


def test_a_localization_is_replayed(browser, tmp_path: Path) -> None:
    m = make(12)
    lines = ["stamp,state,x,y,z,qx,qy,qz,qw,hypotheses,risk,trees,tree_ids,apart,sigma_along,sigma_across"]
    for k in range(20):
        stamp = f"169000000{k // 10}.{k % 10}00000000"
        x = m.p[0, 0] + 0.3 * k
        pose = f"{x},{m.p[0, 1]},0,0,0,0.38268343,0.92387953" if k > 5 else ",,,,,,"
        lines.append(
            f"{stamp},{'tracking' if k > 5 else 'ambiguous'},{pose},{1 if k > 5 else 3},1e-5,2,{m.ids[0]} {m.ids[1]},,0.02,0.03"
        )
    (tmp_path / "localization.csv").write_text("\n".join(lines) + "\n")
    (tmp_path / "hypotheses.csv").write_text(
        "stamp,x,y,yaw,weight\n1690000000.000000000,1,2,0,0.7\n1690000000.000000000,5,2,0,0.3\n"
    )
    data = localization_data(tmp_path, m)
    assert data["hypStart"][:3] == [0, 2, 2]
    assert data["seenStart"][-1] == 40
    write_viewer(tmp_path / "r.html", m, "replay", localization=data)
    p = Page(browser, (tmp_path / "r.html").as_uri())
    slider = p.page.locator("#time")
    slider.fill("0")
    assert "ambiguous, 3 places left, no pose" in p.page.locator("#now").inner_text()
    slider.fill("12")
    assert "1.2 s: tracking" in p.page.locator("#now").inner_text()
    yaw = p.page.evaluate("topograph.D.localization.yaw[12]")
    assert yaw == pytest.approx(np.pi / 4, abs=1e-5)
    slider.fill("0")
    p.page.select_option("#speed", "1")
    p.page.click("#play")
    # Paused by the page itself in that very moment: a slow machine would be at the end, where the button begins anew.
    p.page.wait_for_function("topograph.ui.step > 5 && (document.getElementById('play').click(), true)")
    at = p.page.evaluate("topograph.ui.step")
    p.page.wait_for_timeout(400)
    assert p.page.evaluate("topograph.ui.step") == at
    assert not p.errors


def test_served_pages_fetch_the_clouds_of_one_tree(browser, tmp_path: Path) -> None:
    m = make(12)
    store.save(m, tmp_path / "m.gpkg")
    text = page(m, "served", served=True)
    server = ThreadingHTTPServer(("127.0.0.1", 0), _handler(text.encode(), tmp_path / "m.gpkg", m))
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    address = f"http://127.0.0.1:{server.server_address[1]}"
    try:
        p = Page(browser, f"{address}/")
        tree = m.viewpoints[0].tree
        p.click_tree(tree)
        p.page.wait_for_function("document.querySelector('#cloud canvas')")
        assert f"{address}/clouds/{m.ids[tree]}" in p.requests
        assert all(r.startswith((address, "data:", "blob:")) for r in p.requests)
        assert p.page.evaluate("(async () => (await fetch('/etc/passwd')).status)()") == 404
    finally:
        server.shutdown()
        server.server_close()


def test_a_page_of_a_thousand_trees_is_small(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    views = tuple(
        Viewpoint(i, np.array([np.cos(a), np.sin(a), 0.0]), rng.normal(0, 0.2, (200, 3)).astype(np.float32))
        for i in range(1000)
        for a in (0.0, 1.5, 3.0, 4.5)
    )
    write_viewer(tmp_path / "m.html", replace(orchard(1000), viewpoints=views), "a thousand")
    assert (tmp_path / "m.html").stat().st_size < 6_000_000


def test_names_cannot_break_out_of_the_page(tmp_path: Path) -> None:
    m = replace(make(4), meta={"verdict": "</script><script>alert(1)</script>"})
    text = page(m, "<b>&title", notes=["<img src=x>"])
    assert "<script>alert(1)" not in text
    assert "<b>&title" not in text
    assert "<img src=x>" not in text


def test_the_command(tmp_path: Path) -> None:
    store.save(make(4), tmp_path / "m.gpkg")
    assert call("view", tmp_path / "m.gpkg", tmp_path / "m.html").exit_code == 0
    assert call("view", tmp_path / "m.gpkg", tmp_path / "m.html", "--serve").exit_code == 2
    assert call("view", tmp_path / "m.gpkg", tmp_path / "n.html", "--localization", tmp_path).exit_code == 3
