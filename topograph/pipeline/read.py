"""From bags to small streams and trunks, and single scans to draw."""

from __future__ import annotations

import logging
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from itertools import pairwise
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from topograph.bags import (
    DAMAGED,
    EMPTY,
    INFINITE,
    UNDECODED,
    Fix,
    Heading,
    Imu,
    Odometry,
    Product,
    Recording,
    Scan,
    Trunks,
)
from topograph.config import Config
from topograph.errors import InputError
from topograph.geometry import Array, inverse
from topograph.mapping import Progress, silent
from topograph.motion import LidarOdometry
from topograph.session import Scans, ScansBuilder, Session, Streams, StreamsBuilder, unknown_mounts
from topograph.trunks import from_recorded

if TYPE_CHECKING:
    from topograph.trunks.frontend import FrontEnd

log = logging.getLogger(__name__)

WHOLE = (0.0, float("inf"))


def stream(
    recording: Recording, config: Config, progress: Progress = silent, span_s: tuple[float, float] = WHOLE
) -> Iterator[Trunks | Imu | Odometry | Fix | Heading]:
    """The small messages as they come, and the trunks of each scan as soon as the motion during it is known.

    Only what was recorded within `span_s` (from, to) seconds of the recording's start is read.
    """
    front_end = _front_end(recording, config)
    pending: list[tuple[int, Scan]] = []
    seen: set[int] = set()
    expected = max(1, sum(recording.counts[t] for t in recording.chosen.values()))
    for n, (kind, product) in enumerate(
        _moved(recording, config, recording.messages(window_ns=_window(recording, span_s)))
    ):
        if n % 200 == 0:
            progress("read", n / expected)
        if isinstance(product, (Scan, Trunks)):
            if product.stamp_ns in seen:
                recording.skipped[f"{kind}: repeated stamp"] += 1
                continue
            seen.add(product.stamp_ns)
        if isinstance(product, Scan):
            pending.append((recording.log_ns, product))
        elif isinstance(product, Trunks):
            yield from_recorded(product, recording.frames.get(product.frame), config.trunks)
        else:
            if isinstance(product, (Odometry, Imu)):
                front_end.hear(product)
            yield product
        while pending and recording.log_ns > pending[0][0] + WAIT_NS:
            yield from _careful(front_end, pending.pop(0)[1], recording.skipped)
    for _, scan in pending:
        yield from _careful(front_end, scan, recording.skipped)
    recording.untimed += front_end.untimed
    recording.notes += front_end.notes
    progress("read", 1.0)


def _moved(
    recording: Recording, config: Config, messages: Iterator[tuple[str, Product]]
) -> Iterator[tuple[str, Product]]:
    """The messages, with the motion that the point clouds tell before each of them where wheels are not to."""
    if not recording.moved_by_lidar:
        yield from messages
        return
    odometry = LidarOdometry(recording.frames.get, config.bags.base_frame)
    recording.notes.append("the motion is that of the point clouds (KISS-ICP), not of wheels")
    for kind, product in messages:
        step = odometry.step(product) if isinstance(product, Scan) else None
        if step is not None:
            yield "odometry", step
        yield kind, product


BROKE = "the front end failed on it"
WAIT_NS = 250_000_000
"""After a scan was recorded, its motion has been too: wheels and IMU are late by less."""


def _window(recording: Recording, span_s: tuple[float, float]) -> tuple[int, int] | None:
    """Times of recording (from, to), ns."""
    if span_s == WHOLE:
        return None
    start, stop = (int(min(s, recording.duration_s + 1.0) * 1e9) for s in span_s)
    if span_s[0] >= recording.duration_s:
        raise InputError(
            f"the recording is {recording.duration_s:.0f} s long: nothing lies behind --from {span_s[0]:.0f}"
        )
    return recording.start_ns + start, recording.start_ns + stop


def _careful(front_end: FrontEnd, scan: Scan, skipped: Counter[str]) -> Iterator[Trunks]:
    """The trunks of one scan; one that breaks the front end is counted and does not end the run."""
    try:
        yield front_end.see(scan)
    except (ArithmeticError, ValueError, IndexError, np.linalg.LinAlgError) as err:
        skipped[f"points: {BROKE}"] += 1
        log.warning("the scan of %.3f s broke the front end: %r", scan.stamp_ns * 1e-9, err)


@dataclass(frozen=True, slots=True)
class Heard:
    """A run that was read, and what a localizer hears of it, in the order of the stream."""

    session: Session
    messages: list[Trunks | Imu | Odometry]


def hear(paths: Sequence[Path], config: Config, progress: Progress = silent) -> Heard:
    """Read and detect a run once, to be mapped and localized in many ways. Raises as `read_run`."""
    messages: list[Trunks | Imu | Odometry] = []
    session = read_run(paths, config, progress, keep=messages)
    scans = iter(session.trunks)  # in the order of the stream: the same trunks on the columns' memory
    for k, m in enumerate(messages):
        if isinstance(m, Trunks):
            messages[k] = next(scans)
    return Heard(session, messages)


