"""`topograph map`."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import Any

import click

from topograph.cli.common import (
    TRUTH,
    check_accepted,
    check_target,
    config_of,
    hashed,
    input_options,
    jobs_option,
    main,
    progress_bar,
    results_folder,
    say_if_cold,
    span_options,
    truth_of,
)
from topograph.cli.results import save_results, save_thesis, say_verdict
from topograph.errors import MapError, UsageError


@main.command("map")
@click.argument("bags", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option("-o", "--output", type=click.Path(path_type=Path), help="The map file (.gpkg).")
@click.option("--force", is_flag=True, help="Replace the map file of -o if it is there.")
@click.option("--method", type=click.Choice(["graph", "thesis"]), default="graph", show_default=True,
              help="graph: the factor graph; thesis: Algorithm 3 with filtered poses, to compare with.")  # fmt: skip
@click.option("--into", type=click.Path(path_type=Path), help="Extend this map by the run; the file is replaced whole.")
@click.option(
    "--accept",
    multiple=True,
    metavar="NAME",
    help="Save the map though the audit refuses it for NAME; repeat for more.",
)
@click.option("--results", type=click.Path(path_type=Path), help="Folder for path, report and configuration.")
@click.option("--truth", multiple=True, type=click.Path(path_type=Path), help=TRUTH)
@click.option("--check-fixes", type=click.IntRange(0), default=0, metavar="N",
              help="Withhold every N-th fix from the estimator and report the path's distance from it (1: withhold all).")  # fmt: skip
@span_options
@jobs_option
@click.option("-q", "--quiet", is_flag=True, help="No progress.")
@input_options
def map_command(
    bags: tuple[Path, ...], output: Path | None, force: bool, method: str, into: Path | None, accept: tuple[str, ...], results: Path | None,
    truth: tuple[Path, ...], check_fixes: int, from_s: float, to_s: float, jobs: int, quiet: bool, config_file: Path | None,
    **words: Any,
) -> None:  # fmt: skip
    """Make a map of the trees in BAGS (one run)."""
    from topograph import pipeline, store

    if output is not None and into is not None:
        raise UsageError("-o makes a new map, --into extends one: give one of them")
    if method == "thesis" and into is not None:
        raise UsageError("--method thesis makes a new map: it cannot extend one")
    check_accepted(accept)
    if not 0.0 <= from_s < to_s:
        raise UsageError(f"--from {from_s} --to {to_s}: nothing lies between")
    say_if_cold(quiet)
    config = config_of(config_file, words)
    true = truth_of(truth)
    with ExitStack() as stack:
        folder = stack.enter_context(results_folder(results))
        target = into or output or folder / "map.gpkg"
        check_target(target)
        if results is not None and target == folder / "map.gpkg" and target.exists() and not force:
            raise UsageError(
                f"{target}: is there already, of an earlier run; --force replaces it, or give another --results"
            )
        if output is not None and output.exists() and not force:
            raise UsageError(f"{output}: is there already; --force replaces it, --into {output} extends it")
        if into is not None and not into.exists():
            raise MapError(f"{into}: no such map")
        stack.enter_context(store.locked(target))
        old = None if into is None else store.load(into)
        inputs = stack.enter_context(hashed(bags, whole=to_s == float("inf")))
        with progress_bar(quiet) as progress:
            run = pipeline.read_run(bags, config, progress, (from_s, to_s), jobs)
            if method == "thesis":
                topo = save_thesis(run, config, inputs(), folder, target, true, check_fixes)
                trees = f"{target}: {len(topo)} trees by the thesis's method, {len(topo.edges)} edges, {len(topo.viewpoints)} viewpoints"
                for note in run.notes:
                    click.echo(f"note: {note}", err=True)
                click.echo(f"{trees}; report: {folder / 'report.json'}")
                return
            placed = None
            if old is not None:
                pipeline.refuse_twice(old, run)
                if pipeline.has_no_common_gnss(old, run):
                    placed = pipeline.place(old, run, config, progress)
            solved = pipeline.solve_run(
                run, config, check_fixes=check_fixes, known=old, placed=placed, progress=progress
            )
            topo, verdict = save_results(
                solved, config, inputs, bags, folder, target, true, old, progress, accept, (from_s, to_s)
            )
    say_verdict(solved, topo, verdict, folder, target, run.notes)
