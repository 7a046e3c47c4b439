"""`topograph live`."""

from __future__ import annotations

import os
import shlex
import sys
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import click
import numpy as np

from topograph.cli.common import (
    TRUTH,
    check_accepted,
    check_target,
    config_of,
    hashed,
    input_options,
    main,
    progress_bar,
    results_folder,
    say_if_cold,
    span_options,
    table,
    truth_of,
)
from topograph.cli.results import save_results, say_verdict
from topograph.errors import InputError, TopographError, UsageError


@main.command()
@click.argument("bags", nargs=-1, required=True, type=click.Path(path_type=Path), metavar="BAG... [MAP]")
@click.option(
    "-o", "--output", type=click.Path(path_type=Path), help="The map file (.gpkg) that is written at the end."
)
@click.option("--force", is_flag=True, help="Replace the map file of -o if it is there.")
@click.option("--speed", type=click.FloatRange(0.0), default=0.0, show_default=True,
              help="Times the recording's own pace; 0: as fast as it goes.")  # fmt: skip
@click.option("--every", type=click.FloatRange(0.0), default=1.0, show_default=True,
              help="Say what is known every so many seconds of the recording.")  # fmt: skip
@click.option("--accept", multiple=True, metavar="NAME", help="Save the map though the audit refuses it for NAME.")
@span_options
@click.option("--results", type=click.Path(path_type=Path), help="Folder for path, report and configuration.")
@click.option("--truth", multiple=True, type=click.Path(path_type=Path), help=TRUTH)
@click.option("-q", "--quiet", is_flag=True, help="Say nothing on the way.")
@input_options
def live(
    bags: tuple[Path, ...], output: Path | None, force: bool, speed: float, every: float, accept: tuple[str, ...], from_s: float,
    to_s: float, results: Path | None, truth: tuple[Path, ...], quiet: bool, config_file: Path | None, **words: Any,
) -> None:  # fmt: skip
    """Play BAG as if it were driven now: without a MAP (.gpkg) it maps, with one it localizes in it. At the end the map, of this run or
    of MAP with this run in it, is written to -o; MAP itself stays as it is. Ctrl-C ends the drive there, and the map is made.

    What comes is kept in a journal beside the map until that is written: a run that was cut short is mapped by `topograph live X.gpkg.journal
    -o Y.gpkg`, but for its last half second.

    One line a second says where the robot is and which trees there are. GNSS is taken in when it comes.
    """
    from topograph import pipeline, store

    maps = [b for b in bags if b.suffix == ".gpkg"]
    paths = tuple(b for b in bags if b.suffix != ".gpkg")
    if len(maps) > 1 or not paths:
        raise UsageError("give one run's BAGs, and at most one MAP (.gpkg) to localize in")
    if not 0.0 <= from_s < to_s:
        raise UsageError(f"--from {from_s} --to {to_s}: nothing lies between")
    check_accepted(accept)
    if output is not None and output.exists() and not force:
        raise UsageError(f"{output}: is there already; --force replaces it")
    config, true = config_of(config_file, words), truth_of(truth)
    say_if_cold(quiet)
    said = [-np.inf]

    def say(s: Any) -> None:
        now = s.stamp_ns * 1e-9
        if quiet or now - said[0] < every:
            return
        said[0] = now
        try:
            click.echo(line(s))
        except BrokenPipeError:  # whoever listened has gone; the map is still wanted
            said[0] = np.inf
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())

    with ExitStack() as stack:
        folder = stack.enter_context(results_folder(results))
        target = output or folder / "map.gpkg"
        check_target(target)
        stack.enter_context(store.locked(target))
        journal = None if paths[0].suffix == pipeline.JOURNAL else target.with_name(target.name + pipeline.JOURNAL)
        if journal is not None and journal.exists():
            raise UsageError(f"{journal}: a run was cut short here; `{_rescue(journal)}` makes its map; then remove it")
        if journal is None:
            _same_map(paths[0], maps)
        elif not quiet:
            click.echo(f"what comes is kept in {journal} until the map is written", err=True)
        old = store.load(maps[0]) if maps else None
        inputs = stack.enter_context(hashed(paths))
        about = {"map": str(maps[0].resolve())} if maps else {}
        try:
            played = pipeline.play(
                paths, config, old, speed=speed, say=say, span_s=(from_s, to_s), journal=journal, about=about
            )
            assert played.solved is not None
            with progress_bar(quiet=True) as progress:
                topo, verdict = save_results(
                    played.solved, config, inputs, paths, folder, target, true, old, progress, accept
                )
        except TopographError:  # what was played is there, and would end the same
            if journal is not None:
                journal.unlink(missing_ok=True)
            raise
        except BaseException:
            if journal is not None and journal.exists():
                click.echo(f"topograph: cut short; `{_rescue(journal)}` makes the map of what came", err=True)
            raise
        if journal is not None:
            journal.unlink(missing_ok=True)
    table(pipeline.live_metrics(played, true))
    say_verdict(played.solved, topo, verdict, folder, target, [*played.notes, *played.solved.run.notes])


def _rescue(journal: Path) -> str:
    """The command that makes the map of a journal."""
    from topograph.session import Journaled

    try:
        old = Journaled(journal).about.get("map")
    except InputError:  # begun, and no more
        old = None
    target = journal.with_name(journal.name.removesuffix(".gpkg.journal") + "_rescued.gpkg")
    return shlex.join(["topograph", "live", str(journal), *([old] if old else []), "-o", str(target)])


def _same_map(journal: Path, maps: Sequence[Path]) -> None:
    """Raise UsageError where a run was driven in a map that is not given now."""
    from topograph.session import Journaled

    old = Journaled(journal).about.get("map")
    if old and not maps:
        raise UsageError(f"{journal}: was driven in a map: {_rescue(journal)}")


def line(s: Any) -> str:
    """One line of what is known."""
    clock = f"{s.stamp_ns // 10**9}.{s.stamp_ns % 10**9 // 10**8}"
    trees = f"{s.trees} trees" if s.solved_ns or s.trees else "no trees yet"
    if s.map_T_robot is None:
        return f"{clock}  {s.state:<9} no pose; {trees}"
    x, y = s.map_T_robot[:2, 3]
    yaw = np.degrees(np.arctan2(s.map_T_robot[1, 0], s.map_T_robot[0, 0]))
    frame = "ENU" if s.georeferenced else "local"
    return f"{clock}  {s.state:<9} {x:8.2f} {y:8.2f} m ± {100 * s.sigma:.0f} cm  {yaw:6.1f}°  {frame}; {trees}"
