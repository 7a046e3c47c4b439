"""The README's table of the comparison, made of a `metrics.json` of `topograph compare`:  python tools/readme_figures.py [--from METRICS] [--check]

Without --check the table is written between its marks; with it, exit 1 when a typed figure differs from what docs/compare.json says.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from pathlib import Path

HERE = Path(__file__).resolve().parents[1]
README, KEPT = HERE / "README.md", HERE / "docs" / "compare.json"
BEGIN, END = "<!-- compare: made by tools/readme_figures.py -->", "<!-- end of compare -->"

ROWS = (
    ("nodes that are trees (within 2.5 m), all nodes", "C map", ("precision (2.5 m)", "nodes"), ""),
    ("tree error at 0.8 m: mean", "C map", ("tree error at 0.8 m, mean",), "m"),
    ("largest", "C map", ("tree error at 0.8 m, max",), "m"),
    ("localization: share of scans with a pose after the first", "C", ("share with a pose after the first",), ""),
    ("distance error: mean", "C", ("distance error mean",), "m"),
    ("largest", "C", ("distance error max",), "m"),
    ("driven until the first pose, 16 starts: mean", "convergence", ("convergence mean",), "m"),
    ("starts that ended wrong, or never", "convergence", ("starts that ended wrong", "starts without an end"), ""),
)
NAMES = ("graph", "thesis at its best", "thesis as written")


def shown(value: float | None, unit: str) -> str:
    if value is None or not math.isfinite(value):
        return "–"
    if unit == "m":
        return f"{100 * value:.1f} cm" if abs(value) < 1 else f"{value:.2f} m"
    return f"{value:.0f}" if (float(value).is_integer() and value > 1) or value == 0 else f"{value:.2f}"


def table(figures: dict[str, float | None]) -> str:
    lines = ["| whole chain | " + " | ".join(NAMES) + " |", "|---|" + "---|" * len(NAMES)]
    for title, where, metrics, unit in ROWS:
        cells = [", ".join(shown(figures.get(f"{where}/{n}/{m}"), unit) for m in metrics) for n in NAMES]
        lines.append(f"| {title} | " + " | ".join(cells) + " |")
    ladder = " · ".join(
        f"{k.split('/')[1]} {shown(v, 'm')}"
        for k, v in figures.items()
        if k.startswith("A/") and k.endswith("/tree error at 0.8 m, mean")
    )
    return "\n".join([*lines, "", f"On our detections, another estimator (tree error at 0.8 m): {ladder}."])


def main() -> int:
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--from", dest="source", type=Path)
    p.add_argument("--check", action="store_true")
    a = p.parse_args()
    if a.source is not None:
        found = json.loads(a.source.read_text())["metrics"]
        kept = {
            m["key"]: m["value"]
            for m in found
            if m["key"].split("/")[0] in ("A", "B", "C", "C map", "convergence", "conditions")
        }
        KEPT.write_text(json.dumps(kept, indent=0) + "\n")
    text = README.read_text()
    before, _, rest = text.partition(BEGIN)
    old, _, after = rest.partition(END)
    new = f"\n{table(json.loads(KEPT.read_text()))}\n"
    if a.check:
        if old != new:
            print("README.md does not say what docs/compare.json says: run python tools/readme_figures.py")
        return int(old != new)
    README.write_text(f"{before}{BEGIN}{new}{END}{after}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
