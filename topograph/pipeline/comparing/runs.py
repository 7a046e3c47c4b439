"""What the runs are called, what of them is heard, and truths of their own GNSS."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from topograph.config import Config
from topograph.estimate.ekf import filtered_path
from topograph.evaluate import Truth
from topograph.mapping import prepare
from topograph.pipeline.mapping import mapping_config
from topograph.pipeline.read import Heard


def names(runs: Sequence[Path]) -> list[str]:
    """What the runs are called: their stems, numbered where two are alike."""
    stems = [p.stem for p in runs]
    return [f"{s} ({n + 1})" if stems.count(s) > 1 else s for n, s in enumerate(stems)]


BY_FIXES = (
    "truth: each run's own GNSS through the filter (thesis 5.3); it cannot be better than its fixes, maps used them too, and the mapping path "
    "of the thesis is that filter, so that paths are not compared"
)


BY_WITHHELD = "truth: every fix number {n} of each run's own GNSS, through the filter (thesis 5.3), withheld from all maps; wheels and IMU are in both"


def with_fixes(heard: Heard, n: int, withheld: bool) -> Heard:
    """The run with every `n`-th fix, or (not `withheld`) with all others."""
    s = heard.session.streams
    keep = (np.arange(len(s.fix_ns)) % n == 0) == withheld
    streams = replace(s, **{k: getattr(s, k)[keep] for k in ("fix_ns", "lat_lon_h", "fix_cov", "fix_status")})
    return replace(heard, session=replace(heard.session, streams=streams))


def without(heard: Heard, config: Config) -> Heard:
    """The run as if the streams that the configuration turns off had not been recorded; its trunks are those that were detected."""
    s = heard.session
    streams, chosen = s.streams, dict(s.chosen)
    for kind in ("imu", "heading", "fix", "odometry"):
        if getattr(config.bags, f"topic_{kind}") == "none":
            streams = streams.without(kind)
            chosen.pop(kind, None)
    mounts = {k: v for k, v in s.mounts.items() if k in chosen}
    return replace(
        heard, session=replace(s, streams=streams, chosen=chosen, mounts=mounts, notes=[], skipped=s.skipped.copy())
    )


def fixes_truth(heard: Heard, config: Config) -> Truth | None:
    """The path of a run by its own GNSS, IMU and wheels through the filter, as the thesis had it; None without GNSS."""
    p = prepare(heard.session, mapping_config(config)).problem
    if p.datum is None:
        return None
    ns = np.unique(np.concatenate([heard.session.trunks.stamps_ns, p.stamps_ns])).astype(np.int64)
    ns = ns[(ns >= p.stamps_ns[0]) & (ns <= p.stamps_ns[-1])]
    sigma = float(np.sqrt(np.median(p.fixes.cov[:, 0, 0])))
    return Truth.of_path(ns, filtered_path(p, ns), p.datum, sigma)
