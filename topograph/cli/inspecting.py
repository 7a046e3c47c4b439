"""The commands that look before anything is computed: at a recording, and at the installation."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import click

from topograph.cli.common import config_of, input_options, main, versions
from topograph.errors import InputError, TopicError


@main.command()
@click.argument("bags", nargs=-1, required=True, type=click.Path(path_type=Path))
@input_options
def inspect(bags: tuple[Path, ...], config_file: Path | None, **words: Any) -> None:
    """Say what BAGS hold and what `map` will make of it: streams, clocks, mountings, GNSS. Exit 3: `map` could not run."""
    from topograph.bags import Recording
    from topograph.pipeline import inspect_bags

    config = config_of(config_file, words)
    try:
        found = inspect_bags(bags, config)
    except TopicError:
        recording = Recording(bags, config.bags)
        try:
            with recording:
                pass
        except TopicError:
            for topic, kind in sorted(recording.types.items()):
                click.echo(f"  {topic:<36} {kind:<44} {recording.counts[topic]:>9}")
        raise
    names = ", ".join(p.name or str(p) for p in bags)
    click.echo(f"{names}: {found.duration_s:.1f} s, {found.messages} messages")
    click.echo(f"  {'':<9} {'topic':<28} {'type':<18} {'count':>7} {'rate':>9} {'longest gap':>18} {'stamp-log':>10}")
    for role in found.roles:
        s = role.stream
        if s is None:
            if role.missing:
                click.echo(f"– {role.kind:<9} {role.missing}")
            continue
        gap, at = s.longest_gap(found.duration_s)
        offset = sorted(s.offset_s)[len(s.offset_s) // 2] if len(s.offset_s) else 0.0
        late = f"{1e3 * offset:+.0f} ms" if abs(offset) < LONG_S else f"{offset / 86400:+.1f} d"
        mark = click.style("!", fg="yellow") if role.problems else click.style("✓", fg="green")
        click.echo(
            f"{mark} {role.kind:<9} {s.topic:<28} {s.msgtype.split('/')[-1]:<18} {len(s.logged_s):>7} {s.rate_hz:>6.1f} Hz "
            f"{f'{gap:.2f} s at {at:.0f} s':>18} {late:>10}"
        )
        for fact in role.facts:
            click.echo(f"    {fact}")
        for problem in role.problems:
            click.echo(click.style(f"  ! {problem}", fg="yellow"))
    click.echo(f"frames known from the base: {', '.join(found.frames) or 'none'}")
    if found.others:
        shown = ", ".join(f"{t} ({n})" for t, _, n in found.others[:12])
        click.echo(f"not used: {shown}{f' and {len(found.others) - 12} more' if len(found.others) > 12 else ''}")
    for reason, n in sorted(found.skipped.items()):
        click.echo(f"would skip {n}: {reason}")
    for note in found.notes:
        click.echo(f"note: {note}")
    if found.blockers:
        raise InputError("`map` cannot run: " + "; ".join(found.blockers))
    more = " and the options that were given here" if any(words.values()) or config_file else ""
    click.echo(f"`topograph map {shlex.join(map(str, bags))}` can run{more}")


LONG_S = 100.0
"""Distances of clocks beyond are told in days."""


EXTRAS = {
    "thesis": ("open3d",),
    "exchange": ("geopandas", "pyarrow", "laspy", "lazrs", "rasterio", "smfeval"),
    "rerun": ("rerun",),
}
"""Extra -> modules that it brings; none is needed to map, localize, inspect, view or export to GeoJSON, CSV, KML, GraphML, TUM, PLY, PCD."""


@main.command()
def doctor() -> None:
    """Check this installation: libraries, compiler, a small map made and read back. Exit 1: something is missing."""
    checks: list[tuple[str, Callable[[], str]]] = [
        ("python and libraries", lambda: ", ".join(f"{k} {v}" for k, v in versions().items())),
        ("bags (rosbags, mcap, lz4)", _bags),
        ("front end (numba)", _front_end),
        ("graph and map file (gtsam, SQLite)", _whole_way),
        ("results folder", _writable),
    ]
    bad = 0
    for name, check in checks:
        try:
            click.echo(f"{click.style('✓', fg='green')} {name}: {check()}")
        except Exception as err:  # noqa: BLE001  # whatever is wrong with an installation is what is asked for
            bad += 1
            click.echo(f"{click.style('✗', fg='red')} {name}: {type(err).__name__}: {err}")
    for extra, needs in EXTRAS.items():
        missing = [n for n in needs if find_spec(n) is None]
        if missing:
            click.echo(f"- without {', '.join(missing)} (pip install 'topograph[{extra}]')")
    if bad:
        click.echo(
            "reinstall in a fresh environment: python3.11 -m venv .venv && .venv/bin/pip install topograph", err=True
        )
        sys.exit(1)


@main.command()
def warm() -> None:
    """Compile ahead what the first run would compile: about 40 s, once after an installation."""
    import tempfile
    import time

    from topograph import pipeline, store
    from topograph.config import Config
    from topograph.simulate import DriveConfig, SensorConfig, record

    began = time.perf_counter()
    config = Config()
    with tempfile.TemporaryDirectory() as folder:
        bag, path = Path(folder) / "run.bag", Path(folder) / "map.gpkg"
        record(bag, 1, "grid", DriveConfig(longest_s=6.0), SensorConfig(columns=900))
        solved = pipeline.solve_run(pipeline.read_run([bag], config), config)
        store.save(pipeline.topo_map(solved, config, {}), path)
        pipeline.localize_bags(store.load(path), [bag], config)
    click.echo(f"compiled: {time.perf_counter() - began:.0f} s")


def _front_end() -> str:
    import time

    from topograph.trunks.detector import warm_up

    began = time.perf_counter()
    warm_up()
    return f"compiled and run ({time.perf_counter() - began:.1f} s; the first run of an installation compiles)"


def _whole_way() -> str:
    import tempfile

    from topograph import pipeline, store
    from topograph.config import Config
    from topograph.simulate import DriveConfig, SensorConfig, record

    with tempfile.TemporaryDirectory() as folder:
        bag, path = Path(folder) / "run", Path(folder) / "map.gpkg"
        record(bag, 1, "grid", DriveConfig(longest_s=20.0), SensorConfig(detections=True))
        config = Config()
        run = pipeline.read_run([bag], config)
        topo = pipeline.topo_map(pipeline.solve_run(run, config), config, {})
        store.save(topo, path)
        again = store.load(path)
        if not len(again) or len(again) != len(topo):
            raise RuntimeError(f"a map of {len(topo)} trees is read back with {len(again)}")
    return f"{len(topo)} trees of a simulated run of 20 s were mapped, written and read back"


def _bags() -> str:
    import tempfile

    import numpy as np

    from topograph.bags import Recording
    from topograph.bags.writer import BagWriter

    with tempfile.TemporaryDirectory() as folder:
        for name, compression in (("a.bag", "lz4"), ("b", "zstd")):
            path = Path(folder) / name
            with BagWriter(path, compression) as w:
                w.imu("/imu", 10**18, 10**18, "imu", np.zeros(3), np.ones(3))
            with Recording([path]) as r:
                if len(list(r.messages())) != 1:
                    raise RuntimeError(f"a message written to {name} is not read back")
    return "ROS 1 with lz4 and mcap with zstd are written and read back"


def _writable() -> str:
    import os
    import shutil

    if not os.access(Path.cwd(), os.W_OK):
        raise RuntimeError(f"{Path.cwd()} cannot be written to: name --results and -o elsewhere")
    return f"{shutil.disk_usage(Path.cwd()).free / 1e9:.0f} GB free"
