"""The whole comparison, table after table."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from topograph.config import Config, over
from topograph.errors import InsufficientDataError
from topograph.evaluate import Truth
from topograph.evaluate.comparison import BEST, OURS, WRITTEN, Comparison
from topograph.exchange import check_picture
from topograph.mapping import Progress, silent
from topograph.pipeline.comparing.ablations import ablations_of
from topograph.pipeline.comparing.conditions import conditions
from topograph.pipeline.comparing.localizers import localizers, starts_along
from topograph.pipeline.comparing.maps import detections, maps, per_run, underlay
from topograph.pipeline.comparing.runs import BY_FIXES, BY_WITHHELD, fixes_truth, names, with_fixes
from topograph.pipeline.comparing.work import Work
from topograph.pipeline.localizing import MethodOf
from topograph.pipeline.read import hear


def compare_runs(
    runs: Sequence[Path],
    truths: Sequence[Truth | None],
    config: Config,
    *,
    starts: int = 16,
    ablations: bool = False,
    by_fixes: int = 0,
    image: Path | None = None,
    rivals: dict[str, MethodOf] | None = None,
    progress: Progress = silent,
) -> Comparison:
    """Map the first run and localize all of them, by both methods.

    Args:
        by_fixes: each run's own GNSS, filtered, is its truth (thesis 5.3): 1 all of it, N every N-th fix, which no map is then made with.
        image: a georeferenced picture that is drawn under the maps.
    """
    if image is not None:
        check_picture(image)
    out = Comparison(runs=names(runs))
    w = Work(out, list(truths), by_fixes == 1)
    configs = {OURS: config, WRITTEN: over(config, "thesis"), BEST: over(config, "thesis_best")}
    for n, path in enumerate(runs):
        for front_end in ("organised", "thesis"):
            progress("read", (2 * n + (front_end == "thesis")) / (2 * len(runs)))
            if front_end == "thesis" and "points" not in w.heard["organised", out.runs[n]].session.chosen:
                w.heard["thesis", out.runs[n]] = w.heard["organised", out.runs[n]]
                continue
            chosen = replace(config, trunks=replace(config.trunks, front_end=front_end))
            w.heard[front_end, out.runs[n]] = hear([path], chosen)
        out.notes += [f"{out.runs[n]}: {said}" for said in w.heard["organised", out.runs[n]].session.notes]
    progress("read", 1.0)
    if w.one_front_end:
        out.notes.append(
            "recorded trunk detections, no point clouds: both methods have the same front end, and ICP has no clouds"
        )
    if by_fixes:
        w.truths = [fixes_truth(with_fixes(w.heard["organised", r], by_fixes, True), config) for r in out.runs]
        for r, t in zip(out.runs, w.truths, strict=True):
            if t is None:
                out.notes.append(f"{r}: no truth, too few of its fixes are usable")
        if not any(t is not None for t in w.truths):
            raise InsufficientDataError(
                "--truth fixes: no run has enough usable fixes; give a smaller N, or another truth"
            )
        if by_fixes > 1:
            w.heard = {k: with_fixes(h, by_fixes, False) for k, h in w.heard.items()}
        out.notes.append(BY_FIXES if by_fixes == 1 else BY_WITHHELD.format(n=by_fixes))
    detections(w)
    maps(w, configs, progress)
    if image is not None:
        out.underlay = underlay(image, out.maps[OURS], out.notes)
    per_run(w, configs)
    localizers(w, configs, rivals or {}, progress)
    starts_along(w, configs, starts, progress)
    conditions(w, configs)
    if ablations:
        ablations_of(w, config, progress)
    return out
