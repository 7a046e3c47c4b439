"""How fast the viewer draws, told by the page itself (headless Chromium, software rendering):  python tools/bench_viewer.py"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))  # the orchard and the browser are the tests'

from playwright.sync_api import sync_playwright
from test_viewer import CHROMIUM, GPU, Page, orchard

from topograph.report.viewer import write_viewer


def main() -> None:
    """From the script's begin until all layers are drawn, the median of three; and the page's size."""
    with sync_playwright() as p, tempfile.TemporaryDirectory() as folder:
        browser = p.chromium.launch(executable_path=CHROMIUM, args=GPU)
        for n in (1_000, 10_000, 100_000):
            path = Path(folder) / f"{n}.html"
            write_viewer(path, orchard(n), f"{n} trees")
            drawn = sorted(
                int(Page(browser, path.as_uri()).page.evaluate("document.body.dataset.drawn")) for _ in range(3)
            )
            print(f"{n:>7} trees: drawn in {drawn[1] / 1000:.2f} s, {path.stat().st_size / 1e6:.1f} MB", flush=True)
        browser.close()


if __name__ == "__main__":
    main()
