"""The tables of the comparison in docs/measured.md, made of what `topograph compare` and `topograph compare --suite` leave as `metrics.json`:

    python tools/readme_figures.py [--from METRICS] [--suite METRICS] [--check]

Without --check the tables are written between their marks; with it, exit 1 when a typed figure differs from what docs/compare.json and docs/suite.json say.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from pathlib import Path

HERE = Path(__file__).resolve().parents[1]
PAGE, KEPT, SUITE = HERE / "docs" / "measured.md", HERE / "docs" / "compare.json", HERE / "docs" / "suite.json"
BEGIN, END = "<!-- compare: made by tools/readme_figures.py -->", "<!-- end of compare -->"
SUITE_BEGIN, SUITE_END = "<!-- suite: made by tools/readme_figures.py -->", "<!-- end of suite -->"
RATIOS = (
    ("map: tree error at 0.8 m", "C map, tree error at 0.8 m, mean: graph / thesis at its best"),
    ("localization: distance error", "C, distance error mean: graph / thesis at its best"),
    ("convergence: driven until the first pose", "convergence, convergence mean: graph / thesis at its best"),
    ("on our map and trunks: distance error", "B, distance error mean: graph / thesis at its best"),
)
CHAINS = (
    ("tree error", "C map", "tree error at 0.8 m, mean", "m"),
    ("nodes within 1 m of a tree", "C map", "precision (1 m)", ""),
    ("distance error", "C", "distance error mean", "m"),
    ("starts that ended wrong, of 16", "convergence", "starts that ended wrong", ""),
)

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


def suite_table(figures: dict[str, float | None]) -> str:
    """Ours over the thesis's, and each design by itself."""
    lines = ["| graph / thesis at its best, whole chain | ratio | 95 % |", "|---|---|---|"]
    for title, key in RATIOS:
        ratio, low, high = (figures.get(f"ratios/{key}/{m}") for m in ("ratio", "95 % from", "95 % to"))
        lines.append(f"| {title} | {number(ratio)} | {number(low)} to {number(high)} |")
    designs = sorted({k.split("/")[0].partition(": ")[2] for k in figures if k.startswith("C map: ")})
    names = NAMES[:2]
    lines += [
        "",
        "| design | " + " | ".join(f"{c[0]}: {', '.join(names)}" for c in CHAINS) + " |",
        "|---|" + "---|" * len(CHAINS),
    ]
    for d in designs:
        cells = [
            ", ".join(shown(figures.get(f"{where}: {d}/{n}/{m}"), unit) for n in names) for _, where, m, unit in CHAINS
        ]
        lines.append(f"| {d} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def number(value: float | None) -> str:
    return "–" if value is None or not math.isfinite(value) else f"{value:.2f}"


def kept(source: Path, tables: tuple[str, ...]) -> str:
    """The figures of some tables of a `metrics.json`, as text."""
    found = json.loads(source.read_text())["metrics"]
    figures = {m["key"]: m["value"] for m in found if m["key"].split("/")[0].partition(": ")[0] in tables}
    return json.dumps(figures, indent=0) + "\n"


def replaced(text: str, begin: str, end: str, new: str) -> str:
    """`text` with what stands between two marks replaced."""
    before, _, rest = text.partition(begin)
    return f"{before}{begin}\n{new}\n{end}{rest.partition(end)[2]}"


def main() -> int:
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--from", dest="source", type=Path)
    p.add_argument("--suite", type=Path)
    p.add_argument("--check", action="store_true")
    a = p.parse_args()
    if a.source is not None:
        KEPT.write_text(kept(a.source, ("A", "B", "C", "C map", "convergence", "conditions")))
    if a.suite is not None:
        SUITE.write_text(kept(a.suite, ("C", "C map", "convergence", "ratios")))
    text = PAGE.read_text()
    new = replaced(text, BEGIN, END, table(json.loads(KEPT.read_text())))
    new = replaced(new, SUITE_BEGIN, SUITE_END, suite_table(json.loads(SUITE.read_text())))
    if a.check:
        if text != new:
            print(
                "docs/measured.md does not say what docs/compare.json and docs/suite.json say: run python tools/readme_figures.py"
            )
        return int(text != new)
    PAGE.write_text(new)
    return 0


if __name__ == "__main__":
    sys.exit(main())
