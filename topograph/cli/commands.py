"""`topograph detect`, `simulate`, `demo`, `repair`, `export` and `config`."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import click
import numpy as np

from topograph.cli.common import (
    TRUTH,
    check_output,
    config_of,
    hashed,
    input_options,
    jobs_option,
    main,
    peak_mb,
    progress_bar,
    table,
    truth_of,
)
from topograph.cli.results import save_results
from topograph.errors import InputError, MapError, UsageError


@main.command()
@click.argument("bags", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option("--csv", "csv_file", type=click.Path(path_type=Path), help="One row per trunk and scan.")
@click.option("--picture", type=click.Path(path_type=Path), help="PNG of a scan with its trunks.")
@click.option(
    "--at",
    "at_s",
    type=float,
    default=None,
    help="Seconds into the run of the scan that is drawn (default: the middle).",
)
@click.option("--truth", multiple=True, type=click.Path(path_type=Path), help=TRUTH)
@click.option("--results", type=click.Path(path_type=Path), help="Folder for report.json.")
@jobs_option
@click.option("-q", "--quiet", is_flag=True, help="No progress.")
@input_options
def detect(
    bags: tuple[Path, ...], csv_file: Path | None, picture: Path | None, at_s: float | None, truth: tuple[Path, ...],
    results: Path | None, jobs: int, quiet: bool, config_file: Path | None, **words: Any,
) -> None:  # fmt: skip
    """Find trunks in the scans of BAGS: counts, rate, a table by range, a picture."""
    from topograph import pipeline, report
    from topograph.evaluate import Metric, trunk_metrics
    from topograph.geometry import inverse, transform
    from topograph.whole import write_text

    config = config_of(config_file, words)
    true = truth_of(truth)
    check_output(csv_file, bags, (".csv",))
    check_output(picture, bags, (".png",))
    if true is not None and (not len(true.returns) or not len(true.trees)):
        raise UsageError(
            "detect --truth needs a simulator's folder: it says how many returns each sweep had of each trunk"
        )
    with ExitStack() as stack:
        hashes = stack.enter_context(hashed(bags if results is not None else ()))
        progress = stack.enter_context(progress_bar(quiet))
        run = pipeline.read_run(bags, config, progress, jobs=jobs)
        inputs = hashes()
    for note in run.notes:
        click.echo(f"note: {note}", err=True)
    if run.scans == 0:
        raise InputError("no point cloud and no trunk detections; name a topic with --topic-points or --topic-trunks")
    # What a single scan doubts is for the map to decide; here it would only be a false trunk.
    trunks = [t.select(t.score >= 0) for t in run.trunks.in_order()]
    n = sum(map(len, trunks))
    click.echo(
        f"{run.scans} scans, {n} trunks ({n / run.scans:.1f} a scan), {run.seconds:.1f} s, {run.duration_s / run.seconds:.1f} × real time"
    )
    metrics = [
        Metric("scans", run.scans),
        Metric("trunks", n),
        Metric("real-time factor", run.duration_s / run.seconds, "", "higher"),
    ]
    reach = np.concatenate([np.hypot(t.p[:, 0], t.p[:, 1]) for t in trunks])
    if true is None:
        for low, high in ((0, 5), (5, 10), (10, 20), (20, 30)):
            click.echo(f"  {low:>2}-{high:<2} m {int(((reach >= low) & (reach < high)).sum()):>8}")
    else:
        found, table = trunk_metrics(true, np.array([t.stamp_ns for t in trunks]), [t.p for t in trunks])
        metrics += found
        click.echo("  range     visible   found  precision  recall  radial bias ± sd   across sd")
        for r in table:
            click.echo(
                f"  {r['from']:>2.0f}-{r['to']:<2.0f} m {r['visible']:>9.0f} {r['found']:>7.0f} {r['precision']:>10.3f} "
                f"{r['recall']:>7.3f} {100 * r['radial_bias']:>8.1f} ± {100 * r['radial_sd']:.1f} cm {100 * r['tangential_sd']:>7.1f} cm"
            )
    if csv_file is not None:
        lines = ["stamp,x,y,z,height,diameter,score"]
        for t in trunks:
            stamp = f"{t.stamp_ns // 10**9}.{t.stamp_ns % 10**9:09d}"
            lines += [
                f"{stamp},{p[0]:.4f},{p[1]:.4f},{p[2]:.4f},{h:.3f},{d:.4f},{s:.3f}"
                for p, h, d, s in zip(t.p, t.height, t.diameter, t.score, strict=True)
            ]
        write_text(csv_file, "\n".join(lines) + "\n")
    if picture is not None:
        at = trunks[0].stamp_ns + int(1e9 * (0.5 * run.duration_s if at_s is None else at_s))
        scan, mount = pipeline.scan_near(bags, config, at)
        shown = min(trunks, key=lambda t: abs(t.stamp_ns - scan.stamp_ns))
        feet = None
        if true is not None:
            from topograph.geometry import interpolate

            feet = transform(inverse(interpolate(true.stamps_ns, true.world_T_robot, [scan.stamp_ns])[0]), true.trees)[
                :, :2
            ]
        picture.write_bytes(report.scan_figure(scan, mount, shown, feet))
    if results is not None:
        results.mkdir(parents=True, exist_ok=True)
        report.write_json(
            results / "report.json",
            metrics,
            run.skipped,
            inputs,
            {"read": run.seconds},
            peak_mb(),
            notes=run.notes,
        )


def _designs(_context: click.Context, _option: click.Parameter, begun: str) -> list[str]:
    """For completion: loaded when it is asked for."""
    from topograph.simulate import DESIGNS

    return [name for name in DESIGNS if name.startswith(begun)]


@main.command()
@click.argument("output", type=click.Path(path_type=Path))
@click.option(
    "--design",
    default="grid",
    show_default=True,
    shell_complete=_designs,
    help="grid, olive, steep, gentle, hedgerow, young, trellis, old_olive, bare, forest or yard.",
)
@click.option("--seed", type=click.IntRange(0), default=1, show_default=True)
@click.option("--run", "number", type=click.IntRange(1, 3), default=1, show_default=True,
              help="1: rows downhill and back; 2: the other way; 3: zigzag (thesis 5.3).")  # fmt: skip
@click.option("--gnss", type=click.Choice(["rtk", "float", "degraded", "none"]), default="rtk", show_default=True)
@click.option("--rings", type=click.Choice(["16", "32", "64", "128"]), default="16", show_default=True)
@click.option("--sweep-hz", type=click.FloatRange(0.1, 50.0), default=10.0, show_default=True)
@click.option(
    "--stop-every", type=click.FloatRange(0.0), default=0.0, help="Stop and go, as in the thesis: metres between stops."
)
@click.option(
    "--scans-at-stops", is_flag=True, help="Clouds only while the robot stands, two a second (with --stop-every)."
)
@click.option("--longest", type=click.FloatRange(1.0), default=3600.0, help="Cut the drive after so many seconds.")
@click.option("--laps", type=click.IntRange(1), default=1)
@click.option("--compression", type=click.Choice(["none", "lz4", "zstd"]), default="none")
@click.option("--detections", is_flag=True, help="Write trunk detections in place of clouds (fast).")
@click.option("-q", "--quiet", is_flag=True, help="No progress.")
def simulate(
    output: Path, design: str, seed: int, number: int, gnss: str, rings: str, sweep_hz: float, stop_every: float,
    scans_at_stops: bool, longest: float, laps: int, compression: str, detections: bool, quiet: bool,
) -> None:  # fmt: skip
    """Write a simulated run to OUTPUT (.bag: ROS 1; otherwise a ROS 2 folder with mcap), truth in <OUTPUT>.truth."""
    from topograph.simulate import DESIGNS, DriveConfig, SensorConfig, record

    if design not in DESIGNS:
        raise UsageError(f"--design {design}: known are {', '.join(DESIGNS)}")
    if scans_at_stops and stop_every <= 0:
        raise UsageError("--scans-at-stops needs --stop-every METRES")
    if (compression == "lz4" and output.suffix != ".bag") or (compression == "zstd" and output.suffix == ".bag"):
        raise UsageError(f"--compression {compression}: lz4 is for .bag, zstd for mcap")
    sensor = SensorConfig(
        gnss=gnss, rings=int(rings), sweep_hz=sweep_hz, detections=detections, compression=compression
    )
    drive = DriveConfig(run=number, stop_every=stop_every, scans_at_stops=scans_at_stops, longest_s=longest, laps=laps)
    with progress_bar(quiet) as progress:
        truth = record(output, seed, design, drive, sensor, progress=lambda share: progress("simulate", share))
    span = (truth.stamps_ns[-1] - truth.stamps_ns[0]) * 1e-9
    click.echo(f"{output}: {span:.0f} s, {len(truth.trees)} trees; truth in {output.with_name(output.stem + '.truth')}")


@main.command()
@click.argument("folder", type=click.Path(path_type=Path), default=Path("demo"))
@click.option("--seed", type=int, default=7, show_default=True)
@click.option("-q", "--quiet", is_flag=True, help="No progress.")
@click.pass_context
def demo(context: click.Context, folder: Path, seed: int, quiet: bool) -> None:
    """Simulate an orchard, map it, localize a later run in it, and write pages to look at, in FOLDER."""
    import shutil

    from topograph import pipeline
    from topograph.cli.localizing import localize
    from topograph.config import Config
    from topograph.evaluate import map_metrics
    from topograph.simulate import DriveConfig, SensorConfig, record

    bag, later = folder / "run1.bag", folder / "run3.bag"
    folder.mkdir(parents=True, exist_ok=True)
    for old in (bag, folder / "run1.truth", later, folder / "run3.truth"):
        shutil.rmtree(old) if old.is_dir() else old.unlink(missing_ok=True)
    with progress_bar(quiet) as progress:
        truth = record(
            bag, seed, "olive", DriveConfig(run=1), SensorConfig(sweep_hz=5.0),
            progress=lambda share: progress("simulate", share),
        )  # fmt: skip
        config = Config()
        with hashed([bag]) as inputs:
            run = pipeline.read_run([bag], config, progress)
            solved = pipeline.solve_run(run, config, progress=progress)
            topo, _ = save_results(
                solved, config, inputs, [bag], folder, folder / "orchard.gpkg", truth, None, progress
            )
        record(
            later, seed, "olive", DriveConfig(run=3, longest_s=30.0), SensorConfig(sweep_hz=5.0, gnss="none"),
            progress=lambda share: progress("simulate a later run, without GNSS", share),
        )  # fmt: skip
    table(map_metrics(topo, truth))
    click.echo("the later run, localized in this map:")
    context.invoke(
        localize, map_file=folder / "orchard.gpkg", bags=(later,), results=folder / "localization",
        truth=(folder / "run3.truth",), quiet=quiet,
    )  # fmt: skip
    click.echo(f"look at {folder / 'report.html'} (browser), {folder / 'orchard.gpkg'} (QGIS), {folder / 'map.png'}")


@main.command()
@click.argument("map_file", type=click.Path(path_type=Path))
@click.argument("output", type=click.Path(path_type=Path))
def repair(map_file: Path, output: Path) -> None:
    """Take over what MAP_FILE says, though its digests do not fit, into the new map OUTPUT; says what was lost."""
    from topograph import store

    if output.suffix != ".gpkg":
        raise UsageError(f"{output}: a map is a GeoPackage; end its name in .gpkg")
    if output.exists():
        raise UsageError(f"{output}: is there already; a repaired map is a new one")
    lost = ""
    try:
        topo = store.load(map_file, check=False)
    except MapError as err:
        topo = store.load(map_file, check=False, clouds=False)
        lost = f"; all clouds were left out ({err})"
    with store.locked(output):
        store.save(replace(topo, meta={**topo.meta, "verdict": "repaired"}), output)
    click.echo(
        f"{output}: {len(topo)} trees, {len(topo.edges)} edges, {len(topo.viewpoints)} clouds{lost}; nobody can say which of them are damaged: look at them"
    )


@main.command()
@click.argument("map_file", type=click.Path(path_type=Path))
@click.argument("output", type=click.Path(path_type=Path))
@click.option(
    "--localization", type=click.Path(path_type=Path), help="Results folder of `localize`, to replay in .mcap or .bag."
)
@click.option("--force", is_flag=True, help="Replace OUTPUT if it is there.")
def export(map_file: Path, output: Path, localization: Path | None, force: bool) -> None:
    """Write MAP_FILE in the format that OUTPUT's suffix names.

    \b
    .geojson .csv .kml .parquet   trees
    .graphml                      the graph
    .tum                          the path
    .ply .pcd .las .laz           clouds
    .mcap .bag                    markers, path, clouds for Foxglove and RViz
    .rrd                          the same for Rerun
    """
    from topograph import store
    from topograph.exchange import WRITERS, read_localization, write

    if output.resolve() == map_file.resolve():
        raise UsageError(f"{output}: is an input; nothing is written over it")
    if output.suffix not in WRITERS:
        raise UsageError(f"{output}: end the name in one of {', '.join(WRITERS)}")
    if output.exists() and not force:
        raise UsageError(f"{output}: is there already; --force replaces it")
    if not output.parent.is_dir():
        raise UsageError(f"{output}: there is no folder {output.parent}")
    run = None if localization is None else read_localization(localization)
    write(store.load(map_file, clouds=WRITERS[output.suffix][2]), output, run)
    click.echo(f"written: {output}")


@main.command("config")
@click.option(
    "-c",
    "--config",
    "config_file",
    type=click.Path(path_type=Path),
    help="Check this file (or `thesis`, `thesis_best`) and fill in the rest.",
)
@click.option("--bare", is_flag=True, help="Without what the settings mean.")
def config_command(config_file: Path | None, bare: bool) -> None:
    """Print the whole configuration as YAML, each setting with its meaning and unit."""
    from topograph.config import dump, explained, load

    click.echo((dump if bare else explained)(load(config_file)), nl=False)
