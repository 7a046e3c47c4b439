"""`topograph localize`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import click
import numpy as np

from topograph import __version__
from topograph.cli.common import (
    TRUTH,
    config_of,
    hashed,
    input_options,
    main,
    peak_mb,
    plain_span,
    progress_bar,
    results_folder,
    say_if_cold,
    span_facts,
    span_options,
    table,
    truth_of,
    versions,
)
from topograph.errors import UsageError


@main.command()
@click.argument("map_file", metavar="MAP", type=click.Path(path_type=Path))
@click.argument("bags", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option("--method", type=click.Choice(["graph", "thesis", "both"]), default="graph", show_default=True,
              help="graph: submap, evidence, track; thesis: Algorithms 4-6, to compare with; both: side by side.")  # fmt: skip
@click.option(
    "--risk", type=click.FloatRange(1e-9, 0.5), default=None, help="Chance of a wrong pose that is accepted (1e-4)."
)
@click.option("--measure", type=click.Choice(["both", "ranges", "bearings"]), default=None,
              help="What the graph takes of a trunk while tracking: bearing and range (both), or one of them; the thesis has ranges.")  # fmt: skip
@span_options
@click.option("--results", type=click.Path(path_type=Path), help="Folder for poses, table, report and configuration.")
@click.option("--truth", multiple=True, type=click.Path(path_type=Path), help=TRUTH)
@click.option("-q", "--quiet", is_flag=True, help="No progress.")
@input_options
def localize(
    map_file: Path, bags: tuple[Path, ...], method: str, risk: float | None, measure: str | None, from_s: float, to_s: float, results: Path | None,
    truth: tuple[Path, ...], quiet: bool, config_file: Path | None, **words: Any,
) -> None:  # fmt: skip
    """Find the robot of BAGS (one run) in MAP, from anywhere, without GNSS; no pose is given where it is not sure."""
    from topograph import pipeline, store
    from topograph.config import dump
    from topograph.evaluate import world_in_map, write_tum
    from topograph.evaluate.localization import localization_errors, localization_metrics, path_errors
    from topograph.evaluate.metrics import Metric
    from topograph.exchange import write_wide_tum
    from topograph.geometry import interpolate, tangent_cov
    from topograph.report import Page, localization_error_figure, localization_figure, write_json
    from topograph.report.viewer import localization_data, write_viewer
    from topograph.whole import write_text

    if not 0.0 <= from_s < to_s:
        raise UsageError(f"--from {from_s} --to {to_s}: nothing lies between")
    if map_file.suffix != ".gpkg" and any(b.suffix == ".gpkg" for b in bags):
        raise UsageError(f"{map_file}: the map comes first: topograph localize MAP.gpkg {map_file} ...")
    config = config_of(config_file, words)
    if risk is not None:
        config = replace(config, localize=replace(config.localize, risk=risk))
    if measure is not None:
        config = replace(config, localize=replace(config.localize, measure=measure))
    say_if_cold(quiet)
    true = truth_of(truth)
    topo = store.load(map_file, clouds=method != "graph")
    world = None if true is None else world_in_map(topo, true)
    with results_folder(results) as folder, hashed((map_file, *bags)) as hashes:
        with progress_bar(quiet) as progress:
            first = "thesis" if method == "thesis" else "graph"
            run = pipeline.localize_bags(topo, bags, config, first, progress, (from_s, to_s))
            other = None
            if method == "both":
                other = pipeline.localize_bags(topo, bags, config, "thesis", progress, (from_s, to_s))
        errors = None if true is None or world is None else localization_errors(run.reports, true, world)
        metrics = localization_metrics(run.reports, run.distance, run.update_ms, errors)
        if true is not None and world is not None:
            off = path_errors(*run.smoothed, true, world)
            metrics += [Metric("smoothed: position error mean", float(off.mean()), "m", "lower")] if len(off) else []
        by_method = {} if errors is None else {first: errors}
        if other is not None:
            theirs = None if true is None or world is None else localization_errors(other.reports, true, world)
            by_method |= {} if theirs is None else {"thesis": theirs}
            found = localization_metrics(other.reports, other.distance, other.update_ms, theirs)
            metrics += [replace(m, name=f"thesis: {m.name}") for m in found]
            run.exploded = other.exploded
        fixes = run.fixes
        poses = np.array([f.map_T_robot for f in fixes]).reshape(-1, 4, 4)
        stamps = np.array([f.stamp_ns for f in fixes], np.int64)
        write_tum(folder / "localization.tum", stamps, poses)
        if len(fixes) and all(np.isfinite(f.cov).all() for f in fixes):
            cov = tangent_cov(poses, np.array([f.cov for f in fixes]))
            write_wide_tum(folder / "localization_wide.tum", stamps, poses, cov)
        write_tum(folder / "smoothed.tum", *run.smoothed)
        write_text(folder / "localization.csv", _csv(run.reports))
        write_text(folder / "hypotheses.csv", _hypotheses(run.reports))
        text = dump(config)
        write_text(folder / "config.yaml", text)
        figures = {"Localization": localization_figure(topo, run.reports)}
        if any(len(e.stamps_ns) for e in by_method.values()):
            figures["Errors"] = localization_error_figure(by_method)
            (folder / "errors.png").write_bytes(figures["Errors"])
        (folder / "localization.png").write_bytes(figures["Localization"])
        inputs = hashes()
        said = verdict(run.reports, run.distance)
        word, _, rest = said.partition(" ")
        word = word.rstrip(":")
        notes = [*run.notes, said]
        if topo.meta.get("verdict", "sound") not in ("sound", "not audited", ""):
            why = topo.meta.get("why", "")
            notes.append(f"the map that it is localized in is {topo.meta['verdict']}" + (f": {why}" if why else ""))
        if run.exploded:
            notes.append(f"{run.exploded} scans had more combinations than thesis.combinations and measured nothing")
        write_json(
            folder / "report.json", metrics, run.skipped, inputs, run.seconds, peak_mb(), notes=notes, versions=versions(),
            topics=run.chosen, span_s=plain_span((from_s, to_s)), method=method, verdict={"word": word, "sentence": said},
        )  # fmt: skip
        facts = {
            "map": map_file.name,
            "method": method,
            "measure": config.localize.measure,
            "recorded": f"{run.duration_s:.0f} s",
            **span_facts((from_s, to_s)),
            "topograph": __version__,
        }
        Page(
            title=f"Localization of {', '.join(p.name for p in bags)}", word=word, sentence=rest, tone=tone(run.reports), facts=facts, metrics=metrics,
            figures=figures, notes=[n for n in notes if n is not said], skipped=run.skipped,
            walk=("replay.html", "Replay it on the map"), files=("report.json", "localization.csv", "localization.tum", "config.yaml"),
        ).write(folder / "report.html")  # fmt: skip
        true_xy = None
        if true is not None and world is not None and len(true.stamps_ns):
            stamps = np.array([r.stamp_ns for r in run.reports], np.int64)
            true_xy = world.points(interpolate(true.stamps_ns, true.world_T_robot, stamps)[:, :3, 3])[:, :2]
        replay = localization_data(folder, topo, true_xy, None if true_xy is None else _off(run.reports, true_xy))
        write_viewer(
            folder / "replay.html",
            topo,
            f"Localization of {', '.join(p.name for p in bags)}",
            notes=[said],
            localization=replay,
        )
    for note in run.notes:
        click.echo(f"note: {note}", err=True)
    table(metrics)
    click.echo(f"{said}; report: {folder / 'report.html'}, to replay: {folder / 'replay.html'}")
    if not fixes:
        raise SystemExit(4)


def _off(reports: Sequence[Any], true_xy: Any) -> Any:
    """Distances (S,) of the poses from the truth, NaN without a pose, m."""
    found = np.array([r.fix.map_T_robot[:2, 3] if r.fix is not None else (np.nan, np.nan) for r in reports])
    return np.hypot(*(found - true_xy).T)


MOST_PLACES = 50
"""Hypotheses of a scan that are written, the most probable first."""


def _hypotheses(reports: Sequence[Any]) -> str:
    """One row per place that a scan leaves, while there is no pose."""
    lines = ["stamp,x,y,yaw,weight"]
    for r in reports:
        if r.fix is not None:
            continue
        stamp = f"{r.stamp_ns // 10**9}.{r.stamp_ns % 10**9:09d}"
        n = min(len(r.places), MOST_PLACES)
        weights = r.weights[:n] if len(r.weights) >= n else np.full(n, 1.0 / max(len(r.places), 1))
        lines += [
            f"{stamp},{x:.3f},{y:.3f},{yaw:.4f},{w:.5f}" for (x, y, yaw), w in zip(r.places[:n], weights, strict=True)
        ]
    return "\n".join(lines) + "\n"


def verdict(reports: Sequence[Any], distance: Sequence[float]) -> str:
    """One line: found after how far, or unknown and why."""
    committed = [i for i, r in enumerate(reports) if r.fix is not None]
    if committed:
        after = reports[committed[0] :]
        share, tracked = len(committed) / len(after), tracking_share(after)
        widest = max(max(r.along, r.across) for r in after if r.fix is not None)
        parts = [
            f"found after {distance[committed[0]]:.1f} m",
            f"a pose for {100 * share:.1f} % of the scans from then on",
            *(
                []
                if share - tracked < 0.005
                else [f"{100 * (share - tracked):.0f} % of them by wheels and gyro alone (degraded)"]
            ),
            *([] if not widest > WIDE_M else [f"known to {widest:.1f} m (1 σ) at worst"]),
            *([] if reports[-1].fix is not None else [f"{reports[-1].state} at the end"]),
        ]
        return "; ".join(parts)
    last = reports[-1]
    left = (
        f" ({last.hypotheses} are left, up to {last.apart:.0f} m apart)"
        if last.state == "ambiguous" and last.hypotheses > 1
        else ""
    )
    return f"unknown: {last.why or 'no place was found'}{left}"


WIDE_M = 0.5
"""Deviation that is worth a word."""
MOSTLY = 0.9


def tracking_share(reports: Sequence[Any]) -> float:
    """Of scans in which the trees held the pose."""
    return sum(bool(r.state == "tracking") for r in reports) / len(reports)


def tone(reports: Sequence[Any]) -> str:
    """Good where the robot was tracked by the trees nearly all of the time after it was found, and at the end."""
    committed = [i for i, r in enumerate(reports) if r.fix is not None]
    if not committed:
        return "bad"
    after = reports[committed[0] :]
    return "good" if tracking_share(after) >= MOSTLY and reports[-1].fix is not None else "fair"


def _csv(reports: Sequence[Any]) -> str:
    """One row per scan; the pose is empty while there is none."""
    from topograph.geometry import to_quaternion

    lines = ["stamp,state,x,y,z,qx,qy,qz,qw,hypotheses,risk,trees,tree_ids,apart,sigma_along,sigma_across"]
    for r in reports:
        stamp = f"{r.stamp_ns // 10**9}.{r.stamp_ns % 10**9:09d}"
        pose = [""] * 7
        if r.fix is not None:
            T = r.fix.map_T_robot
            pose = [f"{v:.6f}" for v in (*T[:3, 3], *to_quaternion(T))]
        rest = [f"{v:.4f}" if np.isfinite(v) else "" for v in (r.apart, r.along, r.across)]
        risk = f"{r.risk:.3e}" if np.isfinite(r.risk) else ""
        ids = " ".join(map(str, r.trees.tolist()))
        lines.append(",".join([stamp, r.state, *pose, str(r.hypotheses), risk, str(len(r.trees)), ids, *rest]))
    return "\n".join(lines) + "\n"
