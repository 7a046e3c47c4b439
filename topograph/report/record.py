"""`report.json`: what scripts read."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from topograph.evaluate import Metric


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
        "metrics": [{"name": m.name, "value": _number(m.value), "unit": m.unit} for m in metrics],
        "skipped": dict(skipped),
        "inputs": [dict(i) for i in inputs],
        "seconds": {k: round(v, 3) for k, v in seconds.items()},
        "peak_rss_mb": round(peak_rss_mb, 1),
        **more,
    }
    write_text(path, json.dumps(data, indent=2, allow_nan=False) + "\n")


def _number(v: float) -> float | int | None:
    if not math.isfinite(v):
        return None
    return int(v) if float(v).is_integer() and abs(v) < 1e15 else float(v)


def write_text(path: Path, text: str) -> None:
    """Write a text file so that a reader sees the old one or the new one, never half."""
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        part.write_text(text)
        os.replace(part, path)
    except OSError as err:
        part.unlink(missing_ok=True)
        raise OSError(err.errno, err.strerror, str(path)) from err
