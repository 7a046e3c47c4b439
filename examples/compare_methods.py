"""Both methods on the same runs, from Python:  python examples/compare_methods.py run1.bag run2.bag run1.truth run2.truth"""

import sys
from pathlib import Path

from topograph import Config
from topograph.evaluate import read_truth
from topograph.pipeline.comparing import compare_runs


def main(*words: str) -> None:
    """Runs first, then a truth for each: a simulator's folder, a .tum path, or trees as .csv or .geojson."""
    half = len(words) // 2
    runs, truths = [Path(w) for w in words[:half]], [read_truth([Path(w)]) for w in words[half:]]
    found = compare_runs(runs, truths, Config(), starts=2)
    for row in found.rows:
        for m in row.metrics:
            if m.name in ("tree error at 0.8 m, mean", "distance error mean"):
                print(f"{row.table:<8} {row.name:<50} {row.run:<12} {m.name}: {m.value:.3f} {m.unit}")


if __name__ == "__main__":
    main(*sys.argv[1:])
