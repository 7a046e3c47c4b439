"""`topograph compare`."""

from __future__ import annotations

import importlib.util
import json
import os
import re
import time
from pathlib import Path
from typing import Any

import click

from topograph import __version__
from topograph.cli.common import (
    config_of,
    hashed,
    input_options,
    main,
    progress_bar,
    results_folder,
    say_if_cold,
    truth_of,
    versions,
)
from topograph.errors import InputError, UsageError


@main.command()
@click.argument("runs", nargs=-1, type=click.Path(path_type=Path))
@click.option("--truth", "truths", multiple=True, metavar="TRUTH",
              help="A simulator's folder, a .tum path, trees as .csv or .geojson, or `fixes` (each run's own GNSS, filtered, as the thesis had "
                   "it), or `fixes/N` (every N-th fix alone, which no map is then made with). Once for all runs, or once for each, in order; A+B lays two together.")  # fmt: skip
@click.option(
    "--starts", type=click.IntRange(0), default=16, show_default=True, help="Starts along the first run (Fig. 5.14)."
)
@click.option("--image", type=click.Path(path_type=Path),
              help="A GeoTIFF (orthophoto, satellite) that is drawn under the maps (needs rasterio: topograph[exchange]).")  # fmt: skip
@click.option("--ablations", is_flag=True, help="Also leave each part out in turn.")
@click.option("--rival", "rivals", multiple=True, type=click.Path(path_type=Path),
              help="A Python file with `method(topo, config)`, a localizer with `step(trunks, leg) -> Report`; it joins table B.")  # fmt: skip
@click.option(
    "--suite",
    is_flag=True,
    help="Instead of RUNS, simulated ones: designs x seeds x GNSS x driving. Goes on where it was stopped (give --results).",
)
@click.option("--designs", default="grid,olive,steep", show_default=True, help="Of --suite.")
@click.option("--seeds", default="3001-3003", show_default=True, help="Of --suite: FIRST-LAST.")
@click.option("--gnss", default="rtk", show_default=True, help="Of --suite: rtk, float, none; several with commas.")
@click.option(
    "--driving", default="driving", show_default=True, help="Of --suite: driving, stops; several with commas."
)
@click.option(
    "--longest", type=click.FloatRange(10.0), default=75.0, show_default=True, help="Of --suite: seconds of a run."
)
@click.option(
    "--detections", is_flag=True, help="Of --suite: trunk detections in place of clouds (fast; one front end)."
)
@click.option(
    "--jobs", type=click.IntRange(1), default=os.cpu_count() or 1, show_default=True, help="Of --suite: processes."
)
@click.option("--results", type=click.Path(path_type=Path), help="Folder for page, figures and metrics.json.")
@click.option("-q", "--quiet", is_flag=True, help="No progress.")
@input_options
def compare(
    runs: tuple[Path, ...], truths: tuple[str, ...], starts: int, image: Path | None, ablations: bool, rivals: tuple[Path, ...], suite: bool,
    designs: str, seeds: str, gnss: str, driving: str, longest: float, detections: bool, jobs: int, results: Path | None, quiet: bool, config_file: Path | None, **words: Any,
) -> None:  # fmt: skip
    """Both methods on RUNS: map the first, localize all. Chapter 5's tables and figures, three questions, one page.

    A: the same detections, another estimator. B: the same map and trunks, another localizer. C: whole chain against whole chain.
    """
    from topograph.pipeline.comparing import compare_runs
    from topograph.report.comparison import write_comparison

    if suite == bool(runs):
        raise UsageError("give recordings to compare on, or --suite")
    config = config_of(config_file, words)
    if suite and (truths or rivals or ablations or image):
        raise UsageError("--suite simulates its own truth, and takes neither --truth, --rival, --image nor --ablations")
    if suite:
        _suite(config, (designs, seeds, gnss, driving), longest, detections, starts, jobs, results, quiet)
        return
    for p in (*runs, *([] if image is None else [image])):
        if not p.exists():
            raise InputError(f"{p}: no such file")
    by_fixes = _by_fixes(truths)
    true = [None] * len(runs) if by_fixes else _truths(truths, len(runs))
    methods = {f"rival {p.stem}": _method_of(p) for p in rivals}
    if len(methods) < len(rivals):
        raise UsageError("two rivals of the same name: rename one of the files")
    say_if_cold(quiet)
    began = time.perf_counter()
    with results_folder(results) as folder, hashed(runs) as hashes:
        with progress_bar(quiet) as progress:
            c = compare_runs(
                list(runs), true, config, starts=starts, ablations=ablations, by_fixes=by_fixes, image=image, rivals=methods, progress=progress
            )  # fmt: skip
            progress("page", 0.0)
            facts = {"runs": ", ".join(c.runs), "truth": ", ".join(truths) or "none", "topograph": __version__}
            pictures = write_comparison(folder / "report.html", c, facts)
            progress("page", 1.0)
        for caption, png in pictures.items():
            (folder / f"{_slug(caption)}.png").write_bytes(png)
        _keep(folder, c, config, inputs=hashes())
    _say(c)
    click.echo(f"{time.perf_counter() - began:.0f} s; page: {folder / 'report.html'}")