def read_run(
    paths: Sequence[Path],
    config: Config,
    progress: Progress = silent,
    span_s: tuple[float, float] = WHOLE,
    jobs: int = 1,
    keep: list[Trunks | Imu | Odometry] | None = None,
) -> Session:
    """Read a run (or `span_s` of it) once: small streams into arrays, scans into trunks as they come.

    With several `jobs`, each process detects in its part of the recording; the result is the same, bit for bit. What a localizer would
    hear is appended to `keep`.

    Raises:
        InputError: nothing usable in the bags.
        FrameError: the LiDAR's frame is not known.
    """
    began = time.perf_counter()
    notes: list[str] = []
    with Recording(paths, config.bags) as recording:
        builder = StreamsBuilder()
        if jobs > 1 and "points" in recording.chosen and span_s == WHOLE and not recording.moved_by_lidar:
            found = _in_parts(recording, config, jobs, builder, progress)
            if found is None:
                return read_run(paths, config, progress, span_s)
            trunks = found
        else:
            scans = ScansBuilder()
            for product in stream(recording, config, progress, span_s):
                if keep is not None and isinstance(product, (Trunks, Imu, Odometry)):
                    keep.append(product)
                if isinstance(product, Trunks):
                    scans.add(product)
                else:
                    builder.add(product)
            trunks = scans.build()
        refuse_damaged(recording, span_s != WHOLE)
        notes += _undecoded(recording)
        notes += [*recording.notes, *recording.clocks.notes]
        streams = builder.build(recording.skipped)
        mounts: dict[str, Array | None] = {
            k: recording.frames.of(k, streams.frames[k]) for k in ("imu", "fix", "heading") if k in streams.frames
        }
        notes += unknown_mounts(streams, mounts)
        if recording.untimed > UNTIMED * max(len(trunks), 1):
            notes.append(_smear(streams, trunks))
        child_T_robot = child_mount(recording.frames.find, streams.frames.get("child", ""), config, notes)
        skipped = recording.skipped
        announced = {
            k: recording.given[k] if span_s != WHOLE else recording.counts[t] for k, t in recording.chosen.items()
        }
        chosen, duration, start_ns = dict(recording.chosen), recording.duration_s, recording.start_ns
    return Session(
        streams=streams,
        trunks=trunks,
        mounts=mounts,
        child_T_robot=child_T_robot,
        chosen=chosen,
        skipped=skipped,
        notes=notes,
        scans=len(trunks),
        seconds=time.perf_counter() - began,
        duration_s=duration,
        start_ns=start_ns,
        announced=announced,
    )


MOST_DAMAGED = 0.2
"""Share of a needed stream that may be damaged."""


def refuse_damaged(recording: Recording, part: bool = False) -> None:
    """Raise InputError where a needed stream is mostly damaged: what is left of it would pass for the whole. Of a `part` of a recording
    those count that lie in it.
    """
    for kind in ("points", "trunks", "odometry"):
        topic = recording.chosen.get(kind)
        bad = sum(recording.skipped.get(f"{kind}: {why}", 0) for why in (DAMAGED, UNDECODED, BROKE, INFINITE, EMPTY))
        if topic is None:
            continue
        of = recording.given[kind] if part else recording.counts[topic]
        if bad <= MOST_DAMAGED * of:
            continue
        why = recording.undecoded.get(
            kind, "the file is damaged; restore a copy of it, or cut the sound part out with --from and --to"
        )
        what = {k.partition(": ")[2] for k in recording.skipped if k.startswith(f"{kind}: ")} & {INFINITE, EMPTY}
        if what:
            why = f"{', '.join(sorted(what))}: the sensor or its driver is at fault; cut the sound part out with --from and --to"
        raise InputError(f"{topic}: {bad} of {of} messages cannot be used ({why})")


def _undecoded(recording: Recording) -> list[str]:
    """What to say of streams whose messages could not be decoded or held no number."""
    out = []
    for kind, topic in recording.chosen.items():
        bad = sum(recording.skipped.get(f"{kind}: {why}", 0) for why in (UNDECODED, INFINITE, EMPTY))
        if bad:
            why = recording.undecoded.get(kind, "no finite number in them")
            out.append(f"{topic}: {bad} of {recording.given[kind]} messages cannot be used ({why})")
    return out


UNTIMED = 0.02
"""Share of sweeps without times that is worth a word."""


def _smear(streams: Streams, trunks: Scans) -> str:
    """By how many centimetres it matters that points have no time."""
    period = float(np.median(np.diff(trunks.stamps_ns))) * 1e-9 if len(trunks) > 1 else 0.1
    period = min(period, 0.2)
    speed, rate = np.zeros(1), np.zeros(1)
    if len(streams.odometry_ns):
        speed, rate = np.abs(streams.twist[:, 0]), np.abs(streams.twist[:, 5])
    moved, turned = (float(np.percentile(v, 90)) * period for v in (speed, rate))
    return (
        f"no time per point: sweeps are not deskewed, and trunks may be {100 * moved:.0f} cm off while driving "
        f"and {100 * 10 * turned:.0f} cm at 10 m in turns (motion within one sweep)"
    )


