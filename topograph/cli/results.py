"""What a mapped run leaves behind: the map, if the audit does not refuse it, path, configuration, report; and the word on it."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import click
import numpy as np

from topograph import __version__
from topograph.cli.common import WHOLE, peak_mb, plain_span, span_facts, versions


def save_thesis(
    run: Any, config: Any, inputs: list[dict[str, str]], folder: Path, target: Path, true: Any, check_fixes: int
) -> Any:
    """Map by the thesis's method, with what can be said of it; it is not audited, for it states no uncertainty."""
    import json

    from topograph import pipeline, report, store
    from topograph.config import dump
    from topograph.errors import InsufficientDataError
    from topograph.evaluate import truth_metrics, world_in_map, write_tum
    from topograph.evaluate.metrics import doubles
    from topograph.whole import write_text

    text = dump(config)
    meta = {"config": text, "inputs": json.dumps(inputs), "versions": json.dumps(versions()), "verdict": "not audited"}
    _, e, topo = pipeline.thesis_map(run, config, meta, check_fixes=check_fixes)
    if not len(topo):
        raise InsufficientDataError(f"no node has {config.average.least} clusters (average.least)")
    metrics = [doubles(topo)] if true is None else truth_metrics(topo, e.stamps_ns, e.map_T_robot, true)
    write_tum(folder / "path.tum", e.stamps_ns, e.map_T_robot)
    write_text(folder / "config.yaml", text)
    true_trees = world_in_map(topo, true).points(true.trees) if true is not None and len(true.trees) else None
    picture = report.map_figure(topo, true_trees)
    (folder / "map.png").write_bytes(picture)
    store.save(topo, target)
    report.write_json(
        folder / "report.json", metrics, run.skipped, inputs, {"read": run.seconds, "average": e.seconds}, peak_mb(),
        notes=run.notes, versions=versions(), topics=run.chosen, method="thesis",
    )  # fmt: skip
    return topo


def say_verdict(solved: Any, topo: Any, verdict: Any, folder: Path, target: Path, notes: Sequence[str]) -> None:
    """What became of a map, and the exit code that it deserves."""
    from topograph import pipeline

    no_trees = pipeline.why_no_trees(solved)
    for note in notes:
        click.echo(f"note: {note}", err=True)
    if no_trees:
        click.echo(f"topograph: {no_trees}; the path is in {folder / 'path.tum'}", err=True)
        raise SystemExit(4)
    if verdict.word != "sound":
        click.echo(f"{verdict.word.upper()}:", err=True)
        for f in verdict.findings:
            click.echo(f"  {f.sentence} [{f.name} {f.value:.3g} {f.unit}, bound {f.bound:.3g}]", err=True)
    if verdict.word == "refused":
        click.echo(
            f"topograph: no map was saved; path and report are in {folder}; {accepting(verdict)} saves it all the same",
            err=True,
        )
        raise SystemExit(4)
    where = "georeferenced" if topo.datum is not None else "not georeferenced"
    trees, others = int(topo.is_tree.sum()), int((~topo.is_tree).sum())
    posts = f"{others} posts, " if others else ""
    click.echo(
        f"{target}: {trees} trees, {posts}{len(topo.edges)} edges, {where}, {verdict.word}; report: {folder / 'report.html'}, to walk through: {folder / 'map.html'}"
    )


def accepting(verdict: Any) -> str:
    """What to type to have a refused map all the same."""
    return " ".join(f"--accept '{f.name}'" for f in verdict.findings if f.refuses)


