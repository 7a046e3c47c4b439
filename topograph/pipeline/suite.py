"""Designs x seeds x GNSS x driving, each simulated, compared and thrown away: what a table over many orchards rests on.

A job leaves one file; what is there already is not done again.
"""

from __future__ import annotations

import hashlib
import json
import tempfile
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from topograph.config import Config, dump
from topograph.errors import TopographError
from topograph.evaluate import Metric, read_truth
from topograph.evaluate.comparison import BEST, OURS, WRITTEN, Comparison, Row
from topograph.evaluate.statistics import paired_ratio
from topograph.mapping import Progress, silent
from topograph.pipeline.comparing import compare_runs
from topograph.simulate import DriveConfig, SensorConfig, record
from topograph.whole import write_text

AT_STOPS_M = 2.0
"""Between two stops, as in the thesis (5.3)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Job:
    """An orchard with its runs; `driving` is "driving" or "stops" (clouds only while the robot stands)."""

    design: str
    seed: int
    gnss: str
    driving: str
    longest_s: float
    runs: int
    starts: int
    detections: bool

    @property
    def name(self) -> str:
        short = "" if not self.detections else "-detections"
        return f"{self.design}-{self.seed}-{self.gnss}-{self.driving}{short}"


def run_suite(
    jobs: Sequence[Job], folder: Path, config: Config, workers: int, progress: Progress = silent
) -> Comparison:
    """Do what is not done yet, over `workers` processes, and lay all jobs together."""
    folder.mkdir(parents=True, exist_ok=True)
    waiting = [j for j in jobs if not _file(folder, j, config).exists()]
    progress("suite", 1.0 - len(waiting) / max(len(jobs), 1))
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        lost: list[str] = []
        futures = [pool.submit(_do, j, folder, config) for j in waiting]
        for n, f in enumerate(as_completed(futures)):
            try:
                f.result()
            except TopographError as err:
                lost.append(str(err))
            progress("suite", 1.0 - (len(waiting) - n - 1) / max(len(jobs), 1))
    out = together([j for j in jobs if _file(folder, j, config).exists()], folder, config)
    out.notes += [f"a job ended with: {why}" for why in lost]
    return out


def _file(folder: Path, job: Job, config: Config) -> Path:
    """What a job leaves; other settings are another job."""
    key = hashlib.sha256(f"{job}\n{dump(config)}".encode()).hexdigest()[:10]
    return folder / f"{job.name}-{key}.json"


def _do(job: Job, folder: Path, config: Config) -> None:
    with tempfile.TemporaryDirectory(dir=folder) as at:
        bags = []
        for k in range(1, job.runs + 1):
            bag = Path(at) / f"run{k}.bag"
            stops = job.driving == "stops"
            drive = DriveConfig(
                run=k, stop_every=AT_STOPS_M if stops else 0.0, scans_at_stops=stops, longest_s=job.longest_s
            )
            record(bag, job.seed, job.design, drive, SensorConfig(gnss=job.gnss, detections=job.detections))
            bags.append(bag)
        truths = [read_truth([b.with_suffix(".truth")]) for b in bags]
        c = compare_runs(bags, truths, config, starts=job.starts)
    rows = [
        {
            "table": r.table,
            "name": r.name,
            "run": r.run,
            "metrics": [[m.name, m.plain, m.unit, m.better] for m in r.metrics],
        }
        for r in c.rows
    ]
    text = json.dumps({"job": job.name, "rows": rows, "notes": c.notes}, allow_nan=False)
    write_text(_file(folder, job, config), text)


def together(jobs: Sequence[Job], folder: Path, config: Config) -> Comparison:
    """One comparison of all jobs; a run is called by its job. Beside the tables of all stand those of each design."""
    out = Comparison(runs=[j.name for j in jobs])
    for job in jobs:
        data = json.loads(_file(folder, job, config).read_text())
        out.notes += [f"{job.name}: {n}" for n in data["notes"] if "not localized" in n or "no map" in n]
        for r in _rows(data["rows"]):
            run = f"{job.name}/{r.run}"
            out.rows.append(Row(r.table, r.name, run, r.metrics))
            if r.table in ("C map", "C", "convergence"):
                out.rows.append(Row(f"{r.table}: {job.design}, {job.gnss}, {job.driving}", r.name, run, r.metrics))
    out.rows += ratios(out.rows)
    return out


def _rows(rows: Sequence[dict[str, Any]]) -> Iterator[Row]:
    for r in rows:
        metrics = [Metric(n, float("nan") if v is None else v, unit, better) for n, v, unit, better in r["metrics"]]
        yield Row(r["table"], r["name"], r["run"], metrics)


def ratios(rows: Sequence[Row]) -> list[Row]:
    """Ours over the thesis's, run by run (paired), with the interval of the ratio of the means."""
    out = []
    for table, metric in (
        ("C map", "tree error at 0.8 m, mean"),
        ("C", "distance error mean"),
        ("convergence", "convergence mean"),
        ("B", "distance error mean"),
    ):
        by: dict[str, dict[str, float]] = {}
        for r in rows:
            if r.table == table and r.name in (OURS, BEST, WRITTEN):
                for m in r.metrics:
                    if m.name == metric:
                        by.setdefault(r.name, {})[r.run] = m.value
        for theirs in (BEST, WRITTEN):
            both = sorted(set(by.get(OURS, {})) & set(by.get(theirs, {})))
            if both:
                ratio, low, high = paired_ratio([by[OURS][b] for b in both], [by[theirs][b] for b in both])
                found = [
                    Metric("ratio", ratio, "", "lower"),
                    Metric("95 % from", low),
                    Metric("95 % to", high),
                    Metric("pairs of runs", len(both)),
                ]
                out.append(Row("ratios", f"{table}, {metric}: graph / {theirs}", "all", found))
    return out