_LAG_NS = 2_000_000_000
"""A message is recorded at most this long after its stamp, or it is of no use to a scan of another part."""


@dataclass(slots=True, kw_only=True)
class _Part:
    """Trunks of the scans that were recorded within one part of a recording, and the account of its point clouds."""

    trunks: Scans
    skipped: Counter[str]
    given: int
    undecoded: dict[str, str]
    clocks: list[str]
    untimed: int
    notes: list[str]


def _in_parts(
    recording: Recording, config: Config, jobs: int, builder: StreamsBuilder, progress: Progress
) -> Scans | None:
    """Trunks of all scans, by several processes; the small streams go into `builder` meanwhile. None where clocks need mending: that
    is told from the whole recording, not from parts.
    """
    edges = np.linspace(recording.start_ns, recording.start_ns + int(recording.duration_s * 1e9) + 1, jobs + 1)
    edges = edges.astype(np.int64)
    parts: list[_Part] = []
    # Fresh processes: a fork would inherit the locks of the libraries' threads.
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
        waiting = [
            pool.submit(_detect_part, recording.paths, config, int(a), int(b) + (b == edges[-1]))
            for a, b in pairwise(edges)
        ]
        for _, product in recording.messages(("odometry", "imu", "fix", "heading")):
            assert not isinstance(product, (Scan, Trunks))
            builder.add(product)
        for n, waited in enumerate(waiting):
            parts.append(waited.result())
            progress("read", (n + 1) / jobs)
    if recording.clocks.notes or any(p.clocks for p in parts):
        return None
    for part in parts:
        recording.skipped.update(part.skipped)
        recording.undecoded.update(part.undecoded)
        recording.untimed += part.untimed
        recording.notes += [n for n in part.notes if n not in recording.notes]
        recording.given["points"] += part.given
    recording.count_missing(recording.chosen["points"], "points")
    return Scans.joined([part.trunks for part in parts])


def _detect_part(paths: Sequence[Path], config: Config, start_ns: int, stop_ns: int) -> _Part:
    """The scans recorded from `start_ns` until before `stop_ns`."""
    out = ScansBuilder()
    with Recording(paths, config.bags) as recording:
        front_end = _front_end(recording, config)
        pending: list[tuple[int, Scan]] = []
        seen: set[int] = set()
        window = (max(start_ns - _LAG_NS, recording.start_ns), stop_ns + _LAG_NS)
        recording.count_within = (start_ns, stop_ns)
        for _, product in recording.messages(("points", "odometry", "imu"), window):
            if isinstance(product, Scan):
                repeated = product.stamp_ns in seen
                seen.add(product.stamp_ns)
                if start_ns <= recording.log_ns < stop_ns:
                    if repeated:
                        recording.skipped["points: repeated stamp"] += 1
                    else:
                        pending.append((recording.log_ns, product))
            elif isinstance(product, (Imu, Odometry)):
                front_end.hear(product)
            while pending and recording.log_ns > pending[0][0] + WAIT_NS:
                out.extend(_careful(front_end, pending.pop(0)[1], recording.skipped))
        for _, scan in pending:
            out.extend(_careful(front_end, scan, recording.skipped))
        given = recording.given["points"]
        skipped = Counter({k: v for k, v in recording.skipped.items() if k.startswith("points")})
        return _Part(
            trunks=out.build(),
            skipped=skipped,
            given=given,
            undecoded=recording.undecoded,
            clocks=recording.clocks.notes,
            untimed=front_end.untimed,
            notes=front_end.notes,
        )


def child_mount(find: Callable[[str], Array | None], child: str, config: Config, notes: list[str]) -> Array:
    """`child_T_robot` (4, 4) of odometry's child frame; the identity, with a note, when TF does not know it."""
    base_T_child = find(child)
    if base_T_child is None:
        notes.append(f"odometry's frame {child!r} is not in TF: taken as {config.bags.base_frame!r}")
        base_T_child = np.eye(4)
    return inverse(base_T_child)


def _front_end(recording: Recording, config: Config) -> FrontEnd:
    """The front end with the mountings that the recording knows."""
    from topograph.trunks.frontend import FrontEnd

    return FrontEnd(
        recording.frames.get, recording.frames.find, config.trunks, config.thesis_trunks, recording.frames.all
    )


def scan_near(paths: Sequence[Path], config: Config, stamp_ns: int) -> tuple[Scan, Array]:
    """The scan nearest to a stamp, and the LiDAR's mounting."""
    with Recording(paths, config.bags) as recording:
        best: Scan | None = None
        for _, m in recording.messages(["points"]):
            assert isinstance(m, Scan)
            if best is None or abs(m.stamp_ns - stamp_ns) < abs(best.stamp_ns - stamp_ns):
                best = m
            elif m.stamp_ns > stamp_ns:
                break
        if best is None:
            raise InputError("no point cloud to draw: the recording holds trunk detections only")
        mount = recording.frames.get(best.frame)
    return best, mount
