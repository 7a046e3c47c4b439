"""The library in a few words: recordings to a map, a map and recordings to poses."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from topograph import store
from topograph.config import Config
from topograph.errors import InsufficientDataError
from topograph.mapping import Progress, silent
from topograph.pipeline.auditing import audited
from topograph.pipeline.localizing import Replay
from topograph.pipeline.localizing import localize_bags as _localize
from topograph.pipeline.mapping import extend, solve_run, topo_map, why_no_trees
from topograph.pipeline.placing import has_no_common_gnss, place, refuse_twice
from topograph.pipeline.read import read_run
from topograph.topomap import TopoMap


def map_bags(
    *bags: Path | str,
    config: Config | None = None,
    into: TopoMap | None = None,
    accept: Sequence[str] = (),
    progress: Progress = silent,
) -> TopoMap:
    """The map of one run's recordings, or `into` with the run put in. `meta["verdict"]` is the audit's word, `meta["why"]` its reasons.

    `accept`: findings that shall not refuse it (the names stand in the error).

    Raises:
        InputError: a recording cannot be read.
        InsufficientDataError: it has no trees, does not determine its path, or the audit refuses it.
    """
    config = config or Config()
    run = read_run([Path(b) for b in bags], config, progress)
    placed = None
    if into is not None:
        refuse_twice(into, run)
        placed = place(into, run, config, progress) if has_no_common_gnss(into, run) else None
    solved = solve_run(run, config, known=into, placed=placed, progress=progress)
    if why := why_no_trees(solved):
        raise InsufficientDataError(why)
    verdict = audited(solved).accepting(accept)
    if verdict.word == "refused":
        names = ", ".join(repr(f.name) for f in verdict.findings if f.refuses)
        raise InsufficientDataError(f"refused: {'; '.join(verdict.reasons)} (accept=[{names}] returns it all the same)")
    topo = topo_map(solved, config, {"verdict": verdict.word, "why": "; ".join(verdict.reasons)})
    return topo if into is None else extend(into, topo, solved, config)


def localize_bags(
    topo: TopoMap | Path | str,
    *bags: Path | str,
    config: Config | None = None,
    method: str = "graph",
    progress: Progress = silent,
) -> Replay:
    """Where the robot of a run was in a map, without GNSS: `fixes` are the poses that were committed, `reports` what was believed."""
    topo = topo if isinstance(topo, TopoMap) else load_map(topo)
    return _localize(topo, [Path(b) for b in bags], config or Config(), method, progress)


def load_map(path: Path | str, *, clouds: bool = True) -> TopoMap:
    """A map file; without `clouds` in a fraction of the time."""
    return store.load(path, clouds=clouds)


def save_map(topo: TopoMap, path: Path | str) -> None:
    """Write a map file, whole or not at all; waits for nobody: one writer at a time."""
    with store.locked(Path(path)):
        store.save(topo, Path(path))