def _suite(
    config: Any, words: tuple[str, str, str, str], longest: float, detections: bool, starts: int, workers: int, results: Path | None, quiet: bool
) -> None:  # fmt: skip
    from itertools import product

    from topograph.pipeline.suite import Job, run_suite
    from topograph.report.comparison import write_comparison
    from topograph.simulate import DESIGNS

    designs, seeds, gnss, driving = words
    for word, known in (
        (designs, tuple(DESIGNS)),
        (gnss, ("rtk", "float", "degraded", "none")),
        (driving, ("driving", "stops")),
    ):
        for w in word.split(","):
            if w not in known:
                raise UsageError(f"{w}: known are {', '.join(known)}")
    first, _, last = seeds.partition("-")
    if not first.isdigit() or not (last or first).isdigit():
        raise UsageError(f"--seeds {seeds}: give FIRST-LAST")
    jobs = [
        Job(design=d, seed=s, gnss=g, driving=w, longest_s=longest, runs=3, starts=starts, detections=detections)
        for d, s, g, w in product(
            designs.split(","), range(int(first), int(last or first) + 1), gnss.split(","), driving.split(",")
        )
    ]
    began = time.perf_counter()
    with results_folder(results) as folder:
        with progress_bar(quiet) as progress:
            c = run_suite(jobs, folder / "jobs", config, workers, progress)
        facts = {
            "orchards": str(len(jobs)),
            "designs": designs,
            "seeds": seeds,
            "GNSS": gnss,
            "driving": driving,
            "topograph": __version__,
        }
        write_comparison(folder / "report.html", c, facts)
        _keep(folder, c, config)
    _say(c)
    click.echo(f"{time.perf_counter() - began:.0f} s; page: {folder / 'report.html'}")


def _keep(folder: Path, c: Any, config: Any, **more: Any) -> None:
    """The configuration and `metrics.json` beside the page."""
    from topograph.config import dump
    from topograph.report.comparison import records
    from topograph.whole import write_text

    write_text(folder / "config.yaml", dump(config))
    record = {"metrics": records(c), "notes": c.notes, **more, "versions": versions()}
    write_text(folder / "metrics.json", json.dumps(record, indent=1, allow_nan=False) + "\n")


def _by_fixes(words: tuple[str, ...]) -> int:
    """0: the truth is something else; 1: all fixes; N: every N-th."""
    if len(words) != 1 or not re.fullmatch(r"fixes(/[0-9]{1,6})?", words[0]):
        return 0
    n = int(words[0].partition("/")[2] or 1)
    if n < 1 + ("/" in words[0]):
        raise UsageError(f"--truth {words[0]}: give fixes, or fixes/N with N from 2 on")
    return n


def _truths(words: tuple[str, ...], n: int) -> list[Any]:
    if any(re.fullmatch(r"fixes(/.*)?", part) and not Path(part).exists() for w in words for part in w.split("+")):
        raise UsageError("--truth fixes is for all runs: give it alone")
    found = [truth_of([Path(p) for p in w.split("+")]) for w in words]
    if not found:
        return [None] * n
    if len(found) == 1:
        return found * n
    if len(found) != n:
        raise UsageError(f"{len(found)} truths for {n} runs: give one for all, or one for each, in order")
    return found


def _method_of(path: Path) -> Any:
    """`method` of a Python file that the user names."""
    spec = importlib.util.spec_from_file_location(path.stem, path)
    if spec is None or spec.loader is None or not path.is_file():
        raise UsageError(f"{path}: not a Python file")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    if not hasattr(module, "method"):
        raise UsageError(f"{path}: has no `method(topo, config)`")
    return module.method


def _slug(caption: str) -> str:
    return "_".join("".join(ch if ch.isalnum() or ch == "." else " " for ch in caption.lower()).split())


def _say(c: Any) -> None:
    """The three tables in short."""
    from topograph.report.comparison import tables

    for t in tables(c):
        if not t.title.startswith(("A:", "B:", "C:", "Conv", "Ours")):
            continue
        click.echo(f"\n{t.title}")
        wide = max(len(r.name) for r in t.rows)
        keep = [k for k, col in enumerate(t.columns) if col in SHORT]
        click.echo(f"{'':<{wide}}  " + "  ".join(f"{SHORT[t.columns[k]]:>12}" for k in keep))
        for r in t.rows:
            click.echo(f"{r.name:<{wide}}  " + "  ".join(f"{r.cells[k].text:>12}" for k in keep))
    for n in c.notes:
        click.echo(f"note: {n}", err=True)


SHORT = {
    "nodes": "nodes",
    "precision (1 m)": "precision",
    "recall (1 m)": "recall",
    "tree error at 0.8 m, mean": "error mean",
    "tree error at 0.8 m, max": "error max",
    "distance to the first pose": "first pose",
    "share with a pose after the first": "share posed",
    "distance error mean": "error mean",
    "distance error max": "error max",
    "share of poses wrong": "share wrong",
    "convergence mean": "mean",
    "convergence sd": "sd",
    "convergence max": "max",
    "starts that ended wrong": "wrong",
    "starts without an end": "no end",
    "ratio": "ratio",
    "95 % from": "95 % from",
    "95 % to": "to",
}
"""Columns that a terminal has room for."""
