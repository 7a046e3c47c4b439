"""`report.json`: what scripts read."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from topograph.evaluate import Metric
from topograph.whole import write_text


def write_json(
    path: Path,
    metrics: Sequence[Metric],
    skipped: Mapping[str, int],
    inputs: Sequence[Mapping[str, str]],
    seconds: Mapping[str, float],
    peak_rss_mb: float,
    **more: Any,
) -> None:
    """Write `report.json`, whole or not at all. `more` are further blocks, such as notes and versions."""
    data = {
        "metrics": [{"name": m.name, "value": m.plain, "unit": m.unit} for m in metrics],
        "skipped": dict(skipped),
        "inputs": [dict(i) for i in inputs],
        "seconds": {k: round(v, 3) for k, v in seconds.items()},
        "peak_rss_mb": round(peak_rss_mb, 1),
        **more,
    }
    write_text(path, json.dumps(data, indent=2, allow_nan=False) + "\n")
