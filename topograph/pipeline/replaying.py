"""A bag, or the journal of a run that was cut short, played through `Live` as if it were driven now."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from topograph.bags import Fix, Heading, Imu, Odometry, Recording, Trunks
from topograph.config import Config
from topograph.errors import InsufficientDataError, UsageError
from topograph.evaluate import Metric, Truth
from topograph.geometry import Array, interpolate
from topograph.mapping import Mapper, Progress, Solved, silent
from topograph.motion import Reckoner
from topograph.pipeline.living import Live, State
from topograph.pipeline.mapping import mapping_config
from topograph.pipeline.read import WHOLE, child_mount, refuse_damaged, stream
from topograph.session import Journal, Journaled
from topograph.topomap import TopoMap


@dataclass(slots=True)
class Played:
    """A run that was played live: its states, and what it ended with."""

    states: list[State] = field(default_factory=list)
    solved: Solved | None = None
    notes: list[str] = field(default_factory=list)
    seconds: dict[str, float] = field(default_factory=dict)


@dataclass(slots=True, kw_only=True)
class _Source:
    """What is played: messages in the order of their coming, the mountings of their frames, and what is said of it at the end.

    `check` raises where too much of it could not be read.
    """

    messages: Iterator[Trunks | Odometry | Imu | Fix | Heading]
    find: Callable[[str], Array | None]
    mount: Callable[[str, str], Array | None]
    chosen: dict[str, str]
    start_ns: int
    skipped: Counter[str]
    notes: Callable[[], list[str]]
    check: Callable[[], None]


def play(
    paths: Sequence[Path],
    config: Config,
    topo: TopoMap | None = None,
    *,
    speed: float = 0.0,
    say: Callable[[State], None] = lambda _: None,
    progress: Progress = silent,
    span_s: tuple[float, float] = WHOLE,
    journal: Path | None = None,
    about: dict[str, str] | None = None,
) -> Played:
    """Play bags, or one journal, at `speed` times the recording's own pace (0: as fast as it goes), and `say` what is known after each
    scan. `journal`: a file that is begun for what comes, with facts `about` it; it stays there.

    Raises:
        InsufficientDataError: no scan, or a run that does not determine its path.
    """
    out = Played()
    began = time.perf_counter()
    with _opened(paths, config, progress, span_s) as source, ExitStack() as stack:
        kept: Journal | None = None
        if journal is not None:
            kept = Journal(
                journal, start_ns=source.start_ns, chosen=source.chosen, find=source.find, mount=source.mount, about=about
            )  # fmt: skip
            stack.callback(kept.close)
        live: Live | None = None
        heard: list[Odometry | Imu | Fix | Heading] = []
        first_ns = 0
        try:
            for m in source.messages:
                if not isinstance(m, Trunks):
                    heard.append(m)
                    if kept is not None:
                        kept.hear(m)
                    continue
                if live is None:
                    live, first_ns = _begin(source, heard, config, topo, out.notes, speed > 0), m.stamp_ns
                if speed > 0:
                    ahead = (m.stamp_ns - first_ns) * 1e-9 / speed - (time.perf_counter() - began)
                    time.sleep(max(ahead, 0.0))
                if kept is not None:
                    kept.see(m)
                state = live.process(m, heard)
                heard = []
                out.states.append(state)
                say(state)
        except KeyboardInterrupt:
            out.notes.append("stopped by hand: what came until then is mapped")
        source.check()
        if live is None:
            raise InsufficientDataError("no scan in the recording (or in the part that was asked for)")
        live.mapper.hear(heard)
        live.mapper.skipped.update(source.skipped)
        out.notes += source.notes()
        if kept is not None and kept.broken:
            out.notes.append(kept.broken)
    out.seconds["play"] = time.perf_counter() - began
    progress("finish", 0.0)
    began = time.perf_counter()
    out.solved = live.finish()
    out.seconds["finish"] = time.perf_counter() - began
    progress("finish", 1.0)
    return out


@contextmanager
def _opened(
    paths: Sequence[Path], config: Config, progress: Progress, span_s: tuple[float, float]
) -> Iterator[_Source]:
    """The bags, or the one journal."""
    if any(p.suffix == JOURNAL for p in paths):
        if len(paths) > 1 or span_s != WHOLE:
            raise UsageError(f"{JOURNAL}: one journal at a time, and the whole of it")
        left = Journaled(paths[0])
        yield _Source(
            messages=left.messages(),
            find=left.find,
            mount=left.mount,
            chosen=left.chosen,
            start_ns=left.start_ns,
            skipped=Counter(),
            notes=lambda: ["made of the journal of a run that was cut short", *_torn(left)],
            check=lambda: None,
        )
        return
    with Recording(paths, config.bags) as recording:
        yield _Source(
            messages=stream(recording, config, progress, span_s),
            find=recording.frames.find,
            mount=recording.frames.of,
            chosen=dict(recording.chosen),
            start_ns=recording.start_ns,
            skipped=recording.skipped,
            notes=lambda: [*recording.notes, *recording.clocks.notes],
            check=lambda: refuse_damaged(recording, span_s != WHOLE),
        )


def _torn(left: Journaled) -> list[str]:
    return [f"{left.damaged} records of the journal are torn or damaged, and left out"] if left.damaged else []


JOURNAL = ".journal"
"""How a journal's name ends."""


def _begin(
    source: _Source,
    heard: Sequence[Odometry | Imu | Fix | Heading],
    config: Config,
    topo: TopoMap | None,
    notes: list[str],
    background: bool,
) -> Live:
    """A `Live` with the mountings that the source knows."""
    child = next((m.child_frame for m in heard if isinstance(m, Odometry)), config.bags.base_frame)
    imu = next((m.frame for m in heard if isinstance(m, Imu)), None)
    mount = None if imu is None else source.find(imu)
    mapper = Mapper(mapping_config(config), source.find, source.mount, source.chosen, source.start_ns)
    reckoner = Reckoner(child_mount(source.find, child, config, notes), None if mount is None else mount[:3, :3])
    return Live(mapper, config, reckoner, topo, background=background)


def live_metrics(played: Played, truth: Truth | None) -> list[Metric]:
    """What it took, and how far the poses were off as they were told."""
    states = played.states
    ms = 1e3 * np.array([s.seconds for s in states])
    span = (states[-1].stamp_ns - states[0].stamp_ns) * 1e-9
    told = [s for s in states if s.map_T_robot is not None]
    out = [
        Metric("live: scans with a pose", len(told) / len(states), "", "higher"),
        Metric("live: a scan, 99 %", float(np.percentile(ms, 99)), "ms", "lower"),
        Metric("live: solves' share of a core", sum(s.solve_s for s in states) / max(span, 1e-9), "", "lower"),
    ]
    placed = [s for s in told if s.georeferenced]
    if truth is None or truth.datum is None or not placed:
        return out
    true = interpolate(truth.stamps_ns, truth.world_T_robot, np.array([s.stamp_ns for s in placed], np.int64))
    world = truth.datum.to_geodetic(true[:, :3, 3])
    at = np.array([s.datum.to_enu(g[None])[0] for s, g in zip(placed, world, strict=True) if s.datum is not None])
    found = np.array([s.map_T_robot[:3, 3] for s in placed if s.map_T_robot is not None])
    off = np.linalg.norm((found - at)[:, :2], axis=1)
    out.append(Metric("live: position error mean", float(off.mean()), "m", "lower"))
    out.append(Metric("live: position error 99 %", float(np.percentile(off, 99)), "m", "lower"))
    return out