def save_results(
    solved: Any, config: Any, hashes: Callable[[], list[dict[str, str]]], bags: Sequence[Path], folder: Path, target: Path, true: Any, old: Any,
    progress: Callable[[str, float], None], accept: Sequence[str] = (), span_s: tuple[float, float] = WHOLE,
) -> Any:  # fmt: skip
    """Write the map (if it has trees, and the audit does not refuse it), path, configuration and reports; returns map and verdict."""
    import json

    from topograph import pipeline, report, store
    from topograph.config import dump
    from topograph.evaluate import write_tum
    from topograph.whole import write_text

    began = time.perf_counter()
    e = solved.estimate
    write_tum(folder / "path.tum", e.stamps_ns, e.map_T_robot)
    verdict = pipeline.audited(solved).accepting(accept)
    inputs = hashes()
    text = dump(config)
    no_trees = pipeline.why_no_trees(solved)
    word = "no trees" if no_trees else verdict.word
    meta = {
        "config": text, "inputs": json.dumps(inputs), "versions": json.dumps(versions()), "verdict": verdict.word,
        "why": "; ".join(verdict.reasons),
    }  # fmt: skip
    progress("map", 0.0)
    topo = pipeline.topo_map(solved, config, meta)
    if old is not None:
        topo = pipeline.extend(old, topo, solved, config)
    metrics, figures = _judged(solved, topo, true)
    seconds = {**solved.seconds, "map and report": time.perf_counter() - began}
    write_text(folder / "config.yaml", text)
    notes = [*solved.run.notes, *filter(None, [no_trees])]
    if word in ("sound", "doubtful"):
        store.save(topo, target)
    report.write_json(
        folder / "report.json", metrics, solved.run.skipped, inputs, seconds, peak_mb(), notes=notes, versions=versions(),
        topics=solved.run.chosen, span_s=plain_span(span_s), announced=solved.run.announced, scales=e.scales, verdict={**verdict.record(), "word": word},
        offsets=[{"name": o.name, "value": o.value.tolist(), "sigma": o.sigma.tolist(), "gain": o.gain} for o in e.offsets],
    )  # fmt: skip
    title = f"Map of {', '.join(p.name for p in bags)}"
    facts = {
        "from": ", ".join(p.name for p in bags),
        "recorded": f"{solved.run.duration_s:.0f} s",
        **span_facts(span_s),
        "topograph": __version__,
    }
    report.Page(
        title=title, word=word, sentence=_sentence(word, solved, topo, verdict, no_trees), findings=verdict.findings, facts=facts, metrics=metrics,
        figures=figures, notes=notes, skipped=solved.run.skipped, walk=("map.html", "Walk through the map") if len(topo) else None,
        files=("report.json", "path.tum", "config.yaml"),
    ).write(folder / "report.html")  # fmt: skip
    _pictures(folder, topo, title, verdict, figures)
    progress("map", 1.0)
    return topo, verdict


MAP, BY_FACTOR = "Map", "Residuals by factor"
"""Figures that are files of their own besides."""


def _judged(solved: Any, topo: Any, true: Any) -> tuple[list[Any], dict[str, bytes]]:
    """Metrics and figures (name -> PNG) of a map, against the truth where there is one."""
    from topograph import pipeline, report
    from topograph.evaluate import truth_metrics, world_in_map
    from topograph.evaluate.metrics import doubles, tree_errors

    e = solved.estimate
    metrics = pipeline.residual_metrics(solved)
    figures: dict[str, bytes] = {}
    true_trees = None
    if true is None:
        metrics = [doubles(topo), *metrics]
    else:
        metrics = truth_metrics(topo, e.stamps_ns, e.map_T_robot, true) + metrics
        true_trees = world_in_map(topo, true).points(true.trees) if len(true.trees) else None
        error = tree_errors(topo, true)[2] if len(true.trees) else np.zeros((0, 3))
        if len(error):
            figures["Errors of the trees"] = report.tree_error_figure(np.linalg.norm(error[:, :2], axis=1))
    if len(topo):
        figures = {MAP: report.map_figure(topo, true_trees), **figures}
    if e.residuals:
        figures[BY_FACTOR] = report.residual_figure(e.residuals)
        figures["Residuals over time"] = report.residual_time_figure(e.residuals, e.residual_ns, solved.run.start_ns)
    return metrics, figures


def _sentence(word: str, solved: Any, topo: Any, verdict: Any, no_trees: str) -> str:
    """What the report says after the verdict's word."""
    trees, others = int(topo.is_tree.sum()), int((~topo.is_tree).sum())
    count = f"{trees} trees" + (f" and {others} posts" if others else "")
    s = solved.streams
    streams = (("wheels", s.odometry_ns), ("IMU", s.imu_ns), ("fixes", s.fix_ns), ("headings", s.heading_ns))
    there = ", ".join(name for name, stamps in streams if len(stamps))
    return {
        "no trees": f"– no map was saved, the path is in path.tum; {no_trees}",
        "sound": f"– {count}; {there} and trunks agree." if there else f"– {count}.",
        "doubtful": f"– {count}; the map is saved, look at what the audit found:",
        "refused": f"– no map was saved; the path is in path.tum ({accepting(verdict)} saves it all the same). The audit found:",
    }[word]


def _pictures(folder: Path, topo: Any, title: str, verdict: Any, figures: dict[str, bytes]) -> None:
    """The figures and the page to walk through; what an earlier run left in the folder goes where this one has none."""
    from topograph.report.viewer import write_viewer

    for name, file in ((MAP, "map.png"), (BY_FACTOR, "residuals.png")):
        if name in figures:
            (folder / file).write_bytes(figures[name])
        else:
            (folder / file).unlink(missing_ok=True)
    if len(topo):
        said = [f"{verdict.word}: {r}" for r in verdict.reasons]
        write_viewer(folder / "map.html", topo, title, notes=said[:1])
    else:
        (folder / "map.html").unlink(missing_ok=True)
